//! The rest pose in the units that clothes are cut in.

use glam::Vec3;
use smpl::Shaped;

/// Height in metres of the figure that all measures of the demo's clothes are meant for.
const FIGURE_HEIGHT: f32 = 1.695;

/// SMPL's joints, by index.
pub(crate) mod joint {
    pub const PELVIS: usize = 0;
    pub const LEFT_HIP: usize = 1;
    pub const RIGHT_HIP: usize = 2;
    pub const SPINE: [usize; 3] = [3, 6, 9];
    pub const LEFT_KNEE: usize = 4;
    pub const RIGHT_KNEE: usize = 5;
    pub const LEFT_ANKLE: usize = 7;
    pub const RIGHT_ANKLE: usize = 8;
    pub const NECK: usize = 12;
    pub const HEAD: usize = 15;
    pub const LEFT_SHOULDER: usize = 16;
    pub const RIGHT_SHOULDER: usize = 17;
    pub const LEFT_ELBOW: usize = 18;
    pub const RIGHT_ELBOW: usize = 19;
    /// How many there are.
    pub const COUNT: usize = 24;
}

/// Where the parts of a figure are, with its pelvis at the origin and 1.695 m tall. Left and right
/// are alike.
#[derive(Clone, Copy, Debug)]
pub(super) struct Landmarks {
    /// Length of one figure metre in the body model's unit.
    pub unit: f32,
    pelvis: Vec3,
    /// Where the spine passes the chest.
    pub chest: Vec3,
    pub neck: Vec3,
    pub head: Vec3,
    /// Distance from the head joint to the crown relative to that of the figure the face was drawn
    /// for.
    pub face: f32,
    /// Distances from the middle plane.
    pub shoulder_x: f32,
    pub elbow_x: f32,
    pub wrist_x: f32,
    wrist_y: f32,
    pub knee: Vec3,
    pub ankle: Vec3,
    pub hip: Vec3,
}

impl Landmarks {
    /// From a body in SMPL's T-pose: y up, arms along x.
    pub fn new(shaped: &Shaped) -> Self {
        let low = shaped.vertices.iter().map(|v| v.y).fold(f32::INFINITY, f32::min);
        let high = shaped.vertices.iter().map(|v| v.y).fold(f32::NEG_INFINITY, f32::max);
        let unit = (high - low) / FIGURE_HEIGHT;
        let pelvis = shaped.joints[joint::PELVIS];
        let at = |j: usize| (shaped.joints[j] - pelvis) / unit;
        let head = at(joint::HEAD);
        Self {
            unit,
            pelvis,
            chest: at(joint::SPINE[2]),
            neck: at(joint::NECK),
            head,
            face: ((high - pelvis.y) / unit - head.y) / 0.195,
            shoulder_x: at(joint::LEFT_SHOULDER).x,
            elbow_x: at(joint::LEFT_ELBOW).x,
            wrist_x: at(joint::LEFT_ELBOW + 2).x,
            wrist_y: at(joint::LEFT_ELBOW + 2).y,
            knee: at(joint::LEFT_KNEE),
            ankle: at(joint::LEFT_ANKLE),
            hip: at(joint::LEFT_HIP),
        }
    }

    /// Where a point of a flat hand, figure metres, is in a fist: fingers roll up below the
    /// knuckles.
    pub fn fist(&self, q: Vec3) -> Vec3 {
        const KNUCKLES: f32 = 0.09;
        const RADIUS: f32 = 0.025;
        let along = q.x.abs() - self.wrist_x - KNUCKLES;
        if along <= 0.0 {
            return q;
        }
        let (angle, from_axis) = (along / RADIUS, RADIUS + q.y - self.wrist_y);
        let x = self.wrist_x + KNUCKLES + from_axis * angle.sin();
        Vec3::new(x.copysign(q.x), self.wrist_y - RADIUS + from_axis * angle.cos(), q.z)
    }

    /// A point of the rest pose in figure metres.
    pub fn figure(&self, rest: Vec3) -> Vec3 {
        (rest - self.pelvis) / self.unit
    }

    /// A point in figure metres in the rest pose.
    pub fn rest(&self, figure: Vec3) -> Vec3 {
        self.pelvis + self.unit * figure
    }
}
