//! `front`: one picture that says what the project does, for README.

use std::path::PathBuf;

use anyhow::{Result, ensure};
use clap::Args;
use glam::Vec3;
use image::{Rgb, RgbImage, imageops};
use occnerf::{FieldRenderer, Label, Model, PreparedFrame, Renderer};

use xtask::pictures;
use xtask::process::say;
use xtask::run::use_threads;

use crate::scene;

/// Moments that are shown, a row each.
const ROWS: usize = 3;
/// What stands in front of the person.
const OBSTACLE: Rgb<u8> = Rgb([70, 110, 160]);

#[derive(Args)]
pub struct FrontArguments {
    /// Run directory of a capture that keeps views back
    run: PathBuf,
    /// PNG to write [default: RUN/renders/front.png]
    #[arg(long)]
    out: Option<PathBuf>,
    /// Threads [default: all cores]
    #[arg(long)]
    threads: Option<usize>,
}

/// Runs the command.
pub fn front(arguments: &FrontArguments) -> Result<()> {
    use_threads(arguments.threads)?;
    let (run, source) = scene::of_run(&arguments.run)?;
    let scene = source.scene(&run.train)?;
    ensure!(!scene.eval.is_empty(), "{}: the capture keeps no views back", run.scene);
    ensure!(run.train.held_out == 0, "{}: frames are held out, expected a run with none", arguments.run.display());
    let model = Model::load(&arguments.run)?;
    let mut renderer = FieldRenderer::new(&model)?;
    let mut rows = Vec::new();
    for row in 0..ROWS {
        // Moments apart in time, hidden as much as any near them, each from two other sides.
        let (first, last) = (row * scene.train.len() / ROWS, (row + 1) * scene.train.len() / ROWS);
        let unknown = |frame: &PreparedFrame| frame.labels.iter().filter(|l| *l == Label::Unknown).count();
        let views = |instant: usize| scene.eval.iter().filter(move |v| v.view.instant == Some(instant));
        let shown = (first..last).filter(|&i| views(i).next().is_some()).max_by_key(|&i| unknown(&scene.train[i]));
        let Some(instant) = shown else { continue };
        let mut cells = seen(&scene.train[instant])?.to_vec();
        let all: Vec<&PreparedFrame> = views(instant).collect();
        for side in 0..2 {
            let view = all[(row + side * all.len().div_ceil(2)) % all.len()];
            let (truth, camera) = (view.pixels()?, &view.view.camera);
            cells.push(pictures::over_grey(&truth.image.pixels, &truth.mask, camera.width, camera.height));
            let drawn = renderer.render(&view.view, Vec3::ZERO)?;
            cells.push(pictures::over_grey(&drawn.image.pixels, &drawn.opacity, camera.width, camera.height));
        }
        rows.push(cells);
    }
    crop(&mut rows);
    let names = ["the camera sees", "its mask", "truth, unseen side", "ours", "truth, other side", "ours"];
    let sheet = pictures::captioned(&pictures::sheet(&rows), &names)?;
    let out = arguments.out.clone().unwrap_or_else(|| arguments.run.join("renders/front.png"));
    pictures::save(&sheet, &out)?;
    say!("written: {}", out.display());
    Ok(())
}

/// Cuts all pictures, equally large, to what differs from their corners in any of them.
fn crop(rows: &mut [Vec<RgbImage>]) {
    const ROOM: u32 = 8;
    let (mut low, mut high) = ((u32::MAX, u32::MAX), (0, 0));
    for picture in rows.iter().flatten() {
        let empty = picture.get_pixel(0, 0);
        for (x, y, _) in picture.enumerate_pixels().filter(|(_, _, pixel)| *pixel != empty) {
            low = (low.0.min(x), low.1.min(y));
            high = (high.0.max(x), high.1.max(y));
        }
    }
    for picture in rows.iter_mut().flatten() {
        let (x, y) = (low.0.saturating_sub(ROOM), low.1.saturating_sub(ROOM));
        let (right, bottom) = ((high.0 + ROOM).min(picture.width() - 1), (high.1 + ROOM).min(picture.height() - 1));
        if x < right && y < bottom {
            *picture = imageops::crop_imm(picture, x, y, right - x + 1, bottom - y + 1).to_image();
        }
    }
}

/// What the camera saw of a training frame, the obstacle painted where it stands, and the mask.
fn seen(frame: &PreparedFrame) -> Result<[RgbImage; 2]> {
    let (pixels, camera) = (frame.pixels()?, &frame.view.camera);
    let mut picture = pictures::over_grey(&pixels.image.pixels, &pixels.mask, camera.width, camera.height);
    let mut mask = RgbImage::new(camera.width, camera.height);
    let labels = frame.labels.iter().zip(&pixels.mask);
    for (((_, _, shown), masked), (label, &m)) in picture.enumerate_pixels_mut().zip(mask.pixels_mut()).zip(labels) {
        *masked = Rgb([(255.0 * m).round() as u8; 3]);
        if label == Label::Unknown {
            *shown = OBSTACLE;
        }
    }
    Ok([picture, mask])
}
