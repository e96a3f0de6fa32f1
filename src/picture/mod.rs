//! Pictures for reports: of surfaces ([`surface`]), of depths and normals, and line charts ([`chart`]). Computed on the CPU.

pub mod chart;
pub mod surface;

/// A finished picture: row-major sRGB, three bytes a pixel.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Rgb {
    pub width: usize,
    pub height: usize,
    pub bytes: Vec<u8>,
}

impl Rgb {
    /// The picture as a PNG file.
    pub fn png(&self) -> Vec<u8> {
        use image::ImageEncoder;
        assert_eq!(
            self.bytes.len(),
            3 * self.width * self.height,
            "an RGB picture has three bytes a pixel"
        );
        let mut file = Vec::new();
        image::codecs::png::PngEncoder::new_with_quality(
            &mut file,
            image::codecs::png::CompressionType::Best,
            image::codecs::png::FilterType::Adaptive,
        )
        .write_image(
            &self.bytes,
            self.width as u32,
            self.height as u32,
            image::ExtendedColorType::Rgb8,
        )
        .expect("a PNG of matching size is written to memory");
        file
    }
}

/// Depths in colour: from `near` (yellow) to `far` (dark blue), lightness falling all the way; white where not finite or beyond.
pub fn depth_picture(width: usize, height: usize, depth: &[f32], near: f32, far: f32) -> Rgb {
    // Anchors of the ramp, sRGB.
    const RAMP: [[f32; 3]; 6] = [
        [252.0, 240.0, 150.0],
        [245.0, 178.0, 85.0],
        [218.0, 103.0, 92.0],
        [148.0, 56.0, 124.0],
        [72.0, 40.0, 118.0],
        [20.0, 22.0, 66.0],
    ];
    assert_eq!(depth.len(), width * height, "one depth a pixel");
    let mut bytes = Vec::with_capacity(3 * depth.len());
    for value in depth {
        if !value.is_finite() || *value > far {
            bytes.extend([255; 3]);
            continue;
        }
        let position = ((value - near) / (far - near)).clamp(0.0, 1.0) * (RAMP.len() - 1) as f32;
        let below = (position as usize).min(RAMP.len() - 2);
        let part = position - below as f32;
        for (low, high) in RAMP[below].into_iter().zip(RAMP[below + 1]) {
            bytes.push((low + (high - low) * part).round() as u8);
        }
    }
    Rgb {
        width,
        height,
        bytes,
    }
}

/// Unit vectors in colour: each component from [-1, 1] to a byte; white where the vector is zero.
pub fn normal_picture(width: usize, height: usize, normal: &[[f32; 3]]) -> Rgb {
    assert_eq!(normal.len(), width * height, "one normal a pixel");
    let bytes = normal
        .iter()
        .flat_map(|n| {
            if *n == [0.0; 3] {
                [255; 3]
            } else {
                n.map(|component| (127.5 + 127.5 * component.clamp(-1.0, 1.0)).round() as u8)
            }
        })
        .collect();
    Rgb {
        width,
        height,
        bytes,
    }
}
