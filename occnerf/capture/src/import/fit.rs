//! Fits of all estimators in one form: people with pose, shape, translation and camera per frame.

use std::collections::BTreeMap;

use glam::{DMat3, DQuat, DVec3};

use super::rle::Rle;

/// Joints of SMPL and of SMPL-X.
pub(super) const SMPL: usize = 24;
pub(super) const SMPLX: usize = 55;
/// First joints that SMPL and SMPL-X have alike: all but hands and face.
pub(super) const SHARED: usize = 22;
/// Shape coefficients that estimators fit.
pub(super) const BETAS: usize = 10;
/// Largest |R Rᵀ − I| of a rotation matrix: estimators write `f32`, EasyMocap a few decimals.
pub(super) const ORTHONORMAL: f64 = 1e-2;

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
    /// VIBE (Kocabas et al. 2020), also PyMAF, `vibe_output.pkl`.
    Vibe,
    /// CLIFF (Li et al. 2022), `NAME_cliff_hr48.npz`.
    Cliff,
    /// GLAMR (Yuan et al. 2022), `grecon/NAME_seed1.pkl`.
    Glamr,
    /// ROMP (Sun et al. 2021), `video_results.npz`.
    Romp,
    /// EasyMocap, a folder with `smpl/`, `intri.yml` and `extri.yml`.
    EasyMocap,
    /// PeopleSnapshot (Alldieck et al. 2018) in InstantAvatar's preparation, `poses.npz` with
    /// `cameras.npz`.
    PeopleSnapshot,
    /// GaussianAvatar's (Hu et al. 2024) `smpl_parms.pth` with `cam_parms.npz`.
    GaussianAvatar,
    /// A scene of NeuMan (Jiang et al. 2022), `smpl_output_*.pkl` with `alignments.npy` and
    /// `sparse/`.
    NeuMan,
    /// SAM 3D Body (Yang et al. 2026), its list of dictionaries: points, no body model.
    Sam3dBody,
    /// Joints of any estimator, (T, J, 3): points, no body model.
    Joints,
}

impl Tool {
    /// Its name by its authors.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Wham => "WHAM",
            Self::Phalp => "4D-Humans / PHALP",
            Self::Gvhmr => "GVHMR",
            Self::PromptHmr => "PromptHMR",
            Self::Vibe => "VIBE / PyMAF",
            Self::Cliff => "CLIFF",
            Self::Glamr => "GLAMR",
            Self::Romp => "ROMP",
            Self::EasyMocap => "EasyMocap",
            Self::PeopleSnapshot => "PeopleSnapshot",
            Self::GaussianAvatar => "GaussianAvatar",
            Self::NeuMan => "NeuMan",
            Self::Sam3dBody => "SAM 3D Body",
            Self::Joints => "joints",
        }
    }

    /// Joints of its body model.
    #[must_use]
    pub fn joints(self) -> usize {
        if self.hands_at_mean().is_some() { SMPLX } else { SMPL }
    }

    /// Pelvis at rest of its body model in the mean shape, which translations are relative to;
    /// `None` for points.
    pub(super) fn pelvis(self) -> Option<DVec3> {
        let pelvis = if self.joints() == SMPLX { [0.003, -0.351, 0.012] } else { [-0.002, -0.241, 0.029] };
        (!self.is_points()).then_some(DVec3::from_array(pelvis))
    }

    /// Whether it gives points of the body, to which a body model is fitted.
    #[must_use]
    pub fn is_points(self) -> bool {
        matches!(self, Self::Sam3dBody | Self::Joints)
    }

    /// For SMPL-X, whether the hands have the mean pose rather than a flat one.
    pub(super) fn hands_at_mean(self) -> Option<bool> {
        match self {
            Self::Gvhmr => Some(true),
            Self::PromptHmr => Some(false),
            _ => None,
        }
    }
}

/// The fit of a file.
pub(super) struct Fit {
    pub tool: Tool,
    pub people: Vec<Person>,
    /// Names of the pictures that indices count; `None` where indices count the frames of a video
    /// from 0.
    pub names: Option<Vec<String>>,
}

impl Fit {
    /// A fit whose indices count the frames of a video.
    pub fn of_video(tool: Tool, people: Vec<Person>) -> Self {
        Self { tool, people, names: None }
    }
}

/// One person.
#[derive(Default)]
pub(super) struct Person {
    pub id: String,
    /// By index, each once.
    pub frames: Vec<FitFrame>,
    /// Frames with stale values of another frame.
    pub ghosts: usize,
    /// Frames whose picture is absent.
    pub absent: usize,
    /// Vertices of SAM 3D Body's mesh, a subset of them after each frame's points; 0 without a
    /// mesh.
    pub vertices: usize,
}

impl Person {
    pub fn new(id: impl ToString, frames: impl IntoIterator<Item = FitFrame>) -> Self {
        Self { id: id.to_string(), frames: frames.into_iter().collect(), ..Self::default() }
    }
}

/// People by their ids in a file.
#[derive(Default)]
pub(super) struct People(BTreeMap<i64, Person>);

impl People {
    /// The person of an id.
    pub fn get(&mut self, id: i64) -> &mut Person {
        self.0.entry(id).or_insert_with(|| Person::new(id, []))
    }

    pub fn into_vec(self) -> Vec<Person> {
        self.0.into_values().collect()
    }
}

/// Focal lengths and principal point, pixels.
pub(super) type Lens = [[f64; 2]; 2];

/// The lens of a calibration matrix, row by row.
pub(super) fn pinhole(k: &[f64]) -> Lens {
    [[k[0], k[4]], [k[2], k[5]]]
}

/// A person in one frame. Lengths in metres, OpenCV axes.
#[derive(Clone, Default)]
pub(super) struct FitFrame {
    /// Counted from 0.
    pub index: usize,
    /// Axis-angle of each fitted joint, the root's in the world.
    pub pose: Vec<DVec3>,
    pub betas: Vec<f64>,
    /// The world's axes in the camera.
    pub world_to_camera: DMat3,
    /// Centre of the root's rotation, and translation in the camera.
    pub about: About,
    pub offset: DVec3,
    /// Focal lengths and principal point in pixels of the video.
    pub focal: [f64; 2],
    pub centre: [f64; 2],
    pub mask: Option<OwnMask>,
    /// Points of the body in the camera, NaN where missing, of a fit without pose.
    pub points: Vec<DVec3>,
}

/// Position of the pelvis in the camera, for its rest position J.
#[derive(Clone, Copy, Default)]
pub(super) enum About {
    /// At J + offset.
    #[default]
    Pelvis,
    /// At turn · J + offset.
    Origin(DMat3),
    /// At offset.
    Place,
}

/// A mask in the estimator's file.
#[derive(Clone)]
pub(super) enum OwnMask {
    Runs(Rle),
    /// Height, width, pixels row by row.
    Pixels(usize, usize, Vec<bool>),
}

impl FitFrame {
    /// For a static camera: axis-angle of each joint, shape coefficients and translation side by
    /// side, in its axes, rotation about the pelvis.
    pub fn still(index: usize, row: &[f64], [focal, centre]: Lens) -> Self {
        let (pose, rest) = row.split_at(row.len().saturating_sub(BETAS + 3));
        let (betas, place) = rest.split_at(BETAS);
        let (pose, offset) = (vectors(pose), DVec3::from_slice(place));
        Self { index, pose, betas: betas.to_vec(), offset, focal, centre, ..Self::default() }
    }

    /// The pelvis in the camera, for a body whose pelvis at rest is at `joint`.
    pub fn pelvis(&self, joint: DVec3) -> DVec3 {
        match self.about {
            About::Pelvis => joint + self.offset,
            About::Origin(turn) => turn * joint + self.offset,
            About::Place => self.offset,
        }
    }

    /// Changes the focal length and scales the depth with it.
    pub fn refocused(&mut self, focal: f64, joint: DVec3) {
        let ratio = focal / self.focal[0];
        self.offset.z += self.pelvis(joint).z * (ratio - 1.0);
        self.focal = self.focal.map(|f| f * ratio);
    }
}

/// Groups of three numbers.
pub(super) fn vectors(values: &[f64]) -> Vec<DVec3> {
    values.chunks_exact(3).map(DVec3::from_slice).collect()
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
