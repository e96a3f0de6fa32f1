//! PSNR and SSIM of pictures with values in [0, 1].
//!
//! PSNR = −10 log₁₀ MSE. SSIM (Wang, Bovik, Sheikh & Simoncelli 2004) with an 11×11 Gaussian window of σ = 1.5, K₁ = 0.01, K₂ = 0.03,
//! over the windows that lie inside the picture, per channel, then the mean of the channels.

use crate::scene::Picture;

/// Whether a photograph's mask keeps a pixel.
fn keeps(pixel: &[u8]) -> bool {
    pixel[3] >= 128
}

/// Whether a photograph's mask keeps any pixel.
pub fn keeps_any(photo: &Picture) -> bool {
    photo.rgba.chunks_exact(4).any(keeps)
}

/// PSNR and SSIM of a rendering `[height, width]` beside its photograph; with `masked`, of what the photograph's mask keeps, which has to
/// be something ([`keeps_any`]): the PSNR of nothing is no number.
pub fn compare(rendered: &[[f32; 3]], photo: &Picture, masked: bool) -> (f64, Option<f64>) {
    let counts = |pixel: &[u8]| !masked || keeps(pixel);
    let colors = photo.rgb();
    // What does not count is made equal, and left out of the mean.
    let ours: Vec<f32> = rendered
        .iter()
        .zip(photo.rgba.chunks_exact(4))
        .flat_map(|(rgb, pixel)| {
            [0, 1, 2].map(|c| match counts(pixel) {
                true => rgb[c].clamp(0.0, 1.0),
                false => f32::from(pixel[c]) / 255.0,
            })
        })
        .collect();
    let counted: Vec<bool> = photo.rgba.chunks_exact(4).map(counts).collect();
    let share = counted.iter().filter(|&&counts| counts).count() as f64 / rendered.len() as f64;
    let (width, height) = (photo.width as usize, photo.height as usize);
    (
        psnr(&ours, &colors) + 10.0 * share.log10(),
        ssim_where(&ours, &colors, width, height, 3, |pixel| counted[pixel]),
    )
}

/// Mean squared difference. Any shape.
///
/// # Panics
/// If the lengths differ or are zero.
pub fn mean_squared_error(a: &[f32], b: &[f32]) -> f64 {
    assert_eq!(a.len(), b.len(), "pictures of different size");
    assert!(!a.is_empty(), "empty pictures");
    let squares = a
        .iter()
        .zip(b)
        .map(|(&a, &b)| (f64::from(a) - f64::from(b)).powi(2));
    squares.sum::<f64>() / a.len() as f64
}

/// Peak signal-to-noise ratio in dB; infinite for equal pictures.
///
/// # Panics
/// If the lengths differ or are zero.
pub fn psnr(a: &[f32], b: &[f32]) -> f64 {
    -10.0 * mean_squared_error(a, b).log10()
}

const RADIUS: usize = 5;
const SIGMA: f64 = 1.5;

/// Structural similarity of two pictures `[height, width, channels]`; `None` if a window does not fit into them.
///
/// # Panics
/// If the slices are not `width · height · channels` long.
pub fn ssim(a: &[f32], b: &[f32], width: usize, height: usize, channels: usize) -> Option<f64> {
    ssim_where(a, b, width, height, channels, |_| true)
}

/// The same over the windows whose centre is a pixel that `counts`; `None` if there is none.
fn ssim_where(
    a: &[f32],
    b: &[f32],
    width: usize,
    height: usize,
    channels: usize,
    counts: impl Fn(usize) -> bool,
) -> Option<f64> {
    assert_eq!(
        (a.len(), b.len()),
        (width * height * channels, width * height * channels),
        "pictures of the stated size"
    );
    if width.min(height) <= 2 * RADIUS || channels == 0 {
        return None;
    }
    let across = width - 2 * RADIUS;
    let center = |i: usize| (i / across + RADIUS) * width + i % across + RADIUS;
    let windows: Vec<usize> = (0..across * (height - 2 * RADIUS))
        .filter(|&i| counts(center(i)))
        .collect();
    if windows.is_empty() {
        return None;
    }
    let (c1, c2) = (0.01f64.powi(2), 0.03f64.powi(2));
    let window = window();
    let channel_mean = |channel: usize| {
        let plane = |picture: &[f32]| -> Vec<f64> {
            picture
                .iter()
                .skip(channel)
                .step_by(channels)
                .map(|&x| f64::from(x))
                .collect()
        };
        let (a, b) = (plane(a), plane(b));
        let blurred = |f: &dyn Fn(f64, f64) -> f64| {
            let product: Vec<f64> = a.iter().zip(&b).map(|(&a, &b)| f(a, b)).collect();
            blur(&product, width, height, &window)
        };
        let mean_a = blurred(&|a, _| a);
        let mean_b = blurred(&|_, b| b);
        let square_a = blurred(&|a, _| a * a);
        let square_b = blurred(&|_, b| b * b);
        let product = blurred(&|a, b| a * b);
        let total: f64 = windows
            .iter()
            .map(|&i| {
                let (ma, mb) = (mean_a[i], mean_b[i]);
                let (variance_a, variance_b, covariance) = (
                    square_a[i] - ma * ma,
                    square_b[i] - mb * mb,
                    product[i] - ma * mb,
                );
                (2.0 * ma * mb + c1) * (2.0 * covariance + c2)
                    / ((ma * ma + mb * mb + c1) * (variance_a + variance_b + c2))
            })
            .sum();
        total / windows.len() as f64
    };
    Some((0..channels).map(channel_mean).sum::<f64>() / channels as f64)
}

fn window() -> [f64; 2 * RADIUS + 1] {
    let weights: [f64; 2 * RADIUS + 1] = std::array::from_fn(|i| {
        (-(i as f64 - RADIUS as f64).powi(2) / (2.0 * SIGMA * SIGMA)).exp()
    });
    let sum: f64 = weights.iter().sum();
    weights.map(|weight| weight / sum)
}

/// Weighted means over the windows that fit: `[height − 2 RADIUS, width − 2 RADIUS]`.
fn blur(plane: &[f64], width: usize, height: usize, window: &[f64]) -> Vec<f64> {
    let dot =
        |values: &mut dyn Iterator<Item = f64>| values.zip(window).map(|(x, w)| x * w).sum::<f64>();
    let out_width = width - 2 * RADIUS;
    let rows: Vec<f64> = plane
        .chunks_exact(width)
        .flat_map(|row| row.windows(window.len()))
        .map(|values| dot(&mut values.iter().copied()))
        .collect();
    (0..(height - 2 * RADIUS) * out_width)
        .map(|at| dot(&mut rows[at..].iter().step_by(out_width).copied()))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A rendering that is 0.1 off where the mask keeps it and wrong elsewhere has 20 dB.
    #[test]
    fn what_is_masked_out_does_not_count() {
        let rendered: Vec<[f32; 3]> = (0..8)
            .map(|i| if i < 4 { [0.5; 3] } else { [1.0; 3] })
            .collect();
        let photo = Picture {
            width: 4,
            height: 2,
            rgba: (0..8)
                .flat_map(|i| if i < 4 { [102, 102, 102, 255] } else { [0; 4] })
                .collect(),
        };
        let (masked, _) = compare(&rendered, &photo, true);
        assert!((masked - 20.0).abs() < 1e-3, "{masked}");
        let (whole, ssim) = compare(&rendered, &photo, false);
        assert!(
            (whole + 10.0 * (0.5f64 * 0.01 + 0.5).log10()).abs() < 1e-3,
            "{whole}"
        );
        assert_eq!(ssim, None, "too small for a window");
    }

    /// Of a mask that keeps one pixel, the SSIM is that of the window around it.
    #[test]
    fn only_windows_around_what_the_mask_keeps_count() {
        let (width, height, kept) = (20usize, 16usize, 8 * 20 + 11);
        let colors = |pixel: usize| [1, 2, 3].map(|c| (pixel * 37 * c % 256) as u8);
        let photo = |kept| Picture {
            width: width as u32,
            height: height as u32,
            rgba: (0..width * height)
                .flat_map(|pixel| {
                    let [r, g, b] = colors(pixel);
                    [r, g, b, if pixel == kept { 255 } else { 0 }]
                })
                .collect(),
        };
        let rendered = vec![[0.5; 3]; width * height];
        let crop = |of: &dyn Fn(usize) -> [f32; 3]| -> Vec<f32> {
            let rows = 8 - RADIUS..=8 + RADIUS;
            rows.flat_map(|y| (11 - RADIUS..=11 + RADIUS).map(move |x| y * width + x))
                .flat_map(of)
                .collect()
        };
        let theirs = |pixel: usize| colors(pixel).map(|c| f32::from(c) / 255.0);
        let ours = |pixel: usize| match pixel == kept {
            true => [0.5; 3],
            false => theirs(pixel),
        };
        let expected = ssim(&crop(&ours), &crop(&theirs), 11, 11, 3).unwrap();
        let (_, got) = compare(&rendered, &photo(kept), true);
        assert!((got.unwrap() - expected).abs() < 1e-9, "{got:?}");
        let (_, at_the_edge) = compare(&rendered, &photo(0), true);
        assert_eq!(at_the_edge, None, "no window is around it");
    }
}
