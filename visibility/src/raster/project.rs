//! Projection of vertices to fixed-point image coordinates.

use glam::{Affine3A, DVec3, Mat3, Vec3};
use rayon::prelude::*;

use super::RasterOptions;
use crate::view::View;

/// Steps of fixed-point coordinates between samples.
pub(super) const STEP: i32 = 256;
/// Guard band: distance outside the image, in samples, from which triangles are clipped.
pub(super) const GUARD: f32 = (1 << 15) as f32;

/// A vertex as the camera sees it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Projected {
    /// Homogeneous coordinates in the image: samples times depth, and depth.
    pub clip: Vec3,
    /// Reciprocal of the depth; 0 for a vertex whose triangles are clipped, NaN for one that is not
    /// finite.
    pub inverse: f32,
    /// Fixed-point position.
    pub x: i32,
    pub y: i32,
}

/// A camera in units of samples.
pub(super) struct Projection {
    pub width: usize,
    pub height: usize,
    pub near: f32,
    pub cull_back: bool,
    /// Samples a side of a pixel.
    pub side: usize,
    matrix: Affine3A,
    intrinsics: Mat3,
    world_to_camera: Affine3A,
}

impl Projection {
    pub fn new(view: &View, options: &RasterOptions) -> Self {
        let side = options.samples.per_side();
        let scale = side as f32;
        let intrinsics = Mat3::from_diagonal(Vec3::new(scale, scale, 1.0)) * view.intrinsics();
        Self {
            width: (view.width * side) as usize,
            height: (view.height * side) as usize,
            // `max` replaces NaN too.
            near: options.near.max(f32::MIN_POSITIVE),
            cull_back: options.cull_back,
            side: side as usize,
            matrix: Affine3A::from_mat3(intrinsics) * view.world_to_camera,
            intrinsics,
            world_to_camera: view.world_to_camera,
        }
    }

    pub fn project(&self, vertices: &[Vec3], out: &mut Vec<Projected>) {
        vertices.par_iter().with_min_len(4096).map(|&v| self.vertex(v)).collect_into_vec(out);
    }

    fn vertex(&self, v: Vec3) -> Projected {
        let clip = self.matrix.transform_point3(v);
        let mut projected = Projected { clip, inverse: if v.is_finite() { 0.0 } else { f32::NAN }, x: 0, y: 0 };
        if clip.z >= self.near && clip.x.abs() <= GUARD * clip.z && clip.y.abs() <= GUARD * clip.z {
            projected.inverse = 1.0 / clip.z;
            (projected.x, projected.y) = (fixed(clip.x / clip.z), fixed(clip.y / clip.z));
        }
        projected
    }

    /// Homogeneous coordinates in `f64`, which cannot overflow.
    pub fn exact(&self, v: Vec3) -> DVec3 {
        let camera = Mat3::from(self.world_to_camera.matrix3).as_dmat3() * v.as_dvec3()
            + Vec3::from(self.world_to_camera.translation).as_dvec3();
        self.intrinsics.as_dmat3() * camera
    }
}

/// Rounds samples to fixed point.
pub(super) fn fixed(samples: f32) -> i32 {
    const LIMIT: f32 = GUARD * STEP as f32;
    (samples * STEP as f32 + 0.5).floor().clamp(-LIMIT, LIMIT) as i32
}
