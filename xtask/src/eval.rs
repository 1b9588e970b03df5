//! `eval`: metrics of a run on evaluation and training frames.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};
use clap::{Args, ValueEnum};
use image::RgbImage;
use indicatif::ProgressBar;
use occnerf::bake::{Avatar, BakedRenderer};
use occnerf::capture::Light;
use occnerf::{
    Body, FieldRenderer, Label, Lpips, Method, Model, Person, PreparedFrame, PriorColors, PriorRenderer, Renderer,
    Rendering, Scene, SplitMetrics, evaluate,
};
use rayon::prelude::*;
use visibility::Samples;

use crate::network::{load_lpips, network_name};
use crate::optimise::logged_seconds;
use crate::process::{Ending, Lock, is_read_only, note, one_line, peak_rss_bytes, say};
use crate::report::{self, SHEETS};
use crate::run::{self, Metrics, RunConfig, Splits, make_directory};
use crate::{baked, pictures, table};

/// Stride of scored training frames.
const TRAIN_STRIDE: usize = 10;
/// Instants of a contact sheet with one row a camera.
const SHEET_INSTANTS: usize = 3;
/// Training frames on their sheet.
const TRAIN_PICTURES: usize = 5;

/// Which frames are scored.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Split {
    /// Cameras that training never saw.
    NovelView,
    /// Every tenth training frame, on its known pixels.
    TrainView,
}

impl Split {
    /// Where its scores are kept.
    pub fn of(self, splits: &mut Splits) -> &mut Option<SplitMetrics> {
        match self {
            Self::NovelView => &mut splits.novel_view,
            Self::TrainView => &mut splits.train_view,
        }
    }

    fn frames(self, scene: &Scene) -> Vec<&PreparedFrame> {
        match self {
            Self::NovelView => scene.eval.iter().collect(),
            Self::TrainView => scored_train_frames(scene).collect(),
        }
    }
}

/// Arguments of `eval`.
#[derive(Args)]
pub struct EvalArguments {
    /// Run directory
    run: PathBuf,
    /// Which frames [default: both]
    #[arg(long)]
    split: Option<Split>,
    /// Weights to score LPIPS with, as for `train`
    #[arg(long, value_name = "PATH")]
    lpips: Option<PathBuf>,
    /// The baked person, as `render --baked` draws them, in place of the field; scores are only
    /// printed
    #[arg(long)]
    baked: bool,
    /// Threads [default: all cores]
    #[arg(long)]
    pub threads: Option<usize>,
}

/// Metrics of a run before scoring.
pub fn unscored(run: &RunConfig, drawn: &Drawn<'_>, train_seconds: f64) -> Metrics {
    let config = &run.train;
    let (steps, parameters, perceptual) = match drawn {
        Drawn::Prior(colors) => (0, 3 * colors.colors.len(), String::new()),
        Drawn::Field { model, perceptual } => (model.steps_done(), model.num_parameters(), perceptual.clone()),
        Drawn::Avatar { avatar, .. } => (0, avatar.num_parameters(), String::new()),
    };
    Metrics {
        method: config.method.name().to_owned(),
        preset: config.preset.name().to_owned(),
        occluded: config.occluded.name().to_owned(),
        scene: run.scene.clone(),
        seed: config.seed,
        steps,
        train_seconds,
        peak_rss_bytes: peak_rss_bytes(),
        parameters,
        perceptual,
        ..Metrics::default()
    }
}

/// Runs the command.
pub fn eval(arguments: &EvalArguments) -> Result<()> {
    let lpips = load_lpips(arguments.lpips.as_deref())?;
    let directory = &arguments.run;
    let run = RunConfig::read(directory)?;
    let mut writes = !(arguments.baked && run.train.method.has_field());
    let _lock = match if writes { Lock::take(directory) } else { Lock::share(directory) } {
        Err(error) if is_read_only(&error) => {
            note!("{}: the scores are only printed", one_line(&error));
            writes = false;
            Lock::share(directory)?
        }
        lock => lock?,
    };
    let source = run.source(directory)?;
    let scene = source.scene(&run.train)?;
    ensure!(!arguments.baked || run.train.method != Method::Prior, "--baked: a prior is not baked");
    // A surface is as baked as it can be.
    let baked = arguments.baked && run.train.method.has_field();
    let (loaded, avatar);
    let drawn = if run.train.method == Method::Prior {
        Drawn::Prior(PriorColors::measure(&scene)?)
    } else if run.train.method == Method::Surface {
        avatar = Avatar::load(&baked::path(directory))?;
        let colors = Person::colors(directory, &source.model)?;
        let colors = colors.with_context(|| format!("{} has no person.safetensors", directory.display()))?;
        Drawn::Avatar { body: &scene.body, light: colors.light, avatar: &avatar }
    } else if baked {
        loaded = run::model(directory, &run)?;
        avatar = baked::avatar(directory, &run)?;
        Drawn::Avatar { body: loaded.body(), light: loaded.light(), avatar: &avatar }
    } else {
        loaded = run::model(directory, &run)?;
        Drawn::Field { model: &loaded, perceptual: loaded.config().loss.perceptual_name() }
    };
    let mut network = network_name(lpips.as_ref());
    let mut metrics = unscored(&run, &drawn, 0.0);
    metrics.train_seconds = logged_seconds(directory, metrics.steps)?;
    metrics.of = run::identity(directory)?;
    match Metrics::fresh(directory, directory)? {
        Some(scored) => metrics = scored,
        None if writes => SHEETS.iter().try_for_each(|name| run::remove(&directory.join(name)))?,
        None => {}
    }
    ensure!(
        !scene.eval.is_empty() || arguments.split != Some(Split::NovelView),
        "{}: the capture keeps no views back; --split train-view scores those that training saw",
        run.scene
    );
    if writes && arguments.split.is_none() {
        metrics = score_run(directory, &run, &scene, &drawn, lpips.as_ref(), metrics)?;
    } else {
        for split in [Split::NovelView, Split::TrainView] {
            let empty = split == Split::NovelView && scene.eval.is_empty();
            if arguments.split.is_none_or(|only| only == split) {
                let scores = drawn.score_with_bar(&scene, split, lpips.as_ref(), |_, _| {})?;
                *split.of(&mut metrics.splits) = (!empty).then_some(scores);
            } else if let Some(scores) = split.of(&mut metrics.splits).as_mut().filter(|s| s.lpips_full.is_some()) {
                // One network name holds for both splits; scores of another are dropped.
                match &network {
                    Some(network) if metrics.lpips.as_ref() != Some(network) => scores.lpips_full = None,
                    _ => network = metrics.lpips.clone(),
                }
            }
        }
        metrics.lpips = network;
        if writes {
            metrics.write(directory)?;
            report::write(directory, &metrics)?;
        }
    }
    let mut one = metrics.clone();
    one.method.push_str(if baked { "-baked" } else { "" });
    for (name, split) in metrics.splits.titled() {
        one.splits = Splits { novel_view: Some(split.clone()), train_view: None };
        say!("{name}:\n{}", table::markdown(&[(one.method.clone(), &one)]));
    }
    Ok(())
}

fn scored_train_frames(scene: &Scene) -> impl Iterator<Item = &PreparedFrame> {
    // Held-out frames have unknown pixels only.
    let known = |frame: &&PreparedFrame| frame.labels.iter().any(|label| label != Label::Unknown);
    scene.train.iter().filter(known).step_by(TRAIN_STRIDE)
}

/// Every frame that a finished run is scored on.
pub fn scored_frames(scene: &Scene) -> impl Iterator<Item = &PreparedFrame> {
    scene.eval.iter().chain(scored_train_frames(scene))
}

/// Reads every picture of the scored frames, which may be on disk only.
pub fn check_pictures(scene: &Scene) -> Result<()> {
    let frames: Vec<&PreparedFrame> = scored_frames(scene).collect();
    // Collected as results first, so that the error reported is the first in order whatever
    // finishes first.
    let read: Vec<Result<(), occnerf::Error>> = frames.par_iter().map(|frame| frame.pixels().map(drop)).collect();
    Ok(read.into_iter().collect::<Result<(), _>>()?)
}

/// A model to score and render.
pub enum Drawn<'a> {
    /// The field of a trained model.
    Field {
        /// The model.
        model: &'a Model,
        /// Name of the perceptual term that it was trained with.
        perceptual: String,
    },
    /// The posed prior in mean colours.
    Prior(PriorColors),
    /// The baked avatar.
    Avatar {
        /// Its body.
        body: &'a Body,
        /// Light of the video.
        light: Light,
        /// The surface.
        avatar: &'a Avatar,
    },
}

impl Drawn<'_> {
    /// Its renderer.
    pub fn renderer<'s>(&'s self, scene: &'s Scene) -> Result<Box<dyn Renderer + 's>> {
        Ok(match self {
            Self::Field { model, .. } => Box::new(FieldRenderer::new(model)?),
            Self::Prior(colors) => Box::new(PriorRenderer::new(&scene.body, colors)),
            Self::Avatar { body, light, avatar } => {
                Box::new(BakedRenderer::new(avatar, body.scale, *light, Samples::Four))
            }
        })
    }

    /// Scores a split; `seen` gets each picture.
    pub fn score(
        &self,
        scene: &Scene,
        split: Split,
        lpips: Option<&Lpips>,
        seen: impl FnMut(&PreparedFrame, &Rendering),
    ) -> Result<SplitMetrics> {
        Ok(evaluate(scene, self.renderer(scene)?.as_mut(), &split.frames(scene), lpips, seen)?)
    }

    fn score_with_bar(
        &self,
        scene: &Scene,
        split: Split,
        lpips: Option<&Lpips>,
        mut seen: impl FnMut(&PreparedFrame, &Rendering),
    ) -> Result<SplitMetrics> {
        let bar = ProgressBar::new(split.frames(scene).len() as u64).with_message("scoring");
        let metrics = self.score(scene, split, lpips, |frame, rendering| {
            bar.inc(1);
            seen(frame, rendering);
        })?;
        bar.finish_and_clear();
        Ok(metrics)
    }
}

/// Scores both splits, writes metrics.json and the pictures of unseen views beside the truth.
pub fn score_run(
    directory: &Path,
    run: &RunConfig,
    scene: &Scene,
    drawn: &Drawn<'_>,
    lpips: Option<&Lpips>,
    mut metrics: Metrics,
) -> Result<Metrics> {
    let mut cameras: Vec<(String, Vec<Result<[RgbImage; 2]>>)> = Vec::new();
    let per_camera = scene.eval.iter().filter(|f| f.camera_name == scene.eval[0].camera_name).count().max(1);
    let stride = per_camera.div_ceil(SHEET_INSTANTS).max(1);
    let names: BTreeSet<&str> = scene.eval.iter().map(|f| f.camera_name.as_str()).collect();
    let most = pictures::MAX_SHEET_PIXELS / (2 * SHEET_INSTANTS * names.len().max(1)) as u64;
    let mut index = 0;
    let novel = drawn.score_with_bar(scene, Split::NovelView, lpips, |frame, rendering| {
        if cameras.last().is_none_or(|(name, _)| *name != frame.camera_name) {
            cameras.push((frame.camera_name.clone(), Vec::new()));
            index = 0;
        }
        if index % stride == 0
            && let Some((_, row)) = cameras.last_mut()
        {
            row.push(beside_truth(frame, rendering, most));
        }
        index += 1;
    })?;
    let mut row = Vec::new();
    let most = pictures::MAX_SHEET_PIXELS / (2 * TRAIN_PICTURES) as u64;
    let train = drawn.score_with_bar(scene, Split::TrainView, lpips, |frame, rendering| {
        if row.len() < TRAIN_PICTURES {
            row.push(beside_truth(frame, rendering, most));
        }
    })?;
    metrics.peak_rss_bytes = metrics.peak_rss_bytes.max(peak_rss_bytes());
    metrics.lpips = network_name(lpips);
    metrics.splits = Splits { novel_view: (!scene.eval.is_empty()).then_some(novel), train_view: Some(train) };
    metrics.scene.clone_from(&run.scene);
    if metrics.of.is_empty() {
        metrics.of = run::identity(directory)?;
    }
    metrics.write(directory)?;
    let cameras = cameras.into_iter().map(|(_, row)| row).collect();
    draw(directory, cameras, row).and_then(|()| report::write(directory, &metrics)).or_else(|error| {
        match error.downcast_ref::<Ending>() {
            Some(_) => Err(error),
            // The scores are saved; failed pictures are a warning.
            None => {
                note!("warning: not all was drawn: {}", one_line(&error));
                Ok(())
            }
        }
    })?;
    Ok(metrics)
}

/// Writes the contact sheets of both splits.
fn draw(directory: &Path, novel: Vec<Vec<Result<[RgbImage; 2]>>>, train: Vec<Result<[RgbImage; 2]>>) -> Result<()> {
    make_directory(&directory.join("renders"))?;
    if !novel.is_empty() {
        let rows = novel.into_iter().map(pairs).collect::<Result<Vec<_>>>()?;
        pictures::save(&pictures::sheet(&rows), &directory.join(SHEETS[0]))?;
    }
    pictures::save(&pictures::sheet(&[pairs(train)?]), &directory.join(SHEETS[1]))
}

/// Truth and rendering over grey, each reduced to at most `most` pixels.
fn beside_truth(frame: &PreparedFrame, rendering: &Rendering, most: u64) -> Result<[RgbImage; 2]> {
    let (width, height) = (frame.view.camera.width, frame.view.camera.height);
    let truth = frame.pixels()?;
    Ok([
        pictures::over_grey(&truth.image.pixels, &truth.mask, width, height),
        pictures::over_grey(&rendering.image.pixels, &rendering.opacity, width, height),
    ]
    .map(|picture| pictures::reduced(picture, most)))
}

/// Pictures one after the other.
fn pairs(row: Vec<Result<[RgbImage; 2]>>) -> Result<Vec<RgbImage>> {
    row.into_iter().collect::<Result<Vec<_>>>().map(|pairs| pairs.into_iter().flatten().collect())
}
