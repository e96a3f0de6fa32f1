//! NeuS's cameras_sphere.npz, the layout of DTU and BlendedMVS there (and IDR's cameras.npz, which is the same).
//!
//! `world_mat_i` projects the world to picture i of the sorted folder `image`: K [R | t], up to scale. Its pixel (0, 0) is the *centre*
//! of the first pixel, half a pixel from where it is here. `scale_mat_i` puts the unit sphere around what is to be reconstructed; the
//! world is that of world_mat, in which a DTU mesh is in millimetres, and the sphere is the region.

use std::path::{Path, PathBuf};

use glam::{DMat3, DMat4};

use super::json::file_name;
use super::{Format, Frame, FrameLens, PriorPaths, Reading, RegionHint};
use crate::arrays::Arrays;
use crate::{Error, Result};

const IMAGE_FOLDERS: [&str; 4] = ["image", "images", "rgb", "imgs"];
const MASK_FOLDERS: [&str; 2] = ["mask", "masks"];
const PICTURES: [&str; 6] = ["png", "jpg", "jpeg", "tif", "tiff", "exr"];

/// Reads `file` and looks for pictures and masks beside it.
pub(super) fn read(file: &Path) -> Result<Reading> {
    let root = file.parent().unwrap_or(Path::new("")).to_path_buf();
    let mut arrays = Arrays::open(file)?;
    let cameras = count_cameras(file, &arrays)?;
    let folder = IMAGE_FOLDERS
        .into_iter()
        .map(|name| root.join(name))
        .find(|folder| folder.is_dir())
        .ok_or_else(|| {
            let what = format!(
                "has no folder image beside it (nor {})",
                IMAGE_FOLDERS[1..].join(", ")
            );
            Error::input(file, what, "put the pictures there")
        })?;
    let images = pictures(&folder)?;
    if images.len() != cameras {
        return Err(Error::input(
            file,
            format!(
                "holds {cameras} cameras (world_mat_0 and on), but {} has {} pictures",
                folder.display(),
                images.len()
            ),
            "cameras and pictures belong together by their order: put back what is missing, or take out what is too much",
        ));
    }
    let masks = masks(&root, cameras)?;
    let (mut frames, mut notes) = (Vec::with_capacity(cameras), Vec::new());
    for (index, image) in images.into_iter().enumerate() {
        let name = format!("world_mat_{index}");
        let Projection {
            lengths: [fx, fy, cx, cy],
            skew,
            world_from_camera,
        } = Projection::of(arrays.matrix(&name)?).map_err(|what| {
            let next = "export the cameras again, or take this one and its picture out";
            Error::input(file, format!("{name} {what}"), next)
        })?;
        if skew.abs() > 1e-3 * fx && notes.is_empty() {
            notes.push(format!(
                "{name} has a skew of {skew:.3} pixels, which is not used: no camera model has skew"
            ));
        }
        frames.push(Frame {
            name: below(&root, &image),
            image: Ok(image),
            mask: masks.as_ref().map(|masks| masks[index].clone()),
            lens: FrameLens::Pinhole([fx, fy, cx + 0.5, cy + 0.5]),
            world_from_camera: super::opengl_from_opencv(world_from_camera),
            split: None,
            priors: PriorPaths::default(),
        });
    }
    let region_hint = unit_sphere(file, &mut arrays, cameras, &mut notes)?;
    Ok(Reading {
        root,
        file: file.to_path_buf(),
        format: Format::Neus,
        frames,
        points: Vec::new(),
        region_hint,
        skipped: Vec::new(),
        notes,
        world_from_colmap: vec![DMat4::IDENTITY],
        truth_from_world: None,
    })
}

/// How many `world_mat_i` there are, from 0 on without a gap.
fn count_cameras(file: &Path, arrays: &Arrays) -> Result<usize> {
    let mut numbers: Vec<usize> = arrays
        .names()
        .iter()
        .filter_map(|name| name.strip_prefix("world_mat_")?.parse().ok())
        .collect();
    numbers.sort_unstable();
    if let Some(gap) = (0..numbers.len()).find(|&index| numbers[index] != index) {
        return Err(Error::input(
            file,
            format!("holds world_mat_{} but no world_mat_{gap}", numbers[gap]),
            "number the cameras from 0 on without a gap",
        ));
    }
    Ok(numbers.len())
}

/// The pictures in a folder, sorted by name.
fn pictures(folder: &Path) -> Result<Vec<PathBuf>> {
    let entries = std::fs::read_dir(folder).map_err(|error| Error::unreadable(folder, &error))?;
    let mut found: Vec<PathBuf> = entries
        .flatten()
        .map(|entry| entry.path())
        .filter(|path| {
            let ending = path.extension().unwrap_or_default().to_ascii_lowercase();
            PICTURES.iter().any(|known| ending == *known)
        })
        .collect();
    found.sort();
    Ok(found)
}

/// One mask for each camera, by their order; or the reason why not, which counts only if masks are used.
fn masks(root: &Path, cameras: usize) -> Result<Option<Vec<Result<PathBuf, String>>>> {
    let folders = MASK_FOLDERS.into_iter().map(|name| root.join(name));
    let Some(folder) = folders.into_iter().find(|folder| folder.is_dir()) else {
        return Ok(None);
    };
    let found = pictures(&folder)?;
    let count = found.len();
    Ok(match count {
        0 => None,
        _ if count == cameras => Some(found.into_iter().map(Ok).collect()),
        _ => {
            let why = format!(
                "{} holds {count} masks for {cameras} cameras",
                folder.display()
            );
            Some(vec![Err(why); cameras])
        }
    })
}

/// A path below the dataset's directory, with forward slashes.
fn below(root: &Path, path: &Path) -> String {
    let below = path.strip_prefix(root).unwrap_or(path);
    below.display().to_string().replace('\\', "/")
}

/// What a projection K [R | t] is made of.
struct Projection {
    /// Focal lengths and centre, the centre of the first pixel being (0, 0).
    lengths: [f64; 4],
    skew: f64,
    /// With OpenCV's camera axes.
    world_from_camera: DMat4,
}

impl Projection {
    /// Takes the upper three rows of `matrix` apart, from the last row up: R's rows are orthonormal and K is upper triangular.
    fn of(matrix: DMat4) -> Result<Projection, String> {
        let left = DMat3::from_mat4(matrix);
        let determinant = left.determinant();
        if determinant.abs()
            < 1e-12 * left.x_axis.length() * left.y_axis.length() * left.z_axis.length()
            || determinant == 0.0
        {
            return Err("is no camera: its left 3x3 part is singular".into());
        }
        // Projections are equal up to a factor, but only a positive determinant is that of a rotation behind a lens.
        let sign = determinant.signum();
        let [m1, m2, m3] = [0, 1, 2].map(|row| left.row(row) * sign);
        let k33 = m3.length();
        let r3 = m3 / k33;
        let k23 = m2.dot(r3);
        let across = m2 - r3 * k23;
        let k22 = across.length();
        let r2 = across / k22;
        let (k12, k13) = (m1.dot(r2), m1.dot(r3));
        let across = m1 - r2 * k12 - r3 * k13;
        let k11 = across.length();
        let r1 = across / k11;
        let center = left.inverse() * -matrix.w_axis.truncate();
        let pose = DMat4::from_cols(
            r1.extend(0.0),
            r2.extend(0.0),
            r3.extend(0.0),
            center.extend(1.0),
        );
        Ok(Projection {
            lengths: [k11, k22, k13, k23].map(|length| length / k33),
            skew: k12 / k33,
            world_from_camera: super::rigid(pose)?,
        })
    }
}

/// The unit sphere of `scale_mat_0` in the world, where there is one. The others are the same in every dataset of this layout.
fn unit_sphere(
    file: &Path,
    arrays: &mut Arrays,
    cameras: usize,
    notes: &mut Vec<String>,
) -> Result<Option<RegionHint>> {
    let names = arrays.names();
    if cameras == 0 || !names.iter().any(|name| name == "scale_mat_0") {
        return Ok(None);
    }
    let matrix = arrays.matrix("scale_mat_0")?;
    let axes = DMat3::from_mat4(matrix);
    let radius = axes.x_axis.length();
    if !(radius > 0.0 && super::off_orthonormal(axes * radius.recip()) <= 1e-3) {
        return Err(Error::input(
            file,
            format!("scale_mat_0 makes no sphere of the unit sphere: its axes are {axes}"),
            "export the cameras again",
        ));
    }
    let other = (1..cameras).find(|index| {
        let name = format!("scale_mat_{index}");
        names.contains(&name)
            && arrays
                .matrix(&name)
                .is_ok_and(|other| !other.abs_diff_eq(matrix, 1e-3 * radius))
    });
    if let Some(other) = other {
        notes.push(format!(
            "scale_mat_{other} differs from scale_mat_0, which is used for all cameras"
        ));
    }
    Ok(Some(RegionHint {
        center: matrix.w_axis.truncate(),
        radius,
        half: None,
        how: format!("the unit sphere of scale_mat_0 of {}", file_name(file)),
    }))
}
