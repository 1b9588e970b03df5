//! What to import.

use std::path::PathBuf;

/// The files to import, and what they leave open.
#[derive(Clone, Debug, Default)]
pub struct ImportOptions {
    /// Folder of the video's frames, `.png` or `.jpg`, in the order of their names.
    pub frames: PathBuf,
    /// The estimator's file, or EasyMocap's folder.
    pub fit: PathBuf,
    /// The segmenter's folder, or one `.npy` file; `None`: the masks in the fit.
    pub masks: Option<PathBuf>,
    /// The estimator's id of the person; `None`: who is there in most frames.
    pub person: Option<String>,
    /// The person's value in masks of ids, 1 if `None`.
    pub object: Option<u8>,
    /// Values of what stands in front of the person.
    pub occluder_objects: Vec<u8>,
    /// Focal length in pixels in place of the one that the estimator assumed; the body moves so
    /// that the picture stays.
    pub focal: Option<f64>,
    /// The body model; `None`: one that fits, from a folder `body` near the fit or the frames.
    pub body: Option<PathBuf>,
    /// Whether pictures are copied rather than linked.
    pub copy: bool,
}
