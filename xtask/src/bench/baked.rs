//! `bench baked`: a run's baked person against its field.

use std::path::PathBuf;
use std::time::Instant;

use anyhow::{Context, Result};
use clap::Args;
use glam::{Affine3A, Vec2, Vec4};
use occnerf::bake::{Avatar, BakeOptions, BakedPerson, BakedRenderer, bake};
use occnerf::{FieldRenderer, Model, PosedView, PreparedFrame, Renderer, Rendering, SplitMetrics, evaluate_with};
use visibility::Samples;
use volrender::Camera;

use super::chart::{self, Mark, Panel, Picture, Shape, Style};
use super::front::front;
use crate::network::load_lpips;
use crate::pictures;
use crate::process::{note, say};
use crate::results::{self, Section};
use crate::run::{RunConfig, peak_rss_bytes, use_threads, write};
use crate::scale::Scale;
use crate::table;

/// A score of pictures.
type Pick = fn(&SplitMetrics) -> Option<f64>;

/// Sizes of the pictures whose drawing is timed.
const SIZES: [(u32, u32); 4] = [(256, 256), (512, 512), (1024, 1024), (1920, 1080)];
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
const MADE: [&str; 7] = ["baked", "seconds", "vertices", "faces", "holes", "double", "peak MiB"];
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
    /// Make what is found a section of xtask/RESULTS.md
    #[arg(long)]
    publish: bool,
}

/// Runs the bench.
pub fn baked(arguments: &BakedArguments) -> Result<()> {
    use_threads(arguments.threads)?;
    let run = RunConfig::read(&arguments.run)?;
    let source = run.source(&arguments.run)?;
    let scene = source.scene(&run.train)?;
    let model = Model::load(&arguments.run)?;
    std::fs::create_dir_all(&arguments.out).with_context(|| arguments.out.display().to_string())?;
    let frames: Vec<&PreparedFrame> = scene.eval.iter().collect();
    let lpips = load_lpips(arguments.lpips.as_deref())?;
    let (mut rows, mut of_field) = (Vec::new(), Vec::new());
    let mut points = Vec::new();
    let mut table = vec![TITLES.map(str::to_owned).to_vec()];
    let mut scored = |name: &str, renderer: &mut dyn Renderer| -> Result<()> {
        let (mut row, mut agreement, mut first) = (Vec::new(), Agreement::default(), of_field.is_empty());
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
        note!("{name}: {} dB psnr_mask", mean(scores.psnr_mask));
        let same = std::mem::replace(&mut first, false);
        table.push(vec![
            name.to_owned(),
            mean(scores.psnr_mask),
            mean(scores.psnr_hidden),
            mean(scores.ssim_mask),
            mean(scores.lpips_full),
            mean(scores.mask_iou),
            if same { "–".to_owned() } else { format!("{:.2}", agreement.psnr()) },
            format!("{:.3}", agreement.area[1] / agreement.area[0]),
            format!("{:.3}", agreement.both / agreement.either),
            format!("{:.4}", scores.render_seconds_per_frame),
        ]);
        points.push((name.to_owned(), scores));
        Ok(())
    };
    scored(FIELD, &mut FieldRenderer::new(&model)?)?;
    let mut made = vec![MADE.map(str::to_owned).to_vec()];
    let mut speeds = Vec::new();
    for (shells, refinements, atlas) in all(arguments) {
        let options = BakeOptions { shells, refinements, atlas, ..BakeOptions::default() };
        let start = Instant::now();
        let (avatar, report) = bake(&model, Some(&scene), &options)?;
        let seconds = start.elapsed().as_secs_f64();
        let name = format!("{shells} shells, atlas {}, {refinements} refinements", report.side);
        made.push(vec![
            name.clone(),
            format!("{seconds:.1}"),
            report.vertices.to_string(),
            avatar.faces.len().to_string(),
            report.surface.holes.to_string(),
            report.surface.double.to_string(),
            format!("{:.0}", peak_rss_bytes() as f64 / f64::from(1 << 20)),
        ]);
        for (count, samples) in [(1, Samples::One), (4, Samples::Four)] {
            let name = format!("{name}, {count} samples");
            scored(&name, &mut BakedRenderer::new(&model, &avatar, samples)?)?;
            if Some(&refinements) == arguments.refinements.last() && Some(&atlas) == arguments.atlas.first() {
                let view = &scene.train[0].view;
                speeds.extend(speed(&model, &avatar, view, (shells, count, samples))?);
            }
        }
    }
    let name = &source.capture.name;
    charted(name, &points).write(&arguments.out.join("baked-frame"))?;
    growth(name, &speeds).write(&arguments.out.join("baked-growth"))?;
    pictures::save(&pictures::sheet(&rows), &arguments.out.join("baked.png"))?;
    let text = format!(
        "## {name}, {} steps of {}\n\nAgainst the truth, and against the field, on unseen views:\n\n{}\nBaking:\n\n{}\n\
         Pictures a second, skinning and light included, fastest of three rounds:\n\n{}",
        model.steps_done(),
        run.train.preset.name(),
        table::aligned(&table, 1),
        table::aligned(&made, 1),
        table::aligned(&rates(&speeds), 1),
    );
    write(&arguments.out.join("baked.md"), &text)?;
    say!("{text}");
    if arguments.publish {
        let charts = results::charts(&arguments.out, "baked-")?;
        results::publish(&Section { name: "baked", title: "The baked person", body: &text, charts: &charts })?;
    }
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

/// How fast pictures of a size are drawn.
struct Speed {
    shells: usize,
    samples: usize,
    threads: usize,
    size: (u32, u32),
    seconds: f64,
}

/// Draws a pose of the video at several sizes on one thread and on two: `shells`, samples a pixel.
fn speed(
    model: &Model,
    avatar: &Avatar,
    view: &PosedView,
    (shells, count, samples): (usize, usize, Samples),
) -> Result<Vec<Speed>> {
    let bones: Vec<Affine3A> = view.posed.bones.clone();
    let mut speeds = Vec::new();
    for threads in [1, 2] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build()?;
        for size in SIZES {
            // As high as the picture, whatever its shape.
            let square = view.camera.resized(size.1, size.1);
            let aside = 0.5 * (size.0 - size.1) as f32;
            let camera = Camera { centre: square.centre + Vec2::X * aside, width: size.0, ..square };
            let mut person = BakedPerson::new(avatar, model.body().scale).lit_by(model.light());
            let mut out = vec![Vec4::ZERO; (size.0 * size.1) as usize];
            let mut best = f64::INFINITY;
            for _ in 0..3 {
                let start = Instant::now();
                pool.install(|| (0..10).try_for_each(|_| person.draw(&bones, &camera, samples, &mut out)))?;
                best = best.min(start.elapsed().as_secs_f64() / 10.0);
            }
            speeds.push(Speed { shells, samples: count, threads, size, seconds: best });
        }
    }
    Ok(speeds)
}

/// A row for each number of shells, samples and threads, a column for each size.
fn rates(speeds: &[Speed]) -> Vec<Vec<String>> {
    let titles = ["shells, samples a pixel, threads".to_owned()];
    let sizes = SIZES.map(|(width, height)| format!("{width} × {height}"));
    let mut rows = vec![titles.into_iter().chain(sizes).collect()];
    for line in speeds.chunks(SIZES.len()) {
        let Speed { shells, samples, threads, .. } = line[0];
        let cells = line.iter().map(|speed| format!("{:.0}", speed.seconds.recip()));
        rows.push([format!("{shells}, {samples}, {threads}")].into_iter().chain(cells).collect());
    }
    rows
}

/// Milliseconds against pixels, on one thread and on two.
fn growth(scene: &str, speeds: &[Speed]) -> Picture {
    let pixels = |speed: &Speed| f64::from(speed.size.0) * f64::from(speed.size.1);
    let panel = |threads: usize| {
        let shown = || speeds.iter().filter(move |speed| speed.threads == threads);
        let of: Vec<&Speed> = shown().collect();
        let at = |speed: &&Speed| (pixels(speed), 1e3 * speed.seconds);
        let mark = |speed: &&Speed| Mark {
            at: at(speed),
            name: String::new(),
            style: Style(speed.shells, if speed.samples == 1 { Shape::Circle } else { Shape::Square }),
        };
        Panel {
            title: format!("{threads} thread{}", if threads == 1 { "" } else { "s" }),
            labels: ["pixels".to_owned(), "milliseconds a picture".to_owned()],
            scales: [
                Scale::around(shown().map(pixels), true),
                Scale::around(shown().map(|speed| 1e3 * speed.seconds), true),
            ],
            lines: of
                .chunks(SIZES.len())
                .map(|line| chart::Line { points: line.iter().map(at).collect(), color: line[0].shells })
                .collect(),
            marks: of.iter().map(mark).collect(),
        }
    };
    let mut shells: Vec<usize> = speeds.iter().map(|speed| speed.shells).collect();
    shells.dedup();
    shells.sort_unstable();
    shells.dedup();
    let of_shells = shells.into_iter().map(|n| (format!("shells: {n}"), Style(n, Shape::Dash)));
    let of_samples =
        [("1 sample a pixel", Shape::Circle), ("4 samples", Shape::Square)].map(|(n, s)| (n.to_owned(), Style(5, s)));
    Picture {
        title: format!("{scene}: drawing the baked person"),
        legend: of_shells.chain(of_samples).collect(),
        columns: 2,
        size: (480, 360),
        panels: [1, 2].map(panel).into(),
    }
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
