//! A training step written straight from the definitions, in f64 and sample by sample, to test the
//! fast one against: from where samples lie to the loss, with the gradients taken by central
//! differences.

use std::ops::Range;

use glam::{DVec3, Vec3};
use hashgrid::HashGrid;
use smpl::{MotionField, MotionFrame};
use testkit::oracle;
use visibility::VisibilityCounts;

use crate::config::{Config, DistanceKind, Method, MotionKind, Preset};
use crate::model::body::surface_point;
use crate::model::encoder::{Coordinates, Encoder};
use crate::model::field::{Parameters, Part};
use crate::model::samples::Samples;
use crate::model::trained::Model;
use crate::scene::prepared::Scene;
use crate::train::batch::target;
use crate::train::loss::BETA;
use crate::train::trainer::Trainer;
use volrender::RandomStream;

/// What the plain step reads besides the parameters under test: the samples of a step that was
/// taken.
struct Plain<'a, 'b> {
    trainer: &'a Trainer<'b>,
    counts: &'a VisibilityCounts,
    /// Of the vertices in that step.
    offsets: &'a [f32],
}

impl Plain<'_, '_> {
    /// Rows of features at points of the unit cube.
    fn encode<const D: usize>(&self, table: &[f32], points: &[[f32; D]]) -> Vec<Vec<f64>> {
        let encoding = &self.trainer.model.config.encoding;
        let flat: Vec<f64> = points.iter().flatten().map(|&x| f64::from(x)).collect();
        let (ranges, resolutions) = match &self.trainer.model.field.encoder {
            Encoder::Point(grid) => levels(grid),
            Encoder::Custom(_) => panic!("none of the methods under test"),
            Encoder::Surface(grid, _) => levels(grid),
        };
        let (log2, features) = (encoding.log2_table_size, encoding.features);
        let mut padded = vec![0.0; (resolutions.len() << log2) * features];
        for (range, level) in ranges.into_iter().zip(padded.chunks_mut(features << log2)) {
            level[..range.len()].copy_from_slice(&table[range]);
        }
        let rows = oracle::hash_encode(&flat, D, &resolutions, &padded, log2, features);
        rows.chunks(resolutions.len() * features).map(<[f64]>::to_vec).collect()
    }

    /// Where the vertices are encoded with `offsets`; neighbours are those without.
    fn vertices(&self, offsets: &[f32]) -> Coordinates {
        let Model { body, config, field, .. } = &self.trainer.model;
        let mut at = Coordinates::default();
        let mut neighbours = vec![0; body.query.neighbours_per_query()];
        // Without any they stay where they are.
        let still = vec![0.0; 3 * body.canonical.vertices.len()];
        let [offsets, traced] = [offsets, self.offsets].map(|o| if o.is_empty() { &still[..] } else { o });
        let each = body.canonical.vertices.iter().zip(offsets.chunks_exact(3)).zip(traced.chunks_exact(3));
        for ((&vertex, offset), from) in each {
            body.query.neighbours(vertex + Vec3::from_slice(from), &mut neighbours);
            let v = vertex + Vec3::from_slice(offset);
            let d = surface_point(body, &config.surface, v, &neighbours, 1.0).unwrap().distance;
            field.encoder.push_vertex(v, d, &body.canonical_box, &mut at);
        }
        at
    }

    /// The samples of a segment where the weight volume, if there is one, takes them with `delta`;
    /// those that live, and their neighbours, are the ones without.
    fn moved(&self, samples: &Samples, motion: Option<&MotionField>) -> (Samples, Coordinates) {
        let Model { body, config, field, .. } = &self.trainer.model;
        let (mut out, mut at) = (samples.clone(), Coordinates::default());
        let per_sample = samples.neighbours.len().checked_div(samples.len()).unwrap_or(0);
        let posed = &self.trainer.scene.train[self.trainer.buffers.batch.frame].view.posed;
        let frame = MotionFrame::new(&body.model, posed);
        for s in 0..motion.map_or(0, |_| samples.len()) {
            let mapped = motion.and_then(|motion| motion.map(&frame, samples.world[s], || None)).unwrap();
            let neighbours = &samples.neighbours[s * per_sample..];
            let found = surface_point(body, &config.surface, mapped.canonical, neighbours, 1.0).unwrap();
            (out.canonical[s], out.likelihood[s]) = (mapped.canonical, mapped.likelihood);
            (out.closest[s], out.distance[s]) = (found.closest, found.distance);
        }
        field.encoder.coordinates(&out, &body.canonical_box, &mut at);
        (out, at)
    }

    /// The loss and the colours of the rays, in the order of the batch.
    fn step(&self, values: &Parameters) -> (f64, Vec<DVec3>) {
        let trainer = self.trainer;
        let (config, batch) = (&trainer.model.config, &trainer.buffers.batch);
        let frame = &trainer.scene.train[batch.frame];
        let (field, table) = (values.get(Part::Field), values.get(Part::Table));
        let vertices = self.encode(table, &self.vertices(values.get(Part::Vertices)).surface);
        let motion = trainer.model.volume().map(|volume| {
            let mut weights = volume.clone();
            weights.delta.copy_from_slice(values.get(Part::Motion));
            weights.update();
            MotionField::Volume { weights, threshold: 0.0 }
        });
        let background = batch.background.as_dvec3();
        let mut colors = vec![DVec3::ZERO; batch.pixels.len()];
        let mut completeness = 0.0;
        for state in &trainer.buffers.groups {
            // All samples are one segment.
            let Some(traced) = state.segments.all().first().map(|segment| &segment.batch.samples) else {
                continue;
            };
            let (samples, at) = &self.moved(traced, motion.as_ref());
            let points =
                if at.surface.is_empty() { self.encode(table, &at.point) } else { self.encode(table, &at.surface) };
            let per_sample = samples.neighbours.len().checked_div(samples.len()).unwrap_or(0);
            for (ends, &ray) in samples.starts.windows(2).zip(&state.rays) {
                let (mut transmittance, mut color) = (1.0, DVec3::ZERO);
                for s in ends[0]..ends[1] {
                    let neighbours = &samples.neighbours[s * per_sample..][..per_sample];
                    let mut input = points[s].clone();
                    if config.has_surface_term() {
                        let seen = |v: u32| 1.0 + self.counts.counts()[v as usize] as f64;
                        input.extend(mixed(neighbours.iter().map(|&v| (seen(v), &vertices[v as usize]))));
                    }
                    let raw = trainer.model.field.mlp.plain(field, &input);
                    let d = f64::from(samples.distance[s]);
                    let (f, reach) = (&config.field, f64::from(config.motion.reach()));
                    let (inside, outside) = (f64::from(f.density_bias), f64::from(f.density_bias_outside));
                    let bias = inside + (outside - inside) * d.clamp(0.0, reach) / reach;
                    let sigma = f64::from(f.density_scale) * (raw[0] + bias).exp().ln_1p();
                    let alpha = f64::from(samples.likelihood[s]) * (1.0 - (-sigma * f64::from(samples.delta[s])).exp());
                    let base = samples.base(s).as_dvec4();
                    let rgb = base.truncate() + base.w * DVec3::new(raw[1], raw[2], raw[3]);
                    color += transmittance * alpha * rgb.map(|x| 1.0 / (1.0 + (-x).exp()));
                    transmittance *= 1.0 - alpha;
                    if traced.distance[s] < 0.0 {
                        let beta = f64::from(BETA);
                        completeness += ((beta - sigma).max(0.0) - beta).exp();
                    }
                }
                colors[ray] = color + transmittance * background;
            }
        }
        let shown = frame.reader().unwrap();
        let known = |&(pixel, _): &(&u32, &DVec3)| target(&frame.labels, &shown, *pixel, batch.background).is_some();
        let rays: Vec<(&u32, &DVec3)> = batch.pixels.iter().zip(&colors).filter(known).collect();
        let error = |&(&pixel, color): &(&u32, &DVec3)| {
            let target: Vec3 = target(&frame.labels, &shown, pixel, batch.background).unwrap_or_default();
            (color - target.as_dvec3()).length_squared()
        };
        let mse = rays.iter().map(error).sum::<f64>() / (3 * rays.len()) as f64;
        let nominal = (batch.pixels.len() * config.samples) as f64;
        let loss = f64::from(config.loss.mse) * mse + f64::from(config.loss.completeness) * completeness / nominal;
        (loss, colors)
    }
}

/// The weighted mean of rows.
fn mixed<'a>(rows: impl Iterator<Item = (f64, &'a Vec<f64>)>) -> Vec<f64> {
    let (mut total, mut sum) = (0.0, Vec::new());
    for (weight, row) in rows {
        sum.resize(row.len(), 0.0);
        sum.iter_mut().zip(row).for_each(|(sum, x)| *sum += weight * x);
        total += weight;
    }
    sum.iter().map(|x| x / total).collect()
}

/// Where each level lies in the table, and its cells an axis.
fn levels<const D: usize>(grid: &HashGrid<D>) -> (Vec<Range<usize>>, Vec<u32>) {
    grid.resolutions().iter().enumerate().map(|(l, &n)| (grid.level_range(l), n)).unzip()
}

/// The seed whose case goes without.
const WITHOUT_SURFACE_TERM: u64 = 6;

fn tiny(method: Method, motion: MotionKind, distance: DistanceKind, seed: u64) -> Config {
    let mut config = Config::preset(Preset::Fast, method);
    (config.seed, config.patches, config.patch_size, config.samples) = (seed, 2, 12, 24);
    (config.field.width, config.field.depth) = (24, 2);
    (config.encoding.levels, config.encoding.log2_table_size, config.encoding.n_max) = (5, 11, 96);
    (config.motion.kind, config.motion.shell_interval) = (motion, 0);
    (config.motion.resolution, config.surface.distance) = (16, distance);
    (config.surface.coarse_levels, config.surface.attention) = (3, true);
    config.surface.surface_term = method == Method::Occnerf && seed != WITHOUT_SURFACE_TERM;
    config.min_transmittance = 0.0;
    // Every other one learns its vertices.
    config.rates.vertices = if seed % 2 == 1 { 1e-4 } else { 0.0 };
    config.field.prior_colors &= motion == MotionKind::Surface;
    // The perceptual term has an oracle of its own.
    config.loss.perceptual = 0.0;
    // Small enough for densities below β inside.
    config.field.density_scale = 4.0;
    config
}

/// The fast step and the plain one on the same samples: colours to 1e-4, losses to 1e-4 of
/// themselves, derivatives of every part along random directions to 1e-2 of
/// their size, those that move places to 0.15 (the exact surface under a volume: 0.3).
#[test]
fn a_step_agrees_with_one_written_straight_from_the_definitions() {
    let body = smpl::BodyModel::embedded();
    let cases = [
        (Method::Occnerf, MotionKind::Surface, DistanceKind::Exact),
        (Method::Occnerf, MotionKind::Volume, DistanceKind::Exact),
        (Method::HashPoint, MotionKind::Surface, DistanceKind::Exact),
        (Method::Occnerf, MotionKind::Surface, DistanceKind::Blended),
        (Method::Occnerf, MotionKind::Volume, DistanceKind::Blended),
        (Method::HashPoint, MotionKind::Volume, DistanceKind::Blended),
        (Method::Occnerf, MotionKind::Surface, DistanceKind::Exact),
        (Method::Occnerf, MotionKind::Surface, DistanceKind::Exact),
    ];
    let mut failures = Vec::new();
    for (seed, (method, motion, distance)) in [1u64, 5, 3, 1, 3, 2, 2, WITHOUT_SURFACE_TERM].into_iter().zip(cases) {
        let demo = synth::DemoConfig { size: 48, frames: 3, eval_cameras: 1, eval_every: 3, ..Default::default() };
        let capture = synth::demo(&demo, &body).unwrap();
        let config = tiny(method, motion, distance, seed);
        let scene = Scene::new(&capture, &body, &config).unwrap();
        let mut trainer = Trainer::new(&scene, config).unwrap();
        for _ in 0..3 {
            trainer.step().unwrap();
        }
        let mut random = RandomStream::new(&[seed, 21]);
        // Vertices away from the folds of the mesh that they start on.
        for (part, size) in [(Part::Table, 0.3), (Part::Vertices, 2e-3)] {
            trainer.model.parameters.get_mut(part).iter_mut().for_each(|x| *x += size * random.normal());
        }
        let previous = trainer.model.parameters.clone();
        let counts = trainer.model.counts.clone();
        let report = trainer.step().unwrap();
        let gradients = trainer.optimiser.gradients.clone();
        let plain = Plain { trainer: &trainer, counts: &counts, offsets: previous.get(Part::Vertices) };
        let (loss, colors) = plain.step(&previous);
        assert!((loss - report.loss).abs() < 1e-4 * loss, "{method:?}: loss {} plain {loss}", report.loss);
        let rays: Vec<(DVec3, DVec3)> = (trainer.buffers.groups.iter())
            .flat_map(|g| g.rays.iter().zip(&g.composites).map(|(&ray, c)| (c.color.as_dvec3(), colors[ray])))
            .collect();
        let live = report.live_samples;
        assert!(rays.len() == 288 && live > 500, "{method:?} {motion:?} {distance:?}: {} {live}", rays.len());
        for (fast, plain) in rays {
            assert!((fast - plain).abs().max_element() < 1e-4, "{method:?}: {fast} {plain}");
        }
        // Far enough for f32 to tell places apart, near enough to stay in most cells of the grid.
        let parts = [(Part::Field, 1e-5), (Part::Table, 1e-5), (Part::Vertices, 5e-7), (Part::Motion, 1e-4)];
        for (part, size) in parts.into_iter().filter(|(part, _)| !previous.get(*part).is_empty()) {
            let from = previous.get(part);
            let (mut whole, mut apart) = (0.0, 0.0);
            for direction in 0..3 {
                let mut random = RandomStream::new(&[seed, 22, direction]);
                let mut step: Vec<f32> = from.iter().map(|_| size * random.normal()).collect();
                if part == Part::Field {
                    trainer.model.field.mlp.clear_padding(&mut step);
                }
                let moved = |sign: f32| {
                    let mut values = previous.clone();
                    values.get_mut(part).iter_mut().zip(&step).for_each(|(x, s)| *x += sign * s);
                    values
                };
                let (high, low) = (moved(1.0), moved(-1.0));
                let numeric = plain.step(&high).0 - plain.step(&low).0;
                let each = gradients.get(part).iter().zip(high.get(part).iter().zip(low.get(part)));
                let analytic: f64 = each.map(|(g, (h, l))| f64::from(*g) * (f64::from(*h) - f64::from(*l))).sum();
                whole += numeric * numeric;
                apart += (numeric - analytic).powi(2);
            }
            // Places cross cells of the grid; where the exact surface bends, its closest point does
            // not slide along a plane, which the backward pass takes for granted.
            let tolerance = match part {
                Part::Vertices | Part::Motion => 0.15,
                _ => 0.01,
            };
            let (whole, apart) = (whole.sqrt(), apart.sqrt());
            println!("{method:?} {motion:?} {distance:?} {part:?}: {apart:.1e} of {whole:.1e}");
            // A derivative near 0 is to be no farther off than a hundredth of a step.
            let least = (0.01 * f64::from(size)).min(1e-7);
            if apart >= tolerance * whole.max(least) {
                failures.push(format!("{method:?} {motion:?} {distance:?} {part:?}: {apart} of {whole}"));
            }
        }
    }
    assert!(failures.is_empty(), "{}", failures.join("\n"));
}
