//! What is measured: each kernel in its variants, against its exact form or a truth that was made
//! first.

use std::hint::black_box;

use anyhow::Result;
use glam::{Affine3A, Vec3};
use hashgrid::{HashGrid, HashGridConfig};
use occnerf::{Config, Method, Preset};
use smpl::{MotionField, MotionFrame, SurfaceMotion, SurfacePoint, WeightVolume};
use surface_query::{MeshDistance, SurfaceQuery, SurfaceQueryConfig};
use volrender::{Aabb, Bins, Ray, RaySamples, composite};

use super::figure::{Figure, Kernel, REACH, Random, mean, median};

/// The paper's neighbourhoods, with a grid for a body in metres.
const GRID: SurfaceQueryConfig = SurfaceQueryConfig { k: 5, coarse_levels: 3, ratio: 0.25, cell: 0.02, margin: 0.12 };

/// Signed distance: the blend of the k nearest vertices against the exact closest point.
pub fn distance(figure: &Figure) -> Result<Kernel> {
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

/// The neighbours: how many change over 1 cm, which is how rough a function of them is.
pub fn neighbours(figure: &Figure) -> Result<Kernel> {
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
pub fn motion(figure: &Figure) -> Result<Kernel> {
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
pub fn samples(figure: &Figure, rays: usize) -> Result<Kernel> {
    const MOST: usize = 1024;
    let mut kernel =
        Kernel { name: "samples a ray", cost: "ns a ray", error: "mean error of a colour, %", samples: Vec::new() };
    let mesh = MeshDistance::new(&figure.posed.vertices, &figure.body.faces)?;
    let (low, high) = (figure.posed.vertices.iter())
        .fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(low, high), &v| (low.min(v), high.max(v)));
    let bounds = Aabb { min: low - REACH, max: high + REACH };
    let mut random = Random(2);
    let eye = Affine3A::from_rotation_y(0.4).transform_point3(Vec3::new(0.0, 0.2, 3.0));
    let ray = |target: Vec3| Ray { origin: eye, direction: (target - eye).normalize_or_zero() };
    let mut target = || {
        let vertex = (random.next() * figure.posed.vertices.len() as f32) as usize;
        figure.posed.vertices[vertex] + 0.01 * Vec3::new(random.next(), random.next(), random.next())
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
pub fn table(figure: &Figure, steps: usize) -> Result<Kernel> {
    let mut kernel = Kernel {
        name: "hash table",
        cost: "ns a point, encoding",
        error: "RMS error of a fitted pattern, %",
        samples: Vec::new(),
    };
    let (low, high) = (figure.shaped.vertices.iter())
        .fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(low, high), &v| (low.min(v), high.max(v)));
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
