//! Rendering of a baked person: skinning, rasterisation, texture lookup, shading.

use glam::{Affine3A, Mat3, Mat3A, Vec2, Vec3, Vec3A, Vec4};
use rayon::prelude::*;
use visibility::{Fragment, Pixel, RasterOptions, Rasterizer, Samples};
use volrender::Camera;

use super::avatar::{Atlas, Avatar};
use crate::Error;
use crate::capture::Light;
use crate::model::view::pinhole;

/// Vertices per parallel task.
const CHUNK: usize = 1024;
/// Pose blend-shape terms of a joint other than the root.
const TERMS: usize = 9;

/// An avatar with the buffers to render it.
pub struct BakedPerson<'a> {
    avatar: &'a Avatar,
    /// Canonical positions in the unit of the bones, (V).
    vertices: Vec<Vec3>,
    /// Length of a unit of the avatar in that of the bones.
    scale: f32,
    /// (H, W).
    texels: Vec<Vec3A>,
    features: Vec<f32>,
    skinned: Vec<Vec3>,
    /// Shading of each vertex, (V).
    shades: Vec<f32>,
    rasterizer: Rasterizer,
    light: Light,
}

impl<'a> BakedPerson<'a> {
    /// For bones and cameras in which an avatar's metre is `scale` long.
    #[must_use]
    pub fn new(avatar: &'a Avatar, scale: f32) -> Self {
        let texel = |rgb: &[u8; 3]| Vec3A::from(rgb.map(|byte| f32::from(byte) / 255.0));
        Self {
            avatar,
            vertices: avatar.vertices.iter().map(|v| scale * v).collect(),
            scale,
            texels: avatar.atlas.rgb.as_chunks().0.iter().map(texel).collect(),
            features: Vec::new(),
            skinned: Vec::new(),
            shades: Vec::new(),
            rasterizer: Rasterizer::default(),
            light: Light::default(),
        }
    }

    /// Sets the light; even by default.
    #[must_use]
    pub fn lit_by(self, light: Light) -> Self {
        Self { light, ..self }
    }

    /// World positions of the vertices, (V): pose blend shapes, then linear blend skinning by
    /// `bones` (J), canonical to world.
    ///
    /// # Panics
    /// Unless there are J bones.
    pub fn skin(&mut self, bones: &[Affine3A]) -> &[Vec3] {
        let Self { avatar, vertices, scale, features, skinned, shades, light, .. } = self;
        assert_eq!(bones.len(), avatar.num_joints(), "skin: bones");
        blend_shape_features(avatar, bones, *scale, features);
        skinned.resize(vertices.len(), Vec3::ZERO);
        shades.resize(vertices.len(), 1.0);
        let rows = skinned.par_chunks_mut(CHUNK).zip(shades.par_chunks_mut(CHUNK)).enumerate();
        rows.for_each(|(chunk, (out, shades))| {
            for (v, (out, shade)) in (chunk * CHUNK..).zip(out.iter_mut().zip(shades)) {
                let (mut matrix, mut translation) = (Mat3A::ZERO, Vec3A::ZERO);
                for (joint, weight) in avatar.joints[v].into_iter().zip(avatar.weights[v]) {
                    let bone = &bones[usize::from(joint)];
                    matrix += bone.matrix3 * weight;
                    translation += bone.translation * weight;
                }
                let mut rest = Vec3A::from(vertices[v]);
                for (term, direction) in avatar.posedirs.row(v) {
                    rest += features[term] * Vec3A::from(direction);
                }
                *out = Vec3::from(matrix * rest + translation);
                // Rotated with the bones: equal on both sides of a seam.
                let normal = avatar.normals[v];
                *shade = light.on(Vec3::from(matrix * Vec3A::from(normal)).normalize_or(normal));
            }
        });
        skinned
    }

    /// Positions (V) and shading (V) of the last skinning.
    pub(super) fn posed(&self) -> (&[Vec3], &[f32]) {
        (&self.skinned, &self.shades)
    }

    /// The person in the pose of `bones` (J) as `camera` sees them: premultiplied colour and
    /// opacity of each pixel into `out` (H·W, row-major).
    ///
    /// # Errors
    /// [`Error::Visibility`] for pictures that are too large.
    ///
    /// # Panics
    /// Unless there are J bones and H·W pixels.
    pub fn draw(
        &mut self,
        bones: &[Affine3A],
        camera: &Camera,
        samples: Samples,
        out: &mut [Vec4],
    ) -> Result<(), Error> {
        self.skin(bones);
        let Self { avatar, texels, skinned, shades, rasterizer, scale, .. } = self;
        let options = RasterOptions { samples, cull_back: true, near: 1e-3 * *scale };
        let atlas = &avatar.atlas;
        let size = Vec2::new(atlas.width as f32, atlas.height as f32);
        let colour = |fragment: &Fragment| {
            let albedo = lookup(texels, atlas, atlas_place(avatar, fragment) * size);
            Vec3::from((shade(avatar, shades, fragment) * albedo).min(Vec3A::ONE)).extend(1.0)
        };
        let shade = |pixel: Pixel<'_>| {
            let count = pixel.samples.len();
            if count == 0 {
                return Vec4::ZERO;
            }
            pixel.samples.iter().flatten().map(colour).sum::<Vec4>() / count as f32
        };
        rasterizer.draw(skinned, &avatar.faces, &pinhole(camera), &options, out, shade)?;
        Ok(())
    }
}

/// Interpolated shading of a fragment.
#[inline]
pub(super) fn shade(avatar: &Avatar, shades: &[f32], fragment: &Fragment) -> f32 {
    between(avatar, fragment, |v| shades[v])
}

/// Barycentric interpolation at a fragment.
#[inline]
fn between<T>(avatar: &Avatar, fragment: &Fragment, of: impl Fn(usize) -> T) -> T
where
    T: std::iter::Sum<T>,
    f32: std::ops::Mul<T, Output = T>,
{
    let corners = avatar.faces[fragment.face as usize];
    corners.iter().zip(fragment.barycentric).map(|(&v, b)| b * of(v as usize)).sum()
}

/// R − I of each joint but the root relative to its parent, in units of `scale`.
fn blend_shape_features(avatar: &Avatar, bones: &[Affine3A], scale: f32, out: &mut Vec<f32>) {
    out.clear();
    out.reserve(TERMS * bones.len());
    for (joint, bone) in avatar.skeleton.iter().zip(bones).skip(1) {
        let parent = joint.parent.map_or(Mat3A::IDENTITY, |parent| bones[usize::from(parent)].matrix3);
        let local = Mat3::from(parent.transpose() * bone.matrix3) - Mat3::IDENTITY;
        out.extend((local.transpose() * scale).to_cols_array());
    }
}

/// Bilinear lookup at `place`, in texels.
#[inline]
fn lookup(texels: &[Vec3A], atlas: &Atlas, place: Vec2) -> Vec3A {
    let corner = BilinearCorner::new(place, Vec2::new(atlas.width as f32, atlas.height as f32));
    let [a, b, c, d] = corner.texels(atlas.width, atlas.height).map(|i| texels[i]);
    let (top, bottom) = (a + (b - a) * corner.share.x, c + (d - c) * corner.share.x);
    top + (bottom - top) * corner.share.y
}

/// Atlas coordinates of a fragment, 0 to 1.
#[inline]
pub(super) fn atlas_place(avatar: &Avatar, fragment: &Fragment) -> Vec2 {
    between(avatar, fragment, |v| avatar.uvs[v])
}

/// The first of the four texels of a bilinear lookup, and the fractional offset.
pub(super) struct BilinearCorner {
    x: usize,
    y: usize,
    pub share: Vec2,
}

impl BilinearCorner {
    /// At `place`, in texels of an atlas of `size`.
    #[inline]
    pub fn new(place: Vec2, size: Vec2) -> Self {
        // Clamped to the edge.
        let at = (place - 0.5).clamp(Vec2::ZERO, (size - 1.0).max(Vec2::ZERO));
        let corner = at.floor().min((size - 2.0).max(Vec2::ZERO));
        Self { x: corner.x as usize, y: corner.y as usize, share: at - corner }
    }

    /// Indices row by row; the only row or column of a thin atlas occurs twice.
    #[inline]
    pub fn texels(&self, width: u32, height: u32) -> [usize; 4] {
        let first = self.y * width as usize + self.x;
        let (right, down) = (usize::from(width > 1), if height > 1 { width as usize } else { 0 });
        [first, first + right, first + down, first + right + down]
    }
}
