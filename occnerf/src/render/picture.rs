//! Renderers, the pictures they draw, how a picture is filled, and pictures of the posed prior.

use glam::Vec3;
use rayon::prelude::*;
use visibility::RayMesh;

use crate::Error;
use crate::capture::Image;
use crate::model::body::Body;
use crate::model::colors::{PriorColors, shade};
use crate::model::view::PosedView;

/// A picture with the opacity of each of its pixels.
#[derive(Clone, Debug)]
pub struct Rendering {
    /// sRGB over the background.
    pub image: Image,
    /// H × W accumulated opacity in [0, 1].
    pub opacity: Vec<f32>,
}

/// Something that draws posed people.
pub trait Renderer: Sync {
    /// Draws the person in the pose and before the camera of `view`, over `background`.
    ///
    /// # Errors
    /// For a pose that cannot be drawn.
    fn render(&mut self, view: &PosedView, background: Vec3) -> Result<Rendering, Error>;
}

/// Fills a picture row by row inside the body's box; elsewhere it is the background.
pub(crate) fn paint<S>(
    view: &PosedView,
    background: Vec3,
    scratch: impl Fn() -> S + Sync + Send,
    row: impl Fn(&mut S, u32, std::ops::Range<u32>) -> Vec<(Vec3, f32)> + Sync + Send,
) -> Result<Rendering, Error> {
    let (width, height) = (view.camera.width, view.camera.height);
    let [x0, y0, x1, y1] = margin_box(view);
    let count = (width * height) as usize;
    let (mut pixels, mut opacity) = (background.to_array().repeat(count), vec![0.0; count]);
    let rows = pixels.par_chunks_mut(3 * width as usize).zip(opacity.par_chunks_mut(width as usize)).enumerate();
    rows.for_each_init(scratch, |scratch, (y, (pixels, opacity))| {
        let y = y as u32;
        if !(y0..y1).contains(&y) {
            return;
        }
        for (x, (color, alpha)) in (x0..x1).zip(row(scratch, y, x0..x1)) {
            color.clamp(Vec3::ZERO, Vec3::ONE).write_to_slice(&mut pixels[3 * x as usize..]);
            opacity[x as usize] = alpha;
        }
    });
    Ok(Rendering { image: Image { width, height, pixels }, opacity })
}

/// The body's box in the image with room for clothes, hair and the margin around them.
fn margin_box(view: &PosedView) -> [u32; 4] {
    let [x0, y0, x1, y1] = view.body_box();
    let room = (y1 - y0).max(x1 - x0) / 8 + 4;
    let (width, height) = (view.camera.width, view.camera.height);
    [x0.saturating_sub(room), y0.saturating_sub(room), (x1 + room).min(width), (y1 + room).min(height)]
}

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
        let mesh = RayMesh::new(&view.posed.vertices, faces)?;
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
