//! Shape of a multi-resolution hash grid (Müller et al. 2022): levels, resolutions and sizes by tiny-cuda-nn's rules.

use crate::kernels::Level;

/// Levels, resolutions and table size of a grid over the cube [−1, 1]³.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct HashGrid {
    pub levels: u32,
    /// Coarsest and finest resolution per axis.
    pub base: u32,
    pub max: u32,
    /// A level holds at most 2^log2_size entries; beyond that it is hashed.
    pub log2_size: u32,
    /// Features per entry.
    pub features: u32,
}

impl HashGrid {
    /// The level table: scale_l = base·b^l − 1 with growth b = (max/base)^{1/(levels−1)}, resolution = ⌈scale⌉ + 1, in the float32
    /// arithmetic of the original, whose rounding decides whether a level has 128 or 129 points a side.
    pub fn level_table(&self) -> Vec<Level> {
        let growth = if self.levels > 1 {
            (f64::from(self.max) / f64::from(self.base)).ln() / f64::from(self.levels - 1)
        } else {
            0.0
        };
        let log2_growth = (growth.exp() as f32).log2();
        let capacity = 1u64 << self.log2_size;
        let mut offset = 0;
        (0..self.levels)
            .map(|l| {
                let scale = (l as f32 * log2_growth).exp2() * self.base as f32 - 1.0;
                let resolution = scale.ceil() as u64 + 1;
                let dense = resolution.pow(3);
                let entries = dense.next_multiple_of(8).min(capacity);
                let level = Level {
                    scale,
                    resolution: resolution as u32,
                    entries: entries as u32,
                    offset,
                    hashed: u32::from(dense > entries),
                    reciprocal: ((1 << 32) / entries) as u32,
                };
                offset += entries as u32;
                level
            })
            .collect()
    }

    /// Entries of all levels together.
    pub fn entries(&self) -> u64 {
        self.level_table()
            .iter()
            .map(|l| u64::from(l.entries))
            .sum()
    }

    /// Length of an encoded position.
    pub fn outputs(&self) -> u32 {
        self.levels * self.features
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn published_level_tables() {
        let resolutions = |grid: HashGrid| {
            grid.level_table()
                .iter()
                .map(|l| l.resolution)
                .collect::<Vec<_>>()
        };
        let sdf = HashGrid {
            levels: 16,
            base: 32,
            max: 2048,
            log2_size: 19,
            features: 8,
        };
        assert_eq!(
            resolutions(sdf),
            [
                32, 43, 56, 74, 98, 129, 169, 223, 295, 389, 513, 676, 892, 1177, 1553, 2049
            ]
        );
        assert_eq!(sdf.entries(), 6_984_576);
        let sdf22 = HashGrid {
            log2_size: 22,
            ..sdf
        };
        assert_eq!(sdf22.entries(), 45_724_048);
        assert_eq!(
            sdf22.level_table().iter().filter(|l| l.hashed == 0).count(),
            6
        );
        let proposal = |max| HashGrid {
            levels: 5,
            base: 16,
            max,
            log2_size: 17,
            features: 2,
        };
        assert_eq!(resolutions(proposal(64))[..4], [16, 23, 32, 46]);
        assert_eq!(resolutions(proposal(256)), [16, 32, 64, 128, 256]);
        let background = HashGrid {
            levels: 16,
            base: 16,
            max: 1024,
            log2_size: 19,
            features: 2,
        };
        assert_eq!(resolutions(background)[..6], [16, 22, 28, 37, 49, 65]);
        assert_eq!(background.entries() * 2, 11_445_040);
    }
}
