//! A posed body before a camera.

use glam::Vec3;
use smpl::Posed;
use visibility::{Pixel, RasterOptions, Rasterizer, View};
use volrender::{Aabb, Camera, Ray};

use crate::Error;

/// A pose and a camera, lengths normalised.
#[derive(Clone, Debug)]
pub struct PosedView {
    /// The camera.
    pub camera: Camera,
    /// Index of the training frame of the same instant; `None` for poses that no training frame
    /// has.
    pub instant: Option<usize>,
    /// The posed prior.
    pub posed: Posed,
}

impl PosedView {
    /// A pose that no training frame has, before `camera`.
    pub fn new(camera: &Camera, posed: Posed) -> Self {
        Self { camera: *camera, instant: None, posed }
    }

    /// The same pose before another camera.
    #[must_use]
    pub fn seen_by(&self, camera: &Camera) -> Self {
        Self { camera: *camera, ..self.clone() }
    }

    /// The ray through the centre of the pixel with a row-major index.
    pub fn pixel_ray(&self, pixel: u32) -> Ray {
        let width = self.camera.width;
        self.camera.ray((pixel % width) as f32 + 0.5, (pixel / width) as f32 + 0.5)
    }

    /// The mean of the posed vertices.
    pub fn centre(&self) -> Vec3 {
        self.posed.vertices.iter().sum::<Vec3>() / self.posed.vertices.len().max(1) as f32
    }

    /// The image-space box [x0, y0, x1, y1) of the body's corners, at least one pixel, inside the
    /// image.
    pub(crate) fn body_box(&self) -> [u32; 4] {
        let Aabb { min: low, max: high } = Aabb::from_points(&self.posed.vertices);
        let (width, height) = (self.camera.width as f32, self.camera.height as f32);
        let mut found = [width, height, 0.0f32, 0.0f32];
        for corner in 0..8 {
            let pick = |axis: usize| if corner >> axis & 1 == 0 { low[axis] } else { high[axis] };
            match self.camera.project(Vec3::new(pick(0), pick(1), pick(2))) {
                Some(p) => {
                    found = [found[0].min(p.x), found[1].min(p.y), found[2].max(p.x), found[3].max(p.y)];
                }
                // A corner behind the camera: the box may reach anywhere.
                None => found = [0.0, 0.0, width, height],
            }
        }
        let x0 = found[0].clamp(0.0, width - 1.0).floor();
        let y0 = found[1].clamp(0.0, height - 1.0).floor();
        let x1 = found[2].clamp(x0 + 1.0, width).ceil();
        let y1 = found[3].clamp(y0 + 1.0, height).ceil();
        [x0 as u32, y0 as u32, x1 as u32, y1 as u32]
    }

    /// Pixels (H × W) whose centre the prior covers.
    pub(crate) fn silhouette(&self, faces: &[[u32; 3]]) -> Result<Vec<bool>, Error> {
        let vertices = &self.posed.vertices;
        if let Some(vertex) = vertices.iter().position(|v| !v.is_finite()) {
            return Err(visibility::Error(format!("vertex {vertex} is not finite")).into());
        }
        Ok(silhouette(vertices, faces, &self.camera)?)
    }
}

/// The camera as the visibility crate takes it.
pub fn pinhole(camera: &Camera) -> View {
    let Camera { focal, centre, world_to_camera, width, height } = *camera;
    View { focal, centre, world_to_camera, width, height }
}

/// Pixels (H × W) whose centre a mesh covers. A mesh that reaches behind the camera is clipped.
pub(crate) fn silhouette(
    vertices: &[Vec3],
    faces: &[[u32; 3]],
    camera: &Camera,
) -> Result<Vec<bool>, visibility::Error> {
    let mut covered = vec![false; camera.width as usize * camera.height as usize];
    let options = RasterOptions::default();
    let is_covered = |pixel: Pixel<'_>| !pixel.samples.is_empty();
    Rasterizer::default().draw(vertices, faces, &pinhole(camera), &options, &mut covered, is_covered)?;
    Ok(covered)
}

/// Width of a pixel at the depth of the body, normalised metres: the median over `views`; `None`
/// where none has the body before its camera.
pub(crate) fn pixel_width<'a>(views: impl Iterator<Item = &'a PosedView>) -> Option<f32> {
    let width = |view: &PosedView| {
        let depth = view.camera.world_to_camera.transform_point3(view.centre()).z;
        Some(depth / view.camera.focal.max_element()).filter(|width| width.is_finite() && *width > 0.0)
    };
    let mut widths: Vec<f32> = views.filter_map(width).collect();
    widths.sort_by(f32::total_cmp);
    widths.get(widths.len() / 2).copied()
}
