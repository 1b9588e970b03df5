//! Scores of a trained person against pictures that training never saw.

use std::time::Instant;

use glam::Vec3;
use lpips::Lpips;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use visibility::RayMesh;
use volrender::metrics;

use crate::Error;
use crate::capture::Pixels;
use crate::render::{Renderer, Rendering};
use crate::scene::labels::Label;
use crate::scene::prepared::{PreparedFrame, Scene};

/// Opacity above which the paper counts a pixel as rendered.
const VISIBLE: f32 = 0.001;
/// Fewer hidden pixels than this in a frame give no figure for it: one pixel would weigh as much as
/// a whole side.
const MIN_HIDDEN_PIXELS: usize = 16;

/// Scores of one picture over the pixels that are known, but for `psnr_all`; `None` where the set
/// of pixels is empty. All pixels are known in views of cameras that training did not use.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FrameMetrics {
    /// Name of the frame.
    pub name: String,
    /// Name of the camera.
    pub camera: String,
    /// PSNR (dB) over pixels whose predicted opacity is above 0.001, the paper's definition.
    pub psnr_vis: Option<f64>,
    /// SSIM over the pixels of `psnr_vis`.
    pub ssim_vis: Option<f64>,
    /// PSNR (dB) over the true subject's known pixels.
    pub psnr_mask: Option<f64>,
    /// PSNR (dB) over all of the true subject's pixels, unknown ones included.
    #[serde(default)]
    pub psnr_all: Option<f64>,
    /// Share of the true subject's pixels that are known.
    #[serde(default)]
    pub known: Option<f64>,
    /// SSIM over the pixels of `psnr_mask`.
    pub ssim_mask: Option<f64>,
    /// PSNR (dB) over the subject's pixels on the quartile of vertices that the training video
    /// showed least.
    pub psnr_hidden: Option<f64>,
    /// PSNR (dB) over the whole image. Like those above it is `null` in JSON where there is no
    /// error.
    pub psnr_full: Option<f64>,
    /// SSIM over the whole image.
    pub ssim_full: Option<f64>,
    /// LPIPS over the whole image; not measured without weights.
    #[serde(default)]
    pub lpips_full: Option<f64>,
    /// Intersection over union of the pixels with opacity above one half and the true mask.
    pub mask_iou: f64,
}

/// Means over the pictures of a split, of those pictures that have the score.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SplitMetrics {
    /// Mean of [`FrameMetrics::psnr_vis`].
    pub psnr_vis: Option<f64>,
    /// Mean of [`FrameMetrics::ssim_vis`].
    pub ssim_vis: Option<f64>,
    /// Mean of [`FrameMetrics::psnr_mask`].
    pub psnr_mask: Option<f64>,
    /// Mean of [`FrameMetrics::psnr_all`].
    #[serde(default)]
    pub psnr_all: Option<f64>,
    /// Mean of [`FrameMetrics::known`].
    #[serde(default)]
    pub known: Option<f64>,
    /// Mean of [`FrameMetrics::ssim_mask`].
    pub ssim_mask: Option<f64>,
    /// Mean of [`FrameMetrics::psnr_hidden`].
    pub psnr_hidden: Option<f64>,
    /// Mean of [`FrameMetrics::psnr_full`].
    pub psnr_full: Option<f64>,
    /// Mean of [`FrameMetrics::ssim_full`].
    pub ssim_full: Option<f64>,
    /// Mean of [`FrameMetrics::lpips_full`]; not measured without weights.
    pub lpips_full: Option<f64>,
    /// Mean of [`FrameMetrics::mask_iou`].
    pub mask_iou: Option<f64>,
    /// Seconds of wall clock to draw a picture.
    pub render_seconds_per_frame: f64,
    /// Scores of each picture.
    pub frames: Vec<FrameMetrics>,
}

/// The vertices that the training video showed least: a quarter of them, ties by lower index.
pub fn least_seen_quartile(scene: &Scene) -> Result<Vec<bool>, Error> {
    let frequencies = scene.vertex_frequencies()?;
    let mut order: Vec<usize> = (0..frequencies.len()).collect();
    order.sort_by_key(|&v| (frequencies[v], v));
    let mut least = vec![false; frequencies.len()];
    order[..frequencies.len() / 4].iter().for_each(|&v| least[v] = true);
    Ok(least)
}

/// Renders `frames` over black and scores them, with LPIPS over the whole image where `lpips` is
/// given; `progress` hears of each finished picture.
pub fn evaluate(
    scene: &Scene,
    renderer: &mut dyn Renderer,
    frames: &[&PreparedFrame],
    lpips: Option<&Lpips>,
    mut progress: impl FnMut(&PreparedFrame, &Rendering),
) -> Result<SplitMetrics, Error> {
    let least = least_seen_quartile(scene)?;
    let (mut scores, mut seconds) = (Vec::new(), 0.0);
    for frame in frames {
        let start = Instant::now();
        let mut rendering = renderer.render(&frame.view, Vec3::ZERO)?;
        seconds += start.elapsed().as_secs_f64();
        progress(frame, &rendering);
        let truth = frame.pixels()?;
        let nearest = nearest_vertices(scene, frame, &truth.mask)?;
        let hidden: Vec<bool> = nearest.iter().map(|v| v.is_some_and(|v| least[v as usize])).collect();
        let of_subject: Vec<bool> = truth.mask.iter().map(|&m| m > 0.5).collect();
        let psnr_all = metrics::psnr_masked(&rendering.image.pixels, &truth.image.pixels, &of_subject);
        let known = without_unknown(frame, &truth, &mut rendering);
        scores.push(FrameMetrics { psnr_all, ..score(frame, &truth, &rendering, [&hidden, &known], lpips)? });
    }
    let mean = |pick: &dyn Fn(&FrameMetrics) -> Option<f64>| {
        let values: Vec<f64> = scores.iter().filter_map(pick).filter(|v| v.is_finite()).collect();
        (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
    };
    Ok(SplitMetrics {
        psnr_vis: mean(&|f| f.psnr_vis),
        ssim_vis: mean(&|f| f.ssim_vis),
        psnr_mask: mean(&|f| f.psnr_mask),
        psnr_all: mean(&|f| f.psnr_all),
        known: mean(&|f| f.known),
        ssim_mask: mean(&|f| f.ssim_mask),
        psnr_hidden: mean(&|f| f.psnr_hidden),
        psnr_full: mean(&|f| f.psnr_full),
        ssim_full: mean(&|f| f.ssim_full),
        lpips_full: mean(&|f| f.lpips_full),
        mask_iou: mean(&|f| Some(f.mask_iou)),
        render_seconds_per_frame: seconds / frames.len().max(1) as f64,
        frames: scores,
    })
}

fn score(
    frame: &PreparedFrame,
    truth: &Pixels,
    rendering: &Rendering,
    [hidden, known]: [&[bool]; 2],
    lpips: Option<&Lpips>,
) -> Result<FrameMetrics, Error> {
    let (a, b) = (&rendering.image.pixels[..], &truth.image.pixels[..]);
    let (width, height) = (frame.view.camera.width as usize, frame.view.camera.height as usize);
    let visible: Vec<bool> = rendering.opacity.iter().map(|&o| o > VISIBLE).collect();
    let subject = truth.mask.iter().filter(|m| **m > 0.5).count();
    let mask: Vec<bool> = truth.mask.iter().zip(known).map(|(&m, &known)| m > 0.5 && known).collect();
    let in_mask = mask.iter().filter(|m| **m).count();
    let solid: Vec<bool> = rendering.opacity.iter().map(|&o| o > 0.5).collect();
    let count = |f: &dyn Fn(bool, bool) -> bool| solid.iter().zip(&mask).filter(|(s, m)| f(**s, **m)).count();
    let union = count(&|s, m| s || m);
    let hidden: Vec<bool> = hidden.iter().zip(&mask).map(|(&h, &m)| h && m).collect();
    let enough = hidden.iter().filter(|h| **h).count() >= MIN_HIDDEN_PIXELS;
    let lpips_full = lpips.map(|lpips| lpips.distance(a, b, width, height)).transpose()?;
    Ok(FrameMetrics {
        name: frame.name.clone(),
        camera: frame.camera_name.clone(),
        psnr_vis: metrics::psnr_masked(a, b, &visible),
        ssim_vis: metrics::ssim_masked(a, b, &visible, width, height),
        psnr_mask: metrics::psnr_masked(a, b, &mask),
        psnr_all: None,
        known: (subject > 0).then(|| in_mask as f64 / subject as f64),
        ssim_mask: metrics::ssim_masked(a, b, &mask, width, height),
        psnr_hidden: if enough { metrics::psnr_masked(a, b, &hidden) } else { None },
        psnr_full: metrics::psnr_masked(a, b, known),
        ssim_full: match known.contains(&false) {
            true => metrics::ssim_masked(a, b, known, width, height),
            false => metrics::ssim(a, b, width, height).ok(),
        },
        lpips_full: lpips_full.and_then(|values| values.first().copied()),
        mask_iou: if union == 0 { 1.0 } else { count(&|s, m| s && m) as f64 / union as f64 },
    })
}

/// Removes from a picture the pixels that a training image does not show; which are known.
fn without_unknown(frame: &PreparedFrame, truth: &Pixels, rendering: &mut Rendering) -> Vec<bool> {
    let mut known = vec![true; truth.mask.len()];
    for (i, label) in frame.labels.iter().enumerate() {
        if label == Label::Unknown {
            let truth = &truth.image.pixels[3 * i..3 * i + 3];
            rendering.image.pixels[3 * i..3 * i + 3].copy_from_slice(truth);
            rendering.opacity[i] = 0.0;
            known[i] = false;
        }
    }
    known
}

/// The vertex nearest to each pixel's first hit on the posed prior (H × W); `None` where there is
/// none, and outside the mask.
pub fn nearest_vertices(scene: &Scene, frame: &PreparedFrame, mask: &[f32]) -> Result<Vec<Option<u32>>, Error> {
    let mesh = RayMesh::new(&frame.view.posed.vertices, &scene.body.model.faces)?;
    let width = frame.view.camera.width as usize;
    let nearest = |i: usize| {
        if mask[i] <= 0.5 {
            return None;
        }
        let ray = frame.view.camera.ray((i % width) as f32 + 0.5, (i / width) as f32 + 0.5);
        let hit = mesh.first_hit(ray.origin, ray.direction)?;
        let corners = scene.body.model.faces[hit.face as usize];
        let [a, b, c] = hit.barycentric;
        Some(corners[if a >= b && a >= c { 0 } else { 1 + usize::from(b < c) }])
    };
    Ok((0..width * frame.view.camera.height as usize).into_par_iter().map(nearest).collect())
}
