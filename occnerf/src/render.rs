//! Renderers, the pictures they draw, how a picture is filled, and pictures of a trained person and
//! of the posed prior.

use glam::Vec3;
use rayon::prelude::*;
use smpl::MotionFrame;
use visibility::RayMesh;

use crate::Error;
use crate::capture::Image;
use crate::model::body::Body;
use crate::model::colors::{PriorColors, shade};
use crate::model::encoder::VertexCode;
use crate::model::extent::Extent;
use crate::model::march::{FINE_CELL, March, MarchOptions, PosedSurface, Segment, Tracer};
use crate::model::trained::Model;
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
///
/// ```
/// use glam::Vec3;
/// use occnerf::capture::{LoadOptions, load_capture};
/// use occnerf::{Config, FieldRenderer, Method, Preset, PriorRenderer, Renderer, Scene, Trainer};
///
/// # fn main() -> Result<(), Box<dyn std::error::Error>> {
/// let body = smpl::BodyModel::embedded();
/// let options = LoadOptions { resize: Some(24), max_frames: Some(3), ..Default::default() };
/// let config = Config::preset(Preset::Fast, Method::Occnerf);
/// let scene = Scene::new(&load_capture("../xtask/demo".as_ref(), &body, &options)?, &body, &config)?;
/// let prior = PriorRenderer::new(&scene.body, scene.colors()?).render(&scene.eval[0].view, Vec3::ONE)?;
/// let trainer = Trainer::new(&scene, config)?;
/// let field = FieldRenderer::new(trainer.model())?.render(&scene.eval[0].view, Vec3::ONE)?;
/// assert_eq!(prior.opacity.len(), field.opacity.len());
/// # Ok(())
/// # }
/// ```
pub trait Renderer: Sync {
    /// Draws the person in the pose and before the camera of `view`, over `background`.
    ///
    /// # Errors
    /// For a pose that cannot be drawn.
    fn render(&mut self, view: &PosedView, background: Vec3) -> Result<Rendering, Error>;
}

/// Fills a picture row by row inside the body's box; elsewhere it is the background.
fn paint<S>(
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

/// Draws with a trained field.
pub struct FieldRenderer<'a> {
    model: &'a Model,
    code: VertexCode,
    extent: Extent,
    surface: PosedSurface,
}

impl<'a> FieldRenderer<'a> {
    /// Encodes the vertices and measures the field's extent, once for all pictures.
    ///
    /// # Errors
    /// For a body whose surface cannot be searched.
    pub fn new(model: &'a Model) -> Result<Self, Error> {
        let mut code = VertexCode::default();
        model.encode_vertices(&mut code);
        let extent = model.measure_extent(&code);
        Ok(Self { model, code, extent, surface: PosedSurface::new(&model.body, FINE_CELL)? })
    }
}

#[derive(Default)]
struct Scratch {
    segment: Segment,
    marches: Vec<March>,
}

/// Rays end at a transmittance that could change a colour by a quarter of a level of 8 bits.
const MARCH: MarchOptions = MarchOptions { segment: 4, min_transmittance: 1e-3 };

impl Renderer for FieldRenderer<'_> {
    fn render(&mut self, view: &PosedView, background: Vec3) -> Result<Rendering, Error> {
        let Self { model, code, extent, surface } = self;
        let posed = &view.posed;
        surface.refit(&model.body, posed, extent, &model.config, model.base.light);
        let motion = MotionFrame::new(&model.body.model, posed);
        let tracer = Tracer { model, surface, extent, frame: &motion };
        paint(view, background, Scratch::default, |scratch, row, columns| {
            let Scratch { segment, marches } = scratch;
            let ray = |column| view.pixel_ray(row * view.camera.width + column);
            marches.clear();
            marches.extend(columns.map(|column| March::new(ray(column), None)));
            while segment.advance(&tracer, marches, MARCH, |batch| model.evaluate(code, batch)) {}
            let over = |m: &March| (m.color + m.transmittance * background, 1.0 - m.transmittance);
            marches.iter().map(over).collect()
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Config, Method, Preset};
    use crate::model::field::SampleBatch;
    use crate::model::march::composite_batch;
    use crate::scene::prepared::Scene;
    use crate::train::trainer::Trainer;

    #[test]
    fn a_picture_drawn_front_to_back_is_that_of_all_samples_at_once() {
        let body = smpl::BodyModel::embedded();
        let demo = synth::DemoConfig { size: 32, frames: 3, eval_cameras: 1, ..Default::default() };
        let capture = synth::demo(&demo, &body).unwrap();
        let mut config = Config { steps: 40, ..Config::preset(Preset::Fast, Method::Occnerf) };
        // Dense enough for rays to end, however little was learnt.
        config.field.density_scale *= 16.0;
        config.surface.surface_term = true;
        let scene = Scene::new(&capture, &body, &config).unwrap();
        let mut trainer = Trainer::new(&scene, config).unwrap();
        for _ in 0..40 {
            trainer.step().unwrap();
        }
        let (view, background) = (&*scene.eval[0].view, Vec3::new(0.3, 0.6, 0.9));
        let model = trainer.model();
        let mut renderer = FieldRenderer::new(model).unwrap();
        let picture = renderer.render(view, background).unwrap();
        let posed = &view.posed;
        // Space beyond the extent contributes less than 0.01.
        let whole = (Extent::whole(&scene.body, model.config()), 0.01);
        for (extent, limit) in [(renderer.extent.clone(), MARCH.min_transmittance + 1e-5), whole] {
            renderer.surface.refit(&scene.body, posed, &extent, model.config(), model.base.light);
            let motion = MotionFrame::new(&body, posed);
            let tracer = Tracer { model, surface: &renderer.surface, extent: &extent, frame: &motion };
            let mut all = SampleBatch::default();
            all.samples.clear();
            for pixel in 0..32 * 32 {
                tracer.trace(&mut all.samples, usize::MAX, &mut March::new(view.pixel_ray(pixel), None));
            }
            model.evaluate(&renderer.code, &mut all);
            let (mut weights, mut composites) = (Vec::new(), Vec::new());
            composite_batch(&all, background, &mut weights, &mut composites);
            let (mut worst, mut solid) = (0.0f32, 0);
            for (pixel, expected) in composites.iter().enumerate() {
                let found = Vec3::from_slice(&picture.image.pixels[3 * pixel..]);
                worst = worst.max((found - expected.color).abs().max_element());
                worst = worst.max((picture.opacity[pixel] - expected.opacity).abs());
                solid += usize::from(expected.opacity > 1.0 - MARCH.min_transmittance);
            }
            assert!(solid > 50, "{solid} rays end early");
            assert!(worst < limit, "{worst}, expected below {limit}");
        }
    }
}
