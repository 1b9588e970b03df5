//! Colour observations of the prior's vertices, and the width of a mask's contaminated edge.

use std::borrow::Cow;

use glam::Vec3;
use surface_query::vertex_normals;
use visibility::RayMesh;

use crate::Error;
use crate::capture::{Light, Pixels};
use crate::model::subdivide::Anchor;
use crate::model::view::{PosedView, pinhole};
use crate::scene::labels::{around, squared_distance};
use crate::scene::light::{ColorObservation, albedo};

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
/// each with its depth inside the mask in pixels, from 1. The points lie on the surface of `clothes`
/// (V), or on the body for empty `clothes`.
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

#[cfg(test)]
mod tests {
    use std::sync::OnceLock;

    use super::*;
    use crate::capture::Capture;
    use crate::config::{Config, Method, Preset};
    use crate::model::colors::PriorColors;
    use crate::scene::labels::Label;
    use crate::scene::prepared::Scene;
    use synth::{DemoConfig, Perturbation, demo};

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
}
