//! One training step, whole: rays in; losses, images and the gradient of every parameter out.

use super::background::{Background, Field};
use super::batch::{ActivationGradients, Density, Images, Outcome, Scale, Step, Tangent};
use super::losses;
use super::networks::{NormedLayer, sigmoid};
use super::proposal::{self, Proposal};
use super::sampling::{self, Stretch};
use super::supervision;
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

/// A proposal level's raw outputs and its weights, by which the interlevel loss reaches it.
struct ProposalLevel {
    raw: Var,
    weights: Var,
}

/// The surface field at the samples: the bins' starts, or with NeuS's opacity their middles.
struct Shading {
    points: Vec<[f64; 3]>,
    /// At every point that was asked: samples and taps.
    sdf_all: Var,
    sdf: Var,
    logit: Var,
    features: Var,
    gradient: Var,
    /// Distance of the taps, if there are any.
    tap_steps: Vec<f64>,
}

impl Step {
    pub fn run(&self) -> Outcome {
        let Step {
            config,
            rays,
            now,
            stage,
            ..
        } = self;
        let (n, samples) = (rays.origins.len(), config.samples);
        let tape = &mut Tape::default();
        tape.relu_edge = self.relu_edge;
        let spans = self.put_parameters(tape);
        let mut images = Images {
            stretches: self.stretches(),
            ..Images::default()
        };
        let proposals = self.sample_rays(tape, &spans, &mut images);
        let field = Surface {
            table: spans.get("surface.table"),
            hidden: spans.normed("surface.hidden"),
            heads: spans.normed("surface.heads"),
            released: now.released_levels,
        };
        let shading = self.shade(tape, field, &mut images);
        let gradient = shading.gradient;

        // Density, weights, colours, image.
        let count = n * samples;
        let inv_s = match config.scale {
            Scale::Local => volume::inverse_scale(
                tape,
                shading.logit,
                config.scale_range,
                config.scale_floor,
                now.inv_s_lower,
            ),
            shared => {
                let v = tape.gather_rows(spans.get("surface.scale"), vec![0; count]);
                volume::shared_inverse_scale(tape, v, shared, config.scale_floor)
            }
        };
        let sdf = self.empty_outside(tape, shading.sdf, &images.stretches);
        let directions = self.sample_directions();
        let lengths = per_ray(&images.distances[2], n, sampling::lengths);
        // σ over the bins' lengths, or τ over lengths of 1.
        let (density, lengths) = match stage.density {
            Density::Neus => {
                let parts = [sdf, gradient, inv_s];
                let depth =
                    volume::neus_depth(tape, parts, &directions, lengths, now.cosine_anneal);
                (depth, vec![1.0; count])
            }
            Density::Laplace | Density::Sight => {
                let distance = match stage.density {
                    Density::Laplace => sdf,
                    _ => {
                        let directions = tape.points(&directions);
                        volume::distance_along_ray(tape, sdf, gradient, directions)
                    }
                };
                let beta = volume::reciprocal(tape, inv_s);
                (volume::laplace_density(tape, distance, beta), lengths)
            }
        };
        let density = tape.reshape(density, n, samples);
        let weights = volume::ray_weights(tape, density, lengths);
        let rgb = self.sample_colors(tape, &spans, &shading, &directions);
        let padded = volume::pad_color(tape, rgb);
        let background = self.background(tape, &spans, &images.stretches);
        let image = volume::composite(tape, weights, padded, background);
        self.integrate(tape.value(weights), tape.value(gradient), &mut images);

        // Losses.
        let color_error = losses::color(tape, image, &rays.target, config.color_squared);
        let color = tape.sum(color_error);
        let color = tape.scale(color, now.inv_count);
        let eikonal = losses::eikonal(tape, gradient);
        let eikonal = tape.scale(eikonal, config.eikonal_weight);
        let interlevel = self.interlevel_loss(tape, &proposals, &images);
        let mut named = vec![
            ("color", color),
            ("eikonal", eikonal),
            ("interlevel", interlevel),
        ];
        let mut bias_sdf = None;
        if stage.bias {
            let (loss, sdf) = self.bias_loss(tape, field, sdf, &mut images);
            named.push(("bias", loss));
            bias_sdf = Some(sdf);
        }
        let (mut tangent_points, mut tangent_gradient) = (None, None);
        if let Some(tangent) = &stage.tangent {
            let (loss, points, at_points) =
                self.tangent_loss(tape, field, gradient, tangent, &mut images);
            named.push(("tangent", loss));
            (tangent_points, tangent_gradient) = (Some(points), Some(at_points));
        }
        if now.curvature_weight > 0.0 {
            let steps = shading.tap_steps.clone();
            let loss = surface::curvature(tape, stage.taps, shading.sdf_all, steps);
            named.push(("curvature", tape.scale(loss, now.curvature_weight)));
        }
        named.extend(self.supervise(tape, weights, gradient, &images));
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
        images.sdf = tape.value(shading.sdf_all).to_vec();
        images.logit = tape.value(shading.logit).to_vec();
        images.inv_s = tape.value(inv_s).to_vec();
        images.density = tape.value(density).to_vec();
        images.gradient = tape.value(gradient).to_vec();
        images.features = tape.value(shading.features).to_vec();
        images.rgb = tape.value(rgb).to_vec();
        images.background = tape.value(background).to_vec();
        images.color = tape.value(image).to_vec();
        images.color_error = tape.value(color_error).to_vec();
        let of_one = |var: Option<Var>| var.map_or(Vec::new(), |var| gradients.get(var));
        let d_images = ActivationGradients {
            proposal_raw: [0, 1].map(|level: usize| gradients.get(proposals[level].raw)),
            sdf: gradients.get(shading.sdf_all),
            logit: gradients.get(shading.logit),
            gradient: gradients.get(gradient),
            features: gradients.get(shading.features),
            rgb: gradients.get(rgb),
            background: gradients.get(background),
            bias_sdf: of_one(bias_sdf),
            tangent_points: of_one(tangent_points),
            tangent_gradient: of_one(tangent_gradient),
        };
        Outcome {
            losses,
            images,
            d_images,
            gradients: spans.gradients(&gradients),
        }
    }

    fn stretches(&self) -> Vec<Stretch> {
        let rays = &self.rays;
        rays.stretches.clone().unwrap_or_else(|| {
            let along = rays.origins.iter().zip(&rays.directions);
            along
                .map(|(&origin, &direction)| {
                    sampling::collide(self.config.region, origin, direction)
                })
                .collect()
        })
    }

    /// Edges of all three levels; the proposal networks at the middles of the first two levels' bins.
    fn sample_rays(
        &self,
        tape: &mut Tape,
        spans: &Spans,
        images: &mut Images,
    ) -> Vec<ProposalLevel> {
        let (config, n) = (&self.config, self.rays.origins.len());
        let [first, second] = config.proposal_samples;
        let bins = [first, second, config.samples];
        let mut proposals = Vec::new();
        for level in 0..3 {
            for ray in 0..n {
                let draw = config.train.then(|| self.draws.jitter[level][ray]);
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
                    sampling::resample(edges, weights, self.now.anneal, bins[level], draw)
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
                proposals.push(ProposalLevel { raw, weights });
            }
        }
        proposals
    }

    /// The surface field at the samples, and g there: from taps around them, or analytically.
    fn shade(&self, tape: &mut Tape, field: Surface, images: &mut Images) -> Shading {
        let (config, n) = (&self.config, self.rays.origins.len());
        let count = n * config.samples;
        let distances = match self.stage.density {
            Density::Neus => per_ray(&images.distances[2], n, sampling::midpoints),
            _ => per_ray(&images.distances[2], n, |t| t[..t.len() - 1].to_vec()),
        };
        let points = self.points_at(config.samples, &distances);
        let mut tap_steps = Vec::new();
        let (heads, sdf_all, gradient) = match self.stage.taps {
            0 => {
                let given = self.points.as_deref().map(|given| &given[..count]);
                images.points = given.unwrap_or(&points).to_vec();
                let x = tape.points(&images.points);
                let (heads, gradient) = field.heads_and_gradient(tape, &config.grid, x);
                (heads, tape.columns(heads, 0..1), gradient)
            }
            taps => {
                let step = |&draw| surface::tap_step(draw, config.tap_range, config.tap_floor);
                tap_steps = self.draws.taps.iter().map(step).collect();
                assert_eq!(tap_steps.len(), count, "one tap draw per shading sample");
                let own = || {
                    [
                        points.clone(),
                        surface::tap_points(taps, &points, &tap_steps),
                    ]
                    .concat()
                };
                images.points = self.points.clone().unwrap_or_else(own);
                let heads = field.heads(tape, &config.grid, &images.points);
                let sdf_all = tape.columns(heads, 0..1);
                let at_taps = tape.rows(sdf_all, count..(1 + taps) * count);
                let gradient = surface::tap_gradient(tape, taps, at_taps, tap_steps.clone());
                (heads, sdf_all, gradient)
            }
        };
        let at_samples = tape.rows(heads, 0..count);
        Shading {
            points,
            sdf_all,
            sdf: tape.rows(sdf_all, 0..count),
            logit: tape.columns(at_samples, 1..2),
            features: tape.columns(at_samples, 2..2 + config.features),
            gradient,
            tap_steps,
        }
    }

    /// What is added up along a ray besides colour; `weights` `[N, S + 1]` with what is left behind the last sample.
    fn integrate(&self, weights: &[f64], gradient: &[f64], images: &mut Images) {
        let (n, samples) = (self.rays.origins.len(), self.config.samples);
        let midpoints = per_ray(&images.distances[2], n, sampling::midpoints);
        for ray in 0..n {
            let range = ray * samples..(ray + 1) * samples;
            let row = &weights[ray * (samples + 1)..][..samples + 1];
            let (weights, behind) = (&row[..samples], row[samples]);
            images.weights.extend(weights);
            images.accumulation.push(weights.iter().sum());
            images.transmittance.push(behind);
            images
                .depth
                .push(volume::expected_depth(weights, &midpoints[range.clone()]));
            images.normal.extend(mean_normal(
                weights,
                &gradient[range.start * 3..range.end * 3],
            ));
        }
    }

    /// The loss, and the signed distances that it asks for. `sdf`: with the rays outside emptied.
    fn bias_loss(
        &self,
        tape: &mut Tape,
        field: Surface,
        sdf: Var,
        images: &mut Images,
    ) -> (Var, Var) {
        let (config, rays) = (&self.config, &self.rays);
        let (n, samples) = (rays.origins.len(), config.samples);
        let midpoints = per_ray(&images.distances[2], n, sampling::midpoints);
        let mut middles = Vec::new();
        for ray in 0..n {
            let range = ray * samples..(ray + 1) * samples;
            let weights = &images.weights[range.clone()];
            let sdf = &tape.value(sdf)[range.clone()];
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
        }
        images.bias_points = losses::bias_points(
            &middles,
            &rays.directions,
            config.bias_epsilon,
            config.bias_offset,
        );
        let bias_sdf = field.sdf(tape, &config.grid, &images.bias_points);
        images.bias_sdf = tape.value(bias_sdf).to_vec();
        let loss = losses::bias(
            tape,
            bias_sdf,
            images.bias_gate.clone(),
            config.bias_epsilon,
            config.bias_reduction,
        );
        (tape.scale(loss, self.now.bias_weight), bias_sdf)
    }

    /// The loss, its points, and g there. Over all samples, those of rays outside included. The shifts start at the bins' middles, though the normals are those of the
    /// starts; the shifted points, and g there, keep their derivatives by those normals.
    fn tangent_loss(
        &self,
        tape: &mut Tape,
        field: Surface,
        gradient: Var,
        tangent: &Tangent,
        images: &mut Images,
    ) -> (Var, Var, Var) {
        let (n, samples) = (self.rays.origins.len(), self.config.samples);
        let count = n * samples;
        assert_eq!(tangent.draws.len(), count, "one draw per shading sample");
        let midpoints = per_ray(&images.distances[2], n, sampling::midpoints);
        let middles = self.points_at(samples, &midpoints);
        let directions = tangent.draws.iter().map(|&u| surface::normalized(u));
        let normals = surface::normals(tape, gradient);
        let mut points =
            surface::tangent_points(tape, &middles, normals, directions.collect(), tangent.step);
        if let Some(given) = &self.points {
            points = tape.moved(points, given[count..].as_flattened().to_vec());
        }
        images
            .points
            .extend((0..count).map(|sample| tape.point(points, sample)));
        let (_, shifted) = field.heads_and_gradient(tape, &self.config.grid, points);
        images.tangent_gradient = tape.value(shifted).to_vec();
        let shifted_normals = surface::normals(tape, shifted);
        let loss = losses::tangent(tape, normals, shifted_normals);
        (tape.scale(loss, tangent.weight), points, shifted)
    }

    /// The losses on masks, depths and normals that there are.
    fn supervise(
        &self,
        tape: &mut Tape,
        weights: Var,
        gradient: Var,
        images: &Images,
    ) -> Vec<(&'static str, Var)> {
        let rays = &self.rays;
        let wanted = &rays.supervision;
        let meets = |ray: usize| f64::from(u8::from(!images.stretches[ray].outside));
        let meeting: Vec<f64> = (0..rays.target.len()).map(meets).collect();
        let masks: Vec<f64> = rays.target.iter().map(|target| target[3]).collect();
        let counts: Vec<f64> = meeting.iter().zip(&masks).map(|(a, b)| a * b).collect();
        let mut named = Vec::new();
        if wanted.mask > 0.0 {
            let accumulation = supervision::accumulation(tape, weights);
            let loss = supervision::mask(tape, accumulation, masks, &meeting);
            named.push(("mask", tape.scale(loss, wanted.mask)));
        }
        let midpoints = per_ray(&images.distances[2], rays.target.len(), sampling::midpoints);
        let depth = supervision::depth(tape, weights, midpoints);
        if wanted.sensor_depth > 0.0 {
            let loss = supervision::sensor_depth(tape, depth, &wanted.known, &counts);
            named.push(("sensor_depth", tape.scale(loss, wanted.sensor_depth)));
        }
        if wanted.mono_depth > 0.0 {
            let loss = supervision::mono_depth(tape, depth, &wanted.known, &counts);
            named.push(("mono_depth", tape.scale(loss, wanted.mono_depth)));
        }
        if wanted.mono_normal > 0.0 {
            let normals = surface::normals(tape, gradient);
            let normal = supervision::normal(tape, weights, normals);
            let loss = supervision::mono_normal(tape, normal, &wanted.known, &counts);
            named.push(("mono_normal", tape.scale(loss, wanted.mono_normal)));
        }
        named
    }

    fn interlevel_loss(
        &self,
        tape: &mut Tape,
        proposals: &[ProposalLevel],
        images: &Images,
    ) -> Var {
        let mut sum = tape.constant(1, 1, vec![0.0]);
        for (level, proposal) in proposals.iter().enumerate() {
            let loss = losses::interlevel(
                tape,
                proposal.weights,
                &images.edges[level],
                &images.weights,
                &images.edges[2],
            );
            sum = tape.add(sum, loss);
        }
        tape.scale(sum, self.config.interlevel_weight)
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

    /// The direction of each sample's ray.
    fn sample_directions(&self) -> Vec<[f64; 3]> {
        let directions = self.rays.directions.iter();
        directions
            .flat_map(|&d| std::iter::repeat_n(d, self.config.samples))
            .collect()
    }

    /// f := +1000 on rays that miss the region: no density, and no gradient through it.
    fn empty_outside(&self, tape: &mut Tape, sdf: Var, stretches: &[Stretch]) -> Var {
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
        shading: &Shading,
        directions: &[[f64; 3]],
    ) -> Var {
        let config = &self.config;
        let rays = (0..directions.len()).map(|sample| sample / config.samples);
        let codes = self.codes(tape, spans, "appearance", config.appearance);
        let codes = codes.map(|codes| tape.gather_rows(codes, rays.collect()));
        let layers: Vec<NormedLayer> = (0..=config.color_layers)
            .map(|layer| spans.normed(&format!("color.{layer}")))
            .collect();
        surface::color(
            tape,
            &layers,
            &shading.points,
            directions,
            shading.gradient,
            shading.features,
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
        let n = surface::normalized([g[0], g[1], g[2]]);
        (0..3).for_each(|axis| normal[axis] += weight * n[axis]);
    }
    normal
}
