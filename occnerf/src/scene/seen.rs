//! Colour observations of the prior's vertices, the width of a mask's contaminated edge, and
//! intrinsic decomposition of the colours: albedo a vertex, and shading by one light of all frames.

use std::borrow::Cow;

use glam::Vec3;
use nalgebra::{SMatrix, SVector};
use surface_query::vertex_normals;
use visibility::RayMesh;

use crate::Error;
use crate::capture::{Light, Pixels};
use crate::model::subdivide::Anchor;
use crate::model::view::{PosedView, pinhole};
use crate::scene::labels::{around, squared_distance};

/// Depth inside a mask of reliable pixels.
pub(crate) const MOST: usize = 4;
/// Least ratio of the squared colour residual of a contaminated edge pixel to the next one inside;
/// misregistration raises both.
const STRANGE: f64 = 1.5;

/// Vertices (V) offset along their normals by `clothes`.
pub(crate) fn dressed(vertices: &[Vec3], normals: &[Vec3], clothes: &[f32]) -> Vec<Vec3> {
    let each = vertices.iter().zip(normals).zip(clothes);
    each.map(|((v, n), c)| *v + *c * n.normalize_or_zero()).collect()
}

/// Colour observations of the points `anchors` of the prior, by ray casting against subject pixels,
/// each with its depth inside the mask in pixels, from 1. The points lie on the surface of
/// `clothes` (V), or on the body for empty `clothes`.
pub(crate) fn seen(
    view: &PosedView,
    pixels: &Pixels,
    faces: &[[u32; 3]],
    clothes: &[f32],
    anchors: &[Anchor],
) -> Result<Vec<(ColorObservation, usize)>, Error> {
    let camera = &view.camera;
    // Shading uses the normals of the body.
    let normals = vertex_normals(&view.posed.vertices, faces);
    let mut posed = Cow::Borrowed(&view.posed.vertices[..]);
    if !clothes.is_empty() {
        posed = dressed(&posed, &normals, clothes).into();
    }
    let mesh = RayMesh::new(&posed, faces)?;
    let usable: Vec<bool> = pixels.mask.iter().map(|&m| m > 0.5).collect();
    let points: Vec<Vec3> = anchors.iter().map(|anchor| anchor.mix(&posed)).collect();
    let visible = visibility::visible_vertices(&mesh, &points, &pinhole(camera), Some(&usable));
    let depth = depth_inside(&pixels.mask, camera.width as usize);
    let color = |v: usize| {
        let at = visible[v].then(|| camera.project(points[v])).flatten()?;
        let pixel = at.y as usize * camera.width as usize + at.x as usize;
        let coverage = *pixels.mask.get(pixel)?;
        // Masked pixels are premultiplied by coverage.
        let color = Vec3::from_slice(&pixels.image.pixels[3 * pixel..]) / coverage.max(0.5);
        Some(((v as u32, color, anchors[v].mix(&normals).normalize_or_zero()), (depth[pixel] as usize).max(1)))
    };
    Ok((0..points.len()).filter_map(color).collect())
}

/// Distance of each pixel of a mask from those outside, pixels; 0 outside.
pub(crate) fn depth_inside(mask: &[f32], width: usize) -> Vec<f32> {
    let inside: Vec<bool> = mask.iter().map(|&m| m > 0.5).collect();
    let squared = around(&inside, width, 1.0, |inside, width| {
        squared_distance(&inside.iter().map(|inside| !inside).collect::<Vec<_>>(), width)
    });
    squared.into_iter().map(f32::sqrt).collect()
}

/// Observations more than `edge` pixels inside their masks.
pub(crate) fn deeper(frames: &[Vec<(ColorObservation, usize)>], edge: usize) -> Vec<Vec<ColorObservation>> {
    let deep =
        |frame: &Vec<(ColorObservation, usize)>| frame.iter().filter(|seen| seen.1 > edge).map(|seen| seen.0).collect();
    frames.iter().map(deep).collect()
}

/// Width in pixels of the masks' edge whose colours disagree with the albedo of the inside, under
/// this light: the run of depths with a residual [`STRANGE`] times the next one's.
pub(crate) fn strange_edge(frames: &[Vec<(ColorObservation, usize)>], light: Light, vertices: usize) -> usize {
    let inside = deeper(frames, MOST);
    let sums = albedo(inside.iter().flatten(), vertices, light);
    let mut errors = [(0.0, 0u64); MOST + 2];
    for ((v, color, normal), depth) in frames.iter().flatten() {
        let (sum, squares) = sums[*v as usize];
        if squares > 0.0 {
            let error = &mut errors[(*depth).min(MOST + 1)];
            let squared = (sum / squares * light.on(*normal)).distance_squared(*color);
            *error = (error.0 + f64::from(squared), error.1 + 1);
        }
    }
    // The mean of an unobserved depth is NaN; comparisons with it are false.
    let means = errors.map(|(sum, count)| sum / count as f64);
    (1..MOST).take_while(|&depth| means[depth] > STRANGE * means[depth + 1]).last().unwrap_or(0)
}

/// A vertex as one frame shows it: index, colour, and unit normal in the world.
pub(crate) type ColorObservation = (u32, Vec3, Vec3);

/// Most observations of a light estimate.
const MOST_SEEN: usize = 1 << 20;
/// Rounds of alternating least squares.
const ROUNDS: usize = 6;
/// Regularisation towards even light.
const EVEN: f64 = 0.001;
/// Regularisation of the free third band, which would otherwise explain unobserved directions.
const BOUND: f64 = 0.03;
/// Steepest light.
const MOST_SLOPE: f32 = 0.8;
/// Least share of the squared error of held-out frames that a light must explain.
const WORTH: f64 = 0.02;

/// Σ s c and Σ s² over the observed colours c of each vertex with shading s, (V). Their quotient is
/// the least-squares albedo.
pub(crate) fn albedo<'a>(
    seen: impl Iterator<Item = &'a ColorObservation>,
    vertices: usize,
    light: Light,
) -> Vec<(Vec3, f32)> {
    let mut sums = vec![(Vec3::ZERO, 0.0f32); vertices];
    for (vertex, color, normal) in seen {
        let (sum, shade) = (&mut sums[*vertex as usize], light.on(*normal));
        *sum = (sum.0 + shade * *color, sum.1 + shade * shade);
    }
    sums
}

type Terms = SVector<f64, 9>;

/// The first three bands of spherical harmonics, scaled (Ramamoorthi and Hanrahan 2001); the second
/// includes the third-band term of a lamp in direction `lamp`.
fn harmonics(lamp: Vec3, n: Vec3) -> Terms {
    let [along_x, along_y, along_z] = Light::along(lamp, n).as_dvec3().to_array();
    let [x, y, z] = n.as_dvec3().to_array();
    Terms::from([1.0, along_x, along_y, along_z, x * y, y * z, z * x, x * x - y * y, z * z - 1.0 / 3.0])
}

/// Least-squares light for the albedo of these sums (see [`albedo`]), with a free third band;
/// `None` for a singular system.
fn slope<'a>(seen: impl Iterator<Item = &'a ColorObservation>, sums: &[(Vec3, f32)], lamp: Vec3) -> Option<Vec3> {
    let (mut matrix, mut vector, mut total) = (SMatrix::<f64, 9, 9>::zeros(), Terms::zeros(), 0.0);
    for (v, color, normal) in seen {
        let (sum, squares) = sums[*v as usize];
        let (albedo, basis) = (sum / squares, harmonics(lamp, *normal));
        let squared = f64::from(albedo.length_squared());
        matrix += squared * basis * basis.transpose();
        vector += f64::from(albedo.dot(*color)) * basis;
        total += squared;
    }
    for i in 0..9 {
        matrix[(i, i)] += total * if i < 4 { EVEN } else { BOUND };
    }
    vector[0] += EVEN * total;
    let terms = matrix.try_inverse()? * vector;
    // The constant band is part of the albedo.
    let terms = terms / terms[0];
    terms.iter().all(|t| t.is_finite()).then(|| Vec3::new(terms[1] as f32, terms[2] as f32, terms[3] as f32))
}

/// Least-squares light, alternating with the albedo. The free third band is fitted and dropped.
pub(crate) fn lamp<'a>(seen: impl Iterator<Item = &'a ColorObservation> + Clone, vertices: usize) -> Light {
    let mut found = Light::default();
    for _ in 0..ROUNDS {
        let sums = albedo(seen.clone(), vertices, found);
        let toward = found.slope.normalize_or_zero();
        let Some(slope) = slope(seen.clone(), &sums, toward) else { return Light::default() };
        found = Light { slope: slope.clamp_length_max(MOST_SLOPE) };
    }
    found
}

/// Light of the observations of each frame. Even light unless the estimate from every other frame
/// explains [`WORTH`] of the squared error in the rest.
pub(crate) fn measure_light(frames: &[Vec<ColorObservation>], vertices: usize) -> Light {
    let most = MOST_SEEN.div_ceil(vertices.max(1)).max(4);
    let chosen: Vec<&Vec<ColorObservation>> = frames.iter().step_by(frames.len().div_ceil(most).max(1)).collect();
    let half = |first: usize| chosen.iter().skip(first).step_by(2).flat_map(|frame| frame.iter());
    let error = |light: Light| -> f64 {
        let sums = albedo(half(0), vertices, light);
        let known = half(1).filter(|seen| sums[seen.0 as usize].1 > 0.0);
        let error = |(v, color, normal): &ColorObservation| {
            let (sum, squares) = sums[*v as usize];
            f64::from((sum / squares * light.on(*normal)).distance_squared(*color))
        };
        known.map(error).sum()
    };
    if error(lamp(half(0), vertices)) > (1.0 - WORTH) * error(Light::default()) {
        return Light::default();
    }
    lamp(chosen.iter().flat_map(|frame| frame.iter()), vertices)
}

#[cfg(test)]
mod tests {
    use std::sync::OnceLock;

    use synth::{DemoConfig, Perturbation, demo};
    use volrender::RandomStream;

    use super::*;
    use crate::capture::Capture;
    use crate::config::{Config, Method, Preset};
    use crate::model::colors::PriorColors;
    use crate::scene::labels::Label;
    use crate::scene::prepared::Scene;

    fn scene(wrong: Perturbation) -> Scene {
        let body = smpl::BodyModel::embedded();
        let config = DemoConfig { size: 160, frames: 24, eval_cameras: 0, ..DemoConfig::default() };
        let mut capture: Capture = demo(&config, &body).unwrap();
        wrong.apply(&mut capture, &body).unwrap();
        Scene::new(&capture, &body, &Config::preset(Preset::Fast, Method::Prior)).unwrap()
    }

    #[test]
    fn ragged_masks_have_an_edge_that_is_unknown_and_exact_ones_have_none() {
        let (exact, ragged) =
            (scene(Perturbation::NONE), scene(Perturbation { ragged_pixels: 2.0, ..Perturbation::NONE }));
        assert_eq!(exact.edge, 0);
        assert!((1..=2).contains(&ragged.edge), "{}", ragged.edge);
        for frame in &ragged.train {
            let (mask, width) = (&frame.pixels().unwrap().mask, frame.view.camera.width as usize);
            for (i, label) in frame.labels.iter().enumerate().filter(|(i, _)| i % width > 0) {
                let differs = (mask[i] > 0.5) != (mask[i - 1] > 0.5);
                assert!(!differs || label == Label::Unknown, "pixel {i}: {label:?}");
            }
        }
        // Vertices whose colours both know agree better than if edges counted.
        let truth = PriorColors::measure(&exact).unwrap();
        let error = |scene: &Scene| -> f32 {
            let found = PriorColors::measure(scene).unwrap();
            let known = |v: &usize| truth.seen[*v] && found.seen[*v];
            let each = (0..truth.seen.len()).filter(known);
            let errors: Vec<f32> = each.map(|v| truth.colors[v].distance_squared(found.colors[v])).collect();
            errors.iter().sum::<f32>() / errors.len() as f32
        };
        let (without, with) = (error(&ragged), error(&Scene { edge: 0, lighting: OnceLock::new(), ..ragged }));
        assert!(without < 0.7 * with, "{without} without edges, {with} with them");
    }

    #[test]
    fn an_edge_is_strange_as_far_as_its_colours_are_wrong() {
        let seen = |v: u32, depth: usize, strange: usize| {
            // Wrong by as much at every depth, this way or that.
            let side = ((v + 7 * depth as u32).wrapping_mul(2_654_435_761) >> 16 & 1) as f32;
            let wrong = if depth <= strange { 0.1 * 1.5f32.powi((strange + 1 - depth) as i32) } else { 0.0 };
            let shown = 0.6 + 0.04 * side - wrong;
            ((v, Vec3::splat(shown), Vec3::Y), depth)
        };
        for strange in 0..MOST {
            let frame = |f: u32| (0..200).map(|v| seen(v, 1 + ((v + f) % 9) as usize, strange)).collect();
            let frames: Vec<Vec<(ColorObservation, usize)>> = (0..9).map(frame).collect();
            assert_eq!(strange_edge(&frames, Light::default(), 200), strange);
        }
        assert_eq!(strange_edge(&[], Light::default(), 0), 0);
        assert_eq!(strange_edge(&[vec![seen(0, 1, 1)]], Light::default(), 1), 0);
    }

    /// Colours of vertices that turn before a camera for some frames.
    fn turning(light: Light, noise: f32) -> Vec<Vec<ColorObservation>> {
        let mut stream = RandomStream::new(&[7]);
        let mut random = || Vec3::new(stream.normal(), stream.normal(), stream.normal());
        let vertices: Vec<(Vec3, Vec3)> =
            (0..400).map(|_| (Vec3::splat(0.5) + 0.1 * random(), random().normalize_or(Vec3::Z))).collect();
        let frame = |f: usize| {
            // About the upright alone, a light from above would be a colour.
            let turn = glam::Quat::from_rotation_y(f as f32 * 0.3) * glam::Quat::from_rotation_x(f as f32 * 0.2);
            let mut seen = Vec::new();
            for (v, (albedo, normal)) in vertices.iter().enumerate() {
                let normal = turn * *normal;
                let color = *albedo * light.on(normal) + noise * random();
                if normal.z > 0.0 {
                    seen.push((v as u32, color, normal));
                }
            }
            seen
        };
        (0..20).map(frame).collect()
    }

    #[test]
    fn a_light_is_found_again_and_none_where_there_is_none() {
        let light = Light { slope: Vec3::new(-0.2, 0.15, 0.1) };
        let found = measure_light(&turning(light, 0.01), 400);
        assert!(found.slope.distance(light.slope) < 0.04, "{found:?}");
        assert_eq!(measure_light(&turning(Light::default(), 0.05), 400), Light::default());
        assert_eq!(measure_light(&[], 400), Light::default());
        assert_eq!(measure_light(&[vec![(0, Vec3::ZERO, Vec3::Z)]], 1), Light::default());
    }
}
