//! One pose as 3-D Gaussians (Kerbl et al. 2023, the PLY of their code).

use std::path::Path;

use glam::{Mat3, Quat, Vec2, Vec3};

use crate::Error;
use crate::bake::{Avatar, write_whole};

/// Zeroth spherical harmonic.
const Y00: f32 = 0.282_094_79;
/// In-plane scale over a triangle's own standard deviation, so that neighbours overlap.
const SPREAD: f32 = 1.6;
/// Standard deviation across the surface, in metres.
const THICKNESS: f32 = 1e-3;
/// Least standard deviation; viewers crash on thinner splats.
const LEAST: f32 = 1e-6;
/// Peak opacity.
const OPACITY: f32 = 0.99;
/// Most Gaussians of a file.
const MOST: usize = 4_000_000;

/// Anisotropic Gaussians with colour, N.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Splats {
    /// Centres, metres, y up, (N).
    pub centres: Vec<Vec3>,
    /// sRGB in [0, 1] under the avatar's light, (N).
    pub colors: Vec<Vec3>,
    /// Standard deviations along the three axes, metres, (N).
    pub scales: Vec<Vec3>,
    /// Axes to world, (N).
    pub rotations: Vec<Quat>,
}

/// Covers the avatar's surface, with `vertices` (V) in their places, by a Gaussian a
/// triangle; triangles whose longest edge is above `patch` metres are halved until it is not.
///
/// # Errors
/// [`Error::Bake`] for another number of vertices, a patch that is not above 0, and more than 4
/// million Gaussians.
pub fn splats(avatar: &Avatar, vertices: &[Vec3], patch: f32) -> Result<Splats, Error> {
    if vertices.len() != avatar.num_vertices() {
        let (expected, found) = (avatar.num_vertices(), vertices.len());
        return Err(Error::Bake(format!("splats: expected {expected} vertices, found {found}")));
    }
    if patch.is_nan() || patch <= 0.0 {
        return Err(Error::Bake(format!("splats: expected patches of more than 0 m, found {patch}")));
    }
    let mut out = Splats::default();
    let mut todo: Vec<[(Vec3, Vec2); 3]> = Vec::new();
    for face in &avatar.faces {
        todo.push(face.map(|i| (vertices[i as usize], avatar.uvs[i as usize])));
        while let Some(corners) = todo.pop() {
            let edge = |i: usize| corners[i].0.distance(corners[(i + 1) % 3].0);
            let longest = (0..3).max_by(|&a, &b| edge(a).total_cmp(&edge(b))).unwrap_or(0);
            // Halving an infinite edge would not end.
            if edge(longest) > patch && edge(longest).is_finite() {
                let [a, b, c] = [0, 1, 2].map(|i| corners[(longest + i) % 3]);
                let middle = (a.0.midpoint(b.0), a.1.midpoint(b.1));
                todo.extend([[a, middle, c], [middle, b, c]]);
            } else {
                out.add(corners, avatar);
            }
            if out.centres.len() + todo.len() > MOST {
                return Err(Error::Bake(format!("splats: more than {MOST} with patches of {patch} m")));
            }
        }
    }
    Ok(out)
}

impl Splats {
    fn add(&mut self, corners: [(Vec3, Vec2); 3], avatar: &Avatar) {
        let points = corners.map(|corner| corner.0);
        let centre = (points[0] + points[1] + points[2]) / 3.0;
        let normal = (points[1] - points[0]).cross(points[2] - points[0]);
        let Some(normal) = normal.try_normalize().filter(|_| centre.is_finite()) else {
            return;
        };
        let along = (points[1] - points[0]).normalize_or(normal.any_orthonormal_vector());
        let across = normal.cross(along);
        // Covariance of a uniform density over a triangle, in its plane.
        let (mut xx, mut xy, mut yy) = (0.0f32, 0.0, 0.0);
        for point in points {
            let at = Vec2::new((point - centre).dot(along), (point - centre).dot(across));
            (xx, xy, yy) = (xx + at.x * at.x / 12.0, xy + at.x * at.y / 12.0, yy + at.y * at.y / 12.0);
        }
        let (mean, half) = (0.5 * (xx + yy), 0.5 * (xx - yy));
        let root = half.hypot(xy);
        let angle = 0.5 * xy.atan2(half);
        let first = along * angle.cos() + across * angle.sin();
        let deviation = |variance: f32| (SPREAD * variance.max(0.0).sqrt()).max(LEAST);
        let large = deviation(mean + root);
        // Slivers are widened to a quarter of their length, to cover the gaps beside them.
        let small = deviation(mean - root).max(0.25 * large);
        let uv = (corners[0].1 + corners[1].1 + corners[2].1) / 3.0;
        self.centres.push(centre);
        self.colors.push((avatar.light.on(normal) * avatar.atlas.color(uv)).min(Vec3::ONE));
        self.scales.push(Vec3::new(large, small, THICKNESS.min(small)));
        self.rotations.push(Quat::from_mat3(&Mat3::from_cols(first, normal.cross(first), normal)).normalize());
    }

    /// Writes a binary PLY with `x y z f_dc_0..2 opacity scale_0..2 rot_0..3`: opacity as logit,
    /// scales as natural logarithm, quaternion w x y z. As viewers of such files expect, y is down
    /// and z forward in it.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn write(&self, path: &Path) -> Result<(), Error> {
        let names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"];
        let names = names.into_iter().chain(["rot_0", "rot_1", "rot_2", "rot_3"]);
        let properties: String = names.map(|name| format!("property float {name}\n")).collect();
        let n = self.centres.len();
        let mut bytes =
            format!("ply\nformat binary_little_endian 1.0\nelement vertex {n}\n{properties}end_header\n").into_bytes();
        bytes.reserve(4 * 14 * n);
        let flip = Quat::from_rotation_x(std::f32::consts::PI);
        let logit = (OPACITY / (1.0 - OPACITY)).ln();
        for i in 0..n {
            let at = self.centres[i];
            let color = (self.colors[i] - 0.5) / Y00;
            let (scale, turn) = (self.scales[i].max(Vec3::splat(LEAST)), flip * self.rotations[i]);
            let row = [at.x, -at.y, -at.z, color.x, color.y, color.z, logit];
            let shape = [scale.x.ln(), scale.y.ln(), scale.z.ln(), turn.w, turn.x, turn.y, turn.z];
            row.iter().chain(&shape).for_each(|x| bytes.extend(x.to_le_bytes()));
        }
        write_whole(path, &bytes)
    }
}
