//! `bench baked`: a run's baked person against its field.

use std::path::PathBuf;
use std::time::Instant;

use anyhow::{Context, Result};
use clap::Args;
use glam::{Affine3A, Vec4};
use occnerf::bake::{Avatar, BakeOptions, BakedPerson, BakedRenderer, bake};
use occnerf::{
    FieldRenderer, Model, PosedView, PreparedFrame, Renderer, Rendering, Scene, SplitMetrics, evaluate_with,
};
use visibility::Samples;
use volrender::Camera;

use super::chart::{self, Mark, Panel, Picture, Shape, Style};
use super::front::front;
use crate::network::load_lpips;
use crate::pictures;
use crate::process::say;
use crate::run::{RunConfig, use_threads};
use crate::scale::Scale;

/// A score of pictures.
type Pick = fn(&SplitMetrics) -> Option<f64>;

/// What the field's pictures are called.
const FIELD: &str = "field";

#[derive(Args)]
pub struct BakedArguments {
    /// Run directory
    run: PathBuf,
    /// Where the pictures go
    #[arg(long, default_value = "bench")]
    out: PathBuf,
    /// Longest sides of the atlas, texels
    #[arg(long, value_delimiter = ',', default_value = "2048,256")]
    atlas: Vec<u32>,
    /// Shells to bake
    #[arg(long, value_delimiter = ',', default_value = "1,3,5")]
    shells: Vec<usize>,
    /// Passes of refinement to bake with
    #[arg(long, value_delimiter = ',', default_value = "0,4")]
    refinements: Vec<u32>,
    /// Weights of LPIPS, .safetensors; not measured without
    #[arg(long)]
    lpips: Option<PathBuf>,
    /// Threads [default: all cores]
    #[arg(long)]
    threads: Option<usize>,
}

/// Runs the bench.
pub fn baked(arguments: &BakedArguments) -> Result<()> {
    use_threads(arguments.threads)?;
    let run = RunConfig::read(&arguments.run)?;
    let source = run.source(&arguments.run)?;
    let scene = Scene::new(&source.capture, &source.model, &run.train)?;
    let model = Model::load(&arguments.run)?;
    std::fs::create_dir_all(&arguments.out).with_context(|| arguments.out.display().to_string())?;
    let frames: Vec<&PreparedFrame> = scene.eval.iter().collect();
    let lpips = load_lpips(arguments.lpips.as_deref())?;
    let (mut rows, mut of_field) = (Vec::new(), Vec::new());
    let mut points = Vec::new();
    let mut scored = |name: &str, renderer: &mut dyn Renderer| -> Result<()> {
        let (mut row, mut agreement, first) = (Vec::new(), Agreement::default(), of_field.is_empty());
        let stride = frames.len().div_ceil(6).max(1);
        let mut index = 0;
        let scores = evaluate_with(&scene, renderer, &frames, lpips.as_ref(), |frame, rendering| {
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
        rows.push(row);
        let mean = |value: Option<f64>| value.map_or("–".to_owned(), |value| format!("{value:.3}"));
        say!(
            "| {name} | {} | {} | {} | {} | {} | {:.2} | {:.3} | {:.3} | {:.4} |",
            mean(scores.psnr_mask),
            mean(scores.psnr_hidden),
            mean(scores.ssim_mask),
            mean(scores.lpips_full),
            mean(scores.mask_iou),
            agreement.psnr(),
            agreement.area[1] / agreement.area[0],
            agreement.both / agreement.either,
            scores.render_seconds_per_frame
        );
        points.push((name.to_owned(), scores));
        Ok(())
    };
    say!(
        "| | psnr_mask | psnr_hidden | ssim_mask | lpips | iou | psnr to field | area to field | iou to field | s a picture |"
    );
    say!("| --- {} |", "| ---: ".repeat(9));
    scored(FIELD, &mut FieldRenderer::new(&model)?)?;
    let mut notes = Vec::new();
    for (shells, refinements, atlas) in all(arguments) {
        let options = BakeOptions { shells, refinements, atlas, ..BakeOptions::default() };
        let (avatar, report) = bake(&model, Some(&scene), &options)?;
        let name = format!("{shells} shells, atlas {}, {refinements} refinements", report.side);
        notes.push(format!("{name}: {report:?}"));
        for (count, samples) in [(1, Samples::One), (4, Samples::Four)] {
            let name = format!("{name}, {count} samples");
            scored(&name, &mut BakedRenderer::new(&model, &avatar, samples)?)?;
            let seconds = speed(&model, &avatar, &scene.train[0].view, samples)?;
            notes.push(format!("{name}: {:.1} pictures a second", 1.0 / seconds));
        }
    }
    charted(&source.capture.name, &points).write(&arguments.out.join("baked-frame"))?;
    pictures::save(&pictures::sheet(&rows), &arguments.out.join("baked.png"))?;
    say!("{}", notes.join("\n"));
    Ok(())
}

/// Every number of shells with every number of refinements, and one surface on smaller atlases.
fn all(arguments: &BakedArguments) -> Vec<(usize, u32, u32)> {
    let BakedArguments { shells, refinements, atlas, .. } = arguments;
    let pairs = shells.iter().flat_map(|&shells| refinements.iter().map(move |&passes| (shells, passes)));
    let whole = pairs.flat_map(|(shells, passes)| atlas.first().map(|&side| (shells, passes, side)));
    let smaller =
        refinements.last().into_iter().flat_map(|&passes| atlas.iter().skip(1).map(move |&side| (1, passes, side)));
    whole.chain(smaller).collect()
}

/// Seconds a picture against each score.
fn charted(scene: &str, points: &[(String, SplitMetrics)]) -> Picture {
    let worths: [(&str, Pick); 4] = [
        ("psnr_mask, dB", |m| m.psnr_mask),
        ("psnr_hidden, dB", |m| m.psnr_hidden),
        ("ssim_mask", |m| m.ssim_mask),
        ("−lpips", |m| m.lpips_full.map(|lpips| -lpips)),
    ];
    let panel = |(label, worth): (&str, Pick)| {
        let scored: Vec<(&str, (f64, f64))> = points
            .iter()
            .filter_map(|(name, scores)| Some((name.as_str(), (scores.render_seconds_per_frame, worth(scores)?))))
            .collect();
        let at: Vec<(f64, f64)> = scored.iter().map(|point| point.1).collect();
        let mut along: Vec<(f64, f64)> = at.iter().zip(front(&at)).filter(|(_, on)| *on).map(|(at, _)| *at).collect();
        along.sort_by(|a, b| a.0.total_cmp(&b.0));
        let style = |name: &str| if name == FIELD { Style(6, Shape::Square) } else { Style(0, Shape::Circle) };
        Panel {
            title: label.to_owned(),
            labels: ["seconds a picture".to_owned(), label.to_owned()],
            scales: [Scale::around(at.iter().map(|at| at.0), true), Scale::around(at.iter().map(|at| at.1), false)],
            lines: vec![chart::Line { points: along, color: 5 }],
            marks: scored
                .iter()
                .map(|(name, at)| Mark { at: *at, name: (*name).to_owned(), style: style(name) })
                .collect(),
        }
    };
    let legend =
        [("front", Style(5, Shape::Dash)), (FIELD, Style(6, Shape::Square)), ("baked", Style(0, Shape::Circle))];
    Picture {
        title: format!("{scene}: the baked person and the field on unseen views"),
        legend: legend.iter().map(|(name, style)| ((*name).to_owned(), *style)).collect(),
        columns: 2,
        size: (640, 460),
        panels: worths
            .into_iter()
            .filter(|(_, worth)| points.iter().any(|p| worth(&p.1).is_some()))
            .map(panel)
            .collect(),
    }
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

/// How far pictures agree with those of the field.
#[derive(Default)]
struct Agreement {
    /// Of the colours, over black, where either shows anything.
    squared: f64,
    count: f64,
    /// Opacity of the field's pictures, and of the others.
    area: [f64; 2],
    /// Pixels with opacity above one half.
    both: f64,
    either: f64,
}

impl Agreement {
    fn add(&mut self, field: &Rendering, other: &Rendering) {
        let pixels = field.image.pixels.chunks_exact(3).zip(other.image.pixels.chunks_exact(3));
        for ((a, b), (&f, &o)) in pixels.zip(field.opacity.iter().zip(&other.opacity)) {
            if f > 0.0 || o > 0.0 {
                self.squared += a.iter().zip(b).map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>();
                self.count += 3.0;
            }
            self.area[0] += f64::from(f);
            self.area[1] += f64::from(o);
            self.both += f64::from(u8::from(f > 0.5 && o > 0.5));
            self.either += f64::from(u8::from(f > 0.5 || o > 0.5));
        }
    }

    fn psnr(&self) -> f64 {
        -10.0 * (self.squared / self.count).log10()
    }
}
