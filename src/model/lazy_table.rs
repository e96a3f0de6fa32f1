//! The surface's hash table under an AdamW that changes only what a step needs, exactly (glsl/lib/lazy_table.glsl).
//!
//! A training step touches the entries around its points before it looks them up, and updates what it touched. In between, the rest of
//! the table is behind by some updates; [`LazyTable::flush`] ends that for whoever reads all of it.

use super::hash_grid::HashGrid;
use super::params::Params;
use crate::Result;
use crate::config::OptimizerConfig;
use crate::gpu::{Buffer, Gpu, Kernel, Ptr, Recorder, Work};
use crate::kernels::{
    ClockRow, Level, LevelUse, table_clock, table_flush, table_touch, table_update,
    table_update_whole,
};

/// What one update is made of, beside gradients and moments: the factors of AdamW at its own step.
#[derive(Clone, Copy, Debug)]
pub struct Rates {
    /// η / (1 − β₁ᵗ).
    pub rate: f32,
    /// η λ.
    pub decay: f32,
    /// √(1 − β₂ᵗ).
    pub correction: f32,
}

/// What is known of a table's entries, and the kernels that keep it.
pub struct LazyTable {
    /// The levels that are updated in part; those before them are updated whole, like all other parameters.
    levels: Buffer<Level>,
    n_levels: u32,
    features: u32,
    /// Entries of the largest level.
    most_entries: u64,
    /// Words of marks that one invocation goes through.
    strip: u64,
    /// Share of a level's entries; where more are touched, the level is updated whole.
    most: f32,
    /// Element offsets in the parameter block: of the table, and of the first of these levels.
    table: u64,
    first: u64,
    one_minus_beta1: f32,
    one_minus_beta2: f32,
    epsilon: f32,
    clock: Buffer<u32>,     // [1]
    rows: Buffer<ClockRow>, // [256]
    uses: Buffer<LevelUse>, // [levels]
    marks: Buffer<u32>,     // [slots / 32]
    stamps: Buffer<u32>,    // [slots / 4]
    touch: Kernel<table_touch::Args>,
    update: Kernel<table_update::Args>,
    update_whole: Kernel<table_update_whole::Args>,
    /// Parameters that a workgroup of `update_whole` goes over.
    of_group: u64,
    tick: Kernel<table_clock::Args>,
    catch_up: Kernel<table_flush::Args>,
}

/// Readings of the clock.
const READINGS: u64 = 256;
/// Marks in a word.
const WORD: u64 = 32;
/// Marking an entry costs about as much as updating so many parameters: a level that a step looks at more often than it has such
/// parameters is better updated whole.
const VISIT: u64 = 4;

/// Below it, β₂ to the power of as many steps as an entry may be left alone for is no longer a float32.
const LEAST_BETA2: f64 = 0.75;

impl LazyTable {
    /// The table of a grid that a training step asks at `points`, at an element offset of the parameter block; nothing is touched or
    /// behind at first. `None` where every level is better updated whole, or β₂ is so small that it has to be.
    pub fn new(
        gpu: &Gpu,
        grid: &HashGrid,
        table: u64,
        optimizer: &OptimizerConfig,
        points: u32,
    ) -> Result<Option<LazyTable>> {
        let visits = 8 * u64::from(points);
        let features = grid.features;
        let mut rows = grid.level_table();
        // Levels grow: small ones come first.
        rows.retain(|level| u64::from(level.entries) * u64::from(features) >= VISIT * visits);
        let (Some(first), Some(last)) = (rows.first(), rows.last()) else {
            return Ok(None);
        };
        if optimizer.beta2 < LEAST_BETA2 {
            return Ok(None);
        }
        let n_levels = rows.len() as u32;
        let end = u64::from(last.offset) + u64::from(last.entries);
        let slots = (end / WORD + u64::from(n_levels) + 1) * WORD;
        // Counted in bytes, touching and updating an entry is worth it for up to 65 % of them. A processor pays for finding them, too;
        // where between a fifth and a half it breaks even has not been measured well (tools/runs/throughput.md).
        let (strip, most) = match gpu.info().few_cores {
            true => (16, 0.35),
            false => (2, 0.65),
        };
        let whole = table_update_whole::Shape {
            features,
            ..table_update_whole::Shape::default()
        };
        let update_whole = gpu.kernel(whole)?;
        let levels = gpu.buffer("lazy levels", u64::from(n_levels))?;
        gpu.upload(&levels, 0, &rows)?;
        Ok(Some(LazyTable {
            levels,
            n_levels,
            features,
            most_entries: u64::from(last.entries),
            strip: u64::from(strip),
            most,
            table,
            first: table + u64::from(first.offset) * u64::from(features),
            one_minus_beta1: (1.0 - optimizer.beta1) as f32,
            one_minus_beta2: (1.0 - optimizer.beta2) as f32,
            epsilon: optimizer.epsilon as f32,
            clock: gpu.buffer("table clock", 1)?,
            rows: gpu.buffer("table clock rows", READINGS)?,
            uses: gpu.buffer("table uses", u64::from(n_levels))?,
            marks: gpu.buffer("table marks", slots / WORD)?,
            stamps: gpu.buffer("table stamps", slots / 4)?,
            touch: gpu.kernel(table_touch::Shape {
                levels: n_levels,
                features,
            })?,
            update: gpu.kernel(table_update::Shape { features, strip })?,
            of_group: 2 * u64::from(whole.turns) * u64::from(update_whole.local_size()),
            update_whole,
            tick: gpu.kernel(table_clock::Shape { levels: n_levels })?,
            catch_up: gpu.kernel(table_flush::Shape { features })?,
        }))
    }

    /// Element of the parameter block at which this begins to care; before it, the table is updated like all other parameters.
    pub fn first(&self) -> u64 {
        self.first
    }

    /// Brings the entries around `points [3, n]` up to date and marks them; before a training step looks them up.
    pub fn touch(&self, rec: &mut Recorder, params: &Params, points: Ptr<f32>, n: u32) {
        let args = table_touch::Args {
            levels: self.levels.ptr(),
            points,
            rows: self.rows.ptr(),
            clock: self.clock.ptr(),
            stamps: self.stamps.ptr(),
            first_moment: params.first_moment().at(self.table),
            second_moment: params.second_moment().at(self.table),
            uses: self.uses.ptr_mut(),
            marks: self.marks.ptr_mut(),
            table: params.values().at_mut(self.table),
            n,
            one_minus_beta1: self.one_minus_beta1,
            one_minus_beta2: self.one_minus_beta2,
            epsilon: self.epsilon,
        };
        let work = Work::items(u64::from(n)).slices(self.n_levels);
        let entries = 8.0 * f64::from(self.features);
        rec.run(
            &self.touch,
            work.flops(6.0 * entries).bytes(16.0 * entries),
            args,
        );
    }

    /// One AdamW step of the table; touched entries' gradients are consumed. `step` only has to differ from call to call by one.
    pub fn update(
        &self,
        rec: &mut Recorder,
        params: &Params,
        rates: &Rates,
        step: u64,
        bad_step: &Buffer<u32>,
    ) {
        let Rates {
            rate,
            decay,
            correction,
        } = *rates;
        let args = table_update::Args {
            levels: self.levels.ptr(),
            uses: self.uses.ptr(),
            rows: self.rows.ptr(),
            clock: self.clock.ptr(),
            bad_step: bad_step.ptr(),
            table: params.values().at_mut(self.table),
            grads: params.d_value(self.table),
            first_moment: params.first_moment().at_mut(self.table),
            second_moment: params.second_moment().at_mut(self.table),
            marks: self.marks.ptr_mut(),
            stamps: self.stamps.ptr_mut(),
            rate,
            decay,
            correction,
            one_minus_beta1: self.one_minus_beta1,
            one_minus_beta2: self.one_minus_beta2,
            epsilon: self.epsilon,
            most: self.most,
            step: step as u32,
        };
        // How much of the table it is, the device alone knows: an eighth, as an estimate.
        let strips = self.most_entries.div_ceil(WORD * self.strip);
        let of_strip = (WORD * self.strip * u64::from(self.features)) as f64 / 8.0;
        let work = Work::items(strips).slices(self.n_levels);
        rec.run(
            &self.update,
            work.flops(15.0 * of_strip).bytes(32.0 * of_strip),
            args,
        );
        let args = table_update_whole::Args {
            levels: self.levels.ptr(),
            uses: self.uses.ptr(),
            clock: self.clock.ptr(),
            bad_step: bad_step.ptr(),
            table: params.values().at_mut(self.table),
            grads: params.d_value(self.table),
            first_moment: params.first_moment().at_mut(self.table),
            second_moment: params.second_moment().at_mut(self.table),
            stamps: self.stamps.ptr_mut(),
            rate,
            decay,
            correction,
            one_minus_beta1: self.one_minus_beta1,
            one_minus_beta2: self.one_minus_beta2,
            epsilon: self.epsilon,
        };
        let groups = (self.most_entries * u64::from(self.features)).div_ceil(self.of_group);
        let of_group = self.of_group as f64 / 8.0; // most levels are not whole
        let work = Work::groups(groups).slices(self.n_levels);
        rec.run(
            &self.update_whole,
            work.flops(15.0 * of_group).bytes(32.0 * of_group),
            args,
        );
        let args = table_clock::Args {
            levels: self.levels.ptr(),
            bad_step: bad_step.ptr(),
            uses: self.uses.ptr_mut(),
            rows: self.rows.ptr_mut(),
            clock: self.clock.ptr_mut(),
            rate,
            decay,
            correction,
            one_minus_beta1: self.one_minus_beta1,
            one_minus_beta2: self.one_minus_beta2,
            most: self.most,
        };
        rec.run(&self.tick, Work::groups(1), args);
    }

    /// Brings the whole table up to date: values and moments are those of AdamW, and what follows is what would follow if they had
    /// just been uploaded.
    pub fn flush(&self, rec: &mut Recorder, params: &Params) {
        let args = table_flush::Args {
            levels: self.levels.ptr(),
            uses: self.uses.ptr(),
            rows: self.rows.ptr(),
            clock: self.clock.ptr(),
            marks: self.marks.ptr(),
            stamps: self.stamps.ptr(),
            table: params.values().at_mut(self.table),
            first_moment: params.first_moment().at_mut(self.table),
            second_moment: params.second_moment().at_mut(self.table),
            one_minus_beta1: self.one_minus_beta1,
            one_minus_beta2: self.one_minus_beta2,
            epsilon: self.epsilon,
        };
        let pairs = u64::from(self.features.div_ceil(2));
        let work = Work::items(self.most_entries * pairs).slices(self.n_levels);
        rec.run(&self.catch_up, work.flops(20.0).bytes(48.0), args);
        self.reset(rec);
    }

    /// Forgets what entries have missed: values and moments stand as they are meant to be.
    pub fn reset(&self, rec: &mut Recorder) {
        rec.fill(&self.clock, 0..self.clock.len(), 0);
        rec.fill(&self.rows, 0..self.rows.len(), 0);
        rec.fill(&self.uses, 0..self.uses.len(), 0);
        rec.fill(&self.marks, 0..self.marks.len(), 0);
        rec.fill(&self.stamps, 0..self.stamps.len(), 0);
    }
}
