//! Arrays of numbers in NumPy's files: .npz archives of named arrays, and single ones as .npy.

use std::fs::File;
use std::io::{BufReader, Read};
use std::path::{Path, PathBuf};

use glam::{DMat4, DVec4};
use half::f16;
use npyz::{DType, NpyFile, Order, TypeChar};
use zip::ZipArchive;

use crate::{Error, Result};

/// How many times larger than its archive an array may be, beside what it is granted anyway: a small archive may hold more than memory
/// does. Measured numbers shrink to a tenth at best, equal ones to a thousandth.
const GROWTH: u64 = 32;

/// Bytes that arrays are granted: matrices, numbers, and flags such as whether a voxel was seen, which are mostly equal.
const MATRIX: u64 = 4 << 10;
const NUMBERS: u64 = 64 << 20;
const FLAGS: u64 = 1 << 30;

const NEXT: &str = "copy the file again, or write it anew with numpy.save or numpy.savez";

/// A file of arrays.
pub(crate) struct Arrays {
    file: PathBuf,
    source: Source,
}

enum Source {
    Archive {
        archive: ZipArchive<BufReader<File>>,
        size: u64,
    },
    Single(Vec<u8>),
}

/// Numbers in row-major order: the last index runs fastest.
pub(crate) struct Array<T> {
    pub shape: Vec<usize>,
    pub values: Vec<T>,
}

impl Arrays {
    /// Opens an .npz or .npy file.
    pub fn open(file: &Path) -> Result<Arrays> {
        let unreadable = |error| Error::unreadable(file, &error);
        let extension = file.extension().unwrap_or_default().to_ascii_lowercase();
        let source = match extension.to_str() {
            Some("npz") => {
                let open = File::open(file).map_err(unreadable)?;
                let size = open.metadata().map_err(unreadable)?.len();
                let archive = ZipArchive::new(BufReader::new(open)).map_err(|error| {
                    let what = format!("is no .npz archive ({size} bytes): {error}");
                    Error::input(file, what, NEXT)
                })?;
                Source::Archive { archive, size }
            }
            Some("npy") => Source::Single(std::fs::read(file).map_err(unreadable)?),
            Some("mat") => {
                return Err(Error::input(
                    file,
                    "is a MATLAB file, a format that is not read",
                    "convert it: python3 -c \"import sys, numpy, scipy.io; \
                     numpy.savez(sys.argv[2], **{k: v for k, v in scipy.io.loadmat(sys.argv[1]).items() if k[0] != '_'})\" IN.mat OUT.npz",
                ));
            }
            _ => {
                let what = "is neither an .npz nor an .npy file by its name";
                return Err(Error::input(file, what, "give a file of arrays by NumPy"));
            }
        };
        Ok(Arrays {
            file: file.to_path_buf(),
            source,
        })
    }

    /// The names of all arrays; a single one has none.
    pub fn names(&self) -> Vec<String> {
        match &self.source {
            Source::Archive { archive, .. } => archive
                .file_names()
                .filter_map(|name| Some(name.ok()?.strip_suffix(".npy")?.to_owned()))
                .collect(),
            Source::Single(_) => Vec::new(),
        }
    }

    /// The array `name` of an archive, or the only one of a single file.
    pub fn numbers(&mut self, name: &str) -> Result<Array<f64>> {
        self.read(name, NUMBERS, |number| number)
    }

    /// The same as truth values: whatever is not zero is true.
    pub fn flags(&mut self, name: &str) -> Result<Array<bool>> {
        self.read(name, FLAGS, |number| number != 0.0)
    }

    /// A matrix of four rows, or the upper three, of finite numbers.
    pub fn matrix(&mut self, name: &str) -> Result<DMat4> {
        let Array { shape, values } = self.read(name, MATRIX, |number| number)?;
        if shape != [4, 4] && shape != [3, 4] {
            let what = format!("{name} has the shape {shape:?}, not that of a 4x4 matrix");
            return Err(Error::input(&self.file, what, "export the cameras again"));
        }
        if let Some(at) = values.iter().position(|value| !value.is_finite()) {
            let what = format!(
                "{name} holds {} in row {}, column {}",
                values[at],
                at / 4,
                at % 4
            );
            return Err(Error::input(&self.file, what, "export the cameras again"));
        }
        let mut rows = [DVec4::X, DVec4::Y, DVec4::Z, DVec4::W];
        for (row, entries) in rows.iter_mut().zip(values.chunks(4)) {
            *row = DVec4::from_slice(entries);
        }
        Ok(DMat4::from_cols(rows[0], rows[1], rows[2], rows[3]).transpose())
    }

    fn read<T: Copy>(
        &mut self,
        name: &str,
        granted: u64,
        of: impl Fn(f64) -> T,
    ) -> Result<Array<T>> {
        let file = self.file.clone();
        let there = self.names();
        let bytes = match &mut self.source {
            Source::Single(bytes) => std::mem::take(bytes),
            Source::Archive { archive, size } => {
                let entry = archive.by_name(&format!("{name}.npy")).map_err(|error| {
                    let what = match there.iter().any(|other| other == name) {
                        true => format!("{name} cannot be read: {error}"),
                        false => format!("holds no {name}; there are: {}", there.join(", ")),
                    };
                    Error::input(&file, what, "give the file that has it")
                })?;
                let mut bytes = Vec::new();
                let most = granted.saturating_add(size.saturating_mul(GROWTH));
                entry
                    .take(most.saturating_add(1))
                    .read_to_end(&mut bytes)
                    .map_err(|error| {
                        Error::input(&file, format!("{name} cannot be read: {error}"), NEXT)
                    })?;
                if bytes.len() as u64 > most {
                    let what =
                        format!("{name} has more than {most} bytes, in an archive of {size}");
                    let next = "if it is meant to be that large, write it anew with numpy.savez, which does not compress";
                    return Err(Error::input(&file, what, next));
                }
                bytes
            }
        };
        let read = decode(&bytes, of);
        if let Source::Single(kept) = &mut self.source {
            *kept = bytes;
        }
        read.map_err(|what| Error::input(&file, format!("{name} {what}"), NEXT))
    }
}

/// The array in the bytes of an .npy file, or what is wrong with it.
fn decode<T: Copy>(bytes: &[u8], of: impl Fn(f64) -> T) -> Result<Array<T>, String> {
    // From version 2 on a header may state a length of up to 4 GiB, which would be allocated before it is read.
    if let [_, _, _, _, _, _, 2..=u8::MAX, _, length @ ..] = bytes
        && let Some(length) = length.first_chunk()
        && u32::from_le_bytes(*length) as usize > bytes.len()
    {
        return Err("ends within its header".into());
    }
    let array = NpyFile::new(bytes).map_err(|error| format!("is no array by NumPy: {error}"))?;
    let shape: Vec<usize> = array
        .shape()
        .iter()
        .map(|&side| usize::try_from(side).unwrap_or(usize::MAX))
        .collect();
    let DType::Plain(kind) = array.dtype() else {
        return Err("holds records, not numbers".into());
    };
    let size = kind.num_bytes().unwrap_or(0);
    let count = shape
        .iter()
        .try_fold(1usize, |count, &side| count.checked_mul(side));
    let whole = count
        .and_then(|count| count.checked_mul(size))
        .is_some_and(|needed| needed <= bytes.len());
    if !whole {
        return Err(format!(
            "says that its shape is {shape:?}, but has only {} bytes",
            bytes.len()
        ));
    }
    let order = array.order();
    macro_rules! values {
        ($number:ty, $as_f64:expr) => {
            array
                .data::<$number>()
                .map_err(|error| error.to_string())?
                .map(|value| value.map(|value| of($as_f64(value))))
                .collect::<std::io::Result<Vec<T>>>()
        };
    }
    let values = match (kind.type_char(), size) {
        (TypeChar::Float, 8) => values!(f64, |x| x),
        (TypeChar::Float, 4) => values!(f32, f64::from),
        (TypeChar::Float, 2) => values!(f16, f64::from),
        (TypeChar::Int, 8) => values!(i64, |x| x as f64),
        (TypeChar::Int, 4) => values!(i32, f64::from),
        (TypeChar::Int, 2) => values!(i16, f64::from),
        (TypeChar::Int, 1) => values!(i8, f64::from),
        (TypeChar::Uint, 8) => values!(u64, |x| x as f64),
        (TypeChar::Uint, 4) => values!(u32, f64::from),
        (TypeChar::Uint, 2) => values!(u16, f64::from),
        (TypeChar::Uint, 1) => values!(u8, f64::from),
        (TypeChar::Bool, 1) => values!(bool, |x| f64::from(u8::from(x))),
        _ => return Err(format!("holds {kind}, not real numbers")),
    };
    let mut values = values.map_err(|error| format!("ends early: {error}"))?;
    if order == Order::Fortran && shape.len() > 1 {
        values = row_major(&shape, &values);
    }
    Ok(Array { shape, values })
}

/// What is stored with the first index running fastest, as MATLAB has it, with the last one fastest.
fn row_major<T: Copy>(shape: &[usize], stored: &[T]) -> Vec<T> {
    let strides: Vec<usize> = shape
        .iter()
        .scan(1, |stride, side| {
            let this = *stride;
            *stride *= side;
            Some(this)
        })
        .collect();
    let mut index = vec![0; shape.len()];
    let mut at = 0;
    let mut values = Vec::with_capacity(stored.len());
    while values.len() < stored.len() {
        values.push(stored[at]);
        // One further along the last axis, with carries to those before it.
        for axis in (0..shape.len()).rev() {
            index[axis] += 1;
            at += strides[axis];
            if index[axis] < shape[axis] {
                break;
            }
            at -= strides[axis] * shape[axis];
            index[axis] = 0;
        }
    }
    values
}

#[cfg(test)]
mod tests {
    use super::*;
    use npyz::WriterBuilder;
    use std::io::Write;
    use zip::write::{SimpleFileOptions, ZipWriter};

    /// A million equal numbers shrink to a thousandth: fine for an array, too many for a matrix.
    #[test]
    fn what_an_archive_inflates_to_is_limited_by_what_it_is_for() {
        let mut array = Vec::new();
        let options = npyz::WriteOptions::new().default_dtype();
        let mut writer = options
            .shape(&[1000, 1000])
            .writer(&mut array)
            .begin_nd()
            .unwrap();
        writer.extend(vec![0.5f64; 1_000_000]).unwrap();
        writer.finish().unwrap();
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("arrays.npz");
        let mut archive = ZipWriter::new(File::create(&file).unwrap());
        let options = SimpleFileOptions::default();
        let deflated = options.compression_method(zip::CompressionMethod::Deflated);
        archive.start_file("equal.npy", deflated).unwrap();
        archive.write_all(&array).unwrap();
        archive.finish().unwrap();

        let mut arrays = Arrays::open(&file).unwrap();
        assert_eq!(arrays.numbers("equal").unwrap().values.len(), 1_000_000);
        let refused = arrays.matrix("equal").unwrap_err().to_string();
        assert!(
            refused.contains("equal has more than") && refused.contains("numpy.savez"),
            "{refused}"
        );
    }
}
