//! Pictures and masks: JPEG, PNG and TIFF through `image`, EXR through `exr`, all as RGBA with 8 bits a channel.
//!
//! Reduction is by area: every pixel of the result is the mean of what it covers, colours weighted by alpha. EXR is linear light and
//! becomes sRGB (IEC 61966-2-1).

use std::path::{Path, PathBuf};

use image::metadata::Orientation;
use image::{DynamicImage, ImageDecoder, ImageReader, RgbaImage};

use super::{Camera, View};
use crate::{Error, Result, srgb};

/// A picture in memory.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Picture {
    pub width: u32,
    pub height: u32,
    /// `[height, width, 4]`: red, green, blue in sRGB, not multiplied by the fourth, which is mask times alpha: 255 where the pixel
    /// counts (everywhere, without a mask), 0 where it does not.
    pub rgba: Vec<u8>,
}

impl Picture {
    /// Its colours alone, in [0, 1]: `[height, width, 3]`.
    pub fn rgb(&self) -> Vec<f32> {
        self.rgba
            .chunks_exact(4)
            .flat_map(|pixel| [0, 1, 2].map(|c| f32::from(pixel[c]) / 255.0))
            .collect()
    }
}

/// What a picture's header says.
pub(super) struct Header {
    /// As stored, EXIF orientation not applied.
    pub width: u32,
    pub height: u32,
    orientation: Orientation,
}

impl Header {
    /// The size in which the picture fits `camera`: as stored, or turned the way EXIF says; `None` if neither is proportional.
    pub fn stored_or_turned_for(&self, camera: &Camera) -> Option<(u32, u32)> {
        let stored = (self.width, self.height);
        if proportional(stored, (camera.width, camera.height)) {
            return Some(stored);
        }
        let turned = (self.height, self.width);
        (turns_sideways(self.orientation) && proportional(turned, (camera.width, camera.height)))
            .then_some(turned)
    }
}

fn turns_sideways(orientation: Orientation) -> bool {
    matches!(
        orientation,
        Orientation::Rotate90
            | Orientation::Rotate270
            | Orientation::Rotate90FlipH
            | Orientation::Rotate270FlipH
    )
}

/// Whether two sizes differ by one factor, up to a pixel of rounding in the smaller.
pub(super) fn proportional(a: (u32, u32), b: (u32, u32)) -> bool {
    let (a, b) = if a.0 <= b.0 { (a, b) } else { (b, a) };
    let factor = f64::from(b.0) / f64::from(a.0);
    (f64::from(b.1) / factor - f64::from(a.1)).abs() <= 1.0 + 0.5 * f64::from(a.1) / f64::from(a.0)
}

fn is_exr(path: &Path) -> bool {
    path.extension()
        .is_some_and(|extension| extension.eq_ignore_ascii_case("exr"))
}

/// Reads the header of the picture at `path`.
pub(super) fn header(path: &Path) -> Result<Header> {
    if is_exr(path) {
        let meta = exr::meta::MetaData::read_from_file(path, false)
            .map_err(|error| undecodable(path, &error))?;
        let size = meta.headers.first().map(|header| header.layer_size);
        let size = size.ok_or_else(|| undecodable(path, &"it holds no layer"))?;
        return Ok(Header {
            width: u32::try_from(size.width()).map_err(|error| undecodable(path, &error))?,
            height: u32::try_from(size.height()).map_err(|error| undecodable(path, &error))?,
            orientation: Orientation::NoTransforms,
        });
    }
    let mut decoder = decoder(path)?;
    let (width, height) = decoder.dimensions();
    Ok(Header {
        width,
        height,
        orientation: decoder.orientation().unwrap_or(Orientation::NoTransforms),
    })
}

/// A decoder that allocates at most 4 GiB: 1 gigapixel as RGBA.
fn decoder(path: &Path) -> Result<impl ImageDecoder> {
    let mut reader = ImageReader::open(path)
        .and_then(ImageReader::with_guessed_format)
        .map_err(|error| Error::unreadable(path, &error))?;
    let mut limits = image::Limits::default();
    limits.max_alloc = Some(4 << 30);
    reader.limits(limits);
    reader
        .into_decoder()
        .map_err(|error| undecodable(path, &error))
}

fn undecodable(path: &Path, error: &dyn std::fmt::Display) -> Error {
    Error::input(
        path,
        format!("cannot be read as a picture: {error}"),
        "replace it by a whole JPEG, PNG, TIFF or EXR file, or take it out of the dataset",
    )
}

/// Reads `view`'s picture with its mask, reduced to its camera's size.
pub(super) fn load(view: &View, masks: bool) -> Result<Picture> {
    let path = &view.image_path;
    let (mut rgba, orientation) = decode(path)?;
    let wanted = (view.camera.width, view.camera.height);
    let turn = !proportional(rgba.dimensions(), wanted) && turns_sideways(orientation);
    let upright = |image: RgbaImage| {
        let mut image = DynamicImage::ImageRgba8(image);
        image.apply_orientation(orientation);
        image.into_rgba8()
    };
    if turn {
        rgba = upright(rgba);
    }
    let (width, height) = rgba.dimensions();
    if width < wanted.0 || height < wanted.1 || !proportional((width, height), wanted) {
        return Err(Error::input(
            path,
            format!(
                "the picture has {width}x{height} pixels now, which does not reduce to the {}x{} it was opened with",
                wanted.0, wanted.1
            ),
            "do not change pictures while they are being read",
        ));
    }
    if !masks {
        composite_on_black(&mut rgba);
    }
    if let Some(mask_path) = view.mask_path.as_ref().filter(|_| masks) {
        let mut mask = decode_mask(mask_path)?;
        if mask.dimensions() != (width, height) && turn {
            mask = upright(mask);
        }
        if mask.dimensions() != (width, height) {
            return Err(mask_size(
                mask_path,
                mask.dimensions(),
                path,
                (width, height),
            ));
        }
        for (pixel, mask) in rgba.pixels_mut().zip(mask.pixels()) {
            pixel[3] = (u32::from(pixel[3]) * u32::from(mask[3]) / 255) as u8;
        }
    }
    let rgba = if (width, height) == wanted {
        rgba.into_raw()
    } else {
        reduce(
            rgba.as_raw(),
            (width as usize, height as usize),
            (wanted.0 as usize, wanted.1 as usize),
        )
    };
    Ok(Picture {
        width: wanted.0,
        height: wanted.1,
        rgba,
    })
}

/// Decodes to straight (not premultiplied) RGBA, as stored, with the EXIF orientation beside it.
fn decode(path: &Path) -> Result<(RgbaImage, Orientation)> {
    if is_exr(path) {
        return Ok((decode_exr(path)?, Orientation::NoTransforms));
    }
    if is_cut_off(path)? {
        return Err(undecodable(
            path,
            &"the file ends in the middle of the picture",
        ));
    }
    let mut decoder = decoder(path)?;
    let orientation = decoder.orientation().unwrap_or(Orientation::NoTransforms);
    let image = DynamicImage::from_decoder(decoder).map_err(|error| undecodable(path, &error))?;
    Ok((image.into_rgba8(), orientation))
}

/// Whether a JPEG lacks its end, which decoders forgive and fill with grey: no end marker follows its first scan. What follows the end
/// may be anything, such as a phone's film.
fn is_cut_off(path: &Path) -> Result<bool> {
    let data = std::fs::read(path).map_err(|source| Error::unreadable(path, &source))?;
    Ok(data.starts_with(&[0xff, 0xd8, 0xff])
        && first_scan(&data).is_some_and(|scan| !scan.windows(2).any(|pair| pair == [0xff, 0xd9])))
}

/// What follows a JPEG's first marker of a scan. Segments before it are passed by their lengths: a preview in one is a JPEG of its own.
fn first_scan(jpeg: &[u8]) -> Option<&[u8]> {
    let mut at = 2;
    while let [0xff, marker, segment @ ..] = jpeg.get(at..)? {
        at += match marker {
            0xda => return Some(segment),
            0xff => 1,               // fills up
            0x01 | 0xd0..=0xd8 => 2, // stands alone
            _ => 2 + usize::from(u16::from_be_bytes(*segment.first_chunk()?)),
        };
    }
    None
}

fn decode_exr(path: &Path) -> Result<RgbaImage> {
    use exr::prelude::{Vec2, read_first_rgba_layer_from_file};
    let image = read_first_rgba_layer_from_file(
        path,
        |size: Vec2<usize>, _| RgbaImage::new(size.width() as u32, size.height() as u32),
        |image: &mut RgbaImage, at: Vec2<usize>, (r, g, b, a): (f32, f32, f32, f32)| {
            // EXR's colours are premultiplied by its alpha.
            let straight = |channel: f32| srgb::encode(if a > 0.0 { channel / a } else { channel });
            image.put_pixel(
                at.x() as u32,
                at.y() as u32,
                image::Rgba([straight(r), straight(g), straight(b), srgb::byte(a)]),
            );
        },
    )
    .map_err(|error| undecodable(path, &error))?;
    Ok(image.layer_data.channel_data.pixels)
}

/// Where masks are not used, what they would have hidden is black.
fn composite_on_black(rgba: &mut RgbaImage) {
    for pixel in rgba.pixels_mut().filter(|pixel| pixel[3] != 255) {
        let alpha = u32::from(pixel[3]);
        for channel in &mut pixel.0[..3] {
            *channel = ((u32::from(*channel) * alpha + 127) / 255) as u8;
        }
        pixel[3] = 255;
    }
}

/// Reads a mask into the fourth channel: 255 where the picture counts.
fn decode_mask(path: &Path) -> Result<RgbaImage> {
    let mut mask = decode(path)?.0;
    // Label images hold 0 and 1 instead of 0 and 255.
    let labels = mask
        .pixels()
        .all(|pixel| pixel.0[..3].iter().all(|channel| *channel <= 1));
    let hides = hides(path);
    for pixel in mask.pixels_mut() {
        let [r, g, b, _] = pixel.0.map(u32::from);
        let grey = ((r + g + b) / 3) as u8;
        let value = if labels { grey.min(1) * 255 } else { grey };
        pixel[3] = if hides { 255 - value } else { value };
    }
    Ok(mask)
}

/// instant-ngp's masks are white where something moved, that is where the picture does not count.
fn hides(mask: &Path) -> bool {
    mask.file_name()
        .is_some_and(|name| name.to_string_lossy().starts_with("dynamic_mask_"))
}

/// Looks for the mask of a picture below `root` where the dataset names none: `masks/` beside `images/` (`masks_x` beside `images_x`),
/// with the same name but `.png`, or the whole name and `.png`, or instant-ngp's `dynamic_mask_` beside the picture.
pub(super) fn find_mask(root: &Path, image: &Path) -> Option<PathBuf> {
    let file_name = image.file_name()?.to_string_lossy().into_owned();
    let stem = image.file_stem()?.to_string_lossy().into_owned();
    let dynamic = image.with_file_name(format!("dynamic_mask_{stem}.png"));
    if dynamic.is_file() {
        return Some(dynamic);
    }
    let below = image.strip_prefix(root).ok()?;
    let mut folders: Vec<PathBuf> = vec![root.join("masks").join(below.parent()?)];
    for (depth, part) in below.parent()?.components().enumerate() {
        let part = part.as_os_str().to_string_lossy();
        let above: PathBuf = below.components().take(depth).collect();
        let rest: PathBuf = below.parent()?.components().skip(depth + 1).collect();
        for folder in [part.replacen("images", "masks", 1), "masks".to_owned()] {
            if folder != part {
                folders.push(root.join(&above).join(folder).join(&rest));
            }
        }
    }
    folders
        .into_iter()
        .flat_map(|folder| {
            [
                folder.join(format!("{stem}.png")),
                folder.join(format!("{file_name}.png")),
            ]
        })
        .find(|path| path.is_file())
}

/// Checks that a view's mask, if it has one, is as large as its picture.
pub(super) fn check_mask(
    view: &View,
    upright: impl Fn(&Header) -> Option<(u32, u32)>,
) -> Result<()> {
    let Some(mask_path) = &view.mask_path else {
        return Ok(());
    };
    let (mask, image) = (header(mask_path)?, header(&view.image_path)?);
    let same = (mask.width, mask.height) == (image.width, image.height);
    if same || Some((mask.width, mask.height)) == upright(&image) {
        return Ok(());
    }
    Err(mask_size(
        mask_path,
        (mask.width, mask.height),
        &view.image_path,
        (image.width, image.height),
    ))
}

fn mask_size(mask: &Path, mask_size: (u32, u32), image: &Path, image_size: (u32, u32)) -> Error {
    Error::input(
        mask,
        format!(
            "the mask has {}x{} pixels, its picture {} has {}x{}",
            mask_size.0,
            mask_size.1,
            image.display(),
            image_size.0,
            image_size.1
        ),
        "make them the same size, or do without masks (--no-masks)",
    )
}

/// Mean over the area that each pixel of the result covers; colours weighted by alpha. Sizes are (width, height).
fn reduce(rgba: &[u8], from: (usize, usize), to: (usize, usize)) -> Vec<u8> {
    let columns = Coverage::new(from.0, to.0);
    let rows = Coverage::new(from.1, to.1);
    // One input row reduced across: premultiplied colour and alpha per output column.
    let across = |row: usize| -> Vec<[f32; 4]> {
        let line = &rgba[row * from.0 * 4..(row + 1) * from.0 * 4];
        let reduce_column = |column: usize| {
            let mut sum = [0.0f32; 4];
            for (source, weight) in columns.of(column) {
                let pixel = &line[source * 4..source * 4 + 4];
                let alpha = weight * f32::from(pixel[3]);
                for channel in 0..3 {
                    sum[channel] += alpha * f32::from(pixel[channel]);
                }
                sum[3] += alpha;
            }
            sum
        };
        (0..to.0).map(reduce_column).collect()
    };
    let mut reduced = Vec::with_capacity(to.0 * to.1 * 4);
    let mut last: Option<(usize, Vec<[f32; 4]>)> = None; // a row on a border counts for the rows on both sides
    for row in 0..to.1 {
        let mut sums = vec![[0.0f32; 4]; to.0];
        for (source, weight) in rows.of(row) {
            if last.as_ref().is_none_or(|(number, _)| *number != source) {
                last = Some((source, across(source)));
            }
            let (_, line) = last.as_ref().expect("set above");
            for (sum, pixel) in sums.iter_mut().zip(line) {
                for channel in 0..4 {
                    sum[channel] += weight * pixel[channel];
                }
            }
        }
        for [r, g, b, alpha] in sums {
            let colour = |premultiplied: f32| {
                if alpha > 0.0 {
                    (premultiplied / alpha).round() as u8
                } else {
                    0
                }
            };
            reduced.extend([colour(r), colour(g), colour(b), alpha.round() as u8]);
        }
    }
    reduced
}

/// Which input pixels an output pixel covers along one axis, and by how much of it.
struct Coverage {
    scale: f64,
    from: usize,
}

impl Coverage {
    fn new(from: usize, to: usize) -> Self {
        Coverage {
            scale: from as f64 / to as f64,
            from,
        }
    }

    /// (input index, share of the output pixel); the shares sum to 1.
    fn of(&self, index: usize) -> impl Iterator<Item = (usize, f32)> + '_ {
        let (start, end) = (index as f64 * self.scale, (index + 1) as f64 * self.scale);
        let last = (end.ceil() as usize).min(self.from);
        (start as usize..last).filter_map(move |source| {
            let overlap = end.min((source + 1) as f64) - start.max(source as f64);
            (overlap > 1e-9).then_some((source, (overlap / self.scale) as f32))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reduction_keeps_the_mean() {
        let (width, height) = (13usize, 7usize);
        let rgba: Vec<u8> = (0..width * height)
            .flat_map(|pixel| [(pixel * 37 % 256) as u8, (pixel * 11 % 256) as u8, 200, 255])
            .collect();
        let mean = |rgba: &[u8], channel: usize| {
            rgba.chunks(4)
                .map(|pixel| f64::from(pixel[channel]))
                .sum::<f64>()
                / (rgba.len() / 4) as f64
        };
        for to in [(13, 7), (6, 3), (5, 7), (1, 1), (12, 2)] {
            let small = reduce(&rgba, (width, height), to);
            assert_eq!(small.len(), to.0 * to.1 * 4);
            for channel in 0..4 {
                let difference = mean(&small, channel) - mean(&rgba, channel);
                assert!(
                    difference.abs() < 0.5,
                    "{to:?} channel {channel}: off by {difference}"
                );
            }
        }
        assert_eq!(reduce(&rgba, (width, height), (width, height)), rgba);
    }

    #[test]
    fn hidden_colours_do_not_bleed_into_reduced_pixels() {
        let rgba = [200, 100, 50, 255, 0, 255, 0, 0];
        assert_eq!(reduce(&rgba, (2, 1), (1, 1)), [200, 100, 50, 128]);
    }

    #[test]
    fn sizes_are_proportional_up_to_rounding() {
        assert!(proportional((400, 300), (800, 600)));
        assert!(proportional((1237, 822), (4946, 3286)));
        assert!(proportional((4946, 3286), (1237, 822)));
        assert!(!proportional((400, 300), (300, 400)));
        assert!(!proportional((400, 300), (400, 290)));
    }
}
