//! One training step of stage 1, whole: rays in; losses, images and the gradient of every parameter out.

use super::background::{Background, Field};
use super::batch::{ActivationGradients, Images, Outcome, Step};
use super::losses;
use super::networks::{NormedLayer, sigmoid};
use super::proposal::{self, Proposal};
use super::sampling::{self, Stretch};
use super::surface::{self, Surface};
use super::tape::{Gradients, Tape, Var};
use super::volume;
use std::collections::BTreeMap;

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

        // Rays and samples.
        let stretches = rays.stretches.clone().unwrap_or_else(|| {
            let along = rays.origins.iter().zip(&rays.directions);
            along
                .map(|(&origin, &direction)| sampling::collide(config.region, origin, direction))
                .collect()
        });
        let mut images = Images {
            stretches,
            ..Images::default()
        };
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
            let meets = !images.stretches[ray].outside;
            images.bias_gate.push(if meets {
                losses::bias_gate(sdf, weights, config.bias_needs_opaque)
            } else {
                0.0
            });
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
        Spans(self.config.spans().into_iter().map(put).collect())
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
