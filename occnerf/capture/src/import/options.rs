//! The files of an import, and its options.

use std::path::PathBuf;

/// The files of an import, and its options.
///
/// ```
/// use capture::{ImportOptions, import};
///
/// let options = ImportOptions { frames: "frames".into(), fit: "wham_output.pkl".into(), ..Default::default() };
/// let error = import(&options, "capture".as_ref()).unwrap_err();
/// assert!(error.to_string().starts_with("frames: "));
/// ```
#[derive(Clone, Debug, Default)]
pub struct ImportOptions {
    /// Folder of the video's frames, `.png` or `.jpg`, in the order of their names.
    pub frames: PathBuf,
    /// The estimator's file, or EasyMocap's folder.
    pub fit: PathBuf,
    /// The segmenter's folder, or one `.npy` or `.npz` file; `None`: the masks in the fit, or the
    /// alpha channels of the frames.
    pub masks: Option<PathBuf>,
    /// The estimator's id of the person; `None`: the one in most frames.
    pub person: Option<String>,
    /// The person's value in masks of object ids, 1 if `None`.
    pub object: Option<u32>,
    /// Values of the occluders.
    pub occluder_objects: Vec<u32>,
    /// Focal length in pixels replacing the estimator's; the body is moved in depth to keep its
    /// size in the image.
    pub focal: Option<f64>,
    /// The body model; `None`: one that fits, from a folder `body` near the fit or the frames.
    pub body: Option<PathBuf>,
    /// Joint set of a fit that is an array of joints, one of [`point_fit::joint_sets`].
    pub joints: Option<String>,
    /// Points of the body that SAM 3D Body's `pred_vertices` lie on: `triangle_ids` (V) and
    /// `baryc_coords` (V,3) in its faces, as `smpl2mhr_mapping.npz` of MHR has them; those of the
    /// open body are known.
    pub vertex_map: Option<PathBuf>,
    /// 2-D key points of a detector: OpenPose's folder, or an array (T, J, 3) of one person.
    pub keypoints: Option<PathBuf>,
    /// Whether pictures are copied rather than linked.
    pub copy: bool,
}
