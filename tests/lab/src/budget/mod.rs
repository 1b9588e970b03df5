//! `budget`: where the error of a run's pictures comes from, as tables and as a picture.

mod causes;

use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use clap::Args;
use image::{Rgb, RgbImage};
use occnerf::bake::Avatar;
use occnerf::{Method, Model, PreparedFrame, PriorColors, Renderer, Rendering, Scene};
use xtask::baked;
use xtask::eval::{Drawn, scored_frames};
use xtask::run::{make_directory, use_threads, write};
use xtask::{pictures, say, table};

use crate::scene;

use self::causes::{Cause, Shares, ViewBudget, split_error};

const BUDGET: &str = "budget.json";
/// The picture, below `renders/`.
const PICTURE: &str = "budget.png";
/// What the picture shows.
pub const CAPTION: &str = "Truth, result, and the error by cause, brighter where it is larger: silhouette grey, unseen \
                           surface red, registration green, low-frequency colour blue, the rest yellow";
/// Colours of the causes in the picture.
const COLORS: [[f32; 3]; 5] = [[0.7, 0.7, 0.7], [1.0, 0.2, 0.2], [0.2, 0.9, 0.3], [0.3, 0.5, 1.0], [0.9, 0.8, 0.2]];
/// Error, root of the sum over channels, that is drawn as bright as can be.
const BRIGHTEST: f32 = 0.5;
/// Views in the picture.
const VIEWS: usize = 10;
/// Scores of never-seen surface.
const UNSEEN: [&str; 2] = ["psnr_unseen", "ssim_unseen"];
/// Groups of three pictures in a row of it.
const COLUMNS: usize = 2;

#[derive(Args)]
pub struct BudgetArguments {
    /// Run directories; each gets budget.json and renders/budget.png
    #[arg(required = true, value_name = "RUN")]
    runs: Vec<PathBuf>,
    /// Threads [default: all cores]
    #[arg(long)]
    threads: Option<usize>,
}

/// Runs the command, on unseen views, or on training views where there are no others.
pub fn budget(arguments: &BudgetArguments) -> Result<()> {
    use_threads(arguments.threads)?;
    for directory in &arguments.runs {
        let (run, source) = scene::of_run(directory)?;
        let scene = source.scene(&run.train)?;
        let (model, avatar);
        let drawn = if run.train.method == Method::Prior {
            Drawn::Prior(PriorColors::measure(&scene)?)
        } else if run.train.method == Method::Surface {
            avatar = Avatar::load(&baked::path(directory))?;
            Drawn::Avatar { body: &scene.body, light: scene.colors()?.light, avatar: &avatar }
        } else {
            model = Model::load(directory)?;
            Drawn::Field { model: &model, perceptual: String::new() }
        };
        let frames: Vec<&PreparedFrame> =
            if scene.eval.is_empty() { scored_frames(&scene).collect() } else { scene.eval.iter().collect() };
        split(directory, &scene, drawn.renderer(&scene)?.as_mut(), &frames)?;
    }
    Ok(())
}

/// Splits the error of `frames`, prints it and writes it below `directory`.
fn split(directory: &Path, scene: &Scene, renderer: &mut dyn Renderer, frames: &[&PreparedFrame]) -> Result<()> {
    let stride = frames.len().div_ceil(VIEWS).max(1);
    let (mut drawn, mut index) = (Vec::new(), 0);
    let most = pictures::MAX_SHEET_PIXELS / (3 * VIEWS) as u64;
    let views = split_error(scene, renderer, frames, |frame, rendering, shares| {
        if index % stride == 0 {
            drawn.push(pictures_of(frame, rendering, shares, most));
        }
        index += 1;
    })?;
    let drawn = drawn.into_iter().collect::<Result<Vec<_>>>()?;
    let rows: Vec<Vec<RgbImage>> = drawn.chunks(COLUMNS).map(|row| row.iter().flatten().cloned().collect()).collect();
    make_directory(&directory.join("renders"))?;
    pictures::save(&pictures::sheet(&rows), &directory.join("renders").join(PICTURE))?;
    write(&directory.join(BUDGET), &serde_json::to_string_pretty(&views)?)?;
    say!("{}, error by cause, {} views:\n{}", directory.display(), views.len(), markdown(&views));
    say!("picture: renders/{PICTURE}. {CAPTION}");
    Ok(())
}

/// The table of a run's budget, if it has one.
pub fn read(directory: &Path) -> Result<Option<String>> {
    let path = directory.join(BUDGET);
    if !path.is_file() {
        return Ok(None);
    }
    let text = std::fs::read_to_string(&path).with_context(|| path.display().to_string())?;
    let views: Vec<ViewBudget> = serde_json::from_str(&text).with_context(|| path.display().to_string())?;
    Ok(Some(markdown(&views)))
}

/// A row a camera, and one for all views: the part of the squared error that each cause has, with
/// what PSNR would gain without it, and the scores of never-seen surface.
fn markdown(views: &[ViewBudget]) -> String {
    let header = ["camera", "views"].into_iter().chain(Cause::ALL.map(Cause::name)).chain(UNSEEN);
    let mut lines = vec![header.map(str::to_owned).collect::<Vec<_>>()];
    let mut cameras: Vec<&str> = views.iter().map(|view| view.camera.as_str()).collect();
    cameras.dedup();
    if cameras.len() > 1 {
        lines.extend(cameras.iter().map(|camera| row(camera, views, |view| view.camera == *camera)));
    }
    lines.push(row("all", views, |_| true));
    table::aligned(&lines, 1)
}

fn row(name: &str, views: &[ViewBudget], takes: impl Fn(&ViewBudget) -> bool) -> Vec<String> {
    let views: Vec<&ViewBudget> = views.iter().filter(|view| takes(view)).collect();
    let sum = |cause: usize| views.iter().map(|view| view.squared[cause]).sum::<f64>();
    let sums: Vec<f64> = (0..Cause::ALL.len()).map(sum).collect();
    let whole = sums.iter().sum::<f64>().max(f64::MIN_POSITIVE);
    let mean = |pick: fn(&ViewBudget) -> Option<f64>| {
        let values: Vec<f64> = views.iter().filter_map(|view| pick(view)).filter(|v| v.is_finite()).collect();
        (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
    };
    let share = |sum: &f64| {
        let gain = -10.0 * (1.0 - sum / whole).max(1e-10).log10();
        format!("{:.1} % ({gain:+.2} dB)", 100.0 * sum / whole)
    };
    let mut row = vec![name.to_owned(), views.len().to_string()];
    row.extend(sums.iter().map(share));
    row.push(mean(|view| view.psnr_unseen).map_or("–".to_owned(), |v| format!("{v:.2}")));
    row.push(mean(|view| view.ssim_unseen).map_or("–".to_owned(), |v| format!("{v:.4}")));
    row
}

/// Truth, result and causes, each of at most `most` pixels.
fn pictures_of(frame: &PreparedFrame, rendering: &Rendering, shares: &[Shares], most: u64) -> Result<[RgbImage; 3]> {
    let (width, height) = (frame.view.camera.width, frame.view.camera.height);
    let truth = frame.pixels()?;
    let causes = RgbImage::from_fn(width, height, |x, y| {
        let shares = shares[(y * width + x) as usize].map(|share| share.max(0.0));
        let whole = shares.iter().sum::<f32>();
        let brightness = (whole.sqrt() / BRIGHTEST).min(1.0) / whole.max(f32::MIN_POSITIVE);
        let channel = |c: usize| (0..5).map(|cause| COLORS[cause][c] * shares[cause]).sum::<f32>() * brightness;
        Rgb([0, 1, 2].map(|c| (255.0 * channel(c)).round() as u8))
    });
    let shown = pictures::over_grey(&truth.image.pixels, &truth.mask, width, height);
    let drawn = pictures::over_grey(&rendering.image.pixels, &rendering.opacity, width, height);
    Ok([shown, drawn, causes].map(|picture| pictures::reduced(picture, most)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_are_of_all_views_and_gains_what_is_left_without_them() {
        let view = |camera: &str, squared| ViewBudget {
            name: String::new(),
            camera: camera.to_owned(),
            squared,
            psnr_unseen: None,
            ssim_unseen: Some(0.5),
        };
        let text = markdown(&[view("a", [1.0, 0.0, 0.0, 0.0, 0.0]), view("b", [0.0, 0.0, 0.0, 0.0, 1.0])]);
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines.len(), 5);
        assert!(lines[2].contains("100.0 %") && lines[4].matches("50.0 % (+3.01 dB)").count() == 2, "{text}");
        assert!(lines[4].contains("0.5000") && lines[4].contains('–'), "{text}");
    }
}
