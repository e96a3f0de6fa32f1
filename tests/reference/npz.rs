//! Reads every numeric array of an .npz archive as f64, row-major.

use npyz::{Order, TypeStr, npz::NpzArchive};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;

pub struct Npz {
    name: String,
    arrays: BTreeMap<String, Array>,
}

#[derive(Clone, Debug)]
pub struct Array {
    pub shape: Vec<usize>,
    pub values: Vec<f64>,
}

impl Npz {
    pub fn open(path: &Path) -> Npz {
        let name = path.display().to_string();
        let file = File::open(path).unwrap_or_else(|error| panic!("{name}: {error}"));
        let mut archive =
            NpzArchive::new(BufReader::new(file)).unwrap_or_else(|error| panic!("{name}: {error}"));
        let names: Vec<String> = archive.array_names().map(str::to_string).collect();
        let mut arrays = BTreeMap::new();
        for array in names {
            let file = archive
                .by_name(&array)
                .unwrap_or_else(|error| panic!("{name}: {array}: {error}"));
            let file = file.unwrap_or_else(|| panic!("{name}: {array} has vanished"));
            if let Some(values) = read(file) {
                arrays.insert(array, values);
            }
        }
        Npz { name, arrays }
    }

    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.arrays.keys().map(String::as_str)
    }

    pub fn find(&self, array: &str) -> Option<&Array> {
        self.arrays.get(array)
    }

    pub fn array(&self, array: &str) -> &Array {
        self.find(array)
            .unwrap_or_else(|| panic!("{}: no array {array}", self.name))
    }

    pub fn values(&self, array: &str) -> &[f64] {
        &self.array(array).values
    }

    pub fn shape(&self, array: &str) -> &[usize] {
        &self.array(array).shape
    }

    pub fn scalar(&self, array: &str) -> f64 {
        let values = self.values(array);
        assert_eq!(values.len(), 1, "{}: {array} is one number", self.name);
        values[0]
    }

    /// An array `[n, 3]` as points.
    pub fn vectors(&self, array: &str) -> Vec<[f64; 3]> {
        assert_eq!(
            self.shape(array).last(),
            Some(&3),
            "{}: {array} holds vectors",
            self.name
        );
        self.values(array)
            .chunks_exact(3)
            .map(|v| [v[0], v[1], v[2]])
            .collect()
    }
}

/// None for what is not numbers.
fn read<R: Read>(file: npyz::NpyFile<R>) -> Option<Array> {
    use npyz::TypeChar::{Bool, Float, Int, Uint};
    let shape: Vec<usize> = file.shape().iter().map(|&n| n as usize).collect();
    let order = file.order();
    let npyz::DType::Plain(kind) = file.dtype() else {
        return None;
    };
    let stored: Vec<f64> = match (type_char(&kind), kind.num_bytes()?) {
        (Float, 8) => file.into_vec::<f64>().ok()?,
        (Float, 4) => file
            .into_vec::<f32>()
            .ok()?
            .into_iter()
            .map(f64::from)
            .collect(),
        (Int, 8) => file
            .into_vec::<i64>()
            .ok()?
            .into_iter()
            .map(|x| x as f64)
            .collect(),
        (Int, 4) => file
            .into_vec::<i32>()
            .ok()?
            .into_iter()
            .map(f64::from)
            .collect(),
        (Uint, 8) => file
            .into_vec::<u64>()
            .ok()?
            .into_iter()
            .map(|x| x as f64)
            .collect(),
        (Uint, 4) => file
            .into_vec::<u32>()
            .ok()?
            .into_iter()
            .map(f64::from)
            .collect(),
        (Uint, 1) => file
            .into_vec::<u8>()
            .ok()?
            .into_iter()
            .map(f64::from)
            .collect(),
        (Bool, 1) => file
            .into_vec::<bool>()
            .ok()?
            .into_iter()
            .map(|x| f64::from(u8::from(x)))
            .collect(),
        _ => return None,
    };
    let values = if order == Order::C || shape.len() < 2 {
        stored
    } else {
        row_major(&shape, &stored)
    };
    Some(Array { shape, values })
}

fn type_char(kind: &TypeStr) -> npyz::TypeChar {
    kind.type_char()
}

/// Column-major values, innermost axis last.
fn row_major(shape: &[usize], stored: &[f64]) -> Vec<f64> {
    (0..stored.len())
        .map(|mut i| {
            let index: Vec<usize> = shape.iter().rev().map(|n| (i % n, i /= n).0).collect();
            let at = shape
                .iter()
                .zip(index.iter().rev())
                .rev()
                .fold(0, |at, (n, index)| at * n + index);
            stored[at]
        })
        .collect()
}
