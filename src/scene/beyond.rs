//! What lies beyond the region: nothing to speak of, or ground and surroundings that run on.
//!
//! A background of one learned colour is enough for the former. For the latter it is not: the surface would have to explain what it
//! cannot reach, and is lost over it.

use rayon::prelude::*;
use serde::Serialize;

use super::bounds::{ENOUGH_POINTS, sampled_points, train_views};
use super::{Region, Scene, View, images};
use crate::Result;

/// Whether what the pictures show beyond the region is more than an even backdrop, and what says so.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Beyond {
    pub runs_on: bool,
    pub why: String,
}

/// Views and pixels per view that are looked at: more would not change a share of percents.
const VIEWS: usize = 8;
const COLUMNS: u32 = 48;
const ROWS: u32 = 36;
/// Shares below this are noise: mismatched points, pixels on an outline.
const NOISE: f64 = 0.05;
/// Colours differ from the backdrop's by more than shading and compression do, of 255.
const DIFFERENT: u8 = 32;

impl Beyond {
    /// Judges by the pixels whose rays miss the region, and by the sparse points.
    ///
    /// # Errors
    /// [`crate::Error::Input`] for a picture that cannot be read.
    pub fn of(scene: &Scene, region: &Region) -> Result<Beyond> {
        let (beside, looked_at) = beside_region(scene, region)?;
        let points = sampled_points(scene);
        let outside = points.iter().filter(|point| !region.contains(**point));
        let outside = outside.count() as f64 / points.len().max(1) as f64;
        if points.len() >= ENOUGH_POINTS && outside > 2.0 * NOISE {
            let why = format!(
                "{:.0} % of the sparse points lie outside the region",
                100.0 * outside
            );
            return Ok(Beyond { runs_on: true, why });
        }
        if beside.len() as f64 > NOISE * looked_at as f64 {
            let backdrop = median_colour(&beside);
            let differs = |colour: &&[u8; 3]| {
                let apart = (0..3).map(|channel| colour[channel].abs_diff(backdrop[channel]));
                apart.max().unwrap_or(0) > DIFFERENT
            };
            let share = beside.iter().filter(differs).count() as f64 / beside.len() as f64;
            let [r, g, b] = backdrop;
            return Ok(Beyond {
                runs_on: share > NOISE,
                why: format!(
                    "{:.0} % of the pixels that look past the region differ from their median colour ({r}, {g}, {b})",
                    100.0 * share
                ),
            });
        }
        if points.len() >= ENOUGH_POINTS {
            let inside = 100.0 * (1.0 - outside);
            return Ok(Beyond {
                runs_on: false,
                why: format!("{inside:.0} % of the sparse points lie inside the region"),
            });
        }
        Ok(Beyond {
            runs_on: true,
            why: "the region fills the pictures, and no points say that nothing lies behind it"
                .into(),
        })
    }
}

/// Colours of the pixels that count and whose rays miss the region, in a few views; and how many pixels were looked at.
fn beside_region(scene: &Scene, region: &Region) -> Result<(Vec<[u8; 3]>, usize)> {
    let views: Vec<&View> = train_views(scene).collect();
    let views = views.iter().step_by(views.len().div_ceil(VIEWS).max(1));
    let colours = |view: &&&View| -> Result<(Vec<[u8; 3]>, usize)> {
        let picture = images::load(view, scene.masks)?;
        let (mut colours, mut looked_at) = (Vec::new(), 0);
        for row in 0..ROWS {
            for column in 0..COLUMNS {
                let x = (2 * column + 1) * picture.width / (2 * COLUMNS);
                let y = (2 * row + 1) * picture.height / (2 * ROWS);
                let at = 4 * (y as usize * picture.width as usize + x as usize);
                let [r, g, b, counts] = picture.rgba[at..at + 4] else {
                    unreachable!("four channels");
                };
                if counts < 128 {
                    continue;
                }
                looked_at += 1;
                let pixel = glam::DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
                let (origin, direction) = view.ray(pixel);
                if !region.meets_ray(origin, direction) {
                    colours.push([r, g, b]);
                }
            }
        }
        Ok((colours, looked_at))
    };
    let found: Vec<_> = views
        .collect::<Vec<_>>()
        .par_iter()
        .map(colours)
        .collect::<Result<_>>()?;
    let looked_at = found.iter().map(|(_, looked_at)| looked_at).sum();
    let beside = found.into_iter().flat_map(|(colours, _)| colours).collect();
    Ok((beside, looked_at))
}

/// Channel by channel.
fn median_colour(colours: &[[u8; 3]]) -> [u8; 3] {
    std::array::from_fn(|channel| {
        let mut values: Vec<u8> = colours.iter().map(|colour| colour[channel]).collect();
        let middle = values.len() / 2;
        *values.select_nth_unstable(middle).1
    })
}
