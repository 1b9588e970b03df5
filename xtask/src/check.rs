//! `check`: validates the fit of a capture before training.

use std::path::{Path, PathBuf};

use anyhow::Result;
use clap::Args;
use image::{Rgb, RgbImage, imageops};
use occnerf::capture::Frame;
use occnerf::{Check, Fault, body_silhouette, photograph, unknown_pixels};
use smpl::BodyModel;

use crate::pictures::{captioned, save, sheet, to_rgb};
use crate::process::say;
use crate::source::{self, LoadArguments, Source};
use crate::table;

/// Frames in the picture, and in a row of it.
const FRAMES: usize = 8;
const COLUMNS: usize = 4;
/// Longest side of a frame in the picture, pixels.
const SIDE: u32 = 480;
/// Lines of the table of frames that do not fit.
const LINES: usize = 20;

/// What to check.
#[derive(Args, Default)]
pub struct CheckArguments {
    /// A capture, as of `train`; the demo if left out
    scene: Option<String>,
    /// The picture to write [default: check.png in the capture, or demo-check.png]
    #[arg(long, value_name = "FILE.png")]
    out: Option<PathBuf>,
    /// The body model, as of `train`
    #[arg(long)]
    body: Option<PathBuf>,
    /// Print a line for every frame, not only for those that do not fit
    #[arg(long)]
    all: bool,
    #[command(flatten)]
    load: LoadArguments,
}

impl CheckArguments {
    /// A capture as it is.
    pub fn of(capture: &Path) -> Self {
        Self { scene: Some(capture.display().to_string()), ..Self::default() }
    }
}

/// Runs the command.
pub fn check(arguments: &CheckArguments) -> Result<()> {
    let mut load = arguments.load.options()?;
    // A camera without the body in view is to be diagnosed, not refused.
    load.unseen = true;
    let source = source::load(arguments.scene.as_deref(), arguments.body.as_deref(), &load)?;
    let found = occnerf::check(&source.capture, &source.model)?;
    let path = arguments.out.clone().unwrap_or_else(|| match source.scene.as_str() {
        source::DEMO => PathBuf::from("demo-check.png"),
        scene => Path::new(scene).join("check.png"),
    });
    save(&picture(&source, &found)?, &path)?;
    tell(&found, arguments.all);
    say!("picture: {} (outline of the body; green: mask; orange: unknown)", path.display());
    Ok(())
}

fn tell(found: &Check, all: bool) {
    let count = found.frames.len();
    say!(
        "{count} frames: body and mask overlap {:.2}, {:.0} % of the body hidden, {:.0} % of its surface seen at all",
        found.mean_iou(),
        100.0 * found.mean_hidden(),
        100.0 * found.surface_seen
    );
    let bad = found.frames.iter().filter(|frame| !frame.faults.is_empty()).count();
    if bad > 0 {
        say!("{bad} frames do not fit");
    }
    let mut lines = vec![["frame", "overlap", "hidden", ""].map(str::to_owned).to_vec()];
    for frame in found.frames.iter().filter(|frame| all || !frame.faults.is_empty()) {
        let iou = frame.iou.map_or("-".to_owned(), |iou| format!("{iou:.2}"));
        let faults: Vec<&str> = frame.faults.iter().map(|fault| fault.words()).collect();
        lines.push(vec![frame.name.clone(), iou, format!("{:.0} %", 100.0 * frame.hidden), faults.join(", ")]);
    }
    let more = lines.len().saturating_sub(1 + if all { usize::MAX - 1 } else { LINES });
    if lines.len() > 1 {
        lines.truncate(lines.len() - more);
        say!("{}", table::aligned(&lines, 1).trim_end());
    }
    if more > 0 {
        say!("… and {more} more (--all)");
    }
    let wrong = share(found, |fault| matches!(fault, Fault::Limb(_) | Fault::Overlap));
    say!("{}", grade(found.mean_iou(), wrong));
    let wrong = share(found, |fault| matches!(fault, Fault::Background | Fault::EmptyMask));
    say!("{}", grade_of_masks(found.mean_beyond(), wrong));
    say!("{}", verdict(found));
}

/// Share of the frames with such a fault.
fn share(found: &Check, wanted: impl Fn(Fault) -> bool) -> f32 {
    let frames = found.frames.iter().filter(|frame| frame.faults.iter().any(|fault| wanted(*fault)));
    frames.count() as f32 / found.frames.len().max(1) as f32
}

/// Shares of faulty frames up to which a fit, or masks, are good, and usable.
const GOOD: f32 = 0.05;
const USABLE: f32 = 0.3;

/// The fit's grade by its mean overlap and the share of frames that do not fit, and what to do
/// about it.
fn grade(iou: f32, wrong: f32) -> String {
    if iou >= 0.85 && wrong <= GOOD {
        return "fit: good".to_owned();
    }
    let (grade, advice) = if iou >= 0.65 && wrong <= USABLE {
        ("usable", "registration moves the bodies onto the pictures; 2-D key points help: import --keypoints")
    } else {
        ("poor", "see the picture: wrong masks, or a fit that training will not mend")
    };
    format!("fit: {grade}, overlap {iou:.2}, {:.0} % of the frames off ({advice})", 100.0 * wrong)
}

/// Shares of the masks beyond 5 cm of the body up to which they are good, and usable.
const CLOSE: f32 = 0.01;
const LOOSE: f32 = 0.1;

/// The masks' grade by the share of them that is not close to the body, and the share of frames
/// where they are empty or reach farther than clothes.
fn grade_of_masks(beyond: f32, wrong: f32) -> String {
    if beyond <= CLOSE && wrong <= GOOD {
        return "masks: good".to_owned();
    }
    let grade = if beyond <= LOOSE && wrong <= USABLE { "usable" } else { "poor" };
    let [beyond, wrong] = [beyond, wrong].map(|share| 100.0 * share);
    format!(
        "masks: {grade}, {beyond:.0} % of them lie more than 5 cm from the body (loose clothes, background, things \
         held, or the fit), {wrong:.0} % are empty or reach beyond clothes (segment these frames again)"
    )
}

fn verdict(found: &Check) -> String {
    match found.mistakes.as_slice() {
        [] => "no usual mistake found".to_owned(),
        mistakes => mistakes.iter().map(|mistake| format!("likely mistake: {mistake}")).collect::<Vec<_>>().join("\n"),
    }
}

/// Frames from all over the video, under the verdict.
fn picture(source: &Source, found: &Check) -> Result<RgbImage> {
    let frames = &source.capture.train;
    let shown = FRAMES.min(frames.len());
    let chosen: Vec<usize> = (0..shown).map(|i| (2 * i + 1) * frames.len() / (2 * shown)).collect();
    let mut strips = Vec::new();
    for row in chosen.chunks(COLUMNS) {
        let (mut cells, mut names) = (Vec::new(), Vec::new());
        for &i in row {
            cells.push(cell(&frames[i], &source.model)?);
            let is_seen = body_silhouette(&frames[i], &source.model)?.contains(&true);
            let iou = found.frames[i].iou.map_or("-".to_owned(), |iou| format!("{iou:.2}"));
            names.push(format!("{}  {}", found.frames[i].name, if is_seen { &iou } else { "body not in view" }));
        }
        // Rows are equally wide.
        let size = cells.first().map_or((1, 1), RgbImage::dimensions);
        let missing = COLUMNS.min(shown) - cells.len();
        cells.extend((0..missing).map(|_| RgbImage::from_pixel(size.0, size.1, Rgb([255; 3]))));
        names.extend((0..missing).map(|_| String::new()));
        let names: Vec<&str> = names.iter().map(String::as_str).collect();
        strips.push(captioned(&sheet(&[cells]), &names)?);
    }
    let width = strips.iter().map(RgbImage::width).max().unwrap_or(1);
    let height = strips.iter().map(RgbImage::height).sum::<u32>().max(1);
    let mut whole = RgbImage::from_pixel(width, height, Rgb([255; 3]));
    let mut top = 0;
    for strip in &strips {
        imageops::replace(&mut whole, strip, 0, i64::from(top));
        top += strip.height();
    }
    captioned(&whole, &[&verdict(found).replace('\n', "; ")])
}

/// A frame: mask tinted green, unknown pixels orange, the body's outline white within purple.
fn cell(frame: &Frame, model: &BodyModel) -> Result<RgbImage> {
    let pixels = frame.pixels()?;
    let silhouette = body_silhouette(frame, model)?;
    let unknown = unknown_pixels(frame, &pixels, &silhouette, model);
    let mut picture = to_rgb(&photograph(frame)?);
    let (width, height) = picture.dimensions();
    let at = |x: u32, y: u32| (y * width + x) as usize;
    let blend = |pixel: &mut Rgb<u8>, tint: [u8; 3], share: f32| {
        for (channel, tint) in pixel.0.iter_mut().zip(tint) {
            *channel = (f32::from(*channel) * (1.0 - share) + f32::from(tint) * share) as u8;
        }
    };
    for (x, y, pixel) in picture.enumerate_pixels_mut() {
        if pixels.mask[at(x, y)] > 0.5 {
            blend(pixel, [40, 220, 90], 0.35);
        } else if unknown[at(x, y)] {
            blend(pixel, [255, 140, 0], 0.45);
        }
    }
    // A small picture is enlarged first, so that the line is thin.
    let times = (SIDE / width.max(height)).max(1);
    let mut picture = match width.max(height) {
        longest if longest > SIDE => {
            let side = |n: u32| (n * SIDE / longest).max(1);
            imageops::thumbnail(&picture, side(width), side(height))
        }
        _ => imageops::resize(&picture, width * times, height * times, imageops::FilterType::Nearest),
    };
    let (to_width, to_height) = picture.dimensions();
    let inside = |x: u32, y: u32| {
        let (x, y) = (x * width / to_width, y * height / to_height);
        silhouette[at(x, y)]
    };
    // Two pixels wide, so that it shows on light and on dark.
    let next = |x: u32, y: u32| {
        let (right, below) = ((x + 1).min(to_width - 1), (y + 1).min(to_height - 1));
        [(x.saturating_sub(1), y), (right, y), (x, y.saturating_sub(1)), (x, below)]
    };
    for y in 0..to_height {
        for x in 0..to_width {
            let here = inside(x, y);
            if next(x, y).into_iter().any(|(x, y)| inside(x, y) != here) {
                picture.put_pixel(x, y, Rgb(if here { [255, 255, 255] } else { [200, 0, 160] }));
            }
        }
    }
    Ok(picture)
}
