//! How far the heaviest point of a ray lies behind a plane: what the kernels say, against the closed form.

use neurodin::Result;
use neurodin::config::DensityKind;
use neurodin::gpu::{Gpu, GpuOptions};
use neurodin::render::bias::{closed_form, on_plane};

#[test]
fn a_plane_is_biased_as_the_closed_form_says() -> Result<()> {
    let gpu = Gpu::new(&GpuOptions {
        validation: true,
        guard: true,
        ..GpuOptions::default()
    })?;
    let degrees: Vec<f64> = (0..=17).map(|i| 5.0 * f64::from(i)).collect();
    let cosines: Vec<f64> = degrees.iter().map(|d| d.to_radians().cos()).collect();
    for density in [DensityKind::Laplace, DensityKind::Sight] {
        let measured = on_plane(&gpu, density, &cosines)?;
        for ((angle, cosine), measured) in degrees.iter().zip(&cosines).zip(measured) {
            let known = closed_form(density, *cosine).expect("known");
            println!("{density:?} at {angle}°: {measured:.4} β, closed form {known:.4} β");
            // At 60° the closed form of the plain density passes through zero.
            let allowed = 0.01 * known.abs().max(0.1);
            assert!(
                (measured - known).abs() <= allowed,
                "{density:?} at {angle}°: {measured} β, and not {known} β"
            );
        }
    }
    let messages = gpu.validation_messages();
    assert!(messages.is_empty(), "{}", messages.join("\n"));
    Ok(())
}
