//! `bench kernels`: cost against error of each geometric approximation, one thread, medians. Each
//! kernel is measured in its variants, against its exact form or a known truth.

use std::hint::black_box;
use std::path::Path;
use std::time::Instant;

use anyhow::Result;
use glam::{Affine3A, Vec3};
use hashgrid::{HashGrid, HashGridConfig};
use occnerf::{Config, Method, Preset};
use smpl::{BodyModel, MotionField, MotionFrame, Placement, Posed, Shaped, SurfaceMotion, SurfacePoint, WeightVolume};
use surface_query::{MeshDistance, SurfaceQuery, SurfaceQueryConfig};
use volrender::{Aabb, Bins, RandomStream, Ray, RaySamples, composite};

use super::chart::{Axis, Mark, Panel, Picture, Shape, Style};
use crate::results::{self, Section};
use xtask::process::say;
use xtask::table;

/// Times that a measurement is repeated; the median holds.
const REPEATS: usize = 5;
/// Queries lie within this many metres of the skin.
const REACH: f32 = 0.05;

/// A way of doing it: what it costs and how far off it is.
struct Sample {
    name: String,
    /// Nanoseconds an item.
    nanoseconds: f64,
    /// In the unit of the kernel.
    error: f64,
    /// What is within the presets.
    default: bool,
}

/// A kernel with the names of its axes.
struct Kernel {
    name: &'static str,
    cost: &'static str,
    error: &'static str,
    samples: Vec<Sample>,
}

impl Kernel {
    fn add(&mut self, name: String, seconds: f64, items: usize, error: f64, default: bool) {
        let nanoseconds = 1e9 * seconds / items.max(1) as f64;
        self.samples.push(Sample { name, nanoseconds, error, default });
    }
}

fn median(mut work: impl FnMut()) -> f64 {
    let mut times: Vec<f64> = (0..REPEATS)
        .map(|_| {
            let start = Instant::now();
            work();
            start.elapsed().as_secs_f64()
        })
        .collect();
    times.sort_by(f64::total_cmp);
    times[REPEATS / 2]
}

fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = values.fold((0.0, 0usize), |(s, n), v| (s + v, n + 1));
    sum / count.max(1) as f64
}

/// The embedded body at rest and in a pose with bent limbs, and points around it.
struct Figure {
    body: BodyModel,
    shaped: Shaped,
    posed: Posed,
    /// (face, barycentrics, point at rest) within reach of the skin.
    near: Vec<(u32, [f32; 3], Vec3)>,
}

impl Figure {
    fn new(points: usize) -> Self {
        let body = BodyModel::embedded();
        let shaped = body.shaped(&[]);
        let mut pose = vec![Vec3::ZERO; body.num_joints()];
        for (joint, turn) in [
            (1, Vec3::new(-0.6, 0.0, 0.1)),
            (2, Vec3::new(0.3, 0.0, -0.1)),
            (4, Vec3::new(1.0, 0.0, 0.0)),
            (16, Vec3::new(0.3, 0.0, -0.9)),
            (17, Vec3::new(-0.3, 0.0, 0.9)),
            (18, Vec3::new(0.0, -1.2, 0.0)),
        ] {
            if let Some(at) = pose.get_mut(joint) {
                *at = turn;
            }
        }
        let posed = body.pose(&shaped, &pose, Placement::default());
        let mut random = RandomStream::new(&[1]);
        let near = (0..points)
            .map(|_| {
                let face = ((random.uniform() * body.faces.len() as f32) as usize).min(body.faces.len() - 1);
                let (u, v) = (random.uniform(), random.uniform());
                let (u, v) = if u + v > 1.0 { (1.0 - u, 1.0 - v) } else { (u, v) };
                let [a, b, c] = body.faces[face].map(|i| shaped.vertices[i as usize]);
                let normal = (b - a).cross(c - a).normalize_or_zero();
                let at = a + u * (b - a) + v * (c - a) + (2.0 * random.uniform() - 1.0) * REACH * normal;
                (face as u32, [1.0 - u - v, u, v], at)
            })
            .collect();
        Self { body, shaped, posed, near }
    }

    fn queries(&self) -> Vec<Vec3> {
        self.near.iter().map(|n| n.2).collect()
    }
}

/// Measures everything and draws it.
pub fn run(directory: &Path, quick: bool, publish: bool) -> Result<()> {
    xtask::run::make_directory(directory)?;
    let figure = Figure::new(if quick { 4_000 } else { 20_000 });
    let kernels = [
        distance(&figure)?,
        neighbours(&figure)?,
        motion(&figure)?,
        samples(&figure, if quick { 300 } else { 2000 })?,
        table(&figure, if quick { 20 } else { 60 })?,
    ];
    let mut text = String::new();
    for kernel in &kernels {
        let mut lines = vec![[kernel.name, kernel.cost, kernel.error].map(str::to_owned).to_vec()];
        let line = |s: &Sample| vec![s.name.clone(), format!("{:.1}", s.nanoseconds), format!("{:.3}", s.error)];
        lines.extend(kernel.samples.iter().map(line));
        text.push_str(&format!("{}\n", table::aligned(&lines, 1)));
    }
    say!("{text}");
    let panels = kernels.iter().map(|kernel| {
        let of = |pick: fn(&Sample) -> f64| kernel.samples.iter().map(pick);
        Panel {
            title: kernel.name.to_owned(),
            labels: [kernel.cost.to_owned(), kernel.error.to_owned()],
            scales: [
                Axis::around(of(|s| s.nanoseconds), true),
                Axis::around(of(|s| s.error), of(|s| s.error).all(|e| e > 0.0)),
            ],
            lines: Vec::new(),
            marks: (kernel.samples.iter())
                .map(|s| Mark {
                    at: (s.nanoseconds, s.error),
                    name: s.name.clone(),
                    style: if s.default { Style(1, Shape::Square) } else { Style(0, Shape::Circle) },
                })
                .collect(),
        }
    });
    let legend = vec![
        ("what a preset uses".to_owned(), Style(1, Shape::Square)),
        ("alternatives".to_owned(), Style(0, Shape::Circle)),
    ];
    let title = "Cost against error of each approximation (embedded body, one thread, medians)".to_owned();
    Picture { title, legend, columns: 2, size: (520, 380), panels: panels.collect() }
        .write(&directory.join("kernels"))?;
    if publish {
        let charts = results::charts(directory, "kernels")?;
        let (name, title) = ("kernels", "Cost against error of the geometric kernels");
        results::publish(&Section { name, title, body: &text, charts: &charts })?;
    }
    Ok(())
}

/// The paper's neighbourhoods, with a grid for a body in metres.
const GRID: SurfaceQueryConfig = SurfaceQueryConfig { k: 5, coarse_levels: 3, ratio: 0.25, cell: 0.02, margin: 0.12 };

/// Signed distance: the blend of the k nearest vertices against the exact closest point.
fn distance(figure: &Figure) -> Result<Kernel> {
    let mut kernel = Kernel { name: "distance", cost: "ns a query", error: "mean error, mm", samples: Vec::new() };
    let exact = MeshDistance::new(&figure.shaped.vertices, &figure.body.faces)?;
    let queries = figure.queries();
    let at = |q: Vec3| exact.closest(q).signed_distance;
    let truth: Vec<f32> = queries.iter().map(|&q| at(q)).collect();
    let seconds = median(|| {
        queries.iter().for_each(|&q| {
            black_box(at(q));
        })
    });
    kernel.add("exact".to_owned(), seconds, queries.len(), 0.0, true);
    for k in [1, 2, 3, 5, 8, 16] {
        let config = SurfaceQueryConfig { k, coarse_levels: 0, ..GRID };
        let surface = SurfaceQuery::new(&figure.shaped.vertices, &figure.body.faces, &config)?;
        let mut out = vec![0; k];
        let mut blend = |q: Vec3| {
            surface.neighbours(q, &mut out);
            surface.blend(q, &out).signed_distance
        };
        let error = mean(queries.iter().zip(&truth).map(|(&q, t)| 1e3 * f64::from((blend(q) - t).abs())));
        let seconds = median(|| {
            queries.iter().for_each(|&q| {
                black_box(blend(q));
            })
        });
        kernel.add(format!("blend of {k}"), seconds, queries.len(), error, k == 5);
    }
    Ok(kernel)
}

/// Neighbours: the share that changes over 1 cm, the roughness of a function of them.
fn neighbours(figure: &Figure) -> Result<Kernel> {
    let mut kernel = Kernel {
        name: "neighbours",
        cost: "ns a query",
        error: "neighbours that change over 1 cm, %",
        samples: Vec::new(),
    };
    let queries = figure.queries();
    for (k, coarse_levels, grid) in [
        (5, 3, true),
        (5, 3, false),
        (5, 0, true),
        (1, 0, true),
        (1, 3, true),
        (3, 3, true),
        (8, 1, true),
        (16, 0, true),
    ] {
        let config = if grid { GRID } else { SurfaceQueryConfig::default() };
        let config = SurfaceQueryConfig { k, coarse_levels, ..config };
        let surface = SurfaceQuery::new(&figure.shaped.vertices, &figure.body.faces, &config)?;
        let (mut here, mut there) = (vec![0; surface.neighbours_per_query()], vec![0; surface.neighbours_per_query()]);
        let error = mean(queries.iter().map(|&q| {
            surface.neighbours(q, &mut here);
            surface.neighbours(q + Vec3::new(0.006, 0.008, 0.0), &mut there);
            // Level by level: a vertex of one may be in another too.
            let levels = here.chunks(k).zip(there.chunks(k));
            let changed = levels.map(|(a, b)| a.iter().filter(|v| !b.contains(v)).count()).sum::<usize>();
            100.0 * changed as f64 / here.len() as f64
        }));
        let seconds = median(|| queries.iter().for_each(|&q| surface.neighbours(q, black_box(&mut here))));
        let search = if grid { "" } else { ", trees" };
        let name = format!("k {k}, {} level{}{search}", coarse_levels + 1, if coarse_levels > 0 { "s" } else { "" });
        kernel.add(name, seconds, queries.len(), error, grid && (k, coarse_levels) == (5, 3));
    }
    Ok(kernel)
}

/// The way back to the rest pose, of points that were carried along with their own place on the
/// skin.
fn motion(figure: &Figure) -> Result<Kernel> {
    let mut kernel = Kernel {
        name: "motion",
        cost: "ns a point",
        error: "mean error of the rest position, mm",
        samples: Vec::new(),
    };
    let Figure { body, shaped, posed, near } = figure;
    let carried: Vec<(Vec3, Vec3)> = near
        .iter()
        .map(|(face, barycentric, rest)| {
            let corners = body.faces[*face as usize].map(|v| v as usize);
            let mut at = Vec3::ZERO;
            for (corner, share) in corners.into_iter().zip(barycentric) {
                for (joint, weight) in body.weights.row(corner) {
                    let offset = posed.pose_offsets[corner];
                    at += share * weight * posed.bones[joint].transform_point3(*rest + offset);
                }
            }
            (at, *rest)
        })
        .collect();
    let frame = MotionFrame::new(body, posed);
    let mesh = MeshDistance::new(&posed.vertices, &body.faces)?;
    let learnable = |weights| MotionField::Volume { weights, threshold: 1e-3 };
    let fields = [
        ("surface".to_owned(), MotionField::Surface(SurfaceMotion::default()), true),
        ("volume 32".to_owned(), learnable(WeightVolume::gaussian(body, shaped, 32)), false),
        ("volume 64".to_owned(), learnable(WeightVolume::gaussian(body, shaped, 64)), false),
    ];
    for (name, field, default) in fields {
        let map = |x: Vec3| {
            field.map(&frame, x, || {
                let closest = mesh.closest_within(x, 2.0 * REACH)?;
                let (barycentric, signed_distance) = (closest.barycentric, closest.signed_distance);
                Some(SurfacePoint { face: closest.face, barycentric, signed_distance })
            })
        };
        let off: Vec<f64> =
            carried.iter().filter_map(|(x, rest)| Some(1e3 * f64::from(map(*x)?.canonical.distance(*rest)))).collect();
        let seconds = median(|| {
            carried.iter().for_each(|(x, _)| {
                black_box(map(*x));
            })
        });
        let dead = 100 * (carried.len() - off.len()) / carried.len().max(1);
        let memory = match &field {
            MotionField::Volume { weights, .. } => {
                format!(", {:.1} MB of weights", 4e-6 * weights.weights.len() as f64)
            }
            _ => String::new(),
        };
        let name = format!("{name}{memory}{}", if dead > 0 { format!(" ({dead} % dead)") } else { String::new() });
        kernel.add(name, seconds, carried.len(), mean(off.into_iter()), default);
    }
    Ok(kernel)
}

/// Colours of rays through the posed body, a shell of density around it, by the number of samples.
fn samples(figure: &Figure, rays: usize) -> Result<Kernel> {
    const MOST: usize = 1024;
    let mut kernel =
        Kernel { name: "samples a ray", cost: "ns a ray", error: "mean error of a colour, %", samples: Vec::new() };
    let mesh = MeshDistance::new(&figure.posed.vertices, &figure.body.faces)?;
    let Aabb { min, max } = Aabb::from_points(&figure.posed.vertices);
    let bounds = Aabb { min: min - REACH, max: max + REACH };
    let mut random = RandomStream::new(&[2]);
    let eye = Affine3A::from_rotation_y(0.4).transform_point3(Vec3::new(0.0, 0.2, 3.0));
    let ray = |target: Vec3| Ray { origin: eye, direction: (target - eye).normalize_or_zero() };
    let mut target = || {
        let vertex = (random.uniform() * figure.posed.vertices.len() as f32) as usize;
        figure.posed.vertices[vertex] + 0.01 * Vec3::new(random.uniform(), random.uniform(), random.uniform())
    };
    let rays: Vec<Ray> = (0..rays).map(|_| ray(target())).collect();
    let [mut t, mut delta, mut sigma, mut weights] = [(); 4].map(|()| vec![0.0; MOST]);
    let mut rgb = vec![Vec3::ZERO; MOST];
    let mut color = |ray: &Ray, n: usize| -> Vec3 {
        let Some((near, far)) = bounds.intersect(ray) else { return Vec3::ZERO };
        let bins = Bins::new(near, far, n);
        for i in 0..n {
            (t[i], delta[i]) = (bins.at(i, 0.5), bins.width());
            let at = ray.at(t[i]);
            let closest = mesh.closest_within(at, 0.04);
            let depth = closest.as_ref().map_or(1.0, |c| c.signed_distance);
            // About what a field learns: solid inside, gone 2 cm outside.
            sigma[i] = if closest.is_some() { 150.0 * (0.5 - 25.0 * depth).clamp(0.0, 1.0) } else { 0.0 };
            rgb[i] = closest.map_or(Vec3::ZERO, |c| (40.0 * c.point).map(|x| 0.5 + 0.5 * x.sin()));
        }
        let likelihood = &vec![1.0; n];
        let samples = RaySamples { sigma: &sigma[..n], likelihood, delta: &delta[..n], t: &t[..n], rgb: &rgb[..n] };
        composite(samples, Vec3::ZERO, &mut weights[..n]).color
    };
    let truth: Vec<Vec3> = rays.iter().map(|r| color(r, MOST)).collect();
    let ours = [Preset::Balanced, Preset::Paper].map(|preset| Config::preset(preset, Method::Occnerf).samples);
    for n in [8, 16, 24, 32, 48, 64, 96, 128, 256] {
        let off = |(r, truth): (&Ray, &Vec3)| {
            let difference = (color(r, n) - *truth).abs();
            100.0 * f64::from(difference.element_sum() / 3.0)
        };
        let error = mean(rays.iter().zip(&truth).map(off));
        let seconds = median(|| {
            rays.iter().for_each(|r| {
                black_box(color(r, n));
            })
        });
        kernel.add(n.to_string(), seconds, rays.len(), error, ours.contains(&n));
    }
    Ok(kernel)
}

/// What is wrong with a fine pattern on the skin that was fitted at every other point, at the
/// points between, by the size of the table.
fn table(figure: &Figure, steps: usize) -> Result<Kernel> {
    let mut kernel = Kernel {
        name: "hash table",
        cost: "ns a point, encoding",
        error: "RMS error of a fitted pattern, %",
        samples: Vec::new(),
    };
    let Aabb { min: low, max: high } = Aabb::from_points(&figure.shaped.vertices);
    let place = |at: &Vec3| {
        let [x, y, z] = ((*at - low) / (high - low)).clamp(Vec3::ZERO, Vec3::ONE).to_array();
        [x, y, z, 0.4]
    };
    // Waves of 30 cm, 10 cm and 4 cm.
    let pattern =
        |at: &Vec3| [21.0, 63.0, 157.0].map(|f| (f * *at).map(f32::sin).element_product()).iter().sum::<f32>();
    let near: Vec<(Vec3, [f32; 4], f32)> = figure.near.iter().map(|n| (n.2, place(&n.2), pattern(&n.2))).collect();
    let (fitted, held): (Vec<usize>, Vec<usize>) = (0..near.len()).partition(|i| i % 2 == 0);
    let points = |of: &[usize]| of.iter().map(|&i| near[i].1).collect::<Vec<_>>();
    let (fitted_at, held_at) = (points(&fitted), points(&held));
    for log2_table_size in [8, 10, 12, 13, 14, 15, 16, 18] {
        let config = HashGridConfig { levels: 10, features: 2, log2_table_size, n_min: 12, n_max: 384 };
        let grid = HashGrid::<4>::new(&config)?;
        let width = grid.num_features();
        let mut values = grid.init_table(1);
        let mut features = vec![0.0; fitted_at.len() * width];
        let mut d_features = features.clone();
        let (mut d_table, mut square) = (vec![0.0; values.len()], vec![0.0f32; values.len()]);
        for step in 0..steps {
            // The prediction is the sum of all features; its error goes back to each of them.
            grid.encode(&values, &fitted_at, &mut features);
            let predicted = sums(&features, fitted.len());
            for d_level in d_features.chunks_exact_mut(2 * fitted.len()) {
                for (j, (p, &i)) in predicted.iter().zip(&fitted).enumerate() {
                    d_level[2 * j..][..2].fill(p - near[i].2);
                }
            }
            d_table.fill(0.0);
            grid.encode_backward(&fitted_at, &d_features, &mut d_table);
            let rate = 0.02 * (1.0 - step as f32 / steps as f32);
            for ((value, d), s) in values.iter_mut().zip(&d_table).zip(&mut square) {
                *s = 0.9 * *s + 0.1 * d * d;
                *value -= rate * d / (s.sqrt() + 1e-8);
            }
        }
        let mut found = vec![0.0; held_at.len() * width];
        let seconds = median(|| grid.encode(&values, &held_at, black_box(&mut found)));
        let off = |(found, &i): (&f32, &usize)| f64::from(found - near[i].2).powi(2);
        let error = 100.0 * mean(sums(&found, held.len()).iter().zip(&held).map(off)).sqrt();
        kernel.add(format!("2^{log2_table_size}"), seconds, held_at.len(), error, log2_table_size == 16);
    }
    Ok(kernel)
}

/// The sum of all features of each point, two a level.
fn sums(features: &[f32], points: usize) -> Vec<f32> {
    let levels = || features.chunks_exact(2 * points);
    (0..points).map(|i| levels().map(|level| level[2 * i] + level[2 * i + 1]).sum()).collect()
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a failure here is a failed test")]
mod tests {
    use super::*;

    fn error(kernel: &Kernel, name: &str) -> f64 {
        kernel.samples.iter().find(|s| s.name.starts_with(name)).unwrap().error
    }

    #[test]
    fn better_approximations_have_smaller_errors() {
        let figure = Figure::new(600);
        let distance = distance(&figure).unwrap();
        assert!(error(&distance, "exact") == 0.0 && (0.1..5.0).contains(&error(&distance, "blend of 5")));
        let neighbours = neighbours(&figure).unwrap();
        assert!(error(&neighbours, "k 5, 4 levels") < error(&neighbours, "k 1, 1 level"));
        assert_eq!(error(&neighbours, "k 5, 4 levels, trees"), error(&neighbours, "k 5, 4 levels"));
        let motion = motion(&figure).unwrap();
        assert!(error(&motion, "surface") < error(&motion, "volume 32"));
        let samples = samples(&figure, 60).unwrap();
        assert!(error(&samples, "256") < 0.3 * error(&samples, "8"));
        let table = table(&figure, 20).unwrap();
        assert!(error(&table, "2^14") < error(&table, "2^8"));
        for kernel in [distance, neighbours, motion, samples, table] {
            assert!(kernel.samples.iter().all(|s| s.nanoseconds > 0.0 && s.error.is_finite()), "{}", kernel.name);
        }
    }
}
