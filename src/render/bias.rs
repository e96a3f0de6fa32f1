//! The bias of a rendered surface: along a ray, the heaviest point need not be where the signed distance is zero (Wang et al. 2024,
//! NeuRodin). How far apart they are, on a trained field and on a plane, where it is known in closed form.

use crate::Result;
use crate::config::{DensityKind, ScaleKind};
use crate::gpu::{Gpu, Work};
use crate::kernels::{composite_forward, optical_depth};

/// From the first zero crossing of a ray to the middle of its heaviest bin; positive behind the surface. `None` without a crossing.
///
/// `distances` of the samples along the ray, which are the bins' starts or, with `midpoints`, their middles; the signed distances there;
/// the bins' weights. The crossing is found linearly between two samples, so it is as sharp as these are close.
pub fn behind_surface(
    distances: &[f32],
    sdf: &[f32],
    weights: &[f32],
    midpoints: bool,
) -> Option<f32> {
    let entered = (1..sdf.len()).find(|&i| sdf[i - 1] >= 0.0 && sdf[i] < 0.0)?;
    let share = sdf[entered - 1] / (sdf[entered - 1] - sdf[entered]);
    let surface = distances[entered - 1] + share * (distances[entered] - distances[entered - 1]);
    let mut heaviest = 0;
    for (i, weight) in weights.iter().enumerate() {
        if *weight > weights[heaviest] {
            heaviest = i;
        }
    }
    let at = match (midpoints, distances.get(heaviest + 1)) {
        (false, Some(next)) => 0.5 * (distances[heaviest] + next),
        _ => distances[heaviest],
    };
    Some(at - surface)
}

/// The same for a plane met at the angle whose cosine is given, in units of β and infinitely many samples: for the Laplace density of the
/// signed distance
///     (1/c) ln(2c) where c < ½, before the surface,  −(1/c) ln(2 + c − √(c² + 4c)) beyond, behind it;
/// for that of the distance along the line of sight the second at c = 1, whatever the angle.
pub fn closed_form(density: DensityKind, cosine: f64) -> Option<f64> {
    let behind = |c: f64| -(2.0 + c - (c * c + 4.0 * c).sqrt()).ln() / c;
    match density {
        DensityKind::Laplace if cosine < 0.5 => Some((2.0 * cosine).ln() / cosine),
        DensityKind::Laplace => Some(behind(cosine)),
        DensityKind::Sight => Some(behind(1.0)),
        DensityKind::Neus => None,
    }
}

/// What the kernels say of a plane, in units of β: rays that meet it at angles of these cosines, so finely sampled that the bins are no
/// part of the answer.
///
/// # Errors
/// What the device fails with.
pub fn on_plane(gpu: &Gpu, density: DensityKind, cosines: &[f64]) -> Result<Vec<f64>> {
    const BETA: f64 = 0.004;
    /// What is sampled of a ray, in units of the distance over which the density falls: β along the line of sight, else β/cosine.
    const BEFORE: f64 = 3.0;
    const BEHIND: f64 = 1.0;
    const BINS: usize = 16_000;
    let n = cosines.len();
    let count = n * BINS;
    // Warped positions are linear below a distance of 1, where all of this lies.
    let slope = |cosine: f64| match density {
        DensityKind::Sight => 1.0,
        _ => cosine,
    };
    let reach = |cosine: f64| BETA / slope(cosine);
    let near_far = [0.0, BEFORE + BEHIND].into_iter();
    let near_far: Vec<f32> = near_far
        .flat_map(|t| cosines.iter().map(move |&c| (t * reach(c)) as f32))
        .collect();
    let edges: Vec<f32> = (0..n)
        .flat_map(|_| (0..=BINS).map(|i| (i as f64 / BINS as f64) as f32))
        .collect();
    let along = |i: usize| (BEFORE + BEHIND) * i as f64 / BINS as f64 - BEFORE;
    let sdf: Vec<f32> = (0..count)
        .map(|p| (-along(p % BINS) * reach(cosines[p / BINS]) * cosines[p / BINS]) as f32)
        .collect();
    // The plane's normal is against the first axis, and so are the rays but for their angle.
    let gradient: Vec<f32> = (0..3 * count)
        .map(|i| if i < count { -1.0 } else { 0.0 })
        .collect();
    let sine = |c: f64| (1.0 - c * c).max(0.0).sqrt();
    let directions: Vec<f32> = (cosines.iter().map(|&c| c as f32))
        .chain(cosines.iter().map(|&c| sine(c) as f32))
        .chain(cosines.iter().map(|_| 0.0))
        .collect();
    let put = |name: &str, values: &[f32]| -> Result<_> {
        let buffer = gpu.buffer(name, values.len() as u64)?;
        gpu.upload(&buffer, 0, values)?;
        Ok(buffer)
    };
    let (near_far, edges) = (put("near_far", &near_far)?, put("edges", &edges)?);
    let (field, gradient) = (put("sdf", &sdf)?, put("gradient", &gradient)?);
    let (directions, beta) = (
        put("directions", &directions)?,
        put("beta", &[BETA as f32])?,
    );
    let outside = gpu.buffer::<u32>("outside", n as u64)?;
    let rgb = gpu.buffer::<f32>("rgb", 3 * count as u64)?;
    let background = gpu.buffer::<f32>("background", 3 * n as u64)?;
    let depth = gpu.buffer::<f32>("optical depth", count as u64)?;
    let weights = gpu.buffer::<f32>("weights", count as u64)?;
    let image = gpu.buffer::<f32>("image", 6 * n as u64)?;
    let shape = optical_depth::Shape {
        density: super::composite::density_of(density),
        scale: super::composite::scale_of(ScaleKind::Beta),
    };
    let optical_depth = gpu.kernel(shape)?;
    let composite = gpu.kernel(composite_forward::Shape::default())?;
    gpu.submit("plane", |rec| {
        let args = optical_depth::Args {
            sdf: field.ptr(),
            gradient: gradient.ptr(),
            scale: beta.ptr(),
            directions: directions.ptr(),
            edges: edges.ptr(),
            near_far: near_far.ptr(),
            ray_outside: outside.ptr(),
            optical_depth: depth.ptr_mut(),
            n_rays: n as u32,
            n_samples: BINS as u32,
            scale_range: 0.0,
            scale_floor: 0.0,
            inv_s_lower: 0.0,
            anneal: 1.0,
        };
        rec.run(&optical_depth, Work::items(count as u64), args);
        let args = composite_forward::Args {
            optical_depth: depth.ptr(),
            edges: edges.ptr(),
            near_far: near_far.ptr(),
            rgb: rgb.ptr(),
            background: background.ptr(),
            weights: weights.ptr_mut(),
            image: image.ptr_mut(),
            n_rays: n as u32,
            n_samples: BINS as u32,
        };
        rec.run(&composite, Work::items(n as u64), args);
        Ok(())
    })?;
    let weights = gpu.download(&weights, 0, count as u64)?;
    let samples: Vec<f32> = (0..BINS).map(|i| along(i) as f32).collect();
    Ok((0..n)
        .map(|ray| {
            let row = ray * BINS..(ray + 1) * BINS;
            let behind = behind_surface(&samples, &sdf[row.clone()], &weights[row], false);
            f64::from(behind.expect("the ray passes the plane")) / slope(cosines[ray])
        })
        .collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn behind_is_positive_and_the_first_crossing_counts() {
        let distances = [1.0, 2.0, 3.0, 4.0, 5.0];
        let sdf = [1.0, -1.0, 1.0, -1.0, -1.0];
        let weights = [0.0, 0.2, 0.0, 0.7, 0.0];
        assert_eq!(behind_surface(&distances, &sdf, &weights, false), Some(3.0));
        assert_eq!(behind_surface(&distances, &sdf, &weights, true), Some(2.5));
        assert_eq!(behind_surface(&distances, &[1.0; 5], &weights, true), None);
        let inside = [-1.0, 1.0, 0.5, 0.0, -1.0];
        assert_eq!(
            behind_surface(&distances, &inside, &weights, true),
            Some(0.0)
        );
    }

    #[test]
    fn the_closed_form_is_that_of_the_method() {
        let of = |cosine| closed_form(DensityKind::Laplace, cosine).expect("known");
        for (cosine, delta) in [(0.05, -46.0), (0.2, -4.6), (0.5, 0.0), (1.0, 0.2693)] {
            let error = (of(cosine) - delta).abs();
            assert!(
                error < 0.06 * delta.abs().max(0.01),
                "{cosine}: {}",
                of(cosine)
            );
        }
    }
}
