//! What a frame shows of the posed prior: how far outside its outline the subject's mask ends, and
//! the colours of its vertices.

use std::collections::HashMap;

use glam::{Mat3, Vec2, Vec3};
use surface_query::vertex_normals;
use visibility::{Fragment, RasterOptions, Rasterizer};

use crate::Error;
use crate::config::OccludedRule;
use crate::model::view::pinhole;
use crate::scene::labels::{Label, Labels, label_pixels};
use crate::scene::light::Seen;
use crate::scene::registration::picture::{Look, Picture};

/// Pixels from one look at the mask to the next.
const STEP: f32 = 0.5;
/// Pixels beyond an outline that show whether nothing of the body lies behind it there, and before
/// it, whether the body does.
const BEYOND: f32 = 2.0;
const BEFORE: f32 = 1.5;
/// Least cosine between a vertex's normal and the way to the camera at which its colour counts, and
/// least coverage of the pixels that it is taken from.
const FACING: f32 = 0.4;
const COVERED: f32 = 0.7;
/// How far behind what a pixel sees a vertex may be, metres.
const BEHIND: f32 = 0.02;

/// A vertex on the outline of the posed prior.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Edge {
    pub vertex: u32,
    /// Pixels from the prior's outline to the mask's, outward.
    pub distance: f32,
    /// Derivative of the outline's place along its normal in the image, pixels, by the vertex's
    /// place in the world.
    pub slope: Vec3,
    /// Pixels of a unit of length at the vertex.
    pub scale: f32,
}

/// How the colour that a frame shows of a vertex changes with the vertex's place in the world, a row
/// a channel.
pub(super) type Slope = [Vec3; 3];

/// What a frame shows.
#[derive(Debug, Default)]
pub(super) struct Sight {
    pub edges: Vec<Edge>,
    /// Colours of vertices that face the camera.
    pub seen: Vec<Seen>,
    /// Of `seen`.
    pub slopes: Vec<Slope>,
    /// Pixels that the prior covers.
    pub area: usize,
}

/// An edge of a mesh and the faces on its two sides.
pub(super) type Ridge = ([u32; 2], [u32; 2]);

/// The edges of a mesh that two faces share.
pub(super) fn ridges(faces: &[[u32; 3]]) -> Vec<Ridge> {
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

/// How frames are looked at.
#[derive(Clone, Copy, Debug)]
pub(super) struct Looking {
    /// How far from the prior's outline the mask's is searched, pixels.
    pub reach: f32,
    /// Standard deviation by which colours are blurred, pixels; no colours at 0.
    pub blur: f32,
    /// Length of a metre of a body 1.7 high.
    pub unit: f32,
}

/// Finds where the mask ends along the normals of the outline of `vertices`, and the colours of
/// those that face the camera. What an occluder ends is no outline: beyond the mask there has to be
/// background.
pub(super) fn look(
    picture: &Picture,
    vertices: &[Vec3],
    (faces, ridges): (&[[u32; 3]], &[Ridge]),
    looking: Looking,
) -> Result<Sight, Error> {
    let Looking { reach, blur, unit } = looking;
    let camera = &picture.camera;
    let options = RasterOptions { near: 1e-3 * unit, ..RasterOptions::default() };
    let seen: Vec<Option<Fragment>> = Rasterizer::default().faces(vertices, faces, &pinhole(camera), &options)?;
    let silhouette: Vec<bool> = seen.iter().map(Option::is_some).collect();
    let normals = vertex_normals(vertices, faces);
    let (eye, to_camera) = (camera.centre_of_projection(), camera.world_to_camera);
    let centre = vertices.iter().sum::<Vec3>() / vertices.len().max(1) as f32;
    let depth = to_camera.transform_point3(centre).z.max(1e-3 * unit);
    let labels = Labels::new(&label_pixels(
        OccludedRule::Unknown,
        &picture.coverage(),
        &silhouette,
        picture.occluder.as_deref(),
        camera.width as usize,
        unit * camera.focal.x / depth,
    ));
    let is_background = |p: Vec2| picture.pixel(p).is_some_and(|i| labels.at(i as u32) == Label::Background);
    let is_covered = |p: Vec2| picture.pixel(p).is_some_and(|i| silhouette[i]);
    let end_of_mask = |from: Vec2, along: Vec2| -> Option<f32> {
        let count = (reach / STEP) as i32;
        let value = |i: i32| picture.between(from + along * (i as f32 * STEP));
        let ends = (-count..count).filter_map(|i| {
            let (inside, outside) = (value(i)?, value(i + 1)?);
            let ends = inside >= 0.5 && outside < 0.5;
            ends.then(|| STEP * (i as f32 + (inside - 0.5) / (inside - outside)))
        });
        let nearest = ends.min_by(|a, b| a.abs().total_cmp(&b.abs()))?;
        let clear = [1.0, 2.0].iter().all(|beyond| is_background(from + along * (nearest + beyond)));
        clear.then_some(nearest)
    };
    // Derivatives of the image's axes by the place of a vertex in the world.
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
    for (ends, sides) in ridges.iter().filter(|(_, sides)| faces_camera(sides[0]) != faces_camera(sides[1])) {
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
            if along == Vec2::ZERO || is_covered(p + BEYOND * along) || !is_covered(p - BEFORE * along) {
                continue;
            }
            if let Some(distance) = end_of_mask(p, along) {
                let slope = along.x * dx + along.y * dy;
                edges.push(Edge { vertex, distance, slope, scale: camera.focal.x / at.z });
            }
        }
    }
    let mut sight = Sight { edges, area: silhouette.iter().filter(|s| **s).count(), ..Sight::default() };
    let blurred = (blur > 0.0).then(|| picture.blurred(blur));
    for (vertex, (&place, normal)) in vertices.iter().zip(&normals).enumerate() {
        let normal = normal.normalize_or_zero();
        if normal.dot((eye - place).normalize_or_zero()) < FACING {
            continue;
        }
        let Some(p) = camera.project(place).map(|p| p.truncate()) else { continue };
        let at = to_camera.transform_point3(place);
        let is_first = picture.pixel(p).and_then(|i| seen[i]).is_some_and(|f| at.z <= f.depth + BEHIND * unit);
        let look = blurred.as_ref().filter(|_| is_first).and_then(|blurred| blurred.look(p, COVERED));
        if let Some(Look { color, dx, dy }) = look {
            let (across, down) = axes(at);
            sight.seen.push((vertex as u32, color, normal));
            sight.slopes.push([0, 1, 2].map(|c| dx[c] * across + dy[c] * down));
        }
    }
    Ok(sight)
}
