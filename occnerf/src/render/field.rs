//! Pictures of a trained person.

use glam::Vec3;
use smpl::MotionFrame;

use crate::Error;
use crate::model::extent::Extent;
use crate::model::march::{MarchOptions, Segment};
use crate::model::trace::{FINE_CELL, March, PosedSurface, Tracer};
use crate::model::trained::Model;
use crate::model::vertices::VertexCode;
use crate::model::view::PosedView;
use crate::render::picture::{Renderer, Rendering, paint};

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
        config.field.density_scale *= 8.0;
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
