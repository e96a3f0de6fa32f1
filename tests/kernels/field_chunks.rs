//! A field's backward pass over more points than it takes at once, and over points with heads and without, is the sum of passes over
//! fewer; straight-line code and matrices make the same of a field as loops do, and derivatives that are kept the same as those looked up.

use crate::half_copy::cut;
use crate::harness::assert_gradient;
use neurodin::Result;
use neurodin::gpu::{Gpu, GpuOptions, Matrices, Ptr, PtrMut, Work};
use neurodin::kernels::field_forward;
use neurodin::model::{
    Field, FieldBuffers, FieldShape, Group, HashGrid, Init, Params, ParamsPlan, Scratch, layer_ways,
};

const SHAPE: FieldShape = FieldShape {
    grid: HashGrid {
        levels: 3,
        base: 4,
        max: 16,
        log2_size: 9,
        features: 2,
    },
    hidden: 24,
    coordinates: true,
    softplus: true,
    gradient: true,
    kept: 2,
    half: false,
};
const POINTS: usize = 70_001;
/// Leading points with heads.
const WITH_HEADS: usize = 66_000;

/// A number in [-1, 1) for each index.
fn noise(of: u32, i: usize) -> f32 {
    let mixed = (i as u32 ^ of.wrapping_mul(0x9e37_79b9)).wrapping_mul(0x85eb_ca6b);
    ((mixed ^ (mixed >> 15)).wrapping_mul(0xc2b2_ae35) >> 8) as f32 / (1 << 23) as f32 - 1.0
}

/// Columns `range` of a planar array of `rows` rows that is defined for all points.
fn planes(of: u32, rows: usize, scale: f32, range: std::ops::Range<usize>) -> Vec<f32> {
    let rows = 0..rows;
    rows.flat_map(|row| {
        range
            .clone()
            .map(move |i| scale * noise(of, row * POINTS + i))
    })
    .collect()
}

/// A device of this test's own, so that all buffers that live have their guard words.
fn open(options: GpuOptions) -> Result<Gpu> {
    Gpu::new(&GpuOptions {
        validation: true,
        guard: true,
        ..options
    })
}

fn assert_valid(gpu: &Gpu) {
    let messages = gpu.validation_messages();
    assert!(messages.is_empty(), "{}", messages.join("\n"));
}

fn field(gpu: &Gpu, shape: FieldShape) -> Result<(Field, Params)> {
    let mut plan = ParamsPlan::default();
    let (grid, hidden, inputs) = (shape.grid, shape.hidden, shape.inputs());
    let values = |of, n| (0..n).map(|i| 0.3 * noise(of, i)).collect::<Vec<f32>>();
    // Numbers that float16 has as well.
    let table = [grid.entries(), u64::from(grid.features)];
    let features = values(1, (table[0] * table[1]) as usize);
    let features = features.iter().map(|&x| cut(x.into()) as f32).collect();
    let table = plan.add(Group::Table, "table", &table, Init::Values(features));
    if shape.half {
        plan.keep_half(table);
    }
    let mut matrix = |name, of, rows: u32, columns: u32| {
        let weights = values(of, (rows * columns) as usize);
        plan.add_plain(Group::Fields, name, rows.into(), columns.into(), weights)
    };
    let first = matrix("hidden", 2, hidden, inputs);
    let head = matrix("head", 3, 1, hidden);
    let field = Field::new(gpu, "chunks", shape, table, first, head)?;
    Ok((field, plan.build(gpu, 1, true)?))
}

/// The first output's gradient at these points, none of which has heads.
fn slope(
    gpu: &Gpu,
    (field, params): &(Field, Params),
    range: std::ops::Range<usize>,
) -> Result<Vec<f32>> {
    let buffers = FieldBuffers::new(gpu, "slope", &field.shape, range.len() as u32, 0)?;
    let points = gpu.buffer("points", 3 * range.len() as u64)?;
    gpu.upload(&points, 0, &planes(4, 3, 0.9, range))?;
    gpu.submit("slope", |rec| {
        field.encode(rec, params, points.ptr(), &buffers);
        field.gradient(rec, params, points.ptr(), &buffers);
        Ok(())
    })?;
    let gradient = &buffers.slope().gradient;
    gpu.download(gradient, 0, gradient.len())
}

/// Adds the gradients of these points to `params`' and returns what the points hear.
fn backward(
    gpu: &Gpu,
    (field, params): &(Field, Params),
    range: std::ops::Range<usize>,
) -> Result<Vec<f32>> {
    let n = range.len() as u32;
    let with_heads = range.start.min(WITH_HEADS)..range.end.min(WITH_HEADS);
    let n_hidden = with_heads.len() as u32;
    let buffers = FieldBuffers::new(gpu, "chunks", &field.shape, n, n_hidden)?;
    let scratch = Scratch::new(gpu, &[(field.shape, n)])?;
    let filled = |name: &str, values: &[f32]| {
        let buffer = gpu.buffer(name, values.len() as u64)?;
        gpu.upload(&buffer, 0, values).map(|()| buffer)
    };
    let points = filled("points", &planes(4, 3, 0.9, range.clone()))?;
    let d_first = filled("d_first", &planes(5, 1, 1.0, range.clone()))?;
    let first = gpu.buffer::<f32>("first", u64::from(n))?;
    let d_points = gpu.buffer::<f32>("d_points", 3 * u64::from(n))?;
    gpu.submit("forward", |rec| {
        field.forward(rec, params, points.ptr(), &buffers, first.ptr_mut());
        field.gradient(rec, params, points.ptr(), &buffers);
        Ok(())
    })?;
    let d_gradient = planes(6, 3, 0.1, range);
    gpu.upload(&buffers.slope().d_gradient, 0, &d_gradient)?;
    let d_hidden = planes(7, field.shape.hidden as usize, 1.0, with_heads);
    let stride = u64::from(buffers.hidden.stride);
    for (row, plane) in d_hidden.chunks_exact(n_hidden.max(1) as usize).enumerate() {
        gpu.upload(&buffers.hidden.values, row as u64 * stride, plane)?;
    }
    gpu.submit("backward", |rec| {
        let hear = Some(d_points.ptr_mut());
        field.backward(
            rec,
            params,
            points.ptr(),
            d_first.ptr(),
            &buffers,
            &scratch,
            hear,
        );
        Ok(())
    })?;
    // While the buffers live: their guard words go with them.
    gpu.finish()?;
    let overruns = gpu.check_guards()?;
    assert!(overruns.is_empty(), "written past an end: {overruns:?}");
    gpu.download(&d_points, 0, d_points.len())
}

fn wide(values: &[f32]) -> Vec<f64> {
    values.iter().map(|&x| f64::from(x)).collect()
}

fn gradients(gpu: &Gpu, params: &Params) -> Result<Vec<f64>> {
    let grads = params.grads();
    gpu.download(grads, 0, grads.len()).map(|g| wide(&g))
}

/// Every span of parameters has heard something, and the same.
fn assert_gradients(params: &Params, got: &[f64], want: &[f64]) {
    for span in params.spans() {
        let range = span.first as usize..(span.first + span.len()) as usize;
        assert!(want[range.clone()].iter().any(|&g| g != 0.0));
        assert_gradient(&span.name, &got[range.clone()], &want[range]);
    }
}

#[test]
fn many_points_are_the_sum_of_fewer() -> Result<()> {
    for many_cores in [false, true] {
        sum_up(GpuOptions {
            many_cores,
            ..GpuOptions::default()
        })?;
    }
    Ok(())
}

fn sum_up(options: GpuOptions) -> Result<()> {
    let gpu = &open(options)?;
    let (whole, parts) = (field(gpu, SHAPE)?, field(gpu, SHAPE)?);
    let d_points = backward(gpu, &whole, 0..POINTS)?;
    let cut = 40_000;
    let of_parts = [
        backward(gpu, &parts, 0..cut)?,
        backward(gpu, &parts, cut..POINTS)?,
    ];
    for axis in 0..3 {
        let joined = of_parts.iter().flat_map(|part| {
            let n = part.len() / 3;
            &part[axis * n..(axis + 1) * n]
        });
        let joined: Vec<f32> = joined.copied().collect();
        let row = &d_points[axis * POINTS..(axis + 1) * POINTS];
        assert_gradient("what the points hear", &wide(row), &wide(&joined));
    }
    let of_parts = gradients(gpu, &parts.1)?;
    assert_gradients(&whole.1, &gradients(gpu, &whole.1)?, &of_parts);
    assert_valid(gpu);
    Ok(())
}

/// Fewer points than a subgroup has lanes, and not many more, with heads and without.
#[test]
fn a_few_points_are_the_sum_of_each() -> Result<()> {
    let gpu = &open(GpuOptions::default())?;
    let shape = FieldShape { kept: 2, ..SHAPE };
    let (whole, alone) = (field(gpu, shape)?, field(gpu, shape)?);
    let range = WITH_HEADS - 19..WITH_HEADS + 5;
    let n = range.len();
    let d_points = backward(gpu, &whole, range.clone())?;
    for (i, point) in range.enumerate() {
        let of_point = backward(gpu, &alone, point..point + 1)?;
        let of_whole = [0, 1, 2].map(|axis| d_points[axis * n + i]);
        assert_gradient("what a point hears", &wide(&of_whole), &wide(&of_point));
    }
    let of_each = gradients(gpu, &alone.1)?;
    assert_gradients(&whole.1, &gradients(gpu, &whole.1)?, &of_each);
    assert_valid(gpu);
    Ok(())
}

#[test]
fn derivatives_that_are_kept_are_those_looked_up() -> Result<()> {
    let gpu = &open(GpuOptions::default())?;
    let keeping = |kept| field(gpu, FieldShape { kept, ..SHAPE });
    // Both halves of a pass that is cut.
    let range = 1..POINTS;
    let looked_up = keeping(0)?;
    let want_points = backward(gpu, &looked_up, range.clone())?;
    let want = gradients(gpu, &looked_up.1)?;
    for order in [1, 2] {
        let kept = keeping(order)?;
        let got = backward(gpu, &kept, range.clone())?;
        let what = format!("what the points hear, derivatives kept up to order {order}");
        assert_gradient(&what, &wide(&got), &wide(&want_points));
        assert_gradients(&kept.1, &gradients(gpu, &kept.1)?, &want);
    }
    assert_valid(gpu);
    Ok(())
}

/// Every look-up reads the copy: the table itself may be gone.
#[test]
fn a_copy_in_float16_is_the_same_table() -> Result<()> {
    let gpu = &open(GpuOptions::default())?;
    let range = 0..5_001;
    for kept in [0, 2] {
        let shape = FieldShape { kept, ..SHAPE };
        let whole = field(gpu, shape)?;
        let want_points = backward(gpu, &whole, range.clone())?;
        let want = gradients(gpu, &whole.1)?;
        let half = field(
            gpu,
            FieldShape {
                half: true,
                ..shape
            },
        )?;
        let table = half.1.span("table").expect("the table");
        let nothing = vec![0.0; table.len() as usize];
        gpu.upload(half.1.values(), table.first, &nothing)?;
        let got = backward(gpu, &half, range.clone())?;
        assert_gradient("what the points hear", &wide(&got), &wide(&want_points));
        assert_gradients(&half.1, &gradients(gpu, &half.1)?, &want);
        half.1.refresh_copy(gpu)?;
        let of_nothing = backward(gpu, &half, range.clone())?;
        assert_ne!(of_nothing, got, "a copy that is made again");
    }
    assert_valid(gpu);
    Ok(())
}

/// The recorder cuts a long launch into parts: each encodes its own points, and does not begin with those of the others.
#[test]
fn a_part_of_a_launch_encodes_its_own_points() -> Result<()> {
    let gpu = &open(GpuOptions::default())?;
    let grid = SHAPE.grid;
    let shape = field_forward::Shape {
        levels: grid.levels,
        features: grid.features,
        coordinates: 0,
        part: 1,
        ..field_forward::Shape::default()
    };
    let kernel = gpu.kernel(shape)?;
    let rows = grid.level_table();
    let levels = gpu.buffer("levels", rows.len() as u64)?;
    gpu.upload(&levels, 0, &rows)?;
    let table = gpu.buffer::<u32>("table", grid.entries() * u64::from(grid.features))?;
    let (n, of_part) = (4 * kernel.local_size(), 2 * kernel.local_size());
    let points = gpu.buffer::<f32>("points", 3 * u64::from(n))?;
    let inputs = gpu.scratch::<f32>("inputs", u64::from(grid.outputs() * n))?;
    gpu.submit("part", |rec| {
        let args = field_forward::Args {
            levels: levels.ptr(),
            table: table.ptr(),
            hidden_weight: Ptr::NULL,
            hidden_bias: Ptr::NULL,
            head_weight: Ptr::NULL,
            head_bias: Ptr::NULL,
            points: points.ptr(),
            inputs: inputs.ptr_mut(),
            hidden: PtrMut::NULL,
            first: PtrMut::NULL,
            derivatives: PtrMut::NULL,
            n,
            n_hidden: 0,
            stride_hidden: 0,
            begin: 0,
            end: n,
            points_each: 1,
        };
        rec.run(
            &kernel,
            Work::items(of_part.into()).slices(grid.levels),
            args,
        );
        Ok(())
    })?;
    let inputs = gpu.download(&inputs, 0, inputs.len())?;
    for row in inputs.chunks_exact(n as usize) {
        let (part, rest) = row.split_at(of_part as usize);
        assert!(part.iter().all(|&x| x == 0.0), "a point that is left out");
        assert!(rest.iter().all(|x| x.is_nan()), "another part's point");
    }
    assert_valid(gpu);
    Ok(())
}

#[test]
fn straight_line_code_is_the_same_field() -> Result<()> {
    let loops = &open(GpuOptions::default())?;
    let ways = layer_ways(loops, SHAPE.hidden).into_iter();
    let ways: Vec<String> = ways.filter(|way| way.starts_with("straight")).collect();
    if ways.is_empty() {
        println!("skipped: this device is none for straight-line code");
        return Ok(());
    }
    let straight = &open(GpuOptions {
        ways,
        ..GpuOptions::default()
    })?;
    // Points with heads and without, of both a number that leaves a workgroup's last invocations without work.
    let range = WITH_HEADS - 501..WITH_HEADS + 407;
    let (of_loops, of_straight) = (field(loops, SHAPE)?, field(straight, SHAPE)?);
    let want = backward(loops, &of_loops, range.clone())?;
    let got = backward(straight, &of_straight, range)?;
    assert_gradient("what the points hear", &wide(&got), &wide(&want));
    let want = gradients(loops, &of_loops.1)?;
    assert_gradients(&of_loops.1, &gradients(straight, &of_straight.1)?, &want);
    assert_valid(loops);
    assert_valid(straight);
    Ok(())
}

/// Both where derivatives are kept and where they are looked up, on the way forward more points than have their memory at once.
#[test]
fn matrices_are_the_same_field() -> Result<()> {
    let shape = FieldShape {
        grid: HashGrid {
            levels: 4,
            features: 8,
            ..SHAPE.grid
        },
        hidden: 40,
        ..SHAPE
    };
    for many_cores in [false, true] {
        let options = GpuOptions {
            many_cores,
            ..GpuOptions::default()
        };
        let by_matrices = open(GpuOptions {
            matrices: Matrices::Compensated,
            ..options.clone()
        });
        let by_matrices = match by_matrices {
            Ok(gpu) => gpu,
            Err(error) => {
                println!("skipped: {error}");
                return Ok(());
            }
        };
        let loops = &open(options)?;
        let (of_loops, of_matrices) = (field(loops, shape)?, field(&by_matrices, shape)?);
        let range = 1..POINTS;
        let want = slope(loops, &of_loops, range.clone())?;
        let got = slope(&by_matrices, &of_matrices, range.clone())?;
        assert_gradient("the first output's gradient", &wide(&got), &wide(&want));
        let want = backward(loops, &of_loops, range.clone())?;
        let got = backward(&by_matrices, &of_matrices, range)?;
        assert_gradient("what the points hear", &wide(&got), &wide(&want));
        let want = gradients(loops, &of_loops.1)?;
        assert_gradients(
            &of_loops.1,
            &gradients(&by_matrices, &of_matrices.1)?,
            &want,
        );
        assert_valid(loops);
        assert_valid(&by_matrices);
    }
    Ok(())
}
