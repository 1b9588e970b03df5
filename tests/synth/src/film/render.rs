//! Pictures of a mesh by ray casting.

use std::f32::consts::PI;

use glam::{Affine3A, Mat3, Vec2, Vec3};
use visibility::RayMesh;
use volrender::Camera;

use capture::{CaptureError, Image};
use volrender::RandomStream;

/// Rays a pixel, along each axis.
const SAMPLES: u32 = 2;
/// Most surfaces with holes along a ray, and the distance beyond a hole at which it goes on.
const LAYERS: usize = 32;
const BEYOND: f32 = 1.000_01;
/// Light from everywhere, light from above, light of the lamp, and what the lamp gives on average.
const AMBIENT: f32 = 0.58;
const SKY: f32 = 0.07;
const DIRECT: f32 = 0.42;
const MEAN: f32 = DIRECT / 3.0;

/// The light that a person is filmed under.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Lamp {
    toward: Vec3,
    strength: f32,
}

impl Lamp {
    /// 1 is as strong as usual; at 0 as much light comes from everywhere. It stands to the training
    /// camera's upper left with seed 0, elsewhere on that side of the person with others.
    pub fn new(strength: f32, seed: u64) -> Self {
        let mut stream = RandomStream::new(&[seed, 0x6c61_6d70]);
        let (azimuth, up) = ((stream.uniform() - 0.5) * PI, 0.3 + 0.6 * stream.uniform());
        let elsewhere = Vec3::new(azimuth.sin(), up, azimuth.cos());
        Self { toward: if seed == 0 { Vec3::new(-0.42, 0.68, 0.60) } else { elsewhere }, strength }
    }

    /// What falls on a surface with this normal.
    fn on(&self, normal: Vec3) -> f32 {
        let lamp = normal.dot(self.toward.normalize_or(Vec3::Y));
        // Half-Lambert: the terminator is soft and nothing is black.
        let direct = (0.5 + 0.5 * lamp).powi(2);
        AMBIENT + (1.0 - self.strength) * MEAN + self.strength * SKY * normal.y + self.strength * DIRECT * direct
    }
}

/// A camera at `eye` that looks at `target`, upright, square, with the focal length in picture
/// sides.
pub(crate) fn look_at(eye: Vec3, target: Vec3, size: u32, focal: f32) -> Result<Camera, CaptureError> {
    let forward = (target - eye).normalize_or(Vec3::NEG_Z);
    let right = forward.cross(Vec3::Y).normalize_or(Vec3::X);
    let down = forward.cross(right);
    let rotation = Mat3::from_cols(right, down, forward).transpose();
    let extrinsics = Affine3A::from_mat3_translation(rotation, -(rotation * eye));
    let side = size as f32;
    let intrinsics =
        Mat3::from_cols(Vec3::X * (focal * side), Vec3::Y * (focal * side), Vec3::new(side / 2.0, side / 2.0, 1.0));
    Camera::new(intrinsics, extrinsics, size, size)
        .map_err(|error| CaptureError::setting("camera", "a pinhole camera", error))
}

/// A picture, colours premultiplied, and its coverage.
pub(crate) type Picture = (Image, Vec<f32>);

/// The unlit colour of a face at a point given by barycentric weights; `None` in a hole.
pub(crate) type Albedo<'a> = dyn Fn(u32, [f32; 3]) -> Option<Vec3> + Sync + 'a;

/// A mesh in one pose, ready to be looked at.
pub(crate) struct Posture<'a> {
    vertices: Vec<Vec3>,
    normals: Vec<Vec3>,
    faces: &'a [[u32; 3]],
    albedo: &'a Albedo<'a>,
    lamp: Lamp,
    mesh: RayMesh,
}

impl<'a> Posture<'a> {
    /// `vertices` and their `normals`, which need not be of unit length.
    pub fn new(
        vertices: Vec<Vec3>,
        normals: Vec<Vec3>,
        faces: &'a [[u32; 3]],
        albedo: &'a Albedo<'a>,
        lamp: Lamp,
    ) -> Result<Self, CaptureError> {
        let mesh = RayMesh::new(&vertices, faces)
            .map_err(|error| CaptureError::setting("body", "a mesh that rays can hit", error))?;
        Ok(Self { vertices, normals, faces, albedo, lamp, mesh })
    }

    /// Colour on black, and the share of each pixel that the mesh covers.
    pub fn render(&self, camera: &Camera) -> Picture {
        let (width, height) = (camera.width, camera.height);
        let mut image = Image::new(width, height);
        let mut mask = vec![0.0; (width * height) as usize];
        let eye = camera.centre_of_projection();
        let step = 1.0 / SAMPLES as f32;
        let (low, high) = self.bounds(camera);
        for row in low.y as u32..high.y as u32 {
            for column in low.x as u32..high.x as u32 {
                let mut sum = Vec3::ZERO;
                let mut hits = 0;
                for sample in 0..SAMPLES * SAMPLES {
                    let u = column as f32 + ((sample % SAMPLES) as f32 + 0.5) * step;
                    let v = row as f32 + ((sample / SAMPLES) as f32 + 0.5) * step;
                    if let Some(color) = self.color(eye, camera.ray(u, v).direction) {
                        sum += color;
                        hits += 1;
                    }
                }
                let pixel = (row * width + column) as usize;
                let share = step * step;
                mask[pixel] = hits as f32 * share;
                image.pixels[3 * pixel..3 * pixel + 3].copy_from_slice(&(sum * share).to_array());
            }
        }
        (image, mask)
    }

    /// Whole pixels around everything that projects, clipped to the picture.
    fn bounds(&self, camera: &Camera) -> (Vec2, Vec2) {
        let size = Vec2::new(camera.width as f32, camera.height as f32);
        let (mut low, mut high) = (size, Vec2::ZERO);
        for &vertex in &self.vertices {
            let Some(p) = camera.project(vertex) else {
                // A vertex behind the camera bounds nothing.
                return (Vec2::ZERO, size);
            };
            low = low.min(p.truncate().floor());
            high = high.max(p.truncate().ceil());
        }
        (low.clamp(Vec2::ZERO, size), high.clamp(Vec2::ZERO, size))
    }

    fn color(&self, origin: Vec3, direction: Vec3) -> Option<Vec3> {
        let mut t = 0.0;
        for _ in 0..LAYERS {
            let hit = self.mesh.first_hit(origin + direction * t, direction)?;
            let Some(albedo) = (self.albedo)(hit.face, hit.barycentric) else {
                t = (t + hit.t) * BEYOND;
                continue;
            };
            let corners = self.faces[hit.face as usize];
            let normals = corners.iter().zip(hit.barycentric).map(|(&v, w)| self.normals[v as usize] * w);
            let normal = normals.sum::<Vec3>().normalize_or(-direction);
            return Some((albedo * self.lamp.on(normal)).clamp(Vec3::ZERO, Vec3::ONE));
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_weaker_lamp_gives_as_much_light_more_evenly_and_stands_where_the_seed_says() {
        let normal = |i: usize| {
            // A lattice of Fibonacci: even over the sphere.
            let (z, angle) = (1.0 - (2.0 * i as f32 + 1.0) / 4000.0, 2.399_963_2 * i as f32);
            let r = (1.0 - z * z).sqrt();
            Vec3::new(r * angle.cos(), z, r * angle.sin())
        };
        let on = |lamp: Lamp| -> Vec<f32> { (0..4000).map(|i| lamp.on(normal(i))).collect() };
        for seed in 0..5 {
            let mut spread = Vec::new();
            for strength in [0.0, 0.5, 1.0] {
                let light = on(Lamp::new(strength, seed));
                let mean = light.iter().sum::<f32>() / 4000.0;
                assert!((mean - AMBIENT - MEAN).abs() < 2e-3, "seed {seed}, strength {strength}: {mean}");
                spread.push(light.iter().copied().fold(0.0, f32::max) - light.iter().copied().fold(9.0, f32::min));
            }
            assert!(spread[0] < 1e-6 && spread[0] < spread[1] && spread[1] < spread[2], "{spread:?}");
        }
        assert_ne!(on(Lamp::new(1.0, 0)), on(Lamp::new(1.0, 1)));
    }
}
