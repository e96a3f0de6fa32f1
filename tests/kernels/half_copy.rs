//! What look-ups read where a table has a copy in float16.

use half::f16;

/// A number that float16 has: the last bits of this one are cut off.
#[allow(dead_code)] // not by every test program
pub fn cut(x: f64) -> f64 {
    let cut = f32::from_bits((x as f32).to_bits() & !0x1fff);
    // Below float16's smallest normal number there are fewer bits.
    if cut.abs() < 1.0 / 16384.0 {
        0.0
    } else {
        f64::from(cut)
    }
}

/// The copy is that of these values, whichever way the device rounds.
#[allow(dead_code)]
pub fn assert_copy(copy: &[u32], values: &[f64]) {
    assert_eq!(2 * copy.len(), values.len());
    let mut different = 0;
    for (i, &value) in values.iter().enumerate() {
        let bits = (copy[i / 2] >> (16 * (i % 2))) as u16;
        let copy = f16::from_bits(bits).to_f64();
        let allowed = value.abs() / 1024.0 + 6e-8;
        assert!((copy - value).abs() <= allowed, "{i}: {copy} of {value}");
        different += usize::from(copy != value);
    }
    assert!(different > 0, "values that float16 has tell nothing");
}
