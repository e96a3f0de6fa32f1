//! The float16 copy of a hash table, which look-ups read in its place (glsl/lib/half_copy.glsl).

use crate::Result;
use crate::gpu::{Buffer, Gpu, Kernel, PtrMut, Recorder, Work};
use crate::kernels::table_round;
use std::ops::Range;

/// The copy, and where in the parameter block the table stands.
pub(super) struct HalfCopy {
    table: Range<u64>,
    pairs: Buffer<u32>, // [table / 2] two float16s each
    round: Kernel<table_round::Args>,
}

impl HalfCopy {
    pub fn new(gpu: &Gpu, table: Range<u64>) -> Result<HalfCopy> {
        Ok(HalfCopy {
            pairs: gpu.buffer("table in float16", (table.end - table.start) / 2)?,
            round: gpu.kernel(table_round::Shape::default())?,
            table,
        })
    }

    pub fn pairs(&self) -> &Buffer<u32> {
        &self.pairs
    }

    /// Where the copy of this element of the parameter block, and of the next, stands, if it is one of the table.
    pub fn of(&self, element: u64) -> Option<PtrMut<u32>> {
        let inside = self.table.contains(&element);
        inside.then(|| self.pairs.at_mut((element - self.table.start) / 2))
    }

    /// Makes it that of the table as it is.
    pub fn refresh(&self, rec: &mut Recorder, values: &Buffer<f32>) {
        let n = self.pairs.len();
        let args = table_round::Args {
            table: values.at(self.table.start),
            halves: self.pairs.ptr_mut(),
            n: n as u32,
        };
        rec.run(&self.round, Work::items(n).flops(2.0).bytes(12.0), args);
    }
}
