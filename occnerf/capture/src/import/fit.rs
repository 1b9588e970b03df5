//! What all estimators say: people, and for each of their frames a pose, a shape, a place and a
//! camera.

use glam::{DMat3, DQuat, DVec3};

use super::rle::Rle;

/// Joints of SMPL and of SMPL-X.
pub(super) const SMPL: usize = 24;
pub(super) const SMPLX: usize = 55;
/// Shape coefficients that estimators fit.
pub(super) const BETAS: usize = 10;

/// An estimator.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Tool {
    /// WHAM (Shin et al. 2024), `wham_output.pkl`.
    Wham,
    /// 4D-Humans or PHALP (Goel et al. 2023, Rajasegaran et al. 2022), `demo_NAME.pkl`.
    Phalp,
    /// GVHMR (Shen et al. 2024), `hmr4d_results.pt`.
    Gvhmr,
    /// PromptHMR (Wang et al. 2025), `results.pkl`.
    PromptHmr,
    /// ROMP (Sun et al. 2021), `video_results.npz`.
    Romp,
    /// EasyMocap, a folder with `smpl/`, `intri.yml` and `extri.yml`.
    EasyMocap,
    /// PeopleSnapshot (Alldieck et al. 2018) in InstantAvatar's preparation, `poses.npz` with
    /// `cameras.npz`.
    PeopleSnapshot,
    /// A scene of NeuMan (Jiang et al. 2022), `smpl_output_*.pkl` with `alignments.npy` and
    /// `sparse/`.
    NeuMan,
}

impl Tool {
    /// Its name as its authors write it.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Wham => "WHAM",
            Self::Phalp => "4D-Humans / PHALP",
            Self::Gvhmr => "GVHMR",
            Self::PromptHmr => "PromptHMR",
            Self::Romp => "ROMP",
            Self::EasyMocap => "EasyMocap",
            Self::PeopleSnapshot => "PeopleSnapshot",
            Self::NeuMan => "NeuMan",
        }
    }

    /// Joints of the bodies that it fits.
    #[must_use]
    pub fn joints(self) -> usize {
        if self.hands_at_mean().is_some() { SMPLX } else { SMPL }
    }

    /// For SMPL-X, whether the hands rest at the body model's mean rather than flat.
    pub(super) fn hands_at_mean(self) -> Option<bool> {
        match self {
            Self::Gvhmr => Some(true),
            Self::PromptHmr => Some(false),
            _ => None,
        }
    }
}

/// What a file says.
pub(super) struct Fit {
    pub tool: Tool,
    pub people: Vec<Person>,
}

/// One person.
pub(super) struct Person {
    pub id: String,
    /// By index, each once.
    pub frames: Vec<FitFrame>,
    /// Frames in which what the file says is of another frame.
    pub ghosts: usize,
}

/// A person in one frame. Lengths in metres, OpenCV axes.
#[derive(Clone)]
pub(super) struct FitFrame {
    /// Counted from 0.
    pub index: usize,
    /// Axis-angle of each joint that the tool fits, the root's in the world.
    pub pose: Vec<DVec3>,
    pub betas: Vec<f64>,
    /// The world's axes in the camera.
    pub world_to_camera: DMat3,
    /// What the root turns about, and where that leaves the body in the camera.
    pub about: About,
    pub offset: DVec3,
    /// Focal lengths and principal point in pixels of the video.
    pub focal: [f64; 2],
    pub centre: [f64; 2],
    pub mask: Option<OwnMask>,
}

/// Where the pelvis is in the camera, J being its place in the body at rest.
#[derive(Clone, Copy)]
pub(super) enum About {
    /// At J + offset.
    Pelvis,
    /// At turn · J + offset.
    Origin(DMat3),
}

/// A mask that the estimator's file holds.
#[derive(Clone)]
pub(super) enum OwnMask {
    Runs(Rle),
    /// Height, width, pixels row by row.
    Pixels(usize, usize, Vec<bool>),
}

impl FitFrame {
    /// In a camera that stands still: pose and place in its axes, the root turning about the pelvis.
    pub fn still(
        index: usize,
        pose: Vec<DVec3>,
        betas: Vec<f64>,
        place: &[f64],
        [focal, centre]: [[f64; 2]; 2],
    ) -> Self {
        let (world_to_camera, about, offset) = (DMat3::IDENTITY, About::Pelvis, DVec3::from_slice(place));
        Self { index, pose, betas, world_to_camera, about, offset, focal, centre, mask: None }
    }

    /// The pelvis in the camera, for a body whose pelvis at rest is at `joint`.
    pub fn pelvis(&self, joint: DVec3) -> DVec3 {
        match self.about {
            About::Pelvis => joint + self.offset,
            About::Origin(turn) => turn * joint + self.offset,
        }
    }

    /// The same picture by a camera of another focal length: everything is as many times as far
    /// away.
    pub fn refocused(&mut self, focal: f64, joint: DVec3) {
        let before = self.pelvis(joint);
        let ratio = focal / self.focal[0];
        self.offset.z += before.z * (ratio - 1.0);
        self.focal = self.focal.map(|f| f * ratio);
    }
}

/// Axis-angle of a rotation, at most half a turn.
pub(super) fn axis_angle(rotation: DMat3) -> DVec3 {
    let turn = DQuat::from_mat3(&rotation).normalize();
    let turn = if turn.w < 0.0 { -turn } else { turn };
    turn.to_scaled_axis()
}

/// The rotation of an axis-angle.
pub(super) fn rotation(axis: DVec3) -> DMat3 {
    DMat3::from_quat(DQuat::from_scaled_axis(axis))
}
