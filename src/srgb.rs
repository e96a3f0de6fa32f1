//! Bytes of colours: the sRGB transfer function (IEC 61966-2-1) both ways, and bytes of numbers from 0 to 1.

/// The byte of a number from 0 to 1. What lies outside is held to the nearer end; what is not a number is 0.
pub(crate) fn byte(value: impl Into<f64>) -> u8 {
    (255.0 * value.into().clamp(0.0, 1.0)).round() as u8
}

/// The sRGB byte of linear light from 0 to 1, held to that range as by [`byte`].
pub(crate) fn encode(linear: impl Into<f64>) -> u8 {
    let linear = linear.into().clamp(0.0, 1.0);
    byte(if linear <= 0.003_130_8 {
        12.92 * linear
    } else {
        1.055 * linear.powf(1.0 / 2.4) - 0.055
    })
}

/// Linear light from 0 to 1 of an sRGB byte.
pub(crate) fn decode(srgb: u8) -> f64 {
    let value = f64::from(srgb) / 255.0;
    if value <= 0.040_45 {
        value / 12.92
    } else {
        ((value + 0.055) / 1.055).powf(2.4)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn srgb_has_its_published_values() {
        for (linear, encoded) in [
            (0.0, 0),
            (0.0031308, 10),
            (0.2158605, 128),
            (0.5, 188),
            (1.0, 255),
        ] {
            assert_eq!(encode(linear), encoded, "{linear}");
        }
    }

    #[test]
    fn every_byte_comes_back() {
        for srgb in 0..=255 {
            assert_eq!(encode(decode(srgb)), srgb);
            assert_eq!(byte(f64::from(srgb) / 255.0), srgb);
        }
        assert_eq!((decode(0), decode(255)), (0.0, 1.0));
    }

    #[test]
    fn what_is_out_of_range_is_held_to_it() {
        for (value, held) in [
            (-1.0, 0),
            (f64::NEG_INFINITY, 0),
            (f64::NAN, 0),
            (7.0, 255),
            (f64::INFINITY, 255),
        ] {
            assert_eq!((byte(value), encode(value)), (held, held), "{value}");
        }
    }
}
