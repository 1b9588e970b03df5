//! What is looked at in a frame, and what can be wrong with it.

use volrender::Camera;

/// Something wrong with one frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Fault {
    /// The mask shows nobody.
    EmptyMask,
    /// The silhouette and the mask overlap too little.
    Overlap,
    /// The body moves much further than between other frames.
    PlaceJump,
    /// Joints turn much further than between other frames.
    PoseJump,
}

impl Fault {
    /// A few words for tables.
    #[must_use]
    pub fn words(self) -> &'static str {
        match self {
            Self::EmptyMask => "mask empty",
            Self::Overlap => "does not fit",
            Self::PlaceJump => "jump of place or camera",
            Self::PoseJump => "jump of pose",
        }
    }
}

/// A frame's mask, small.
pub(super) struct View {
    pub index: usize,
    pub camera: Camera,
    pub mask: Vec<bool>,
    pub occluder: Option<Vec<bool>>,
}
