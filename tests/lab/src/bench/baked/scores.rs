//! Scores of several renderers on the unseen views of a scene.

use anyhow::Result;
use image::RgbImage;
use occnerf::{Lpips, PreparedFrame, Renderer, Rendering, Scene, SplitMetrics, evaluate};

use super::agreement::Agreement;
use xtask::pictures;
use xtask::process::note;

/// A score of pictures.
pub type Pick = fn(&SplitMetrics) -> Option<f64>;

/// What the field's pictures are called.
pub const FIELD: &str = "field";
/// Pictures a renderer that are kept to be looked at.
const SHOWN: usize = 6;
const TITLES: [&str; 10] = [
    "drawn",
    "psnr_mask",
    "psnr_hidden",
    "ssim_mask",
    "lpips",
    "iou",
    "psnr to field",
    "area to field",
    "iou to field",
    "s a picture",
];

/// What was scored so far; the first renderer is that of the field.
pub struct Scores<'a> {
    scene: &'a Scene,
    frames: Vec<&'a PreparedFrame>,
    lpips: Option<&'a Lpips>,
    of_field: Vec<Rendering>,
    pub points: Vec<(String, SplitMetrics)>,
    /// A line a renderer under the titles.
    pub table: Vec<Vec<String>>,
    /// A row of pictures a renderer.
    pub rows: Vec<Vec<RgbImage>>,
}

impl<'a> Scores<'a> {
    pub fn new(scene: &'a Scene, lpips: Option<&'a Lpips>) -> Self {
        let (frames, table) = (scene.eval.iter().collect(), vec![TITLES.map(str::to_owned).to_vec()]);
        Self { scene, frames, lpips, of_field: Vec::new(), points: Vec::new(), table, rows: Vec::new() }
    }

    /// Draws and scores every view.
    pub fn add(&mut self, name: &str, renderer: &mut dyn Renderer) -> Result<()> {
        let Self { scene, frames, lpips, of_field, .. } = self;
        let (mut row, mut agreement, first) = (Vec::new(), Agreement::default(), of_field.is_empty());
        let stride = frames.len().div_ceil(SHOWN).max(1);
        let mut index = 0;
        let scores = evaluate(scene, renderer, frames, *lpips, |frame, rendering| {
            if index % stride == 0 {
                let (width, height) = (frame.view.camera.width, frame.view.camera.height);
                row.push(pictures::over_grey(&rendering.image.pixels, &rendering.opacity, width, height));
            }
            if first {
                of_field.push(rendering.clone());
            }
            agreement.add(&of_field[index], rendering);
            index += 1;
        })?;
        let mean = |value: Option<f64>| value.map_or("–".to_owned(), |value| format!("{value:.3}"));
        note!("{name}: {} dB psnr_mask", mean(scores.psnr_mask));
        self.rows.push(row);
        self.table.push(vec![
            name.to_owned(),
            mean(scores.psnr_mask),
            mean(scores.psnr_hidden),
            mean(scores.ssim_mask),
            scores.lpips_full.map_or("–".to_owned(), |lpips| format!("{lpips:.4}")),
            mean(scores.mask_iou),
            if first { "–".to_owned() } else { format!("{:.2}", agreement.psnr()) },
            format!("{:.3}", agreement.area[1] / agreement.area[0]),
            format!("{:.3}", agreement.both / agreement.either),
            format!("{:.4}", scores.render_seconds_per_frame),
        ]);
        self.points.push((name.to_owned(), scores));
        Ok(())
    }
}
