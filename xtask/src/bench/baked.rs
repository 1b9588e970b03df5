//! `bench baked`: a run's baked person against its field.

use std::path::PathBuf;
use std::time::Instant;

use anyhow::{Context, Result};
use clap::Args;
use glam::{Affine3A, Vec4};
use occnerf::bake::{Avatar, BakeOptions, BakedPerson, BakedRenderer, bake};
use occnerf::{FieldRenderer, Model, PosedView, PreparedFrame, Renderer, Scene, SplitMetrics, evaluate};
use visibility::Samples;
use volrender::Camera;

use crate::pictures;
use crate::process::say;
use crate::run::{RunConfig, use_threads};

#[derive(Args)]
pub struct BakedArguments {
    /// Run directory
    run: PathBuf,
    /// Where the pictures go
    #[arg(long, default_value = "bench")]
    out: PathBuf,
    /// Longest side of the atlas, texels
    #[arg(long, default_value_t = 2048)]
    atlas: u32,
    /// Shells to bake
    #[arg(long, value_delimiter = ',', default_value = "1,3,5")]
    shells: Vec<usize>,
    /// Passes of refinement to bake with
    #[arg(long, value_delimiter = ',', default_value = "0,4")]
    refinements: Vec<u32>,
    /// Threads [default: all cores]
    #[arg(long)]
    threads: Option<usize>,
}

/// Runs the bench.
pub fn baked(arguments: &BakedArguments) -> Result<()> {
    use_threads(arguments.threads)?;
    let run = RunConfig::read(&arguments.run)?;
    let source = run.source()?;
    let scene = Scene::new(&source.capture, &source.model, &run.train)?;
    let model = Model::load(&arguments.run)?;
    std::fs::create_dir_all(&arguments.out).with_context(|| arguments.out.display().to_string())?;
    let frames: Vec<&PreparedFrame> = scene.eval.iter().collect();
    let mut rows = Vec::new();
    let mut scored = |name: &str, renderer: &mut dyn Renderer| -> Result<SplitMetrics> {
        let mut row = Vec::new();
        let stride = frames.len().div_ceil(6).max(1);
        let mut index = 0;
        let scores = evaluate(&scene, renderer, &frames, |frame, rendering| {
            if index % stride == 0 {
                let (width, height) = (frame.view.camera.width, frame.view.camera.height);
                row.push(pictures::over_grey(&rendering.image.pixels, &rendering.opacity, width, height));
            }
            index += 1;
        })?;
        rows.push(row);
        let mean = |value: Option<f64>| value.map_or("–".to_owned(), |value| format!("{value:.3}"));
        say!(
            "| {name} | {} | {} | {} | {} | {:.4} |",
            mean(scores.psnr_mask),
            mean(scores.psnr_hidden),
            mean(scores.ssim_mask),
            mean(scores.mask_iou),
            scores.render_seconds_per_frame
        );
        Ok(scores)
    };
    say!("| | psnr_mask | psnr_hidden | ssim_mask | iou | s a picture |\n| --- | ---: | ---: | ---: | ---: | ---: |");
    scored("field", &mut FieldRenderer::new(&model)?)?;
    let mut notes = Vec::new();
    for &shells in &arguments.shells {
        for &refinements in &arguments.refinements {
            let options = BakeOptions { shells, refinements, atlas: arguments.atlas, ..BakeOptions::default() };
            let (avatar, report) = bake(&model, Some(&scene), &options)?;
            notes.push(format!("{shells} shells, {refinements} refinements: {report:?}"));
            for (name, samples) in [("1 sample", Samples::One), ("4 samples", Samples::Four)] {
                let name = format!("{shells} shells, {refinements} refinements, {name}");
                scored(&name, &mut BakedRenderer::new(&model, &avatar, samples)?)?;
                let seconds = speed(&model, &avatar, &scene.train[0].view, samples)?;
                notes.push(format!("{name}: {:.1} pictures a second", 1.0 / seconds));
            }
            if shells == 1 {
                let atlas = &avatar.atlas;
                let rgb = |i: usize| image::Rgb([atlas.rgba[4 * i], atlas.rgba[4 * i + 1], atlas.rgba[4 * i + 2]]);
                let picture =
                    image::RgbImage::from_fn(atlas.width, atlas.height, |x, y| rgb((y * atlas.width + x) as usize));
                pictures::save(&picture, &arguments.out.join(format!("atlas_{refinements}.png")))?;
            }
        }
    }
    pictures::save(&pictures::sheet(&rows), &arguments.out.join("baked.png"))?;
    say!("{}", notes.join("\n"));
    Ok(())
}

/// Seconds of a picture of 512 × 512 of the video's motion, skinning included; the fastest of three
/// rounds.
fn speed(model: &Model, avatar: &Avatar, view: &PosedView, samples: Samples) -> Result<f64> {
    let camera: Camera = view.camera.resized(512, 512);
    let mut person = BakedPerson::new(avatar, model.body().scale);
    let bones: Vec<Affine3A> = model.corrected(view).bones.clone();
    let mut out = vec![Vec4::ZERO; 512 * 512];
    let mut best = f64::INFINITY;
    for _ in 0..3 {
        let start = Instant::now();
        for _ in 0..20 {
            person.draw(&bones, &camera, samples, &mut out)?;
        }
        best = best.min(start.elapsed().as_secs_f64() / 20.0);
    }
    Ok(best)
}
