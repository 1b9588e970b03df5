//! Whole pictures of a trained person, or of the prior.

use glam::Vec3;
use rayon::prelude::*;
use smpl::Posed;
use volrender::{Camera, Composite};

use crate::Error;
use crate::capture::Image;
use crate::model::extent::Shell;
use crate::model::field::Group;
use crate::model::march::composite_group;
use crate::model::parameters::Part;
use crate::model::samples::{FINE_CELL, March, Stage};
use crate::model::vertices::VertexCode;
use crate::scene::colors::VertexColors;
use crate::scene::prepared::{PreparedFrame, Scene};
use crate::train::batch::body_box;
use crate::train::trainer::{Trainer, pixel_ray};

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
    /// The person in a frame's pose and camera over `background`.
    fn render(&mut self, frame: &PreparedFrame, background: Vec3) -> Result<Rendering, Error>;
}

/// A frame that only says pose and camera, for pictures that no camera took.
pub fn view_of(scene: &Scene, camera: &Camera, posed: Posed) -> PreparedFrame {
    assert_eq!(posed.vertices.len(), scene.canonical.vertices.len(), "posed body of another model");
    PreparedFrame::bare(camera, posed)
}

/// Draws with a trained field.
pub struct FieldRenderer<'a> {
    trainer: &'a Trainer<'a>,
    code: VertexCode,
    shell: Shell,
    stage: Stage,
}

impl<'a> FieldRenderer<'a> {
    /// Encodes the vertices once for every picture to come, and looks where the field is empty.
    pub fn new(trainer: &'a Trainer<'a>) -> Result<Self, Error> {
        let mut code = VertexCode::default();
        trainer.encode_vertices(&mut code);
        let shell = trainer.measure_shell(&code.rows);
        Ok(Self { trainer, code, shell, stage: Stage::new(trainer.scene, FINE_CELL)? })
    }
}

#[derive(Default)]
struct Scratch {
    group: Group,
    weights: Vec<f32>,
    composites: Vec<Composite>,
    rays: Vec<Progress>,
}

/// A ray and the colour before what it has yet to meet.
struct Progress {
    march: March,
    color: Vec3,
}

/// Live samples of a ray that are evaluated before it is asked whether it goes on.
const RUN: usize = 4;
/// Transmittance behind which nothing is looked at: it could change a colour by a thousandth, a quarter of a level of 8 bits.
const HIDDEN: f32 = 1e-3;

impl Renderer for FieldRenderer<'_> {
    fn render(&mut self, frame: &PreparedFrame, background: Vec3) -> Result<Rendering, Error> {
        let trainer = self.trainer;
        let posed = trainer.corrected(frame);
        self.stage.set(trainer.scene, &posed, &self.shell, &trainer.config);
        let tracer = trainer.tracer(&self.stage, &self.shell, frame, &posed);
        let (field, table) = (trainer.parameters.get(Part::Field), trainer.parameters.get(Part::Table));
        let features = &self.code.rows;
        paint(frame, background, Scratch::default, |scratch, row, columns| {
            let start = |column| Progress {
                march: March::new(pixel_ray(frame, row * frame.camera.width + column), None),
                color: Vec3::ZERO,
            };
            let Scratch { group, weights, composites, rays } = scratch;
            rays.clear();
            rays.extend(columns.map(start));
            loop {
                let mut going: Vec<&mut Progress> = rays.iter_mut().filter(|p| p.march.goes_on(HIDDEN)).collect();
                if going.is_empty() {
                    break;
                }
                group.samples.clear();
                for p in &mut going {
                    group.samples.trace_on(&tracer, RUN, &mut p.march);
                }
                trainer.field.forward(field, table, features, &trainer.counts, group, None);
                composite_group(group, Vec3::ZERO, weights, composites);
                for (p, run) in going.into_iter().zip(composites.iter()) {
                    p.color += p.march.transmittance * run.color;
                    p.march.pass(run.opacity);
                }
            }
            let shown = |p: &Progress| (p.color + p.march.transmittance * background, 1.0 - p.march.transmittance);
            rays.iter().map(shown).collect()
        })
    }
}

/// Draws the prior's mesh with one colour a vertex.
pub struct PriorRenderer<'a> {
    scene: &'a Scene,
    colors: &'a VertexColors,
}

impl<'a> PriorRenderer<'a> {
    /// Draws `scene`'s body in `colors`.
    pub fn new(scene: &'a Scene, colors: &'a VertexColors) -> Self {
        Self { scene, colors }
    }
}

/// Rays an axis of a pixel that show the mesh's edge as smoothly as the images do.
const SUPERSAMPLING: u32 = 2;

impl Renderer for PriorRenderer<'_> {
    fn render(&mut self, frame: &PreparedFrame, background: Vec3) -> Result<Rendering, Error> {
        let faces = &self.scene.model.faces;
        let mesh = visibility::RayMesh::new(&frame.posed.vertices, faces)?;
        let share = 1.0 / (SUPERSAMPLING * SUPERSAMPLING) as f32;
        paint(
            frame,
            background,
            || (),
            |(), row, columns| {
                columns
                    .map(|column| {
                        let (mut color, mut opacity) = (Vec3::ZERO, 0.0);
                        for sub in 0..SUPERSAMPLING * SUPERSAMPLING {
                            let offset = |i: u32| (i as f32 + 0.5) / SUPERSAMPLING as f32;
                            let (u, v) = (offset(sub % SUPERSAMPLING), offset(sub / SUPERSAMPLING));
                            let ray = frame.camera.ray(column as f32 + u, row as f32 + v);
                            if let Some(hit) = mesh.first_hit(ray.origin, ray.direction) {
                                let corners = faces[hit.face as usize];
                                let weighted = corners.iter().zip(hit.barycentric);
                                color +=
                                    share * weighted.map(|(&v, b)| b * self.colors.colors[v as usize]).sum::<Vec3>();
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

/// Fills a picture row by row inside the body's box; elsewhere it is the background.
fn paint<S>(
    frame: &PreparedFrame,
    background: Vec3,
    scratch: impl Fn() -> S + Sync + Send,
    row: impl Fn(&mut S, u32, std::ops::Range<u32>) -> Vec<(Vec3, f32)> + Sync + Send,
) -> Result<Rendering, Error> {
    let (width, height) = (frame.camera.width, frame.camera.height);
    let [x0, y0, x1, y1] = margin_box(frame);
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
fn margin_box(frame: &PreparedFrame) -> [u32; 4] {
    let [x0, y0, x1, y1] = body_box(frame);
    let room = (y1 - y0).max(x1 - x0) / 8 + 4;
    let (width, height) = (frame.camera.width, frame.camera.height);
    [x0.saturating_sub(room), y0.saturating_sub(room), (x1 + room).min(width), (y1 + room).min(height)]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Config, Method, Preset};

    #[test]
    fn a_picture_drawn_front_to_back_is_that_of_all_samples_at_once() {
        let body = smpl::BodyModel::embedded();
        let demo = crate::capture::DemoConfig { size: 32, frames: 3, eval_cameras: 1, ..Default::default() };
        let capture = crate::capture::demo(&demo, &body).unwrap();
        let mut config = Config { steps: 40, ..Config::preset(Preset::Fast, Method::Occnerf) };
        // Dense enough for rays to end, however little was learnt.
        config.field.density_scale *= 4.0;
        let scene = Scene::new(&capture, &body, &config).unwrap();
        let mut trainer = Trainer::new(&scene, config).unwrap();
        for _ in 0..40 {
            trainer.step().unwrap();
        }
        let (frame, background) = (&scene.eval[0], Vec3::new(0.3, 0.6, 0.9));
        let mut renderer = FieldRenderer::new(&trainer).unwrap();
        let picture = renderer.render(frame, background).unwrap();
        let posed = trainer.corrected(frame);
        renderer.shell = Shell::whole(&scene, &trainer.config);
        renderer.stage.set(&scene, &posed, &renderer.shell, &trainer.config);
        let tracer = trainer.tracer(&renderer.stage, &renderer.shell, frame, &posed);
        let mut all = Scratch::default();
        all.group.samples.clear();
        for pixel in 0..32 * 32 {
            all.group.samples.trace(&tracer, &pixel_ray(frame, pixel));
        }
        let (field, table) = (trainer.parameters.get(Part::Field), trainer.parameters.get(Part::Table));
        trainer.field.forward(field, table, &renderer.code.rows, &trainer.counts, &mut all.group, None);
        composite_group(&all.group, background, &mut all.weights, &mut all.composites);
        let (mut worst, mut solid) = (0.0f32, 0);
        for (pixel, expected) in all.composites.iter().enumerate() {
            let found = Vec3::from_slice(&picture.image.pixels[3 * pixel..]);
            worst = worst.max((found - expected.color).abs().max_element());
            worst = worst.max((picture.opacity[pixel] - expected.opacity).abs());
            solid += usize::from(expected.opacity > 1.0 - HIDDEN);
        }
        assert!(solid > 50, "{solid} rays end early");
        assert!(worst < HIDDEN + 1e-5, "{worst}");
    }
}
