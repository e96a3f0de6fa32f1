//! Units, axes and signs of priors, from their files to the losses: what a model renders of itself, written down as sdfstudio has it, it has
//! no quarrel with.

use crate::rig::{Rig, write_npy};
use glam::{DVec2, DVec3};
use neurodin::Result;
use neurodin::config::{BackgroundKind, Config};
use neurodin::gpu::GpuOptions;
use neurodin::scene::synthetic::RADIUS;
use neurodin::scene::{PriorPaths, RegionShape, Split, View};

/// Depth and normal of every pixel.
type Own = (Vec<f64>, Vec<f64>);

/// z-depths in the world's units, and normals [3, height, width] as (n + 1)/2 in OpenCV's camera axes, of what an untrained model renders.
fn rendered(rig: &Rig, index: usize, view: &View) -> Result<Own> {
    let (w, h) = (view.camera.width, view.camera.height);
    let own = rig.trainer.render(index, (w, h), &mut |_| true)?;
    let pixels = (w * h) as usize;
    let (mut depths, mut normals) = (vec![0.0; pixels], vec![0.5; 3 * pixels]);
    for pixel in 0..pixels {
        let at = DVec2::new(
            (pixel % w as usize) as f64 + 0.5,
            (pixel / w as usize) as f64 + 0.5,
        );
        let along_axis = -view.camera.direction(at).normalize().z;
        depths[pixel] = f64::from(own.depth[pixel]) * along_axis * RADIUS;
        // A ray that passes the surface by has a normal whose length float32 cannot tell from none.
        if own.accumulation[pixel] < 0.5 {
            continue;
        }
        let normal = DVec3::from_array(own.normal[pixel].map(f64::from)).normalize_or_zero();
        let [right, up, backward] = [
            view.world_from_camera.x_axis,
            view.world_from_camera.y_axis,
            view.world_from_camera.z_axis,
        ]
        .map(|axis| axis.truncate());
        for (axis, n) in [normal.dot(right), -normal.dot(up), -normal.dot(backward)]
            .into_iter()
            .enumerate()
        {
            normals[axis * pixels + pixel] = (n + 1.0) / 2.0;
        }
    }
    Ok((depths, normals))
}

#[test]
fn a_models_own_depths_and_normals_cost_it_little() -> Result<()> {
    let preset = Config::preset("outdoor-tiny").expect("a preset");
    let mut config = Config {
        steps: 40,
        rays: 96,
        ..preset
    };
    // A sharp surface, rays that miss it included: neither samples nor taps move what is rendered of it by much.
    config.surface.scale_max = 0.01;
    config.background.kind = BackgroundKind::Constant;
    let mut views = Vec::new();
    let bare = Rig::with(
        config.clone(),
        RegionShape::Sphere,
        GpuOptions::default(),
        &mut |scene, _| views.clone_from(&scene.views),
    )?;
    let own = (views.iter().enumerate())
        .map(|(index, view)| match view.split {
            Split::Train => rendered(&bare, index, view),
            Split::Test => Ok(Own::default()),
        })
        .collect::<Result<Vec<Own>>>()?;
    drop(bare);
    config.loss.sensor_depth = 1.0;
    config.loss.mono_depth = 1.0;
    config.loss.mono_normal = 1.0;
    let losses = |change: &dyn Fn(&Own) -> Own| -> Result<[f64; 3]> {
        let mut rig = Rig::with(
            config.clone(),
            RegionShape::Sphere,
            GpuOptions::default(),
            &mut |scene, folder| {
                for (index, view) in scene.views.iter_mut().enumerate() {
                    if view.split == Split::Test {
                        continue;
                    }
                    let (w, h) = (u64::from(view.camera.width), u64::from(view.camera.height));
                    let (depths, normals) = change(&own[index]);
                    let depth = folder.join(format!("{index}_depth.npy"));
                    let normal = folder.join(format!("{index}_normal.npy"));
                    write_npy(&depth, &[h, w], &depths);
                    write_npy(&normal, &[3, h, w], &normals);
                    view.priors = PriorPaths([Some(depth.clone()), Some(normal), Some(depth)]);
                }
            },
        )?;
        rig.trainer.step()?;
        let losses = rig.trainer.finish()?.expect("the losses of a step");
        rig.check_device()?;
        Ok(["sensor_depth", "mono_depth", "mono_normal"].map(|term| f64::from(losses.of(term))))
    };
    let agreeing = losses(&Own::clone)?;
    let mirrored = losses(&|(depths, normals): &Own| {
        let depths = depths.iter().map(|depth| 5.0 - 1.2 * depth).collect();
        let third = normals.len() / 3;
        let flip = |(i, n): (usize, &f64)| if i < third { 1.0 - n } else { *n };
        (depths, normals.iter().enumerate().map(flip).collect())
    })?;
    println!("agreeing {agreeing:?}, changed {mirrored:?}");
    let [sensor, mono, normal] = agreeing;
    assert!(
        sensor < 5e-3 && mono < 1e-4 && normal < 0.02,
        "{agreeing:?}"
    );
    // A sensor's depth is missed when it is changed; of a monocular one another scale, be it negative, and shift are another unit, whose
    // square its loss has; a mirrored normal is another.
    assert!(mirrored[0] > 10.0 * sensor && mirrored[1] < 1.5 * 1.44 * mono + 1e-6);
    assert!(mirrored[2] > 5.0 * normal, "{mirrored:?}");
    Ok(())
}
