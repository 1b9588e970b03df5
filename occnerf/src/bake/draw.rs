//! Rendering of a baked person: skinning, rasterisation, texture lookup, shading.

use glam::{Affine3A, Mat3, Mat3A, Vec2, Vec3, Vec3A, Vec4};
use rayon::prelude::*;
use visibility::{Fragment, Pixel, RasterOptions, Rasterizer, Samples};
use volrender::Camera;

use super::avatar::{Atlas, Avatar, TERMS_PER_JOINT, blend};
use crate::Error;
use crate::capture::{Image, Light};
use crate::model::view::{PosedView, pinhole};
use crate::render::{Renderer, Rendering};

/// Vertices per parallel task.
const CHUNK: usize = 1024;

/// Draws an avatar by rasterising; keeps its buffers.
pub struct BakedRenderer<'a> {
    avatar: &'a Avatar,
    /// Canonical positions in the unit of the bones, (V).
    vertices: Vec<Vec3>,
    /// Length of a unit of the avatar in that of the bones.
    scale: f32,
    light: Light,
    samples: Samples,
    /// (H, W).
    texels: Vec<Vec3A>,
    features: Vec<f32>,
    skinned: Vec<Vec3>,
    /// Place in the atlas, texels, and shading of each vertex, (V).
    looks: Vec<Vec3A>,
    rasterizer: Rasterizer,
    pixels: Vec<Vec4>,
}

impl<'a> BakedRenderer<'a> {
    /// For bones and cameras in which an avatar's metre is `scale` long, under `light`, with
    /// `samples` a pixel.
    #[must_use]
    pub fn new(avatar: &'a Avatar, scale: f32, light: Light, samples: Samples) -> Self {
        Self {
            avatar,
            vertices: avatar.vertices.iter().map(|v| scale * v).collect(),
            scale,
            light,
            samples,
            texels: avatar.atlas.rgb.as_chunks().0.iter().map(|rgb| color(*rgb).into()).collect(),
            features: Vec::new(),
            skinned: Vec::new(),
            looks: avatar.uvs.iter().map(|uv| (uv * avatar.atlas.size()).extend(1.0).into()).collect(),
            rasterizer: Rasterizer::default(),
            pixels: Vec::new(),
        }
    }

    /// World positions of the vertices, (V), and, as z after their places in the atlas in texels,
    /// their shading, (V): pose blend shapes, then linear blend skinning by `bones` (J), canonical
    /// to world.
    ///
    /// # Panics
    /// Unless there are J bones.
    pub fn skin(&mut self, bones: &[Affine3A]) -> (&[Vec3], &[Vec3A]) {
        let Self { avatar, vertices, scale, features, skinned, looks, light, .. } = self;
        assert_eq!(bones.len(), avatar.num_joints(), "skin: bones");
        blend_shape_features(avatar, bones, *scale, features);
        skinned.resize(vertices.len(), Vec3::ZERO);
        let rows = skinned.par_chunks_mut(CHUNK).zip(looks.par_chunks_mut(CHUNK)).enumerate();
        rows.for_each(|(chunk, (out, looks))| {
            for (v, (out, look)) in (chunk * CHUNK..).zip(out.iter_mut().zip(looks)) {
                let bone = blend(bones, avatar.joints[v], avatar.weights[v]);
                let mut rest = Vec3A::from(vertices[v]);
                for (term, direction) in avatar.posedirs.row(v) {
                    rest += features[term] * Vec3A::from(direction);
                }
                *out = Vec3::from(bone.matrix3 * rest + bone.translation);
                // Rotated with the bones: equal on both sides of a seam.
                let normal = avatar.normals[v];
                look.z = light.on(Vec3::from(bone.matrix3 * Vec3A::from(normal)).normalize_or(normal));
            }
        });
        (skinned, looks)
    }

    /// The person in the pose of `bones` (J) as `camera` sees them: premultiplied colour and
    /// opacity of each pixel, (H·W, row-major).
    ///
    /// # Errors
    /// [`Error::Scene`] for bones of another skeleton; [`Error::Visibility`] for pictures that are
    /// too large.
    pub fn draw(&mut self, bones: &[Affine3A], camera: &Camera) -> Result<&[Vec4], Error> {
        let (expected, found) = (self.avatar.num_joints(), bones.len());
        if found != expected {
            return Err(Error::Scene(format!("the avatar has {expected} joints, the body {found}")));
        }
        self.skin(bones);
        let Self { avatar, texels, skinned, looks, rasterizer, scale, samples, pixels, .. } = self;
        let options = RasterOptions { samples: *samples, cull_back: true, near: 1e-3 * *scale };
        let colour = |fragment: &Fragment| {
            let look = look(avatar, looks, fragment);
            let albedo = bilinear(&avatar.atlas, look.truncate(), |i| texels[i]);
            Vec3::from((look.z * albedo).min(Vec3A::ONE)).extend(1.0)
        };
        let shade = |pixel: Pixel<'_>| {
            let count = pixel.samples.len();
            if count == 0 {
                return Vec4::ZERO;
            }
            pixel.samples.iter().flatten().map(colour).sum::<Vec4>() / count as f32
        };
        pixels.resize(camera.width as usize * camera.height as usize, Vec4::ZERO);
        rasterizer.draw(skinned, &avatar.faces, &pinhole(camera), &options, pixels, shade)?;
        Ok(pixels)
    }
}

impl Renderer for BakedRenderer<'_> {
    fn render(&mut self, view: &PosedView, background: Vec3) -> Result<Rendering, Error> {
        let drawn = self.draw(&view.posed.bones, &view.camera)?;
        let over = |p: &Vec4| (p.truncate() + (1.0 - p.w) * background).to_array();
        let pixels: Vec<f32> = drawn.par_iter().flat_map_iter(over).collect();
        let opacity = drawn.iter().map(|p| p.w).collect();
        let Camera { width, height, .. } = view.camera;
        Ok(Rendering { image: Image { width, height, pixels }, opacity })
    }
}

/// Colour from 8 bits a channel.
pub(super) fn color(rgb: [u8; 3]) -> Vec3 {
    Vec3::from(rgb.map(|byte| f32::from(byte) / 255.0))
}

/// Place in the atlas, texels, and, as z, shading of a fragment, from those of the vertices, (V).
#[inline]
pub(super) fn look(avatar: &Avatar, looks: &[Vec3A], fragment: &Fragment) -> Vec3A {
    let [a, b, c] = avatar.faces[fragment.face as usize].map(|v| looks[v as usize]);
    let [p, q, r] = fragment.barycentric;
    p * a + q * b + r * c
}

/// R − I of each joint but the root relative to its parent, in units of `scale`.
fn blend_shape_features(avatar: &Avatar, bones: &[Affine3A], scale: f32, out: &mut Vec<f32>) {
    out.clear();
    out.reserve(TERMS_PER_JOINT * bones.len());
    for (joint, bone) in avatar.skeleton.iter().zip(bones).skip(1) {
        let parent = joint.parent.map_or(Mat3A::IDENTITY, |parent| bones[usize::from(parent)].matrix3);
        let local = Mat3::from(parent.transpose() * bone.matrix3) - Mat3::IDENTITY;
        out.extend((local.transpose() * scale).to_cols_array());
    }
}

/// Bilinear lookup at a `place` of the atlas, texels, in texels that are given by their index.
#[inline]
pub(super) fn bilinear(atlas: &Atlas, place: Vec2, texel: impl Fn(usize) -> Vec3A) -> Vec3A {
    let corner = BilinearCorner::new(place, atlas);
    let [a, b, c, d] = corner.texels(atlas).map(texel);
    let (top, bottom) = (a + (b - a) * corner.share.x, c + (d - c) * corner.share.x);
    top + (bottom - top) * corner.share.y
}

/// The first of the four texels of a bilinear lookup, and the fractional offset.
pub(super) struct BilinearCorner {
    x: usize,
    y: usize,
    pub share: Vec2,
}

impl BilinearCorner {
    /// At a `place` of the atlas, texels.
    #[inline]
    pub fn new(place: Vec2, atlas: &Atlas) -> Self {
        let size = atlas.size();
        // Clamped to the edge.
        let at = (place - 0.5).clamp(Vec2::ZERO, (size - 1.0).max(Vec2::ZERO));
        let last = (size - 2.0).max(Vec2::ZERO);
        // Truncation is the floor of a coordinate that is not negative.
        let (x, y) = (at.x.min(last.x) as u32, at.y.min(last.y) as u32);
        Self { x: x as usize, y: y as usize, share: at - Vec2::new(x as f32, y as f32) }
    }

    /// Indices row by row; the only row or column of a thin atlas occurs twice.
    #[inline]
    pub fn texels(&self, atlas: &Atlas) -> [usize; 4] {
        let width = atlas.width as usize;
        let first = self.y * width + self.x;
        let (right, down) = (usize::from(width > 1), if atlas.height > 1 { width } else { 0 });
        [first, first + right, first + down, first + right + down]
    }
}
