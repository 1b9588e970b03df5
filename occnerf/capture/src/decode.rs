//! Planned frames, memory budget, and decoding, for all layouts.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::Vec2;
use rayon::prelude::*;
use smpl::BodyModel;

use super::checks::{self, Fitted};
use super::files::{Files, FrameFiles, decoding_bytes};
use super::gate::Gate;
use super::image::dimensions;
use super::pictures::file_name;
use super::source::{Allowance, PixelSource};
use super::{Capture, CaptureError, EvalFrame, Frame, Keypoint, LoadOptions};

/// Bytes per pixel of a frame: three colours and coverage.
pub const PIXEL_BYTES: u64 = 16;
/// Bytes per vertex of a prepared body: pose offset and posed position.
const VERTEX_BYTES: u64 = 24;
/// Ratio of the bytes of a training frame's pixels to its labels', 3 bits a pixel.
const LABELS_SHARE: u64 = 42;

/// A frame whose pictures have not been read.
pub(super) struct Planned {
    pub name: String,
    pub files: FrameFiles,
    pub body: Fitted,
    /// In pixels of the files.
    pub keypoints: Vec<Keypoint>,
}

/// Memory for packed pictures and for decoding.
struct Budget {
    kept: Arc<Allowance>,
    gate: Arc<Gate>,
}

impl Budget {
    /// Splits `left` bytes: `picture` for each thread's decoding, at most a quarter of all unless a
    /// single picture takes more, and the rest for packed pictures.
    fn new(left: u64, picture: u64) -> Self {
        let threads = rayon::current_num_threads() as u64;
        let aside = (picture.saturating_mul(threads)).min(left / 4).max(picture);
        Self { kept: Arc::new(Allowance::new(left.saturating_sub(aside))), gate: Arc::new(Gate::new(aside)) }
    }
}

/// The frames of one camera, all of one size.
pub(super) struct View {
    frames: Vec<Planned>,
    size: (u32, u32),
    /// Named in errors about all masks and about all cameras.
    masks: PathBuf,
    cameras: PathBuf,
}

impl View {
    /// `masks` and `cameras` are named in errors about all frames. There must be a frame.
    pub fn new(frames: Vec<Planned>, masks: &Path, cameras: &Path) -> Result<Self, CaptureError> {
        let first = frames.first().ok_or_else(|| CaptureError::invalid(cameras, "all frames", "a frame", "none"))?;
        let size = dimensions(&first.files.image)?;
        Ok(Self { frames, size, masks: masks.to_owned(), cameras: cameras.to_owned() })
    }

    /// Bytes of a frame's pixels.
    fn picture_bytes(&self, options: &LoadOptions) -> u64 {
        let (width, height) = options.resized(self.size);
        u64::from(width) * u64::from(height) * PIXEL_BYTES
    }

    /// The frames, checked together. Pictures within `budget` are decoded; of the others, headers
    /// are checked.
    fn frames(self, body: &BodyModel, options: &LoadOptions, budget: &Budget) -> Result<Vec<Frame>, CaptureError> {
        let first = Arc::from(self.frames[0].name.as_str());
        let (size, to) = (self.size, options.resized(self.size));
        let frame = |plan: Planned| {
            let Planned { name, files, body, mut keypoints } = plan;
            let Fitted { pose, placement, betas } = body;
            let scale = Vec2::new(to.0 as f32 / size.0 as f32, to.1 as f32 / size.1 as f32);
            keypoints.iter_mut().for_each(|point| point.place *= scale);
            let (first, gate) = (Arc::clone(&first), Arc::clone(&budget.gate));
            let files = Files { of: files, size, to, first, gate };
            let camera = files.camera().resized(to.0, to.1);
            let source = PixelSource::on_disk(files, Arc::clone(&budget.kept));
            Frame { name, source, camera, pose, placement, betas, keypoints }
        };
        let frames: Vec<Frame> = self.frames.into_iter().map(frame).collect();
        // Collected as results first: the first error in order is reported.
        let checked: Vec<Result<(), CaptureError>> = frames.par_iter().map(|f| f.source.check()).collect();
        checked.into_iter().collect::<Result<(), CaptureError>>()?;
        checks::subject_is_seen(&self.masks, &frames)?;
        if !options.unseen {
            checks::body_is_seen(&self.cameras, &frames, body)?;
        }
        Ok(frames)
    }
}

/// An evaluation view, with camera name and training index of each frame.
pub(super) type EvalView = (View, Vec<(String, usize)>);

/// Decodes all views within [`LoadOptions::max_bytes`]. `mean_betas` are by default those of the
/// training frames.
pub(super) fn capture(
    dir: &Path,
    train: View,
    eval: Vec<EvalView>,
    mean_betas: Option<Vec<f32>>,
    body: &BodyModel,
    options: &LoadOptions,
) -> Result<Capture, CaptureError> {
    let (eval, indices): (Vec<View>, Vec<_>) = eval.into_iter().unzip();
    let budget = budget(&train, &eval, body, options)?;
    let train = train.frames(body, options, &budget)?;
    let mut frames = Vec::new();
    for (view, indices) in eval.into_iter().zip(indices) {
        let each = view.frames(body, options, &budget)?.into_iter().zip(indices);
        frames.extend(each.map(|(frame, (camera_name, train_index))| EvalFrame { camera_name, train_index, frame }));
    }
    let mean_betas = mean_betas.unwrap_or_else(|| checks::mean_betas(train.iter().map(|f| f.betas.as_slice())));
    Ok(Capture { name: file_name(dir), train, eval: frames, mean_betas })
}

/// Budget for pixels within [`LoadOptions::max_bytes`] beside the bodies of all views. Errors if no
/// picture can be decoded in that, naming options that fit.
fn budget(train: &View, eval: &[View], body: &BodyModel, options: &LoadOptions) -> Result<Budget, CaptureError> {
    let limit = options.max_bytes;
    let body_bytes = body.num_vertices() as u64 * VERTEX_BYTES;
    let views = || std::iter::once(train).chain(eval);
    // Bytes of bodies and labels, for every n-th training frame and every m-th evaluation view.
    let kept = |n: usize, m: usize| {
        let (frames, views) =
            (train.frames.len().div_ceil(n), eval.iter().map(|v| v.frames.len().div_ceil(m)).sum::<usize>());
        (frames + views) as u64 * body_bytes + frames as u64 * train.picture_bytes(options).div_ceil(LABELS_SHARE)
    };
    let bodies = kept(1, 1);
    let picture = views().map(|view| decoding_bytes(view.size)).max().unwrap_or(0);
    if bodies + picture <= limit {
        return Ok(Budget::new(limit - bodies, picture));
    }
    let mut ways = Vec::new();
    let longest = views().map(|view| view.frames.len()).max().unwrap_or(1);
    let fits = |n: usize, m: usize| kept(n, m) + picture <= limit;
    if let Some(n) = (2..=longest).find(|&n| fits(n, n)) {
        match options.max_frames {
            Some(_) => ways.push(format!("max_frames {}", train.frames.len().div_ceil(n))),
            None => ways.push(format!("stride {}", n.saturating_mul(options.stride))),
        }
    }
    if let Some(m) = (2..=longest).find(|&m| !eval.is_empty() && fits(1, m)) {
        ways.push(format!("eval_stride {}", m.saturating_mul(options.eval_stride)));
    }
    let mebibytes = |bytes: u64| bytes.div_ceil(1 << 20);
    ways.push(format!("memory {}", mebibytes(bodies + picture)));
    let frames: usize = views().map(|view| view.frames.len()).sum();
    let expected =
        format!("all bodies and a picture within {} MiB (would fit: {})", mebibytes(limit), ways.join(", or "));
    let actual = format!("{frames} bodies of {} vertices and {picture} bytes to decode a picture", body.num_vertices());
    Err(CaptureError::setting("max_bytes", expected, actual))
}
