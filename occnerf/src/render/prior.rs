//! Pictures of the posed prior in one colour a vertex.

use glam::Vec3;

use crate::Error;
use crate::model::body::Body;
use crate::model::colors::VertexColors;
use crate::model::view::PosedView;
use crate::render::picture::{Renderer, Rendering, paint};

/// Draws the prior's mesh with one colour a vertex.
pub struct PriorRenderer<'a> {
    body: &'a Body,
    colors: &'a VertexColors,
}

impl<'a> PriorRenderer<'a> {
    /// Draws `body` in `colors`.
    pub fn new(body: &'a Body, colors: &'a VertexColors) -> Self {
        Self { body, colors }
    }
}

/// Rays an axis of a pixel that show the mesh's edge as smoothly as the images do.
const SUPERSAMPLING: u32 = 2;

impl Renderer for PriorRenderer<'_> {
    fn render(&mut self, view: &PosedView, background: Vec3) -> Result<Rendering, Error> {
        let faces = &self.body.model.faces;
        let mesh = visibility::RayMesh::new(&view.posed.vertices, faces)?;
        let shades = self.colors.light.on_surface(&view.posed.vertices, faces);
        let lit: Vec<Vec3> = self.colors.lit(&shades).collect();
        let share = 1.0 / (SUPERSAMPLING * SUPERSAMPLING) as f32;
        paint(
            view,
            background,
            || (),
            |(), row, columns| {
                columns
                    .map(|column| {
                        let (mut color, mut opacity) = (Vec3::ZERO, 0.0);
                        for sub in 0..SUPERSAMPLING * SUPERSAMPLING {
                            let offset = |i: u32| (i as f32 + 0.5) / SUPERSAMPLING as f32;
                            let (u, v) = (offset(sub % SUPERSAMPLING), offset(sub / SUPERSAMPLING));
                            let ray = view.camera.ray(column as f32 + u, row as f32 + v);
                            if let Some(hit) = mesh.first_hit(ray.origin, ray.direction) {
                                let corners = faces[hit.face as usize];
                                let weighted = corners.iter().zip(hit.barycentric);
                                color += share * weighted.map(|(&v, b)| b * lit[v as usize]).sum::<Vec3>();
                                opacity += share;
                            }
                        }
                        (color + (1.0 - opacity) * background, opacity)
                    })
                    .collect()
            },
        )
    }
}
