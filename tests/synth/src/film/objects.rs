//! A desk and pillars between the training camera and the person, and the room behind.
//!
//! They stand wholly in front of the person and do not move, nor does the camera: one picture of
//! them serves all frames.

use glam::Vec3;
use volrender::Camera;

use super::noise::smooth_noise;
use super::render::{Lamp, Picture, Posture};
use capture::{CaptureError, Frame, Image, Pixels};

/// Distance of the objects' far and near sides from the person's axis, in heights of the person:
/// beyond a stretched arm, before the camera.
const FAR: f32 = 0.72;
const NEAR: f32 = 0.90;
/// Between the pillars, behind, and the desk.
const MIDDLE: f32 = 0.80;
/// Corners of a box, and its triangles, outside counter-clockwise.
const QUADS: [[u32; 4]; 6] = [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];
const TRIANGLES_A_BOX: u32 = 12;
/// Widest that objects are tried, and halvings of the interval.
const WIDEST: f32 = 8.0;
const HALVINGS: usize = 12;

const WOOD: Vec3 = Vec3::new(0.55, 0.36, 0.20);
const STONE: Vec3 = Vec3::new(0.62, 0.60, 0.56);
const FLOOR: [Vec3; 2] = [Vec3::new(0.52, 0.50, 0.46), Vec3::new(0.40, 0.38, 0.36)];
const WALL: Vec3 = Vec3::new(0.70, 0.74, 0.76);

/// What the training camera sees beside the person.
pub(crate) struct Objects {
    /// Premultiplied colour and coverage of the objects.
    front: Picture,
    /// The room.
    room: Image,
}

impl Objects {
    /// Objects so wide that they hide as nearly as pixels allow `fraction` of the subject in
    /// `frames`, `position` picture widths to the right of the person; `height` is what the cameras
    /// stand for.
    pub fn new(
        frames: &[Frame],
        height: f32,
        (fraction, position): (f32, f32),
        lamp: Lamp,
    ) -> Result<Self, CaptureError> {
        let Some(camera) = frames.first().map(|frame| frame.camera) else {
            return Err(CaptureError::setting("frames", "at least 1", 0));
        };
        let eye = camera.centre_of_projection();
        // A picture's width where the objects stand.
        let width = (eye.z - NEAR * height) / camera.focal.x * camera.width as f32;
        let at = |size: f32| picture(&camera, height, (size, position * width), lamp);
        let hidden = |front: &Picture| -> Result<f32, CaptureError> {
            let (mut whole, mut gone) = (0u64, 0u64);
            for frame in frames {
                for (mask, cover) in frame.pixels()?.mask.iter().zip(&front.1).filter(|(mask, _)| **mask > 0.5) {
                    whole += 1;
                    gone += u64::from(mask * (1.0 - cover) <= 0.5);
                }
            }
            Ok(gone as f32 / whole.max(1) as f32)
        };
        let (mut low, mut high) = (0.0, if fraction > 0.0 { WIDEST } else { 0.0 });
        for _ in 0..HALVINGS {
            let middle = 0.5 * (low + high);
            if hidden(&at(middle)?)? < fraction {
                low = middle;
            } else {
                high = middle;
            }
        }
        let (below, above) = (at(low)?, at(high)?);
        let nearer = fraction - hidden(&below)? <= hidden(&above)? - fraction;
        Ok(Self { front: if nearer { below } else { above }, room: room(&camera, height) })
    }

    /// Hides what the objects cover, and marks it as covered where they take more than half of a
    /// pixel.
    pub fn hide(&self, frames: &mut [Frame]) {
        let visible: Vec<f32> = self.front.1.iter().map(|cover| 1.0 - cover).collect();
        let covered: Vec<bool> = self.front.1.iter().map(|&cover| cover > 0.5).collect();
        for frame in frames {
            let (visible, covered) = (visible.clone(), covered.clone());
            frame.source.edit(move |pixels| {
                pixels.mask.iter_mut().zip(&visible).for_each(|(mask, seen)| *mask *= seen);
                pixels.image.multiply(&visible);
                pixels.occluder = Some(covered.clone());
            });
        }
    }

    /// Coverage by the objects, (H, W).
    pub fn coverage(&self) -> &[f32] {
        &self.front.1
    }

    /// What a camera would take of a person (premultiplied, with its coverage) in the room, behind
    /// the objects if `occluded`.
    pub fn photograph(&self, Pixels { image: person, mask, .. }: &Pixels, occluded: bool) -> Image {
        let mut photo = self.room.clone();
        for (i, pixel) in photo.pixels.chunks_exact_mut(3).enumerate() {
            for (c, value) in pixel.iter_mut().enumerate() {
                *value = person.pixels[3 * i + c] + (1.0 - mask[i]) * *value;
                if occluded {
                    *value = self.front.0.pixels[3 * i + c] + (1.0 - self.front.1[i]) * *value;
                }
            }
        }
        photo
    }
}

/// The desk and the pillars, `size` times as wide as usual, moved right.
fn picture(camera: &Camera, height: f32, (size, right): (f32, f32), lamp: Lamp) -> Result<Picture, CaptureError> {
    if size == 0.0 {
        let pixels = camera.width as usize * camera.height as usize;
        return Ok((Image::new(camera.width, camera.height), vec![0.0; pixels]));
    }
    let pillar = |x: f32| {
        let half = 0.022 * size;
        [Vec3::new(x - half, 0.0, FAR), Vec3::new(x + half, 1.6, MIDDLE)]
    };
    let desk = 0.26 * size.min(1.3);
    let top = 0.10 + 0.11 * size.min(2.0);
    let boxes = [
        [Vec3::new(0.02 - desk, 0.04, MIDDLE + 0.01), Vec3::new(0.02 + desk, top, NEAR - 0.01)],
        [Vec3::new(-desk, top, MIDDLE), Vec3::new(0.04 + desk, top + 0.02, NEAR)],
        pillar(-0.05),
        pillar(0.15),
    ];
    let (mut vertices, mut faces) = (Vec::new(), Vec::new());
    for [low, high] in boxes {
        let first = vertices.len() as u32;
        for corner in 0..8u32 {
            let pick = |axis: usize| if corner >> axis & 1 == 1 { high[axis] } else { low[axis] };
            vertices.push(Vec3::new(pick(0), pick(1), pick(2)) * height + Vec3::X * right);
        }
        for [a, b, c, d] in QUADS {
            faces.extend([[a, b, c], [a, c, d]].map(|face| face.map(|v| first + v)));
        }
    }
    // Flat faces: every triangle has corners of its own.
    let corners: Vec<Vec3> = faces.as_flattened().iter().map(|&v| vertices[v as usize]).collect();
    let normals: Vec<Vec3> =
        corners.chunks_exact(3).flat_map(|t| [(t[1] - t[0]).cross(t[2] - t[0]).normalize_or_zero(); 3]).collect();
    let faces: Vec<[u32; 3]> = (0..corners.len() as u32 / 3).map(|f| [3 * f, 3 * f + 1, 3 * f + 2]).collect();
    let places = corners.clone();
    let color = |face: u32, weights: [f32; 3]| {
        let at: Vec3 = (0..3).map(|k| places[3 * face as usize + k] * weights[k]).sum::<Vec3>() / height;
        Some(if face / TRIANGLES_A_BOX < 2 {
            WOOD * (0.75 + 0.5 * smooth_noise(at * Vec3::new(9.0, 60.0, 60.0)))
        } else {
            STONE * (0.8 + 0.3 * smooth_noise(at * 30.0)) * if (at.y * 6.0).rem_euclid(1.0) < 0.06 { 0.7 } else { 1.0 }
        })
    };
    Ok(Posture::new(corners, normals, &faces, &color, lamp)?.render(camera))
}

/// A tiled floor at y = 0 and a wall.
fn room(camera: &Camera, height: f32) -> Image {
    let mut image = Image::new(camera.width, camera.height);
    let width = camera.width as usize;
    for (i, pixel) in image.pixels.chunks_exact_mut(3).enumerate() {
        let ray = camera.ray((i % width) as f32 + 0.5, (i / width) as f32 + 0.5);
        let (origin, wall) = (ray.origin / height, -1.6);
        let behind = (wall - origin.z) / ray.direction.z.min(-1e-6);
        let at = origin + behind * ray.direction;
        let color = if at.y > 0.0 {
            WALL * if (at.x * 2.0).rem_euclid(1.0) < 0.05 { 0.9 } else { 1.0 }
        } else {
            let at = origin - ray.direction * (origin.y / ray.direction.y.min(-1e-6));
            let tile = (at.x * 3.0).floor() + (at.z * 3.0).floor();
            FLOOR[tile.rem_euclid(2.0) as usize]
        };
        pixel.copy_from_slice(&color.to_array());
    }
    image
}
