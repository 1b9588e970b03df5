//! Where [v̂, d] of a canonical point comes from: the one place that knows the kinds of distance.

use glam::Vec3;

use crate::config::{DistanceKind, SurfaceConfig};
use crate::model::body::Body;

/// A canonical point's place on the surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct SurfacePoint {
    /// v̂.
    pub closest: Vec3,
    /// d, outside positive.
    pub distance: f32,
}

/// The place of `x`, whose `neighbours` (finest level first) are read by the blended kind;
/// `None` where the exact surface is farther than `farthest`.
pub(crate) fn surface_point(
    body: &Body,
    config: &SurfaceConfig,
    x: Vec3,
    neighbours: &[u32],
    farthest: f32,
) -> Option<SurfacePoint> {
    match config.distance {
        DistanceKind::Blended => {
            let blended = body.query.blend(x, &neighbours[..config.k]);
            Some(SurfacePoint { closest: blended.point, distance: blended.signed_distance })
        }
        DistanceKind::Exact => {
            let found = body.surface.closest_within(x, farthest)?;
            Some(SurfacePoint { closest: found.point, distance: found.signed_distance })
        }
    }
}

/// Backward of [`surface_point`]: the gradient with respect to `x`. `at_surface` is the derivative
/// of the exact distance where `x` lies on the surface and has no direction from it.
pub(crate) fn surface_point_backward(
    body: &Body,
    config: &SurfaceConfig,
    (x, neighbours): (Vec3, &[u32]),
    at: SurfacePoint,
    d_at: SurfacePoint,
    at_surface: Vec3,
) -> Vec3 {
    match config.distance {
        DistanceKind::Blended => body.query.blend_backward(x, &neighbours[..config.k], d_at.closest, d_at.distance),
        DistanceKind::Exact => {
            let normal = ((x - at.closest) * at.distance.signum()).normalize_or(at_surface);
            d_at.distance * normal + d_at.closest - normal.dot(d_at.closest) * normal
        }
    }
}
