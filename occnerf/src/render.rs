//! Whole pictures of a trained person, or of the prior.

use glam::Vec3;
use rayon::prelude::*;
use smpl::Posed;
use volrender::{Camera, Composite};

use crate::Error;
use crate::batch::body_box;
use crate::data::Image;
use crate::field::Group;
use crate::parameters::Part;
use crate::prior::VertexColors;
use crate::samples::Stage;
use crate::scene::{PreparedFrame, Scene};
use crate::trainer::{Trainer, composite_group, pixel_ray};
use crate::vertices::VertexCode;

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
    stage: Stage,
}

impl<'a> FieldRenderer<'a> {
    /// Encodes the vertices once for every picture to come.
    pub fn new(trainer: &'a Trainer<'a>) -> Result<Self, Error> {
        let mut code = VertexCode::default();
        trainer.encode_vertices(&mut code);
        Ok(Self { trainer, code, stage: Stage::new(trainer.scene)? })
    }
}

#[derive(Default)]
struct Scratch {
    group: Group,
    weights: Vec<f32>,
    composites: Vec<Composite>,
}

impl Renderer for FieldRenderer<'_> {
    fn render(&mut self, frame: &PreparedFrame, background: Vec3) -> Result<Rendering, Error> {
        let trainer = self.trainer;
        let posed = trainer.corrected(frame);
        self.stage.set(trainer.scene, &posed, &trainer.config);
        let tracer = trainer.tracer(&self.stage, frame, &posed);
        let (field, table) = (trainer.parameters.get(Part::Field), trainer.parameters.get(Part::Table));
        let features = &self.code.features;
        paint(frame, background, Scratch::default, |scratch, row, columns| {
            scratch.group.samples.clear();
            for column in columns {
                let ray = pixel_ray(frame, row * frame.camera.width + column);
                scratch.group.samples.trace(&tracer, &ray, None);
            }
            trainer.field.forward(field, table, features, &trainer.counts, &mut scratch.group);
            composite_group(&scratch.group, background, &mut scratch.weights, &mut scratch.composites);
            scratch.composites.iter().map(|c| (c.color, c.opacity)).collect()
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
    let mut pixels: Vec<f32> = (0..width * height).flat_map(|_| background.to_array()).collect();
    let mut opacity = vec![0.0; (width * height) as usize];
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
