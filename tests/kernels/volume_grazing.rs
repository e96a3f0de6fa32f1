//! Rays that pass along a surface, where the distance along the line of sight, f/|g·d|, has its pole.

use crate::harness::*;
use neurodin::kernels::optical_depth_backward;

/// The density of the distance along the line of sight, with a local scale (glsl/lib/optical_depth.glsl).
const SIGHT: optical_depth_backward::Shape = optical_depth_backward::Shape {
    density: 1,
    scale: 0,
    gradient: 1,
};

/// g·d cancels to 0 here in float32 as in the reals: 1e-8 stands in for it, and derivatives are large but finite. One NaN among them would
/// be in every parameter after the step, although its loss is finite.
#[test]
fn a_ray_along_the_surface_has_finite_derivatives() {
    const BIN: f64 = 0.25;
    const INV_S: f64 = 100.0;
    const C: f64 = 1e-8;
    let device = device();
    let sdf = [0.0, 1e-10, -1e-10, 1e-3, -1e-3];
    let n = sdf.len();
    let gradient = [vec![1.0; n], vec![-1.0; n], vec![0.0; n]].concat();
    let edges: Vec<f64> = (0..=n).map(|i| i as f64 * BIN).collect();
    let direction = [0.6, 0.6, 0.52].map(|x| f64::from(x as f32));
    let d_scale = device.room("d_scale", n);
    let d_gradient = device.room("d_gradient", 3 * n);
    let d_tau = device.put("d_tau", &vec![1.0; n]);
    device.run(
        SIGHT,
        n,
        optical_depth_backward::Args {
            sdf: device.put("sdf", &sdf).ptr(),
            gradient: device.put("gradient", &gradient).ptr(),
            scale: device.put("logit", &vec![-100.0; n]).ptr(),
            directions: device.put("direction", &direction).ptr(),
            edges: device.put("edges", &edges).ptr(),
            near_far: device.put("near_far", &[0.0, 1.0]).ptr(),
            ray_outside: device.table("ray_outside", &[0u32]).ptr(),
            d_sdf: d_tau.ptr_mut(),
            d_scale: d_scale.ptr_mut(),
            d_gradient: d_gradient.ptr_mut(),
            n_rays: 1,
            n_samples: n as u32,
            scale_range: 0.1,
            scale_floor: (1.0 / INV_S) as f32,
            inv_s_lower: 1.0,
            anneal: 1.0,
        },
    );
    let tail = |f: f64| BIN * INV_S * INV_S * 0.5 * (-f.abs() / C * INV_S).exp();
    let want: Vec<f64> = sdf.iter().map(|&f| -tail(f) / C).collect();
    assert_gradient("d_sdf", &device.take(&d_tau), &want);
    let want = [0, 1, 2].map(|axis| sdf.map(|f| tail(f) * f / (C * C) * direction[axis]));
    assert_gradient("d_gradient", &device.take(&d_gradient), &want.concat());
    let d_scale = device.take(&d_scale);
    assert!(d_scale.iter().all(|d| d.is_finite()), "{d_scale:?}");
}
