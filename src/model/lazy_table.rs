//! The surface's hash table under an AdamW that changes only what a step needs, exactly (glsl/lib/lazy_table.glsl).
//!
//! A training step touches the entries around its points before it looks them up: each gets the update that its last gradient waits for,
//! and those that it has missed since. So an entry is visited once in a step that asks for it, and in no other;
//! [`LazyTable::flush`] ends the waiting for whoever reads all of the table.

use super::hash_grid::HashGrid;
use super::params::Params;
use crate::Result;
use crate::config::OptimizerConfig;
use crate::gpu::{Buffer, Gpu, Kernel, Ptr, Recorder, Work};
use crate::kernels::{
    ClockRow, Level, LevelUse, table_clock, table_forget, table_mark, table_settle,
    table_update_whole,
};
use std::ops::Range;

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
    /// Share of a level's entries; where more are touched, the level is updated whole.
    most: f32,
    /// Elements of the parameter block: the first of the table, and those of these levels.
    table: u64,
    elements: Range<u64>,
    one_minus_beta1: f32,
    one_minus_beta2: f32,
    epsilon: f32,
    clock: Buffer<u32>,     // [1]
    rows: Buffer<ClockRow>, // [256]
    uses: Buffer<LevelUse>, // [levels]
    marks: Buffer<u32>,     // [slots / 32]
    settled: Buffer<u32>,   // [slots / 32]
    stamps: Buffer<u32>,    // [slots / 4]
    mark: Kernel<table_mark::Args>,
    /// The same, which settles what it marks.
    mark_and_settle: Kernel<table_mark::Args>,
    settle: Sweep<table_settle::Args>,
    forget: Sweep<table_forget::Args>,
    update_whole: Sweep<table_update_whole::Args>,
    tick: Kernel<table_clock::Args>,
}

/// A kernel that goes over a level, and the entries of a workgroup.
struct Sweep<A> {
    kernel: Kernel<A>,
    of_group: u64,
}

/// When entries are settled, and so which (glsl/table_settle.comp).
enum Occasion {
    /// Those that were marked.
    Touch,
    /// What this step's update leaves to be settled.
    Update(u64),
    /// All.
    Flush,
}

impl<A> Sweep<A> {
    /// Of an invocation that goes over so many entries.
    fn new(kernel: Kernel<A>, entries: u64) -> Sweep<A> {
        Sweep {
            of_group: entries * u64::from(kernel.local_size()),
            kernel,
        }
    }
}

/// Readings of the clock.
const READINGS: u64 = 256;
/// Marks in a word, and in two.
const WORD: u64 = 32;
const PAIR: u64 = 2 * WORD;
/// Marking an entry costs about as much as updating so many parameters: a level that a step looks at more often than it has such
/// parameters is better updated whole.
const VISIT: u64 = 4;

/// Settling entries where they are marked costs about as much, for each that is asked for, as going over so many words of marks: few
/// points in a training step ask for what others have not.
const WORDS_A_MARK: u64 = 4;

/// Below it, β₂ to the power of as many steps as an entry may be left alone for is no longer a float32.
const LEAST_BETA2: f64 = 0.75;

impl LazyTable {
    /// The table of a grid that a training step asks at `points`, at an element offset of the parameter block; nothing is touched or
    /// behind at first. `half`: it has a copy in float16. `None` where every level is better updated whole, or β₂ is so small that it has
    /// to be.
    pub fn new(
        gpu: &Gpu,
        grid: &HashGrid,
        table: u64,
        optimizer: &OptimizerConfig,
        points: u32,
        half: bool,
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
        let slots = (end / PAIR + u64::from(n_levels) + 1) * PAIR;
        // Counted in bytes, settling an entry by itself is worth it for up to 65 % of them. A processor pays for finding it, too, whatever
        // its features (tools/runs/throughput.md).
        let (strip, most) = match gpu.info().few_cores {
            true => (16, 0.03 + 0.0275 * features as f32),
            false => (1, 0.65),
        };
        let half = u32::from(half);
        let whole = table_update_whole::Shape {
            levels: n_levels,
            features,
            half,
            ..table_update_whole::Shape::default()
        };
        let forget = table_forget::Shape {
            features,
            ..table_forget::Shape::default()
        };
        let mark = table_mark::Shape {
            levels: n_levels,
            features,
            settles: 0,
            half,
        };
        let mark_and_settle = table_mark::Shape { settles: 1, ..mark };
        let levels = gpu.buffer("lazy levels", u64::from(n_levels))?;
        gpu.upload(&levels, 0, &rows)?;
        Ok(Some(LazyTable {
            levels,
            n_levels,
            features,
            most_entries: u64::from(last.entries),
            most,
            table,
            elements: table + u64::from(first.offset) * u64::from(features)
                ..table + end * u64::from(features),
            one_minus_beta1: (1.0 - optimizer.beta1) as f32,
            one_minus_beta2: (1.0 - optimizer.beta2) as f32,
            epsilon: optimizer.epsilon as f32,
            clock: gpu.buffer("table clock", 1)?,
            rows: gpu.buffer("table clock rows", READINGS)?,
            uses: gpu.buffer("table uses", u64::from(n_levels))?,
            marks: gpu.buffer("table marks", slots / WORD)?,
            settled: gpu.buffer("table marks settled", slots / WORD)?,
            stamps: gpu.buffer("table stamps", slots / 4)?,
            mark: gpu.kernel(mark)?,
            mark_and_settle: gpu.kernel(mark_and_settle)?,
            forget: Sweep::new(gpu.kernel(forget)?, WORD * u64::from(forget.turns)),
            update_whole: Sweep::new(
                gpu.kernel(whole)?,
                2 * u64::from(whole.turns) / u64::from(features),
            ),
            tick: gpu.kernel(table_clock::Shape { levels: n_levels })?,
            settle: Sweep::new(
                gpu.kernel(table_settle::Shape {
                    levels: n_levels,
                    features,
                    strip,
                    half,
                })?,
                PAIR * u64::from(strip),
            ),
        }))
    }

    /// Element of the parameter block at which this begins to care; before it, the table is updated like all other parameters.
    pub fn first(&self) -> u64 {
        self.elements.start
    }

    /// Brings the entries around `points [3, n]` up to date; before a training step looks them up.
    pub fn touch(&self, rec: &mut Recorder, params: &Params, points: Ptr<f32>, n: u32) {
        let args = table_mark::Args {
            levels: self.levels.ptr(),
            points,
            uses: self.uses.ptr_mut(),
            marks: self.marks.ptr_mut(),
            rows: self.rows.ptr(),
            clock: self.clock.ptr(),
            settled: self.settled.ptr_mut(),
            stamps: self.stamps.ptr_mut(),
            table: params.values().at_mut(self.table),
            halves: params.copy_of(self.table),
            grads: params.d_value(self.table),
            first_moment: params.first_moment().at_mut(self.table),
            second_moment: params.second_moment().at_mut(self.table),
            one_minus_beta1: self.one_minus_beta1,
            one_minus_beta2: self.one_minus_beta2,
            epsilon: self.epsilon,
            n,
        };
        let work = Work::items(u64::from(n)).slices(self.n_levels);
        let work = work.flops(100.0).bytes(64.0);
        if 8 * u64::from(n) * WORDS_A_MARK <= self.most_entries / WORD {
            rec.run(&self.mark_and_settle, work, args);
        } else {
            rec.run(&self.mark, work, args);
            self.settle(rec, params, Occasion::Touch);
        }
    }

    /// One AdamW step of the table, whose gradients are consumed now or when their entries are asked for again. `step` only has to differ
    /// from call to call by one.
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
        let args = table_forget::Args {
            levels: self.levels.ptr(),
            bad_step: bad_step.ptr(),
            marks: self.marks.ptr(),
            grads: params.d_value(self.table),
        };
        rec.run(
            &self.forget.kernel,
            self.over_levels(&self.forget, 0.0, 0.0),
            args,
        );
        rec.fill(&self.marks, 0..self.marks.len(), 0);
        rec.fill(&self.settled, 0..self.settled.len(), 0);
        let args = table_update_whole::Args {
            levels: self.levels.ptr(),
            uses: self.uses.ptr(),
            clock: self.clock.ptr(),
            bad_step: bad_step.ptr(),
            table: params.values().at_mut(self.table),
            halves: params.copy_of(self.table),
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
        // How much of the table is whole the device alone knows: an eighth, as an estimate.
        let of_entry = f64::from(self.features) / 8.0;
        rec.run(
            &self.update_whole.kernel,
            self.over_levels(&self.update_whole, 15.0 * of_entry, 32.0 * of_entry),
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
        self.settle(rec, params, Occasion::Update(step));
    }

    /// Brings the whole table up to date: values and moments are those of AdamW, and what follows is what would follow if they had
    /// just been uploaded.
    pub fn flush(&self, rec: &mut Recorder, params: &Params) {
        self.settle(rec, params, Occasion::Flush);
        self.begin_anew(rec);
    }

    fn settle(&self, rec: &mut Recorder, params: &Params, occasion: Occasion) {
        let args = table_settle::Args {
            levels: self.levels.ptr(),
            uses: self.uses.ptr(),
            rows: self.rows.ptr(),
            clock: self.clock.ptr(),
            marks: self.marks.ptr(),
            settled: self.settled.ptr_mut(),
            stamps: self.stamps.ptr_mut(),
            table: params.values().at_mut(self.table),
            halves: params.copy_of(self.table),
            grads: params.d_value(self.table),
            first_moment: params.first_moment().at_mut(self.table),
            second_moment: params.second_moment().at_mut(self.table),
            one_minus_beta1: self.one_minus_beta1,
            one_minus_beta2: self.one_minus_beta2,
            epsilon: self.epsilon,
            after_update: u32::from(matches!(occasion, Occasion::Update(_))),
            everything: u32::from(matches!(occasion, Occasion::Flush)),
            step: match occasion {
                Occasion::Update(step) => step as u32,
                _ => 0,
            },
        };
        // How many are marked the device alone knows, and whether a level becomes whole.
        let share = match occasion {
            Occasion::Touch => 1.0 / 8.0,
            Occasion::Update(_) => 1.0 / 64.0,
            Occasion::Flush => 1.0,
        };
        let of_entry = share * f64::from(self.features);
        rec.run(
            &self.settle.kernel,
            self.over_levels(&self.settle, 25.0 * of_entry, 32.0 * of_entry),
            args,
        );
    }

    /// One launch over all levels; operations and bytes of an entry.
    fn over_levels<A>(&self, sweep: &Sweep<A>, flops: f64, bytes: f64) -> Work {
        let of_group = sweep.of_group as f64;
        Work::groups(self.most_entries.div_ceil(sweep.of_group))
            .slices(self.n_levels)
            .flops(flops * of_group)
            .bytes(bytes * of_group)
    }

    /// Forgets what entries wait for and have missed: values and moments stand as they are meant to be.
    pub fn reset(&self, rec: &mut Recorder, params: &Params) {
        params.forget_gradients(rec, self.elements.clone());
        self.begin_anew(rec);
    }

    fn begin_anew(&self, rec: &mut Recorder) {
        rec.fill(&self.clock, 0..self.clock.len(), 0);
        rec.fill(&self.rows, 0..self.rows.len(), 0);
        rec.fill(&self.uses, 0..self.uses.len(), 0);
        rec.fill(&self.marks, 0..self.marks.len(), 0);
        rec.fill(&self.settled, 0..self.settled.len(), 0);
        rec.fill(&self.stamps, 0..self.stamps.len(), 0);
    }
}
