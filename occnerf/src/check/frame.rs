//! Downsampled frames, and their faults.

use volrender::Camera;

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
    /// The mask reaches farther from the body than clothes, and no limb explains it: background, or a thing held.
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
    pub(super) fn joints(self) -> [&'static str; 2] {
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
