//! Pictures of the posed prior in the colours that the video shows of it.

use glam::Vec3;

use crate::Error;
use crate::model::body::Body;
use crate::model::colors::{PriorColors, shade};
use crate::model::view::PosedView;
use crate::render::picture::{Renderer, Rendering, paint};

/// Draws the prior's mesh in colours of its surface.
pub struct PriorRenderer<'a> {
    body: &'a Body,
    colors: &'a PriorColors,
}

impl<'a> PriorRenderer<'a> {
    /// Draws `body` in `colors`.
    pub fn new(body: &'a Body, colors: &'a PriorColors) -> Self {
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
                                let shade = shade(&shades, faces[hit.face as usize], hit.barycentric);
                                color += share * shade * self.colors.at(hit.face, hit.barycentric).truncate();
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
