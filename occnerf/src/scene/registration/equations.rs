//! What a frame asks of its pose and of the shape: that outlines and colours agree.

use glam::Vec3;
use smpl::{BodyModel, Posed, Shaped};
use volrender::Camera;

use crate::scene::registration::colors::Colors;
use crate::scene::registration::sight::{Edge, Sight};
use crate::scene::registration::system::Normal;
use crate::scene::registration::unknowns::{Motion, Motions};

/// Change of a coefficient that its derivatives are taken by.
pub(super) const BETA_STEP: f32 = 0.5;
/// Standard deviation of an outline: pixels, and metres by which clothes hang differently.
const OUTLINE: [f32; 2] = [0.6, 0.006];
/// Pixels of an outline that tell the same.
const CORRELATED: f32 = 3.0;
/// Weight of the colours against their noise: most of what is left is not noise but what one colour
/// a vertex cannot say.
const COLOR: f32 = 0.1;

/// What is not known of how far away the body is: its inverse depth, of which the part `nearness`
/// is left, while the focal length keeps its picture as large as it is.
#[derive(Clone, Copy, Debug)]
pub(super) struct Perspective {
    pub nearness: f32,
    /// Depth of the root before that.
    pub depth: f32,
}

impl Perspective {
    /// How the picture of a point moves with `nearness`, as a shift of the point in the world.
    pub fn of(&self, camera: &Camera, point: Vec3) -> Vec3 {
        let at = camera.world_to_camera.transform_point3(point);
        let share = (self.depth / self.nearness - at.z) / (self.nearness * at.z);
        camera.world_to_camera.matrix3.transpose() * (share * at.with_z(0.0))
    }
}

/// The equations of a frame, as they are put together.
pub(super) struct Equations<'a> {
    posed: &'a Posed,
    /// The camera, where its focal length is not known.
    perspective: Option<(Perspective, Camera)>,
    /// The body with [`BETA_STEP`] more of each shape coefficient.
    reshaped: Vec<Posed>,
    motions: Motions<'a>,
    motion: Motion,
    row: Vec<f64>,
    pub normal: Normal,
}

impl<'a> Equations<'a> {
    /// Of a body in the pose `posed` of `shape`; `reshaped` has [`BETA_STEP`] more of each shape
    /// coefficient, `camera` is the frame's. Shared are the shape and, if there is one, the
    /// perspective.
    pub fn new(
        model: &'a BodyModel,
        (shape, posed): (&'a Shaped, &'a Posed),
        reshaped: Vec<Posed>,
        camera: &Camera,
        perspective: Option<(Perspective, Camera)>,
    ) -> Self {
        let shared = reshaped.len() + usize::from(perspective.is_some());
        let normal = Normal::new(3 * (model.num_joints() + 1), shared);
        let motions = Motions::new(model, &shape.vertices, posed, camera);
        Self { posed, perspective, reshaped, motions, motion: Motion::default(), row: Vec::new(), normal }
    }

    /// Looks how a vertex moves, for [`Equations::add`].
    fn at(&mut self, v: usize) {
        let Self { motions, motion, reshaped, posed, perspective, normal, .. } = self;
        motions.of(v, motion);
        for (k, more) in reshaped.iter().enumerate() {
            motion.columns.push((normal.own + k) as u32);
            motion.directions.push((more.vertices[v] - posed.vertices[v]) / BETA_STEP);
        }
        if let Some((perspective, camera)) = perspective {
            motion.columns.push((normal.own + reshaped.len()) as u32);
            motion.directions.push(perspective.of(camera, posed.vertices[v]));
        }
    }

    /// Adds a residual and its derivatives by the place of the vertex and as the surface turns there.
    fn add(&mut self, weight: f32, residual: f32, slope: Vec3, turned: Vec3) {
        let Self { motion, row, normal, .. } = self;
        row.clear();
        row.extend(motion.directions.iter().map(|d| f64::from(d.dot(slope))));
        for (column, turn) in motion.turns() {
            row[column] += f64::from(turn.dot(turned));
        }
        normal.add(f64::from(weight), f64::from(residual), &motion.columns, row);
    }

    /// Asks for outlines where the mask ends, in clothes that become thicker by `thicker` (V).
    /// `unit` is the length of a metre of a body 1.7 high.
    pub fn align_outline(&mut self, sight: &Sight, thicker: &[f32], unit: f32) {
        // As many pixels as a body of this area has around it.
        let around = 3.5 * (sight.area as f32).sqrt();
        let alone = (around / (CORRELATED * sight.edges.len().max(1) as f32)).min(1.0);
        for &Edge { vertex, distance, slope, scale } in &sight.edges {
            let v = vertex as usize;
            let residual = thicker[v] * scale - distance;
            let noise = OUTLINE[0] + OUTLINE[1] * unit * scale;
            self.at(v);
            self.add(alone * robust(residual * residual, noise) / (noise * noise), residual, slope, Vec3::ZERO);
        }
    }

    /// Asks for the colours that all frames agree on, under a blur of `blur` pixels.
    pub fn align_colors(&mut self, sight: &Sight, colors: &Colors, blur: f32) {
        // Vertices closer than the blur see the same.
        let density = sight.seen.len() as f32 / sight.area.max(1) as f32;
        let alone = (4.0 * std::f32::consts::PI * blur * blur * density).max(1.0).recip();
        for (seen, slope) in sight.seen.iter().zip(&sight.slopes) {
            let Some(error) = colors.error(seen) else { continue };
            let squared = colors.noise * colors.noise;
            let weight = COLOR * alone * robust(error.length_squared(), colors.noise) / squared;
            self.at(seen.0 as usize);
            let turned = colors.turned(seen);
            (0..3).for_each(|c| self.add(weight, error[c], slope[c], turned[c]));
        }
    }
}

/// The weight of a residual far beyond its standard deviation (Geman and McClure 1985).
fn robust(squared: f32, noise: f32) -> f32 {
    (1.0 + squared / (9.0 * noise * noise)).powi(-2)
}
