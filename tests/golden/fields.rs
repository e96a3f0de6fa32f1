//! Golden vectors of the learned functions: networks, direction encoding, hash grids with their first and second derivatives.

use crate::reference::golden;
use crate::reference::hash_grid::{Grid, Level};
use crate::reference::networks::{self, NormedLayer};
use crate::reference::npz::Npz;
use crate::reference::tape::{Tape, Var};
use crate::{assert_close, parameter};

/// Puts the layers `{prefix}{0..}` of an archive on the tape, and gives them back with their arrays' names.
fn layers(tape: &mut Tape, npz: &Npz, prefix: &str) -> (Vec<NormedLayer>, Vec<(String, Var)>) {
    let (mut layers, mut named) = (Vec::new(), Vec::new());
    while npz
        .find(&format!("{prefix}{}_bias", layers.len()))
        .is_some()
    {
        let mut put = |part: &str| {
            let array = format!("{prefix}{}_{part}", layers.len());
            let var = parameter(tape, npz, &array);
            named.push((array, var));
            var
        };
        layers.push(NormedLayer {
            v: put("weight_v"),
            g: put("weight_g"),
            bias: put("bias"),
        });
    }
    assert!(layers.len() >= 2);
    (layers, named)
}

fn check_network(
    archive: &str,
    prefix: &str,
    network: impl Fn(&mut Tape, &[NormedLayer], Var) -> Var,
) {
    let Some(npz) = golden::open(archive) else {
        return;
    };
    let tape = &mut Tape::default();
    let x = parameter(tape, &npz, "x");
    let (layers, named) = layers(tape, &npz, prefix);
    let y = network(tape, &layers, x);
    assert_close("y", tape.value(y), npz.values("y"), 1e-12);
    let gradients = tape.backward_with(y, npz.values("cotangent"));
    assert_close("grad_x", &gradients.get(x), npz.values("grad_x"), 1e-11);
    for (array, var) in named {
        assert_close(
            &array,
            &gradients.get(var),
            npz.values(&format!("grad_{array}")),
            1e-11,
        );
    }
}

#[test]
fn geometry_net() {
    check_network("geometry_net", "glin", |tape, layers, x| {
        networks::geometry_network(tape, layers[0], layers[1], x)
    });
}

#[test]
fn color_net() {
    check_network("color_net", "clin", networks::color_network);
}

#[test]
fn direction_encoding() {
    let Some(npz) = golden::open("direction_encoding") else {
        return;
    };
    let ours: Vec<f64> = npz
        .vectors("d")
        .into_iter()
        .flat_map(networks::direction_encoding)
        .collect();
    assert_close("encoding", &ours, npz.values("encoding"), 1e-13);
}

/// One hash-grid archive: level table, indices, weights, encoding, first and second derivatives.
fn check_hash_grid(archive: &str) {
    let Some(npz) = golden::open(archive) else {
        return;
    };
    let scale = npz.values("scale");
    let levels = scale.len();
    let [points, width] = *npz.shape("encoding") else {
        panic!("encoding is points x features")
    };
    let side = |level: usize| (scale[level] + 1.0).round() as u32;
    let hashed = (0..levels).find(|&level| npz.values("dense")[level] == 0.0);
    let log2_size = hashed.map_or(24, |level| npz.values("entries")[level].log2() as u32);
    let grid = Grid::exact(levels, side(0), side(levels - 1), log2_size, width / levels);
    let ours = |f: &dyn Fn(&Level) -> f64| -> Vec<f64> { grid.levels.iter().map(f).collect() };
    assert_close(
        "scale",
        &ours(&|level| level.scale),
        npz.values("scale"),
        1e-14,
    );
    assert_eq!(
        ours(&|level| f64::from(level.resolution)),
        npz.values("resolution")
    );
    assert_eq!(
        ours(&|level| f64::from(level.entries)),
        npz.values("entries")
    );
    assert_eq!(
        ours(&|level| f64::from(u8::from(level.dense))),
        npz.values("dense")
    );
    assert_eq!(
        ours(&|level| level.offset as f64),
        npz.values("offset")[..levels]
    );
    assert_eq!(grid.entries() as f64, npz.values("offset")[levels]);

    let table = golden::table(grid.parameters(), 1.0);
    let u: Vec<[f64; 3]> = npz
        .vectors("x")
        .iter()
        .map(|x| x.map(|x| (x + 1.0) / 2.0))
        .collect();
    let rows = npz.shape("index")[0];
    let cells: Vec<_> = u[..rows]
        .iter()
        .flat_map(|&u| grid.levels.iter().map(move |level| level.cell(u)))
        .collect();
    let index: Vec<f64> = cells
        .iter()
        .flat_map(|cell| cell.index.map(f64::from))
        .collect();
    assert_eq!(index, npz.values("index"));
    let weight: Vec<f64> = cells.iter().flat_map(|cell| cell.weight).collect();
    assert_close("weight", &weight, npz.values("weight"), 1e-7); // stored as f32

    let (mut encoding, mut d_u, mut d2_u) = (Vec::new(), Vec::new(), Vec::new());
    let mut d_table = vec![0.0; grid.parameters()];
    let mut d2_table = vec![0.0; grid.parameters()];
    let cotangents = npz.values("cotangent").chunks_exact(width);
    for ((&u, cotangent), h) in u.iter().zip(cotangents).zip(npz.vectors("cotangent2")) {
        encoding.extend(grid.encode(&table, u));
        d_u.extend(grid.point_gradient(&table, u, cotangent));
        d2_u.extend(grid.point_gradient_of_slope(&table, u, cotangent, h));
        grid.add_table_gradient(u, cotangent, &mut d_table);
        grid.add_table_gradient_of_slope(u, cotangent, h, &mut d2_table);
    }
    assert_eq!(u.len(), points);
    // A scale that is rounded otherwise in its last place moves a fine level's weights by 1e-12.
    assert_close("encoding", &encoding, npz.values("encoding"), 1e-10);
    assert_close("grad_u", &d_u, npz.values("grad_u"), 1e-10);
    assert_close("grad2_u", &d2_u, npz.values("grad2_u"), 1e-10);
    for (name, gradient) in [("gt", &d_table), ("gt2", &d2_table)] {
        let some: Vec<f64> = npz
            .values(&format!("{name}_index"))
            .iter()
            .map(|&i| gradient[i as usize])
            .collect();
        assert_close(name, &some, npz.values(&format!("{name}_value")), 1e-10);
    }
    let sum: f64 = d_table.iter().map(|d| d.abs()).sum();
    assert_close("gt_abs_sum", &[sum], npz.values("gt_abs_sum"), 1e-10);
}

#[test]
fn hash_grid_of_the_surface() {
    check_hash_grid("hash_sdf_shipped");
}

#[test]
fn hash_grids_of_the_proposals() {
    check_hash_grid("hash_prop0");
    check_hash_grid("hash_prop1");
}

#[test]
fn hash_grid_of_the_background() {
    check_hash_grid("hash_background");
}

#[test]
fn hash_grids_for_a_cpu() {
    check_hash_grid("hash_cpu");
    check_hash_grid("hash_cpu512");
}
