//! Observations of the posed prior in one frame: distances from its outline to where the mask has the
//! same coverage, and the colours of its vertices.

use std::collections::HashMap;
use std::ops::RangeInclusive;

use glam::{Mat3, Vec2, Vec3};
use visibility::{Fragment, Pixel, RasterOptions, Rasterizer, Samples, View};
use volrender::Camera;

use crate::Error;
use crate::config::OccludedRule;
use crate::model::subdivide::normals;
use crate::model::view::pinhole;
use crate::scene::labels::{Label, Labels, label_pixels};
use crate::scene::light::ColorObservation;
use crate::scene::registration::crop::{ColorSample, Crop, interpolated};

/// Step of the search for the mask's edge, pixels.
const STEP: f32 = 0.5;
/// An outline point needs background this far outside and body this far inside, pixels.
const OUTSIDE: f32 = 2.0;
const INSIDE: f32 = 1.5;
/// Coverage of the rendered outline at a point whose distance is measured: 0.5 on straight edges, less on
/// thin limbs, more in concave corners.
const LEVELS: RangeInclusive<f32> = 0.15..=0.85;
/// Rows and columns of a pixel whose coverage is rendered, of four samples each.
const FINE: usize = 2;
/// Least cosine between normal and view direction, and least coverage, of an observed colour.
const FACING: f32 = 0.4;
const COVERED: f32 = 0.7;
/// Depth tolerance of a visible vertex, metres.
const BEHIND: f32 = 0.02;

/// A vertex on the outline of the posed prior.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Edge {
    pub vertex: u32,
    /// Distance from the prior's outline to the mask's, pixels, outward.
    pub distance: f32,
    /// Derivative of the outline point along its image normal, pixels, by the vertex position.
    pub gradient: Vec3,
    /// Pixels per unit of length at the vertex.
    pub scale: f32,
}

/// Observations of one frame.
#[derive(Debug, Default)]
pub(crate) struct Observations {
    pub edges: Vec<Edge>,
    /// Colours of vertices that face the camera.
    pub colors: Vec<ColorObservation>,
    /// Jacobian of each of `colors` by the vertex position, a row a channel.
    pub jacobians: Vec<[Vec3; 3]>,
    /// Pixels that the prior covers.
    pub area: usize,
}

/// An edge of a mesh and the faces on its two sides.
pub(crate) type SharedEdge = ([u32; 2], [u32; 2]);

/// Edges of a mesh with two faces.
pub(crate) fn shared_edges(faces: &[[u32; 3]]) -> Vec<SharedEdge> {
    let mut open: HashMap<[u32; 2], u32> = HashMap::new();
    let mut out = Vec::new();
    for (f, corners) in faces.iter().enumerate() {
        for i in 0..3 {
            let (a, b) = (corners[i], corners[(i + 1) % 3]);
            match open.remove(&[b, a]) {
                Some(other) => out.push(([a, b], [f as u32, other])),
                None => {
                    open.insert([a, b], f as u32);
                }
            }
        }
    }
    out
}

/// Parameters of [`observe`].
#[derive(Clone, Copy, Debug)]
pub(crate) struct ObservationOptions {
    /// Search distance of the mask's edge from the prior's outline, pixels.
    pub reach: f32,
    /// Standard deviation of the blur of colours, pixels; no colours at 0.
    pub blur: f32,
    /// Length of a metre of a body 1.7 high.
    pub unit: f32,
}

/// Searches the mask's edge along the normals of the outline of `vertices`, and samples the colours
/// of vertices that face the camera. The edge is where the mask falls below the coverage that the
/// rendered outline has at its own point: a pixel's footprint shifts both alike on thin limbs and in
/// corners. It counts if background lies beyond it, which excludes edges at an occluder.
pub(crate) fn observe(
    crop: &Crop,
    vertices: &[Vec3],
    (faces, shared_edges): (&[[u32; 3]], &[SharedEdge]),
    options: ObservationOptions,
) -> Result<Observations, Error> {
    let ObservationOptions { reach, blur, unit } = options;
    let camera = &crop.camera;
    let options = RasterOptions { near: 1e-3 * unit, ..RasterOptions::default() };
    let nearest: Vec<Option<Fragment>> = Rasterizer::default().faces(vertices, faces, &pinhole(camera), &options)?;
    let silhouette: Vec<bool> = nearest.iter().map(Option::is_some).collect();
    let rendered = coverage(vertices, faces, camera, &options)?;
    let normals = normals(vertices, faces);
    let (eye, to_camera) = (camera.centre_of_projection(), camera.world_to_camera);
    let centre = vertices.iter().sum::<Vec3>() / vertices.len().max(1) as f32;
    let depth = to_camera.transform_point3(centre).z.max(1e-3 * unit);
    let labels = Labels::new(&label_pixels(
        OccludedRule::Unknown,
        &crop.coverage(),
        &silhouette,
        crop.occluder.as_deref(),
        camera.width as usize,
        unit * camera.focal.x / depth,
    ));
    let is_background = |p: Vec2| crop.pixel(p).is_some_and(|i| labels.at(i as u32) == Label::Background);
    let is_covered = |p: Vec2| crop.pixel(p).is_some_and(|i| silhouette[i]);
    let end_of_mask = |from: Vec2, along: Vec2| -> Option<f32> {
        let level = interpolated(|i| rendered[i], from, camera).filter(|level| LEVELS.contains(level))?;
        let count = (reach / STEP) as i32;
        let value = |i: i32| crop.coverage_at(from + along * (i as f32 * STEP));
        let ends = (-count..count).filter_map(|i| {
            let (inside, outside) = (value(i)?, value(i + 1)?);
            let ends = inside >= level && outside < level;
            ends.then(|| STEP * (i as f32 + (inside - level) / (inside - outside)))
        });
        let nearest = ends.min_by(|a, b| a.abs().total_cmp(&b.abs()))?;
        let clear = [1.0, 2.0].iter().all(|beyond| is_background(from + along * (nearest + beyond)));
        clear.then_some(nearest)
    };
    // Gradients of the image coordinates by a point in the world.
    let rows = Mat3::from(to_camera.matrix3).transpose();
    let axes = |at: Vec3| {
        let dx = camera.focal.x / at.z * (rows.x_axis - at.x / at.z * rows.z_axis);
        (dx, camera.focal.y / at.z * (rows.y_axis - at.y / at.z * rows.z_axis))
    };
    let faces_camera = |f: u32| {
        let [a, b, c] = faces[f as usize].map(|v| vertices[v as usize]);
        (b - a).cross(c - a).dot(eye - a) > 0.0
    };
    let mut edges = Vec::new();
    let mut done = vec![false; vertices.len()];
    for (ends, sides) in shared_edges.iter().filter(|(_, sides)| faces_camera(sides[0]) != faces_camera(sides[1])) {
        debug_assert_ne!(sides[0], sides[1]);
        for &vertex in ends {
            if std::mem::replace(&mut done[vertex as usize], true) {
                continue;
            }
            let place = vertices[vertex as usize];
            let Some(p) = camera.project(place).map(|p| p.truncate()) else { continue };
            let at = to_camera.transform_point3(place);
            let (dx, dy) = axes(at);
            let normal = normals[vertex as usize];
            let along = Vec2::new(dx.dot(normal), dy.dot(normal)).normalize_or_zero();
            if along == Vec2::ZERO || is_covered(p + OUTSIDE * along) || !is_covered(p - INSIDE * along) {
                continue;
            }
            if let Some(distance) = end_of_mask(p, along) {
                let gradient = along.x * dx + along.y * dy;
                edges.push(Edge { vertex, distance, gradient, scale: camera.focal.x / at.z });
            }
        }
    }
    let area = silhouette.iter().filter(|s| **s).count();
    let mut observed = Observations { edges, area, ..Observations::default() };
    let blurred = (blur > 0.0).then(|| crop.blurred(blur));
    for (vertex, (&place, normal)) in vertices.iter().zip(&normals).enumerate() {
        let normal = normal.normalize_or_zero();
        if normal.dot((eye - place).normalize_or_zero()) < FACING {
            continue;
        }
        let Some(p) = camera.project(place).map(|p| p.truncate()) else { continue };
        let at = to_camera.transform_point3(place);
        let is_visible = crop.pixel(p).and_then(|i| nearest[i]).is_some_and(|f| at.z <= f.depth + BEHIND * unit);
        let sample = blurred.as_ref().filter(|_| is_visible).and_then(|blurred| blurred.sample(p, COVERED));
        if let Some(ColorSample { color, dx, dy }) = sample {
            let (across, down) = axes(at);
            observed.colors.push((vertex as u32, color, normal));
            observed.jacobians.push([0, 1, 2].map(|c| dx[c] * across + dy[c] * down));
        }
    }
    Ok(observed)
}

/// Share of each pixel that a mesh covers, (H, W).
fn coverage(
    vertices: &[Vec3],
    faces: &[[u32; 3]],
    camera: &Camera,
    options: &RasterOptions,
) -> Result<Vec<f32>, Error> {
    let (width, height) = (camera.width as usize, camera.height as usize);
    let View { focal, centre, .. } = pinhole(camera);
    let fine = FINE as f32;
    let (across, down) = (FINE as u32 * camera.width, FINE as u32 * camera.height);
    let view = View { focal: fine * focal, centre: fine * centre, width: across, height: down, ..pinhole(camera) };
    let options = RasterOptions { samples: Samples::Four, ..*options };
    let mut covered = vec![0u8; FINE * width * FINE * height];
    let count = |pixel: Pixel<'_>| pixel.samples.iter().flatten().count() as u8;
    Rasterizer::default().draw(vertices, faces, &view, &options, &mut covered, count)?;
    let mut shares = vec![0.0; width * height];
    for (i, &samples) in covered.iter().enumerate() {
        let (x, y) = (i % (FINE * width), i / (FINE * width));
        shares[y / FINE * width + x / FINE] += f32::from(samples) / (4 * FINE * FINE) as f32;
    }
    Ok(shares)
}
