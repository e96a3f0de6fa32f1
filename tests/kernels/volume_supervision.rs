//! The losses on masks, depths and normals at their edges: what is clipped, unknown, masked out, beside the region, or all the same. In
//! between, tests/step compares them with their float64 twin.

use crate::harness::*;
use neurodin::gpu::Buffer;
use neurodin::kernels;

const WEIGHT: f64 = 0.25;

/// What every loss reads; each third ray is masked out, each fifth misses the region.
struct Batch {
    n: usize,
    image: Vec<f64>,
    priors: Vec<f64>,
    target: Vec<f64>,
    outside: Vec<u32>,
}

impl Batch {
    fn new(random: &mut Random, n: usize) -> Batch {
        let mut target = random.many(4 * n, 0.0, 1.0);
        (0..n).for_each(|ray| target[3 * n + ray] = f64::from(u8::from(ray % 3 != 0)));
        Batch {
            n,
            image: random.many(6 * n, 0.0, 1.0),
            priors: random.many(6 * n, 0.1, 1.0),
            target,
            outside: (0..n).map(|ray| u32::from(ray % 5 == 1)).collect(),
        }
    }

    fn counts(&self, ray: usize) -> bool {
        self.target[3 * self.n + ray] > 0.0 && self.outside[ray] == 0
    }

    fn cosine(&self, ray: usize) -> f64 {
        self.priors[ray]
    }

    fn depth(&self, ray: usize) -> f64 {
        self.image[5 * self.n + ray]
    }

    fn scale(&self) -> f64 {
        f64::from((WEIGHT / self.n as f64) as f32)
    }

    /// Losses, and what was added to a picture that had heard 1 of everything.
    fn results(&self, loss: &Buffer<f32>, d_image: &Buffer<f32>) -> (Vec<f64>, Vec<f64>) {
        let device = device();
        let heard = device.take(d_image);
        (device.take(loss), heard.iter().map(|d| d - 1.0).collect())
    }

    fn mono_depth(&self) -> (Vec<f64>, Vec<f64>) {
        let device = device();
        let loss = device.room("loss", self.n);
        let d_image = device.put("d_image", &vec![1.0; 5 * self.n]);
        device.run(
            kernels::mono_depth_loss::Shape::default(),
            1,
            kernels::mono_depth_loss::Args {
                image: device.put("image", &self.image).ptr(),
                priors: device.put("priors", &self.priors).ptr(),
                target: device.put("target", &self.target).ptr(),
                ray_outside: device.table("outside", &self.outside).ptr(),
                loss: loss.ptr_mut(),
                d_image: d_image.ptr_mut(),
                n_rays: self.n as u32,
                scale: self.scale() as f32,
            },
        );
        self.results(&loss, &d_image)
    }
}

/// Zeros but for one plane.
fn plane(n: usize, plane: usize, of: impl Fn(usize) -> f64) -> Vec<f64> {
    (0..5 * n)
        .map(|i| if i / n == plane { of(i % n) } else { 0.0 })
        .collect()
}

#[test]
fn masks_pull_accumulated_weight_within_their_clip() {
    let device = device();
    let mut batch = Batch::new(&mut Random(21), 67);
    let n = batch.n;
    let edges = [0.0, 5e-4, 0.9995, 1.0];
    for (ray, a) in edges.into_iter().cycle().take(24).enumerate() {
        batch.image[3 * n + ray] = f64::from(a as f32);
    }
    (0..n).for_each(|ray| batch.image[4 * n + ray] = 1.0 - batch.image[3 * n + ray]);
    let loss = device.room("loss", n);
    let d_image = device.put("d_image", &vec![1.0; 5 * n]);
    device.run(
        kernels::mask_loss::Shape::default(),
        n,
        kernels::mask_loss::Args {
            image: device.put("image", &batch.image).ptr(),
            target: device.put("target", &batch.target).ptr(),
            ray_outside: device.table("outside", &batch.outside).ptr(),
            loss: loss.ptr_mut(),
            d_image: d_image.ptr_mut(),
            n_rays: n as u32,
            scale: batch.scale() as f32,
        },
    );
    let at = |ray: usize| (batch.image[3 * n + ray], batch.target[3 * n + ray]);
    let wanted = |ray: usize| {
        let (a, m) = at(ray);
        let a = a.clamp(1e-3, 1.0 - 1e-3);
        let loss = -(m * a.ln() + (1.0 - m) * (1.0 - a).ln());
        if batch.outside[ray] == 0 { loss } else { 0.0 }
    };
    let slope = |ray: usize| {
        let (a, m) = at(ray);
        let clipped = !(1e-3..=1.0 - 1e-3).contains(&a);
        if clipped || batch.outside[ray] != 0 {
            return 0.0;
        }
        batch.scale() * ((1.0 - m) / (1.0 - a) - m / a)
    };
    let (loss, heard) = batch.results(&loss, &d_image);
    assert_close("loss", &loss, &(0..n).map(wanted).collect::<Vec<_>>(), 1e-6);
    assert_close("d_image", &heard, &plane(n, 0, slope), 1e-6);
}

#[test]
fn sensor_depths_count_where_they_are_known() {
    let device = device();
    let mut batch = Batch::new(&mut Random(22), 67);
    let n = batch.n;
    (0..n)
        .step_by(4)
        .for_each(|ray| batch.priors[5 * n + ray] = 0.0);
    let loss = device.room("loss", n);
    let d_image = device.put("d_image", &vec![1.0; 5 * n]);
    device.run(
        kernels::sensor_depth_loss::Shape::default(),
        n,
        kernels::sensor_depth_loss::Args {
            image: device.put("image", &batch.image).ptr(),
            priors: device.put("priors", &batch.priors).ptr(),
            target: device.put("target", &batch.target).ptr(),
            ray_outside: device.table("outside", &batch.outside).ptr(),
            loss: loss.ptr_mut(),
            d_image: d_image.ptr_mut(),
            n_rays: n as u32,
            scale: batch.scale() as f32,
        },
    );
    let counts = |ray: usize| batch.counts(ray) && !ray.is_multiple_of(4);
    let error = |ray: usize| batch.cosine(ray) * batch.depth(ray) - batch.priors[5 * n + ray];
    let wanted = |ray: usize| if counts(ray) { error(ray).abs() } else { 0.0 };
    let slope = |ray: usize| match counts(ray) {
        true => batch.scale() * batch.cosine(ray) * error(ray).signum(),
        false => 0.0,
    };
    let (loss, heard) = batch.results(&loss, &d_image);
    assert_close("loss", &loss, &(0..n).map(wanted).collect::<Vec<_>>(), 1e-6);
    assert_close("d_image", &heard, &plane(n, 1, slope), 1e-6);
}

#[test]
fn monocular_depths_are_fitted_by_scale_and_shift() {
    let mut random = Random(23);
    for n in [67, 256, 1000] {
        let mut batch = Batch::new(&mut random, n);
        for ray in (0..n).step_by(4) {
            batch.priors[n + ray] = [f64::NAN, f64::INFINITY][ray / 4 % 2];
        }
        let counting: Vec<usize> = (0..n)
            .filter(|&ray| batch.counts(ray) && ray % 4 != 0)
            .collect();
        let x = |ray: usize| batch.cosine(ray) * batch.depth(ray);
        let p = |ray: usize| batch.priors[n + ray];
        let sum = |f: &dyn Fn(usize) -> f64| counting.iter().map(|&ray| f(ray)).sum::<f64>();
        let [one, sx, sp] = [sum(&|_| 1.0), sum(&x), sum(&p)];
        let [sxx, sxp] = [sum(&|ray| x(ray) * x(ray)), sum(&|ray| x(ray) * p(ray))];
        let scale = (one * sxp - sx * sp) / (one * sxx - sx * sx);
        let error = |ray: usize| scale * (x(ray) - sx / one) - (p(ray) - sp / one);
        let known = |ray: usize| counting.contains(&ray);
        let wanted = |ray: usize| if known(ray) { error(ray).powi(2) } else { 0.0 };
        let slope = |ray: usize| match known(ray) {
            true => batch.scale() * 2.0 * error(ray) * scale * batch.cosine(ray),
            false => 0.0,
        };
        let (loss, heard) = batch.mono_depth();
        assert_close("loss", &loss, &(0..n).map(wanted).collect::<Vec<_>>(), 1e-5);
        assert_close("d_image", &heard, &plane(n, 1, slope), 1e-6);
    }
}

/// One depth everywhere has no scale, and nothing known has neither: a loss, or none, but no gradient.
#[test]
fn monocular_depths_without_a_fit_pull_nowhere() {
    let mut batch = Batch::new(&mut Random(24), 67);
    let n = batch.n;
    for ray in 0..n {
        (batch.priors[ray], batch.image[5 * n + ray]) = (1.0, 0.5);
    }
    let (loss, heard) = batch.mono_depth();
    assert!(loss.iter().sum::<f64>() > 0.0);
    assert_eq!(heard, vec![0.0; 5 * n]);
    batch.outside = vec![1; n];
    let (loss, heard) = batch.mono_depth();
    assert_eq!((loss, heard), (vec![0.0; n], vec![0.0; 5 * n]));
}
