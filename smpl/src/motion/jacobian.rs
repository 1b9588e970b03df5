//! Derivatives of x̂ and f by the point.

use glam::{Affine3A, Mat3, Mat3A, Vec3, Vec3A};

use super::field::{MotionFrame, SurfacePoint};
use super::{MotionSample, SurfaceMotion, WeightVolume};
use crate::pose::blend;

/// a bᵀ.
fn outer(a: Vec3, b: Vec3) -> Mat3 {
    Mat3::from_cols(a * b.x, a * b.y, a * b.z)
}

impl WeightVolume {
    /// With y_i = R_i x + t_i and g_i the gradient of w_i in canonical space:
    /// ∂x̂/∂x = Σ (w_i R_i + (y_i − x̂) (R_iᵀ g_i)ᵀ) / Σ w and ∂f/∂x = Σ R_iᵀ g_i where Σ w < 1.
    pub(super) fn map_with_jacobian(
        &self,
        to_canonical: &[Affine3A],
        point: Vec3,
        threshold: f32,
    ) -> Option<(MotionSample, Mat3, Vec3)> {
        let sample = self.map(to_canonical, point, threshold)?;
        let samples = self.resolution.pow(3);
        let (mut sum, mut matrix, mut gradient) = (0.0f32, Mat3::ZERO, Vec3::ZERO);
        for (bone, transform) in to_canonical.iter().enumerate() {
            let y = transform.transform_point3(point);
            let Some(cell) = self.cell(bone, y.into()) else {
                continue;
            };
            let channel = &self.weights[bone * samples..][..samples];
            let linear = Mat3::from(transform.matrix3);
            let (w, g) = (self.sample(channel, &cell), linear.transpose() * self.slope(channel, &cell));
            sum += w;
            gradient += g;
            matrix += linear * w + outer(y - sample.canonical, g);
        }
        let gradient = if sum < 1.0 { gradient } else { Vec3::ZERO };
        Some((sample, matrix * sum.recip(), gradient))
    }

    /// Gradient of the trilinear interpolation.
    fn slope(&self, channel: &[f32], cell: &super::volume::Cell) -> Vec3 {
        let c = self.corners(cell.corner).map(|i| channel[i]);
        let (t, s) = (cell.t, Vec3::ONE - cell.t);
        let x = (c[1] - c[0]) * s.y * s.z
            + (c[3] - c[2]) * t.y * s.z
            + (c[5] - c[4]) * s.y * t.z
            + (c[7] - c[6]) * t.y * t.z;
        let y = (c[2] - c[0]) * s.x * s.z
            + (c[3] - c[1]) * t.x * s.z
            + (c[6] - c[4]) * s.x * t.z
            + (c[7] - c[5]) * t.x * t.z;
        let z = (c[4] - c[0]) * s.x * s.y
            + (c[5] - c[1]) * t.x * s.y
            + (c[6] - c[2]) * s.x * t.y
            + (c[7] - c[3]) * t.x * t.y;
        Vec3::new(x, y, z) * ((self.resolution - 1) as f32 / (self.max - self.min))
    }
}

impl SurfaceMotion {
    /// With M = Σ b_k M_k over the corners, p = M⁻¹ x and x̂ = p − Σ b_k o_k:
    /// ∂x̂/∂x = M⁻¹ (I − Σ (M_k p) ∇b_kᵀ) − Σ o_k ∇b_kᵀ.
    pub(super) fn map_with_jacobian(
        &self,
        frame: &MotionFrame<'_>,
        point: Vec3,
        nearest: SurfacePoint,
    ) -> Option<(MotionSample, Mat3, Vec3)> {
        let SurfacePoint { face, barycentric, signed_distance } = nearest;
        let (model, posed) = (frame.model, frame.posed);
        let sample = self.map(model, posed, point, face, barycentric, signed_distance)?;
        let corners = model.faces[face as usize].map(|v| v as usize);
        let positions = corners.map(|v| posed.vertices[v]);
        let gradients = barycentric_gradients(positions, barycentric);
        let bones = corners.map(|v| blend(&posed.bones, model.weights.row(v)));
        let offsets = corners.map(|v| posed.pose_offsets[v]);
        let offset: Vec3 = (0..3).map(|k| barycentric[k] * offsets[k]).sum();
        let mut linear = Mat3A::ZERO;
        for k in 0..3 {
            linear += bones[k].matrix3 * barycentric[k];
        }
        let mut matrix;
        if linear.determinant() < Self::MIN_DETERMINANT {
            let weights = || {
                (corners.iter().zip(barycentric))
                    .flat_map(|(&v, b)| model.weights.row(v).map(move |(joint, w)| (joint, b * w)))
            };
            matrix = Mat3::from(posed.bones[super::surface::heaviest(weights())].matrix3).inverse();
        } else {
            let rest = Vec3A::from(sample.canonical + offset);
            matrix = Mat3::IDENTITY;
            for k in 0..3 {
                matrix -= outer(bones[k].transform_point3a(rest).into(), gradients[k]);
            }
            matrix = Mat3::from(linear).inverse() * matrix;
        }
        for k in 0..3 {
            matrix -= outer(offsets[k], gradients[k]);
        }
        // f falls along the outward normal, only beyond the margin, where the distance is not 0.
        let foot: Vec3 = (0..3).map(|k| barycentric[k] * positions[k]).sum();
        let gradient = self.likelihood_slope(signed_distance) * (point - foot).normalize_or_zero();
        matrix.is_finite().then_some((sample, matrix, gradient))
    }
}

/// Gradients of the barycentric coordinates of the nearest point with respect to the query: within
/// a triangle those of the projection on its plane, on an edge those along it, at a corner 0. A
/// triangle or edge without extent has none.
fn barycentric_gradients(positions: [Vec3; 3], barycentric: [f32; 3]) -> [Vec3; 3] {
    let mut out = [Vec3::ZERO; 3];
    let within: Vec<usize> = (0..3).filter(|&k| barycentric[k] != 0.0).collect();
    match within.as_slice() {
        &[a, b] => {
            let edge = positions[b] - positions[a];
            let along = edge / edge.length_squared();
            if along.is_finite() {
                out[a] = -along;
                out[b] = along;
            }
        }
        [_, _, _] => {
            let normal = (positions[1] - positions[0]).cross(positions[2] - positions[0]);
            let scaled = normal / normal.length_squared();
            if scaled.is_finite() {
                for k in 0..3 {
                    out[k] = scaled.cross(positions[(k + 2) % 3] - positions[(k + 1) % 3]);
                }
            }
        }
        _ => {}
    }
    out
}
