//! The f64 twin's own gradients against central differences, and the tables and bases that it is built on.

mod reference;

use reference::background::{self, Background};
use reference::batch::{Density, Outcome, Scale, Stage, Step, StepConfig};
use reference::hash_grid::Grid;
use reference::losses::{self, BiasReduction};
use reference::networks::{NormedLayer, spherical_harmonics};
use reference::sampling::{self, Region, Stretch};
use reference::surface::{self, Surface};
use reference::tape::Tape;
use reference::trial::{self, Random};

/// What a span's gradient belongs to. No gradient flows from the interlevel loss through the final weights, which it takes as they
/// are, so differences of the surface's parameters must leave it out; the proposal networks have no other loss.
fn objective(outcome: &Outcome, span: &str) -> f64 {
    let interlevel = outcome.losses["interlevel"];
    if span.starts_with("proposal") {
        interlevel
    } else {
        outcome.losses["total"] - interlevel
    }
}

/// Compares sampled gradients of every span with central differences of step 1e-6, at fixed sample positions (no gradient flows
/// through those). The seeds are such that no sampled difference straddles a kink (ReLU, |C − target|, the hinges, the heaviest sample).
fn check_gradients(mut step: Step, stage: &Stage, seed: u64) {
    step.stage = stage.clone();
    let outcome = step.run();
    step.edges = Some(outcome.images.edges.clone());
    for (name, loss) in &outcome.losses {
        assert!(*loss > 0.0, "the {name} loss is {loss}: nothing is tested");
    }
    let random = &mut Random(seed);
    let spans: Vec<String> = step.params.keys().cloned().collect();
    for span in spans {
        let gradient = &outcome.gradients[&span];
        let touched: Vec<usize> = (0..gradient.len())
            .filter(|&i| gradient[i] != 0.0)
            .collect();
        assert!(!touched.is_empty(), "{span} has no gradient");
        let largest = (0..gradient.len()).fold(0, |best, i| {
            if gradient[i].abs() > gradient[best].abs() {
                i
            } else {
                best
            }
        });
        let some = |random: &mut Random, n: usize| (random.uniform() * n as f64) as usize;
        let mut sampled = vec![largest, some(random, gradient.len())];
        sampled.extend((0..4).map(|_| touched[some(random, touched.len())]));
        for i in sampled {
            let value = step.params[&span][i];
            let mut at = |value: f64| {
                step.params.get_mut(&span).expect("a span")[i] = value;
                objective(&step.run(), &span)
            };
            let difference = (at(value + 1e-6) - at(value - 1e-6)) / 2e-6;
            at(value);
            let error = (difference - gradient[i]).abs();
            let allowed =
                1e-3 * gradient[i].abs() + (1e-4 * gradient[largest].abs()).clamp(1e-9, 1e-5);
            assert!(
                error <= allowed,
                "{span}[{i}]: gradient {}, central difference {difference}",
                gradient[i]
            );
        }
    }
}

#[test]
fn gradients_outdoors_with_one_background_color() {
    check_gradients(trial::step(trial::config(), 24, 1), &Stage::first(), 2);
}

#[test]
fn gradients_outdoors_with_a_background_field() {
    for contraction in [true, false] {
        let step = trial::step(with_background_field(contraction), 24, 3);
        check_gradients(step, &Stage::first(), 4);
    }
}

fn with_background_field(contraction: bool) -> StepConfig {
    let field = background::FieldConfig {
        contraction,
        ..trial::background_field()
    };
    StepConfig {
        background: Background::Field(field),
        ..trial::config()
    }
}

#[test]
fn gradients_indoors() {
    check_gradients(indoors(), &Stage::first(), 6);
}

/// A step whose scale bound holds for half of the samples.
fn indoors() -> Step {
    let config = StepConfig {
        region: Region::Box {
            half: [1.0, 0.7, 0.8],
        },
        background: Background::Black,
        bias_needs_opaque: false,
        bias_reduction: BiasReduction::Published,
        bias_offset: 0.01,
        grid: Grid::published(3, 4, 32, 10, 8),
        appearance: 0,
        ..trial::config()
    };
    let mut step = trial::step(config, 16, 5);
    let mut scales = step.run().images.inv_s;
    scales.sort_by(f64::total_cmp);
    step.now.inv_s_lower = scales[scales.len() / 2];
    step
}

/// With losses on masks, depths and normals, in both stages.
#[test]
fn gradients_of_what_is_wanted_besides_colour() {
    let step = trial::supervised(trial::step(trial::config(), 24, 1), 41);
    check_gradients(step.clone(), &Stage::first(), 42);
    let stage = trial::second_stage(&step, 43);
    check_gradients(step, &stage, 44);
    let step = trial::supervised(indoors(), 45);
    check_gradients(step, &Stage::first(), 46);
}

/// The scale and shift of a monocular depth are those of least squares: another scale and shift of the prior changes the loss by that
/// scale's square, and nothing else.
#[test]
fn monocular_depths_have_no_unit() {
    let step = trial::supervised(trial::step(trial::config(), 24, 47), 48);
    let loss = step.run().losses["mono_depth"];
    let mut other = step;
    for known in &mut other.rays.supervision.known {
        known.mono_depth = 3.0 * known.mono_depth - 7.0;
    }
    let ratio = other.run().losses["mono_depth"] / loss;
    assert!((ratio - 9.0).abs() < 1e-9, "{ratio}");
}

/// What the other methods are made of, in combinations that differ in everything.
#[test]
fn gradients_of_other_methods() {
    let neuralangelo = Stage {
        taps: 4,
        density: Density::Neus,
        bias: false,
        tangent: None,
    };
    let mut step = one_scale(Scale::Exponential { rate: 2.0 }, 31);
    step.now.curvature_weight = 1e-3;
    step.now.released_levels = 3;
    step.now.cosine_anneal = 0.6;
    check_gradients(step.clone(), &neuralangelo, 32);
    let six = Stage {
        taps: 6,
        ..neuralangelo.clone()
    };
    check_gradients(step.clone(), &six, 33);
    step.now.curvature_weight = 0.0;
    let neus = Stage {
        taps: 0,
        ..neuralangelo
    };
    check_gradients(step, &neus, 34);
    let volsdf = Stage {
        density: Density::Laplace,
        ..neus
    };
    check_gradients(one_scale(Scale::Beta, 35), &volsdf, 36);
    let with_bias = Stage {
        bias: true,
        ..volsdf
    };
    check_gradients(trial::step(trial::config(), 24, 1), &with_bias, 38);
}

/// A step with one scale for all samples.
fn one_scale(scale: Scale, seed: u64) -> Step {
    let config = StepConfig {
        scale,
        ..trial::config()
    };
    trial::step(config, 24, seed)
}

#[test]
fn gradients_of_stage_2_outdoors_with_one_background_color() {
    let step = trial::step(trial::config(), 24, 11);
    let stage = trial::second_stage(&step, 12);
    check_gradients(step, &stage, 13);
}

#[test]
fn gradients_of_stage_2_outdoors_with_a_background_field() {
    let step = trial::step(with_background_field(true), 24, 14);
    let stage = trial::second_stage(&step, 15);
    check_gradients(step, &stage, 16);
}

#[test]
fn gradients_of_stage_2_indoors() {
    let step = indoors();
    let stage = trial::second_stage(&step, 17);
    check_gradients(step, &stage, 18);
}

/// Beyond the bound an angle is that of the bound and has no gradient; a gradient of no length has no direction, but a derivative.
#[test]
fn tangent_loss_at_its_edges() {
    let tape = &mut Tape::default();
    let normals = tape.parameter(3, 3, [[0.6, 0.8, 0.0]; 3].concat());
    let others = [[0.6, 0.8, 0.0], [-0.6, -0.8, 0.0], [0.0, 0.0, 1.0]];
    let others = tape.parameter(3, 3, others.concat());
    let loss = losses::tangent(tape, normals, others);
    assert!((tape.scalar(loss) - 0.5).abs() < 1e-15);
    let gradients = tape.backward(loss);
    for (d, other) in [
        (gradients.get(normals), [0.0, 0.0, 1.0]),
        (gradients.get(others), [0.6, 0.8, 0.0]),
    ] {
        assert_eq!(d[..6], [0.0; 6]);
        let expected = other.map(|other| -other / (3.0 * std::f64::consts::PI));
        for (d, expected) in d[6..].iter().zip(expected) {
            assert!((d - expected).abs() < 1e-15, "{d}, expected {expected}");
        }
    }

    let short = tape.parameter(1, 3, vec![0.0; 3]);
    let normal = surface::normals(tape, short);
    assert_eq!(tape.value(normal), [0.0; 3]);
    let d = tape.backward_with(normal, &[1.0, 2.0, 3.0]).get(short);
    assert_eq!(d, [1.0, 2.0, 3.0].map(|d| d / 1e-12));
}

/// The explicit formula of g is the derivative of f, and its own derivative by x that of central differences.
#[test]
fn analytic_gradient_of_the_surface() {
    let step = trial::step(trial::config(), 6, 19);
    let points: Vec<[f64; 3]> = step.run().images.points;
    let at = |points: &[[f64; 3]]| {
        let tape = &mut Tape::default();
        let mut put = |name: &str| {
            let (_, rows, cols) = (step.config.spans().into_iter())
                .find(|(span, _, _)| span == name)
                .expect("a span");
            tape.constant(rows, cols, step.params[name].clone())
        };
        let mut layer = |name: &str| NormedLayer {
            v: put(&format!("{name}.v")),
            g: put(&format!("{name}.g")),
            bias: put(&format!("{name}.bias")),
        };
        let field = Surface {
            hidden: layer("surface.hidden"),
            heads: layer("surface.heads"),
            table: put("surface.table"),
            released: step.config.grid.levels.len() - 1,
        };
        let x = tape.parameter(points.len(), 3, points.as_flattened().to_vec());
        let (heads, gradient) = field.heads_and_gradient(tape, &step.config.grid, x);
        let sdf = tape.columns(heads, 0..1);
        let by_tape = tape.backward_with(sdf, &vec![1.0; points.len()]).get(x);
        let h = [0.3, -0.8, 0.5].repeat(points.len());
        let bend = tape.backward_with(gradient, &h).get(x);
        let along: Vec<f64> = (tape.value(gradient).chunks_exact(3).zip(h.chunks_exact(3)))
            .map(|(g, h)| g[0] * h[0] + g[1] * h[1] + g[2] * h[2])
            .collect();
        (tape.value(gradient).to_vec(), by_tape, along, bend)
    };
    let (gradient, by_tape, _, bend) = at(&points);
    for (a, b) in gradient.iter().zip(&by_tape) {
        assert!((a - b).abs() < 1e-12 * (1.0 + b.abs()), "g {a}, ∂f/∂x {b}");
    }
    for axis in 0..3 {
        let moved = |step: f64| {
            let mut points = points.clone();
            points.iter_mut().for_each(|x| x[axis] += step);
            at(&points).2
        };
        for (i, (above, below)) in moved(1e-6).iter().zip(moved(-1e-6)).enumerate() {
            let (difference, bend) = ((above - below) / 2e-6, bend[i * 3 + axis]);
            assert!(
                (difference - bend).abs() <= 1e-5 + 1e-5 * bend.abs(),
                "∂(h·g)/∂x: {bend}, central difference {difference}"
            );
        }
    }
}

#[test]
fn given_points_are_taken_as_they_are() {
    let mut step = trial::step(trial::config(), 6, 20);
    let second = trial::second_stage(&step, 21);
    for stage in [Stage::first(), second] {
        step.stage = stage;
        step.points = None;
        let own = step.run();
        step.points = Some(own.images.points.clone());
        let given = step.run();
        assert_eq!(given.losses, own.losses);
        assert_eq!(given.gradients, own.gradients);
        // The last points are the last ray's outermost taps, or its last shifted point.
        let last = step.points.as_mut().and_then(|points| points.last_mut());
        last.expect("points")[0] += 0.05;
        assert_ne!(step.run().losses, own.losses);
    }
}

#[test]
fn masked_rays_have_no_color_loss() {
    let mut step = trial::step(trial::config(), 6, 7);
    let all = step.run();
    let half: f64 = all.images.color_error[..3].iter().sum::<f64>() / 3.0;
    step.rays.target[3..]
        .iter_mut()
        .for_each(|target| target[3] = 0.0);
    step.now.inv_count = 1.0 / 3.0;
    assert!((step.run().losses["color"] - half).abs() < 1e-14);
}

#[test]
fn published_level_tables() {
    let resolutions = |grid: Grid| {
        grid.levels
            .iter()
            .map(|level| level.resolution)
            .collect::<Vec<_>>()
    };
    let surface = Grid::published(16, 32, 2048, 19, 8);
    assert_eq!(surface.entries(), 6_984_576);
    assert_eq!(surface.parameters(), 55_876_608);
    assert_eq!(
        resolutions(surface),
        [
            32, 43, 56, 74, 98, 129, 169, 223, 295, 389, 513, 676, 892, 1177, 1553, 2049
        ]
    );
    let surface = Grid::published(16, 32, 2048, 22, 8);
    assert_eq!(surface.entries(), 45_724_048);
    assert_eq!(surface.levels.iter().filter(|level| level.dense).count(), 6);
    let entries = |grid: Grid| {
        grid.levels
            .iter()
            .map(|level| level.entries)
            .collect::<Vec<_>>()
    };
    assert_eq!(
        entries(Grid::published(5, 16, 64, 17, 2)),
        [4096, 12168, 32768, 97336, 131_072]
    );
    assert_eq!(
        entries(Grid::published(5, 16, 256, 17, 2)),
        [4096, 32768, 131_072, 131_072, 131_072]
    );
    let background = Grid::published(16, 16, 1024, 19, 2);
    assert_eq!(background.parameters(), 11_445_040);
    assert_eq!(resolutions(background)[..6], [16, 22, 28, 37, 49, 65]);
}

#[test]
fn exact_scales_and_published_ones_agree_to_single_precision() {
    let (exact, published) = (
        Grid::exact(12, 16, 1024, 17, 2),
        Grid::published(12, 16, 1024, 17, 2),
    );
    for (a, b) in exact.levels.iter().zip(&published.levels) {
        assert!(
            (a.scale - b.scale).abs() <= 1e-6 * a.scale,
            "{} and {}",
            a.scale,
            b.scale
        );
    }
}

/// ∫ Y_i Y_j = δ_ij over the sphere, by midpoints in z and in the angle around it.
#[test]
fn spherical_harmonics_are_orthonormal() {
    let (rings, steps) = (2000, 24);
    let mut products = [[0.0; 16]; 16];
    for ring in 0..rings {
        let z = 2.0 * (ring as f64 + 0.5) / rings as f64 - 1.0;
        for step in 0..steps {
            let angle = std::f64::consts::TAU * (step as f64 + 0.5) / steps as f64;
            let radius = (1.0 - z * z).sqrt();
            let harmonics = spherical_harmonics([radius * angle.cos(), radius * angle.sin(), z]);
            let area = 4.0 * std::f64::consts::PI / (rings * steps) as f64;
            for (row, a) in products.iter_mut().zip(harmonics) {
                row.iter_mut()
                    .zip(harmonics)
                    .for_each(|(sum, b)| *sum += area * a * b);
            }
        }
    }
    for (i, row) in products.iter().enumerate() {
        for (j, product) in row.iter().enumerate() {
            assert!(
                (product - f64::from(u8::from(i == j))).abs() < 1e-5,
                "harmonics {i}, {j}: {product}"
            );
        }
    }
}

#[test]
fn rays_meet_a_box_where_they_enter_and_leave_it() {
    let half = [1.0, 0.5, 0.8];
    let random = &mut Random(8);
    let mut met = 0;
    for _ in 0..200 {
        let origin = random.direction().map(|x| 1.5 * x);
        let direction = random.direction();
        let Stretch { near, far, outside } = sampling::collide_box(half, origin, direction);
        let inside = |t: f64| {
            let x = sampling::point_on_ray(origin, direction, t);
            (0..3).all(|axis| x[axis].abs() <= half[axis])
        };
        let samples = (0..400).map(|i| (f64::from(i) + 0.5) * 0.01);
        if outside {
            assert!(samples.clone().filter(|&t| inside(t)).count() < 2);
        } else {
            met += 1;
            for t in samples {
                assert_eq!(
                    inside(t),
                    near < t && t < far,
                    "near {near}, far {far}, t {t}"
                );
            }
        }
    }
    assert!(met > 20);
    let through = sampling::collide_box(half, [0.0; 3], [0.0, 1.0, 0.0]);
    assert_eq!(
        through,
        Stretch {
            near: 0.0,
            far: 0.5,
            outside: false
        }
    );
}
