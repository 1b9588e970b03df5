//! Pictures of a trained person.

use glam::Vec3;
use smpl::MotionFrame;

use crate::Error;
use crate::model::extent::Extent;
use crate::model::march::{MarchOptions, Segment};
use crate::model::trace::{FINE_CELL, March, PosedSurface};
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
    /// Encodes the vertices once for every picture to come, and looks where the field is empty.
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

/// Live samples of a ray that are evaluated before it is asked whether it goes on, and the
/// transmittance behind which nothing is looked at: it could change a colour by a thousandth, a
/// quarter of a level of 8 bits.
const MARCH: MarchOptions = MarchOptions { segment: 4, min_transmittance: 1e-3 };

impl Renderer for FieldRenderer<'_> {
    fn render(&mut self, view: &PosedView, background: Vec3) -> Result<Rendering, Error> {
        let Self { model, code, extent, surface } = self;
        let posed = model.corrected(view);
        surface.refit(&model.body, &posed, extent, &model.config);
        let motion = MotionFrame::new(&model.body.model, &posed);
        let tracer = model.tracer(surface, extent, &motion);
        paint(view, background, Scratch::default, |scratch, row, columns| {
            let Scratch { segment, marches } = scratch;
            let ray = |column| view.pixel_ray(row * view.camera.width + column);
            marches.clear();
            marches.extend(columns.map(|column| March::new(ray(column), None)));
            while segment.advance(&tracer, marches, MARCH, |batch| model.evaluate(code, batch, None)) {}
            let over = |m: &March| (m.color + m.transmittance * background, 1.0 - m.transmittance);
            marches.iter().map(over).collect()
        })
    }
}
