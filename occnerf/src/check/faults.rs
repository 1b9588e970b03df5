//! Downsampled frames and their faults: mask pixels that the fit does not explain (limbs elsewhere,
//! or masks that show more than the person), and temporal outliers of a fit.

use glam::{Quat, Vec2, Vec3};
use smpl::{BodyModel, BoneNames, Posed};
use volrender::Camera;

use crate::capture::{Capture, Frame};
use crate::scene::labels::squared_distance;

/// A fault of one frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Fault {
    /// The mask is empty.
    EmptyMask,
    /// The silhouette and the mask overlap too little.
    Overlap,
    /// The translation of the body is an outlier.
    PlaceJump,
    /// The rotations of half of the joints are outliers.
    PoseJump,
    /// The mask shows a limb elsewhere.
    Limb(Limb),
    /// The mask reaches farther from the body than clothes, and no limb explains it: background, or
    /// a thing held.
    Background,
}

impl Fault {
    /// Short name for tables.
    #[must_use]
    pub fn words(self) -> &'static str {
        match self {
            Self::EmptyMask => "mask empty",
            Self::Overlap => "does not fit",
            Self::PlaceJump => "jump of place or camera",
            Self::PoseJump => "jump of pose",
            Self::Limb(limb) => limb.words_elsewhere(),
            Self::Background => "mask beyond the body",
        }
    }
}

/// A limb, of the person's own left or right.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Limb {
    /// From the shoulder.
    LeftArm,
    /// From the shoulder.
    RightArm,
    /// From the hip.
    LeftLeg,
    /// From the hip.
    RightLeg,
}

impl Limb {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::LeftArm, Self::RightArm, Self::LeftLeg, Self::RightLeg];

    fn words_elsewhere(self) -> &'static str {
        ["left arm elsewhere", "right arm elsewhere", "left leg elsewhere", "right leg elsewhere"][self as usize]
    }

    /// Names of the joints that it turns at.
    fn joints(self) -> [&'static str; 2] {
        match self {
            Self::LeftArm => ["left_shoulder", "left_elbow"],
            Self::RightArm => ["right_shoulder", "right_elbow"],
            Self::LeftLeg => ["left_hip", "left_knee"],
            Self::RightLeg => ["right_hip", "right_knee"],
        }
    }
}

/// A downsampled frame.
pub(super) struct View {
    pub index: usize,
    pub camera: Camera,
    pub mask: Vec<bool>,
    pub occluder: Option<Vec<bool>>,
}

/// Distance of close clothes from the silhouette, and largest distance of clothes and hair, metres.
const CLOSE: f32 = 0.05;
const REACH: f32 = 0.1;
/// Least share of the mask beyond it that is a fault.
const BEYOND: f32 = 0.01;
/// Least share of these pixels that a rotated limb has to explain.
const EXPLAINED: f32 = 0.9;
/// Least share of a limb outside the mask for it to be elsewhere.
const OUTSIDE: f32 = 0.5;
/// Directions that limbs are rotated to, and most vertices and pixels that are compared.
const DIRECTIONS: usize = 48;
const SAMPLES: usize = 96;

/// A limb from one of its joints on.
pub(super) struct Part {
    limb: Limb,
    joint: usize,
    vertices: Vec<usize>,
}

/// The parts of a body's limbs; none where the skeleton is not SMPL's.
pub(super) fn parts(body: &BodyModel) -> Vec<Part> {
    let names = BoneNames::Smpl.of_body(body.parents.len());
    let heaviest: Vec<usize> = (0..body.num_vertices()).map(|v| body.weights.heaviest(v).unwrap_or(0)).collect();
    let part = |limb: Limb, name: &str| {
        let joint = names.iter().position(|other| other == name)?;
        let mut moves = vec![false; names.len()];
        for j in joint..names.len() {
            moves[j] = j == joint || body.parents[j].is_some_and(|parent| moves[parent]);
        }
        let all: Vec<usize> = (0..heaviest.len()).filter(|&v| moves[heaviest[v]]).collect();
        let vertices: Vec<usize> = all.iter().copied().step_by(all.len().div_ceil(SAMPLES).max(1)).collect();
        (!vertices.is_empty()).then_some(Part { limb, joint, vertices })
    };
    Limb::ALL.into_iter().flat_map(|limb| limb.joints().map(|name| part(limb, name))).flatten().collect()
}

/// Share of the mask beyond close clothes of the body's `outline`, and the fault of a frame whose
/// mask reaches farther than clothes do. `metre`: pixels of a metre at the body's depth. A limb is
/// elsewhere if that part of the mask lies where the limb would be, rotated about a joint of its
/// own.
pub(super) fn beyond(view: &View, outline: &[bool], posed: &Posed, parts: &[Part], metre: f32) -> (f32, Option<Fault>) {
    let width = view.camera.width as usize;
    let far = squared_distance(outline, width);
    let beyond = |reach: f32| -> Vec<usize> { (0..far.len()).filter(|&i| view.mask[i] && far[i] > reach).collect() };
    let mask = view.mask.iter().filter(|mask| **mask).count().max(1) as f32;
    let reach = (REACH * metre).powi(2);
    let (close, beyond) = (beyond((CLOSE * metre).powi(2)), beyond(reach));
    let fault = (beyond.len() as f32 > BEYOND * mask).then(|| fault(view, &beyond, posed, parts, reach));
    (close.len() as f32 / mask, fault)
}

fn fault(view: &View, beyond: &[usize], posed: &Posed, parts: &[Part], reach: f32) -> Fault {
    let width = view.camera.width as usize;
    let pixels: Vec<Vec2> = beyond
        .iter()
        .step_by(beyond.len().div_ceil(SAMPLES))
        .map(|i| Vec2::new((i % width) as f32 + 0.5, (i / width) as f32 + 0.5))
        .collect();
    let fit = |part: &Part, turn: Quat| {
        let joint = posed.joints[part.joint];
        let moved = part.vertices.iter().map(|&v| joint + turn * (posed.vertices[v] - joint));
        let at: Vec<Vec2> = moved.filter_map(|vertex| Some(view.camera.project(vertex)?.truncate())).collect();
        let explained = pixels.iter().filter(|pixel| at.iter().any(|at| at.distance_squared(**pixel) < reach)).count();
        let outside = at.iter().filter(|at| !view.shows(**at)).count();
        (explained as f32 / pixels.len() as f32, outside as f32 / at.len().max(1) as f32)
    };
    let mut best: Option<(f32, Limb)> = None;
    for part in parts {
        let joint = posed.joints[part.joint];
        let mean = part.vertices.iter().map(|&v| posed.vertices[v] - joint).sum::<Vec3>().normalize_or(Vec3::Y);
        let (_, outside) = fit(part, Quat::IDENTITY);
        if outside < OUTSIDE {
            continue;
        }
        for direction in (0..DIRECTIONS).map(direction) {
            let (explained, then) = fit(part, Quat::from_rotation_arc(mean, direction));
            let gain = explained + outside - then;
            if explained >= EXPLAINED && best.is_none_or(|(most, _)| gain > most) {
                best = Some((gain, part.limb));
            }
        }
    }
    best.map_or(Fault::Background, |(_, limb)| Fault::Limb(limb))
}

/// Directions of equal density over the sphere (a Fibonacci lattice).
fn direction(i: usize) -> Vec3 {
    let z = 1.0 - (2 * i + 1) as f32 / DIRECTIONS as f32;
    let (sin, cos) = (i as f32 * 2.399_963).sin_cos();
    let radius = (1.0 - z * z).sqrt();
    Vec3::new(radius * cos, radius * sin, z)
}

/// Least lateral jump of the pelvis in multiples of the farthest joint's distance from it, least
/// logarithmic jump of its depth, least jump of the rotation of half of the joints, radians.
const LEAST_JUMPS: [f32; 3] = [0.35, 0.25, 0.5];
/// Least ratios of jumps to the median step.
const TIMES: [f32; 3] = [8.0, 8.0, 5.0];

/// The jumps of each frame from the previous one.
pub(super) fn jumps(capture: &Capture, body: &BodyModel) -> Vec<Vec<Fault>> {
    let states: Vec<State> = capture.train.iter().map(|frame| State::of(frame, body)).collect();
    let steps: Vec<[f32; 3]> = states.windows(2).map(|pair| pair[0].step(&pair[1])).collect();
    let median = |i: usize| {
        let mut values: Vec<f32> = steps.iter().map(|step| step[i]).collect();
        values.sort_by(f32::total_cmp);
        values.get(values.len() / 2).copied().unwrap_or(0.0)
    };
    let limits = [0, 1, 2].map(|i| LEAST_JUMPS[i].max(TIMES[i] * median(i)));
    let faults = |step: &[f32; 3]| {
        let mut faults = Vec::new();
        // A pelvis behind the camera gives NaN; comparisons with it are false.
        if step[0] > limits[0] || step[1] > limits[1] {
            faults.push(Fault::PlaceJump);
        }
        if step[2] > limits[2] {
            faults.push(Fault::PoseJump);
        }
        faults
    };
    let first = if states.is_empty() { None } else { Some(Vec::new()) };
    first.into_iter().chain(steps.iter().map(faults)).collect()
}

/// A body in its camera.
struct State {
    pelvis: Vec3,
    reach: f32,
    bones: Vec<Quat>,
}

impl State {
    fn of(frame: &Frame, body: &BodyModel) -> Self {
        let posed = body.pose(&body.shaped(&frame.betas), &frame.pose, frame.placement);
        let camera = frame.camera.world_to_camera;
        let turn = |bone: &glam::Affine3A| Quat::from_mat3a(&(camera.matrix3 * bone.matrix3));
        let pelvis = posed.joints.first().copied().unwrap_or(Vec3::ZERO);
        let reach = posed.joints.iter().map(|joint| joint.distance(pelvis)).fold(f32::MIN_POSITIVE, f32::max);
        Self { pelvis: camera.transform_point3(pelvis), reach, bones: posed.bones.iter().map(turn).collect() }
    }

    /// Lateral and depth step of the pelvis, and the median rotation of the joints.
    fn step(&self, next: &Self) -> [f32; 3] {
        let direction = |p: Vec3| p.truncate() / p.z;
        let across = direction(self.pelvis).distance(direction(next.pelvis)) * self.pelvis.z / self.reach;
        let depth = (next.pelvis.z / self.pelvis.z).ln().abs();
        let mut turns: Vec<f32> = self.bones.iter().zip(&next.bones).map(|(a, b)| a.angle_between(*b)).collect();
        turns.sort_by(f32::total_cmp);
        [across, depth, turns.get(turns.len() / 2).copied().unwrap_or(0.0)]
    }
}
