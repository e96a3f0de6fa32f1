//! Numbers drawn as functions of what they are for, by SplitMix64 (Steele, Lea & Flood 2014): no state, so the same in every order.

/// SplitMix64's step: indices times this are far apart.
pub(crate) const STEP: u64 = 0x9e37_79b9_7f4a_7c15;

/// SplitMix64's finaliser: bits that look unlike those of any other `x`.
pub(crate) fn mix(x: u64) -> u64 {
    let x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    x ^ (x >> 31)
}

/// Bits as a number in [0, 1).
pub(crate) fn unit(bits: u64) -> f64 {
    (bits >> 11) as f64 / (1u64 << 53) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_sequence_is_the_published_one() {
        // SplitMix64's first outputs from the seed 1234567.
        let outputs = [1, 2, 3].map(|n: u64| mix(STEP.wrapping_mul(n).wrapping_add(1_234_567)));
        assert_eq!(
            outputs,
            [
                6_457_827_717_110_365_317,
                3_203_168_211_198_807_973,
                9_817_491_932_198_370_423
            ]
        );
        assert_eq!(unit(0), 0.0);
        assert!((1.0 - unit(u64::MAX) - f64::EPSILON / 2.0).abs() < 1e-20);
    }
}
