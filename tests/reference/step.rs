//! One training step of stage 1, whole: rays in; losses, images and the gradient of every parameter out.

use super::background::{Background, Field};
use super::hash_grid::Grid;
use super::losses::{self, BiasReduction};
use super::networks::{NormedLayer, sigmoid};
use super::proposal::{self, Proposal};
use super::sampling::{self, Region, Stretch};
use super::surface::{self, Surface};
use super::tape::{Gradients, Tape, Var};
use super::volume;
use std::collections::BTreeMap;

/// The shape of everything, and the numbers that do not change with time.
#[derive(Clone, Debug, PartialEq)]
pub struct StepConfig {
    pub region: Region,
    /// False: no jitter, and appearance codes of zeros.
    pub train: bool,
    /// The two proposal networks' grids, hidden width and bins.
    pub proposal_grids: [Grid; 2],
    pub proposal_hidden: usize,
    pub proposal_samples: [usize; 2],
    /// Shading samples per ray.
    pub samples: usize,
    pub grid: Grid,
    /// Width of the surface network's hidden layer.
    pub hidden: usize,
    /// Geometry features handed to the colour network.
    pub features: usize,
    /// β = scale_range · sigmoid(v) + scale_floor
    pub scale_range: f64,
    pub scale_floor: f64,
    /// δ = max(tap_range · u, tap_floor)
    pub tap_range: f64,
    pub tap_floor: f64,
    pub color_hidden: usize,
    /// Hidden layers of the colour network.
    pub color_layers: usize,
    pub views: usize,
    /// Length of a view's appearance code; 0: none.
    pub appearance: usize,
    pub background: Background,
    pub eikonal_weight: f64,
    pub interlevel_weight: f64,
    pub bias_epsilon: f64,
    pub bias_offset: f64,
    pub bias_reduction: BiasReduction,
    /// Only rays with Σ w > 0.999 pass the bias loss's gate (outdoors).
    pub bias_needs_opaque: bool,
}

/// A batch of N rays in the region frame.
#[derive(Clone, Debug, Default)]
pub struct Rays {
    pub origins: Vec<[f64; 3]>,
    /// Unit vectors.
    pub directions: Vec<[f64; 3]>,
    /// r, g, b and the weight of the ray's colour loss.
    pub target: Vec<[f64; 4]>,
    /// Index of the ray's view.
    pub view: Vec<usize>,
    /// Near, far and outside, where they are not to be computed from the region.
    pub stretches: Option<Vec<Stretch>>,
}

/// The step's random numbers, raw draws in [0, 1).
#[derive(Clone, Debug, Default)]
pub struct Draws {
    /// First sampler, first and second resampling: one draw per ray each.
    pub jitter: [Vec<f64>; 3],
    /// One per shading sample, `[N · S]`.
    pub taps: Vec<f64>,
    /// One per edge of the background field, `[N · (samples + 1)]`; empty: edges stay where they are.
    pub background: Vec<f64>,
}

/// What changes with time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Now {
    /// Exponent of the proposal weights.
    pub anneal: f64,
    /// Lower bound of 1/β.
    pub inv_s_lower: f64,
    pub bias_weight: f64,
    /// Factor of the sum over rays in the colour loss: 1/N, or 1/Σ of the rays' weights.
    pub inv_count: f64,
}

#[derive(Clone, Debug)]
pub struct Step {
    pub config: StepConfig,
    /// By span name; [`Step::spans`] lists names and shapes.
    pub params: BTreeMap<String, Vec<f64>>,
    pub rays: Rays,
    pub draws: Draws,
    pub now: Now,
    /// Normalised edges `[N, bins + 1]` of both proposal levels and the final one, to be taken as they are.
    pub edges: Option<[Vec<f64>; 3]>,
}

/// Everything that the forward pass makes, sample-major with the component innermost.
#[derive(Clone, Debug, Default)]
pub struct Images {
    /// `[N]`
    pub stretches: Vec<Stretch>,
    /// Normalised edges per level, `[N, bins + 1]`, and the same as distances.
    pub edges: [Vec<f64>; 3],
    pub distances: [Vec<f64>; 3],
    /// Log densities `[N, bins]` and weights `[N, bins]` of the proposal levels.
    pub proposal_raw: [Vec<f64>; 2],
    pub proposal_weights: [Vec<f64>; 2],
    /// `[7 · N · S]`: bin starts, then the six tap blocks. Points are x, y, z.
    pub points: Vec<[f64; 3]>,
    /// Network outputs at `points`, before anything is overwritten for rays outside.
    pub sdf: Vec<f64>,
    /// `[N · S]`
    pub logit: Vec<f64>,
    pub inv_s: Vec<f64>,
    /// σ, `[N, S]`; rays outside have f = +1000 here where there is a background.
    pub density: Vec<f64>,
    /// `[N, S, 3]`
    pub gradient: Vec<f64>,
    /// `[N, S, K]`
    pub features: Vec<f64>,
    /// `[N, S, 3]` before padding.
    pub rgb: Vec<f64>,
    /// `[N, S]`
    pub weights: Vec<f64>,
    /// Behind the last sample, `[N]`.
    pub transmittance: Vec<f64>,
    pub accumulation: Vec<f64>,
    pub depth: Vec<f64>,
    /// Σ w n, `[N, 3]`
    pub normal: Vec<f64>,
    /// `[N, 3]`
    pub background: Vec<f64>,
    pub color: Vec<f64>,
    /// Colour loss per ray before `inv_count`, `[N]`.
    pub color_error: Vec<f64>,
    /// The bias loss's gates `[N]`, points `[2N]` and the network's values there `[2N]`.
    pub bias_gate: Vec<f64>,
    pub bias_points: Vec<[f64; 3]>,
    pub bias_sdf: Vec<f64>,
}

/// ∂total/∂(some of [`Images`]), shaped like them.
#[derive(Clone, Debug, Default)]
pub struct ActivationGradients {
    pub proposal_raw: [Vec<f64>; 2],
    /// All seven blocks.
    pub sdf: Vec<f64>,
    pub logit: Vec<f64>,
    pub gradient: Vec<f64>,
    pub features: Vec<f64>,
    pub rgb: Vec<f64>,
    pub background: Vec<f64>,
    pub bias_sdf: Vec<f64>,
}

#[derive(Clone, Debug)]
pub struct Outcome {
    /// "color", "eikonal", "bias", "interlevel", each with its weight, and their sum "total".
    pub losses: BTreeMap<String, f64>,
    pub images: Images,
    pub d_images: ActivationGradients,
    /// ∂total/∂parameter, by span name.
    pub gradients: BTreeMap<String, Vec<f64>>,
}

/// The parameters on the tape, by span name.
struct Spans(BTreeMap<String, Var>);

impl Spans {
    fn get(&self, name: &str) -> Var {
        *self
            .0
            .get(name)
            .unwrap_or_else(|| panic!("no parameter span {name}"))
    }

    fn normed(&self, name: &str) -> NormedLayer {
        let part = |part: &str| self.get(&format!("{name}.{part}"));
        NormedLayer {
            v: part("v"),
            g: part("g"),
            bias: part("bias"),
        }
    }

    fn proposal(&self, level: usize) -> Proposal {
        let part = |part: &str| self.get(&format!("proposal.{level}.{part}"));
        Proposal {
            table: part("table"),
            hidden: part("hidden"),
            out: part("out"),
        }
    }
}

impl Step {
    /// Name, rows and columns of every parameter span of a configuration.
    pub fn spans(config: &StepConfig) -> Vec<(String, usize, usize)> {
        let mut spans = Vec::new();
        let mut plain = |name: String, rows: usize, cols: usize| spans.push((name, rows, cols));
        let mut normed = |name: String, rows: usize, cols: usize| {
            plain(format!("{name}.v"), rows, cols);
            plain(format!("{name}.g"), rows, 1);
            plain(format!("{name}.bias"), 1, rows);
        };
        normed(
            "surface.hidden".into(),
            config.hidden,
            3 + config.grid.width(),
        );
        normed("surface.heads".into(), 2 + config.features, config.hidden);
        let mut inputs = 3 + 27 + 3 + config.features + config.appearance;
        for layer in 0..=config.color_layers {
            let outputs = if layer < config.color_layers {
                config.color_hidden
            } else {
                3
            };
            normed(format!("color.{layer}"), outputs, inputs);
            inputs = outputs;
        }
        plain(
            "surface.table".into(),
            config.grid.entries(),
            config.grid.features,
        );
        if config.appearance > 0 {
            plain("appearance".into(), config.views, config.appearance);
        }
        for (level, grid) in config.proposal_grids.iter().enumerate() {
            plain(
                format!("proposal.{level}.table"),
                grid.entries(),
                grid.features,
            );
            plain(
                format!("proposal.{level}.hidden"),
                config.proposal_hidden,
                grid.width(),
            );
            plain(format!("proposal.{level}.out"), 1, config.proposal_hidden);
        }
        match &config.background {
            Background::Black | Background::Fixed(_) => {}
            Background::Learned => plain("background.constant".into(), 1, 3),
            Background::Field(field) => {
                plain(
                    "background.table".into(),
                    field.grid.entries(),
                    field.grid.features,
                );
                plain("background.hidden".into(), field.hidden, field.grid.width());
                plain("background.heads".into(), 1 + field.geometry, field.hidden);
                plain(
                    "background.color.0".into(),
                    field.hidden,
                    16 + field.geometry + field.appearance,
                );
                plain("background.color.1".into(), field.hidden, field.hidden);
                plain("background.color.2".into(), 3, field.hidden);
                if field.appearance > 0 {
                    plain(
                        "background.appearance".into(),
                        config.views,
                        field.appearance,
                    );
                }
            }
        }
        spans
    }

    pub fn run(&self) -> Outcome {
        let Step {
            config,
            rays,
            draws,
            now,
            ..
        } = self;
        let (n, samples) = (rays.origins.len(), config.samples);
        let tape = &mut Tape::default();
        let spans = self.put_parameters(tape);
        let mut images = Images::default();

        // Rays and samples.
        images.stretches = rays.stretches.clone().unwrap_or_else(|| {
            let along = rays.origins.iter().zip(&rays.directions);
            along
                .map(|(&origin, &direction)| sampling::collide(config.region, origin, direction))
                .collect()
        });
        let bins = [
            config.proposal_samples[0],
            config.proposal_samples[1],
            samples,
        ];
        let mut proposal_raw = Vec::new();
        let mut proposal_weights = Vec::new();
        for level in 0..3 {
            for ray in 0..n {
                let draw = config.train.then(|| draws.jitter[level][ray]);
                let edges = if let Some(edges) = &self.edges {
                    edges[level][ray * (bins[level] + 1)..][..bins[level] + 1].to_vec()
                } else if level == 0 {
                    let same = |_| draw.unwrap_or(0.5);
                    sampling::place(
                        bins[0],
                        draw.is_some().then_some(&same as &dyn Fn(usize) -> f64),
                    )
                } else {
                    let before = bins[level - 1];
                    let edges = &images.edges[level - 1][ray * (before + 1)..][..before + 1];
                    let weights = &images.proposal_weights[level - 1][ray * before..][..before];
                    sampling::resample(edges, weights, now.anneal, bins[level], draw)
                };
                images.distances[level].extend(sampling::distances(&edges, images.stretches[ray]));
                images.edges[level].extend(edges);
            }
            if level < 2 {
                let points = self.points_at(
                    bins[level],
                    &per_ray(&images.distances[level], n, sampling::midpoints),
                );
                let raw =
                    spans
                        .proposal(level)
                        .log_density(tape, &config.proposal_grids[level], &points);
                let lengths = per_ray(&images.distances[level], n, sampling::lengths);
                let weights = proposal::weights(tape, raw, lengths, bins[level]);
                images.proposal_raw[level] = tape.value(raw).to_vec();
                images.proposal_weights[level] = tape.value(weights).to_vec();
                proposal_raw.push(raw);
                proposal_weights.push(weights);
            }
        }

        // The surface field at bin starts and around them.
        let starts = self.points_at(
            samples,
            &per_ray(&images.distances[2], n, |t| t[..t.len() - 1].to_vec()),
        );
        let steps: Vec<f64> = draws
            .taps
            .iter()
            .map(|&draw| surface::tap_step(draw, config.tap_range, config.tap_floor))
            .collect();
        assert_eq!(steps.len(), n * samples, "one tap draw per shading sample");
        images.points = [starts.clone(), surface::tap_points(&starts, &steps)].concat();
        let field = Surface {
            table: spans.get("surface.table"),
            hidden: spans.normed("surface.hidden"),
            heads: spans.normed("surface.heads"),
        };
        let heads = field.heads(tape, &config.grid, &images.points);
        let sdf_all = tape.columns(heads, 0..1);
        let at_starts = tape.rows(heads, 0..n * samples);
        let logit = tape.columns(at_starts, 1..2);
        let features = tape.columns(at_starts, 2..2 + config.features);
        let taps = tape.rows(sdf_all, n * samples..7 * n * samples);
        let gradient = surface::six_tap_gradient(tape, taps, steps);

        // Density, weights, colours, image.
        let inv_s = volume::inverse_scale(
            tape,
            logit,
            config.scale_range,
            config.scale_floor,
            now.inv_s_lower,
        );
        let beta = volume::reciprocal(tape, inv_s);
        let sdf = tape.rows(sdf_all, 0..n * samples);
        let sdf = self.empty_outside(tape, sdf, &images.stretches);
        let density = volume::laplace_density(tape, sdf, beta);
        let density = tape.reshape(density, n, samples);
        let lengths = per_ray(&images.distances[2], n, sampling::lengths);
        let weights = volume::ray_weights(tape, density, lengths);
        let rgb = self.sample_colors(tape, &spans, &starts, gradient, features);
        let padded = volume::pad_color(tape, rgb);
        let background = self.background(tape, &spans, &images.stretches);
        let image = volume::composite(tape, weights, padded, background);

        // Losses.
        let color_error = losses::color(tape, image, &rays.target);
        let color = tape.sum(color_error);
        let color = tape.scale(color, now.inv_count);
        let eikonal = losses::eikonal(tape, gradient);
        let eikonal = tape.scale(eikonal, config.eikonal_weight);

        let weights_and_rest = tape.value(weights).to_vec();
        images.weights = weights_and_rest
            .chunks_exact(samples + 1)
            .flat_map(|row| row[..samples].to_vec())
            .collect();
        let midpoints = per_ray(&images.distances[2], n, sampling::midpoints);
        let mut middles = Vec::new();
        for ray in 0..n {
            let range = ray * samples..(ray + 1) * samples;
            let (weights, sdf) = (
                &images.weights[range.clone()],
                &tape.value(sdf)[range.clone()],
            );
            images
                .bias_gate
                .push(losses::bias_gate(sdf, weights, config.bias_needs_opaque));
            let middle = midpoints[range.start + losses::heaviest(weights)];
            middles.push(sampling::point_on_ray(
                rays.origins[ray],
                rays.directions[ray],
                middle,
            ));
            images.accumulation.push(weights.iter().sum());
            images
                .transmittance
                .push(weights_and_rest[ray * (samples + 1) + samples]);
            images
                .depth
                .push(volume::expected_depth(weights, &midpoints[range.clone()]));
            images.normal.extend(mean_normal(
                weights,
                &tape.value(gradient)[range.start * 3..range.end * 3],
            ));
        }
        images.bias_points = losses::bias_points(
            &middles,
            &rays.directions,
            config.bias_epsilon,
            config.bias_offset,
        );
        let bias_sdf = field.sdf(tape, &config.grid, &images.bias_points);
        let gates = images.bias_gate.clone();
        let bias = losses::bias(
            tape,
            bias_sdf,
            gates,
            config.bias_epsilon,
            config.bias_reduction,
        );
        let bias = tape.scale(bias, now.bias_weight);

        let mut interlevel = tape.constant(1, 1, vec![0.0]);
        for (level, &weights) in proposal_weights.iter().enumerate() {
            let loss = losses::interlevel(
                tape,
                weights,
                &images.edges[level],
                &images.weights,
                &images.edges[2],
            );
            interlevel = tape.add(interlevel, loss);
        }
        let interlevel = tape.scale(interlevel, config.interlevel_weight);

        let named = [
            ("color", color),
            ("eikonal", eikonal),
            ("bias", bias),
            ("interlevel", interlevel),
        ];
        let total = named[1..]
            .iter()
            .fold(color, |sum, &(_, loss)| tape.add(sum, loss));
        let mut losses: BTreeMap<String, f64> = named
            .iter()
            .map(|&(name, loss)| (name.to_string(), tape.scalar(loss)))
            .collect();
        losses.insert("total".into(), tape.scalar(total));

        // Back again.
        let gradients = tape.backward(total);
        images.sdf = tape.value(sdf_all).to_vec();
        images.logit = tape.value(logit).to_vec();
        images.inv_s = tape.value(inv_s).to_vec();
        images.density = tape.value(density).to_vec();
        images.gradient = tape.value(gradient).to_vec();
        images.features = tape.value(features).to_vec();
        images.rgb = tape.value(rgb).to_vec();
        images.background = tape.value(background).to_vec();
        images.color = tape.value(image).to_vec();
        images.color_error = tape.value(color_error).to_vec();
        images.bias_sdf = tape.value(bias_sdf).to_vec();
        let d_images = ActivationGradients {
            proposal_raw: [
                gradients.get(proposal_raw[0]),
                gradients.get(proposal_raw[1]),
            ],
            sdf: gradients.get(sdf_all),
            logit: gradients.get(logit),
            gradient: gradients.get(gradient),
            features: gradients.get(features),
            rgb: gradients.get(rgb),
            background: gradients.get(background),
            bias_sdf: gradients.get(bias_sdf),
        };
        Outcome {
            losses,
            images,
            d_images,
            gradients: spans.gradients(&gradients),
        }
    }

    fn put_parameters(&self, tape: &mut Tape) -> Spans {
        let put = |(name, rows, cols): (String, usize, usize)| {
            let value = self
                .params
                .get(&name)
                .unwrap_or_else(|| panic!("no values for the parameter span {name}"));
            assert_eq!(value.len(), rows * cols, "{name} is {rows} x {cols}");
            let var = tape.parameter(rows, cols, value.clone());
            (name, var)
        };
        Spans(Step::spans(&self.config).into_iter().map(put).collect())
    }

    /// o + t d for `bins` distances per ray.
    fn points_at(&self, bins: usize, distances: &[f64]) -> Vec<[f64; 3]> {
        let point = |(i, &t): (usize, &f64)| {
            sampling::point_on_ray(
                self.rays.origins[i / bins],
                self.rays.directions[i / bins],
                t,
            )
        };
        distances.iter().enumerate().map(point).collect()
    }

    /// f := +1000 on rays that miss the region, where a background takes their place: no density, and no gradient through it.
    fn empty_outside(&self, tape: &mut Tape, sdf: Var, stretches: &[Stretch]) -> Var {
        if self.config.background == Background::Black {
            return sdf;
        }
        let samples = self.config.samples;
        let outside: Vec<bool> = (0..sdf.len())
            .map(|i| stretches[i / samples].outside)
            .collect();
        let value = tape
            .value(sdf)
            .iter()
            .zip(&outside)
            .map(|(&f, &outside)| if outside { 1000.0 } else { f })
            .collect();
        tape.record(
            sdf.rows,
            sdf.cols,
            value,
            &[sdf],
            move |_, d_out, gradients| {
                if let Some(d_sdf) = gradients.of(sdf) {
                    for ((d_sdf, d_out), &outside) in d_sdf.iter_mut().zip(d_out).zip(&outside) {
                        *d_sdf += if outside { 0.0 } else { *d_out };
                    }
                }
            },
        )
    }

    /// Codes of the rays' views `[N, width]`; zeros outside training.
    fn codes(&self, tape: &mut Tape, spans: &Spans, span: &str, width: usize) -> Option<Var> {
        if width == 0 {
            return None;
        }
        let n = self.rays.origins.len();
        Some(match self.config.train {
            true => tape.gather_rows(spans.get(span), self.rays.view.clone()),
            false => tape.constant(n, width, vec![0.0; n * width]),
        })
    }

    fn sample_colors(
        &self,
        tape: &mut Tape,
        spans: &Spans,
        points: &[[f64; 3]],
        gradient: Var,
        features: Var,
    ) -> Var {
        let config = &self.config;
        let ray_of_sample: Vec<usize> = (0..points.len())
            .map(|sample| sample / config.samples)
            .collect();
        let directions: Vec<[f64; 3]> = ray_of_sample
            .iter()
            .map(|&ray| self.rays.directions[ray])
            .collect();
        let codes = self.codes(tape, spans, "appearance", config.appearance);
        let codes = codes.map(|codes| tape.gather_rows(codes, ray_of_sample));
        let layers: Vec<NormedLayer> = (0..=config.color_layers)
            .map(|layer| spans.normed(&format!("color.{layer}")))
            .collect();
        surface::color(
            tape,
            &layers,
            points,
            &directions,
            gradient,
            features,
            codes,
        )
    }

    fn background(&self, tape: &mut Tape, spans: &Spans, stretches: &[Stretch]) -> Var {
        let n = self.rays.origins.len();
        match &self.config.background {
            Background::Black => tape.constant(n, 3, vec![0.0; n * 3]),
            Background::Fixed(color) => tape.constant(n, 3, color.repeat(n)),
            Background::Learned => {
                let color = sigmoid(tape, spans.get("background.constant"));
                tape.gather_rows(color, vec![0; n])
            }
            Background::Field(config) => {
                let code = self.codes(tape, spans, "background.appearance", config.appearance);
                let field = Field {
                    table: spans.get("background.table"),
                    hidden: spans.get("background.hidden"),
                    heads: spans.get("background.heads"),
                    color: [0, 1, 2].map(|layer| spans.get(&format!("background.color.{layer}"))),
                    code,
                };
                let near: Vec<f64> = stretches.iter().map(|stretch| stretch.far).collect();
                let draws = &self.draws.background;
                let draws = (self.config.train && !draws.is_empty()).then_some(draws.as_slice());
                field.render(
                    tape,
                    config,
                    &self.rays.origins,
                    &self.rays.directions,
                    &near,
                    draws,
                )
            }
        }
    }
}

impl Spans {
    fn gradients(&self, gradients: &Gradients) -> BTreeMap<String, Vec<f64>> {
        self.0
            .iter()
            .map(|(name, &var)| (name.clone(), gradients.get(var)))
            .collect()
    }
}

/// Applies `f` to each ray's share of `edges`.
fn per_ray(edges: &[f64], rays: usize, f: impl Fn(&[f64]) -> Vec<f64>) -> Vec<f64> {
    edges.chunks_exact(edges.len() / rays).flat_map(f).collect()
}

/// Σ w g/max(‖g‖, 1e-12)
fn mean_normal(weights: &[f64], gradients: &[f64]) -> [f64; 3] {
    let mut normal = [0.0; 3];
    for (weight, g) in weights.iter().zip(gradients.chunks_exact(3)) {
        let length = g.iter().map(|g| g * g).sum::<f64>().sqrt().max(1e-12);
        (0..3).for_each(|axis| normal[axis] += weight * g[axis] / length);
    }
    normal
}
