//! Training frames, cropped to the subject and downsampled, and observations of the posed prior in
//! one: distances from its outline to where the mask has the same coverage, and the colours of its
//! vertices.

use std::collections::HashMap;
use std::ops::RangeInclusive;

use glam::{Mat3, Vec2, Vec3};
use visibility::{Fragment, Pixel, RasterOptions, Rasterizer, Samples, View};
use volrender::Camera;

use crate::Error;
use crate::capture::Pixels;
use crate::config::OccludedRule;
use crate::model::subdivide::normals;
use crate::model::view::pinhole;
use crate::scene::labels::{Label, Labels, label_pixels};
use crate::scene::seen::ColorObservation;

/// Step of the search for the mask's edge, pixels.
const STEP: f32 = 0.5;
/// An outline point needs background this far outside and body this far inside, pixels.
const OUTSIDE: f32 = 2.0;
const INSIDE: f32 = 1.5;
/// Coverage of the rendered outline at a point whose distance is measured: 0.5 on straight edges,
/// less on thin limbs, more in concave corners.
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
/// rendered outline has at its own point: a pixel's footprint shifts both alike on thin limbs and
/// in corners. It counts if background lies beyond it, which excludes edges at an occluder.
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

/// Height of the subject in a crop, pixels: a tenth of one is below the accuracy of a body's
/// surface.
const HEIGHT: f32 = 240.0;
/// Margin around the posed prior, in multiples of the subject's height.
const BORDER: f32 = 0.15;
/// Largest side of a crop.
const LARGEST: u32 = 1024;

/// The subject in a frame, and the known occluder.
pub(crate) struct Crop {
    pub camera: Camera,
    /// Premultiplied colour and coverage of pixels over one half, 0 to 255, (H, W).
    pixels: Vec<[u8; 4]>,
    /// Coverage of all pixels, 0 to 255, (H, W): antialiased edges.
    coverage: Vec<u8>,
    pub occluder: Option<Vec<bool>>,
}

/// A blurred crop: premultiplied colour and coverage, (H, W).
pub(crate) struct Blurred {
    width: usize,
    pixels: Vec<[f32; 4]>,
}

/// A colour and its image derivatives.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ColorSample {
    pub color: Vec3,
    pub dx: Vec3,
    pub dy: Vec3,
}

impl Crop {
    /// Crops the picture of `given` to a body's `vertices`; `None` where they are outside it.
    pub fn new(given: &Camera, shown: &Pixels, vertices: &[Vec3]) -> Option<Self> {
        let (mut low, mut high) = (Vec2::INFINITY, Vec2::NEG_INFINITY);
        for p in vertices.iter().filter_map(|&v| given.project(v)) {
            (low, high) = (low.min(p.truncate()), high.max(p.truncate()));
        }
        let size = Vec2::new(given.width as f32, given.height as f32);
        let border = BORDER * (high.y - low.y);
        let factor = ((high.y - low.y).min(size.y) / HEIGHT).round().max(1.0) as u32;
        let (low, high) = ((low - border).clamp(Vec2::ZERO, size), (high + border).clamp(Vec2::ZERO, size));
        // False for NaN.
        if !(low.x < high.x && low.y < high.y) {
            return None;
        }
        let (x0, y0) = (low.x as u32, low.y as u32);
        let reduced = |low: u32, high: f32| (high.ceil() as u32 - low).div_ceil(factor).clamp(1, LARGEST);
        let (width, height) = (reduced(x0, high.x), reduced(y0, high.y));
        let across = given.width;
        // Pixels of the frame under one pixel of the crop.
        let block = |i: u32| {
            let (left, top) = (x0 + i % width * factor, y0 + i / width * factor);
            let rows = top..(top + factor).min(given.height);
            rows.flat_map(move |y| (left..(left + factor).min(across)).map(move |x| (y * across + x) as usize))
        };
        let share = 255.0 / (factor * factor) as f32;
        let mean = |i: u32| {
            let mut sum = [0.0f32; 4];
            // Pixels outside the mask may show an occluder.
            for p in block(i).filter(|&p| shown.mask[p] > 0.5) {
                sum[3] += shown.mask[p];
                (0..3).for_each(|c| sum[c] += shown.image.pixels[3 * p + c]);
            }
            sum.map(|sum| (share * sum).round() as u8)
        };
        let coverage = |i: u32| (share * block(i).map(|p| shown.mask[p]).sum::<f32>()).round() as u8;
        let covered = |known: &Vec<bool>| (0..width * height).map(|i| block(i).any(|p| known[p])).collect();
        let mut camera = Camera { width, height, ..*given };
        camera.focal /= factor as f32;
        camera.centre = (camera.centre - Vec2::new(x0 as f32, y0 as f32)) / factor as f32;
        let (pixels, coverage) = (0..width * height).map(|i| (mean(i), coverage(i))).unzip();
        Some(Self { camera, pixels, coverage, occluder: shown.occluder.as_ref().map(covered) })
    }

    /// Coverage of every pixel, 0 to 1.
    pub fn coverage(&self) -> Vec<f32> {
        self.coverage.iter().map(|&c| f32::from(c) / 255.0).collect()
    }

    /// Index of the pixel at an image point; `None` outside.
    pub fn pixel(&self, at: Vec2) -> Option<usize> {
        let (width, height) = (self.camera.width as f32, self.camera.height as f32);
        let inside = at.x >= 0.0 && at.y >= 0.0 && at.x < width && at.y < height;
        inside.then(|| at.y as usize * self.camera.width as usize + at.x as usize)
    }

    /// Coverage, interpolated bilinearly; `None` beyond the outermost pixel centres.
    pub fn coverage_at(&self, at: Vec2) -> Option<f32> {
        interpolated(|i| f32::from(self.coverage[i]) / 255.0, at, &self.camera)
    }

    /// The crop under a Gaussian blur with standard deviation `sigma`, pixels; black and empty
    /// beyond its border.
    pub fn blurred(&self, sigma: f32) -> Blurred {
        let (width, height) = (self.camera.width as usize, self.camera.height as usize);
        let radius = (2.5 * sigma).ceil() as usize;
        let weight = |k: usize| (-0.5 * ((k as f32 - radius as f32) / sigma).powi(2)).exp();
        let total: f32 = (0..=2 * radius).map(weight).sum();
        let kernel: Vec<f32> = (0..=2 * radius).map(|k| weight(k) / total).collect();
        let along = |from: &[[f32; 4]], length: usize, stride: usize| -> Vec<[f32; 4]> {
            let at = |i: usize| {
                let place = i / stride % length;
                let mut sum = [0.0f32; 4];
                for (k, weight) in kernel.iter().enumerate() {
                    let moved = place + k;
                    if moved >= radius && moved - radius < length {
                        let value = &from[i + moved * stride - (radius + place) * stride];
                        sum.iter_mut().zip(value).for_each(|(sum, value)| *sum += weight * value);
                    }
                }
                sum
            };
            (0..from.len()).map(at).collect()
        };
        let pixels: Vec<[f32; 4]> = self.pixels.iter().map(|p| p.map(|v| f32::from(v) / 255.0)).collect();
        Blurred { width, pixels: along(&along(&pixels, width, 1), height, width) }
    }
}

impl Blurred {
    /// The subject's colour, interpolated bilinearly; `None` beyond the outermost pixel centres,
    /// and where the coverage of one of the four pixels is below `least`.
    pub fn sample(&self, at: Vec2, least: f32) -> Option<ColorSample> {
        let (corners, share) = corners(at, self.width, self.pixels.len() / self.width.max(1))?;
        let corners = corners.map(|i| self.pixels[i]);
        if corners.iter().any(|c| c[3] < least) {
            return None;
        }
        let [a, b, c, d] = corners.map(|c| Vec3::new(c[0], c[1], c[2]) / c[3]);
        let (top, bottom) = (a.lerp(b, share.x), c.lerp(d, share.x));
        Some(ColorSample { color: top.lerp(bottom, share.y), dx: (b - a).lerp(d - c, share.y), dy: bottom - top })
    }
}

/// Values of pixels, interpolated bilinearly; `None` beyond the outermost pixel centres.
pub(crate) fn interpolated(value: impl Fn(usize) -> f32, at: Vec2, camera: &Camera) -> Option<f32> {
    let (corners, share) = corners(at, camera.width as usize, camera.height as usize)?;
    let [a, b, c, d] = corners.map(value);
    let (top, bottom) = (a + share.x * (b - a), c + share.x * (d - c));
    Some(top + share.y * (bottom - top))
}

/// The four pixels around a point, row by row, and its fractional offset from the first centre;
/// `None` beyond the centres.
fn corners(at: Vec2, width: usize, height: usize) -> Option<([usize; 4], Vec2)> {
    let at = at - 0.5;
    if !(at.x >= 0.0 && at.y >= 0.0 && at.x < width as f32 - 1.0 && at.y < height as f32 - 1.0) {
        return None;
    }
    let first = at.y as usize * width + at.x as usize;
    Some(([first, first + 1, first + width, first + width + 1], at.fract()))
}
