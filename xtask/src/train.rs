//! `train`: from frames to a scored and drawn person.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, Error, Result, bail, ensure};
use clap::Args;
use occnerf::bake::fit;
use occnerf::capture::{Capture, Mending};
use occnerf::{Config, Lpips, Method, Person, Scene, Trainer, checkpoint_config};

use crate::auto;
use crate::baked;
use crate::eval::{Drawn, Split, check_pictures, score_run, scored_frames, unscored};
use crate::network::{load_lpips, network_name};
use crate::optimise::{RunOptions, SavingArguments, optimise};
use crate::process::{Lock, check_memory, free_bytes, note, peak_rss_bytes, results_in, say, still_held, telling};
use crate::report;
use crate::run::{
    self, AVATAR, CHECKPOINT, METRICS, Metrics, RunConfig, Verdict, existing_directory, make_directory, new_directory,
};
use crate::settings::{HOLD_OUT, SettingArguments};
use crate::shard::ShardArguments;
use crate::source::{self, LoadArguments, Source};
use crate::table;

/// Arguments of `train`.
#[derive(Args)]
pub struct TrainArguments {
    /// A capture: raw ZJU-MoCap, or HumanNeRF's prepared or wild layout; the demo if left out or
    /// "demo" (a folder of that name is ./demo)
    pub scene: Option<String>,
    /// Run directory [default: runs/SCENE-METHOD]
    #[arg(long)]
    pub out: Option<PathBuf>,
    /// The body model of the capture, .npz, .pkl or .safetensors [default: body.npz or
    /// body.safetensors in the capture, the variable SMPL_MODEL, or body/*.npz near the capture]
    #[arg(long)]
    pub body: Option<PathBuf>,
    /// How the capture is read.
    #[command(flatten)]
    pub load: LoadArguments,
    /// What is trained.
    #[command(flatten)]
    pub settings: SettingArguments,
    /// Threads [default: all cores]; the result does not depend on it
    #[arg(long)]
    pub threads: Option<usize>,
    /// Weights to score LPIPS with: SqueezeNet 1.1, VGG16 or AlexNet, .safetensors or .pth, a file
    /// or a directory
    #[arg(long, value_name = "PATH")]
    pub lpips: Option<PathBuf>,
    /// Go on with the run in --out from its checkpoint
    #[arg(long)]
    pub resume: bool,
    /// How often it is saved.
    #[command(flatten)]
    pub saving: SavingArguments,
    /// Rewrite preview.png in the run directory every few seconds: the first training view as the
    /// model of that moment has it
    #[arg(long, conflicts_with = "list")]
    pub preview: bool,
    /// Stop after this many steps in all, leaving a checkpoint to resume from
    #[arg(long)]
    pub stop_after: Option<u64>,
    /// Train every scene of FILE, a path a line, each under OUT; finished ones are not trained
    /// again
    #[arg(long, value_name = "FILE", conflicts_with_all = ["scene", "resume", "stop_after"])]
    pub list: Option<PathBuf>,
    /// Which part of a list is trained.
    #[command(flatten)]
    pub part: ShardArguments,
}

/// Runs the command.
pub fn train(arguments: &TrainArguments) -> Result<()> {
    let lpips = load_lpips(arguments.lpips.as_deref())?;
    let alone = arguments.part.shard.is_none() && !arguments.part.merge;
    ensure!(alone, "--shard and --merge: of one scene there are no parts; they go with --list");
    let method = if arguments.settings.is_auto() { "auto" } else { arguments.settings.config()?.method.name() };
    let name = format!("{}-{method}", scene_name(arguments.scene.as_deref()));
    let out = arguments.out.as_deref();
    let interval = arguments.saving.interval()?;
    let TrainArguments { resume, stop_after, preview, .. } = *arguments;
    let options = RunOptions { resume, stop_after, interval, preview };
    // The lock is held to the end.
    let Begun { directory, source, config, _lock } =
        if arguments.resume { resumed(arguments, &existing_directory(out, &name)?)? } else { begun(arguments, &name)? };
    let run = RunConfig::new(&source, config)?;
    if arguments.resume && RunConfig::read(&directory)?.difference(&run) == Some(run::CHANGED) {
        note!("warning: the capture is not the one that the run began with");
    }
    run.write(&directory)?;
    say!("run: {}", directory.display());
    let Some(metrics) = run_one(&directory, &run, &source, lpips.as_ref(), &options)? else {
        say!("stopped; go on with --resume --out {}", directory.display());
        return Ok(());
    };
    let lesser = baselines(&run, &source, lpips.as_ref())?;
    let rows: Vec<_> = lesser.iter().chain([&metrics]).map(|metrics| (metrics.method.clone(), metrics)).collect();
    say!("\n{}:\n{}", metrics.splits.title(), table::markdown(&rows));
    say!("pictures: {}", directory.join("renders").display());
    if run.train.method != Method::Prior {
        say!("a page to turn the person around: cargo xtask view {}", directory.display());
    }
    Ok(())
}

/// A run before its training, and its directory, locked for writing.
struct Begun {
    directory: PathBuf,
    source: Source,
    config: Config,
    _lock: Lock,
}

/// A new run.
fn begun(arguments: &TrainArguments, name: &str) -> Result<Begun> {
    let mut config = arguments.settings.config()?;
    let unused = [("--preview", arguments.preview), ("--stop-after", arguments.stop_after.is_some())];
    if let Some((option, _)) = unused.iter().find(|(_, given)| *given && !config.method.has_field()) {
        bail!("{option}: the method {} takes no steps", config.method.name());
    }
    let mut source = source::load(arguments.scene.as_deref(), arguments.body.as_deref(), &arguments.load.options()?)?;
    let is_given = arguments.settings.set.iter().any(|set| set.starts_with("held_out="));
    if source.capture.eval.is_empty() && source.capture.train.len() >= 2 * HOLD_OUT && !is_given {
        config.held_out = HOLD_OUT;
        say!("no other camera: every {HOLD_OUT}th frame is scored, and nothing is learnt from it (--set held_out=0)");
    }
    let verdict = if arguments.settings.is_auto() { Some(auto::weigh(&mut source, &config)?) } else { None };
    if verdict.as_ref().is_some_and(|verdict| !verdict.field) {
        config = Config { held_out: config.held_out, ..arguments.settings.without_field()? };
    }
    // The directory is made only now, so that bad input leaves nothing behind.
    let (directory, lock) = new_directory(arguments.out.as_deref(), name)?;
    Verdict::begin(&directory, verdict.as_ref())?;
    Ok(Begun { directory, source, config, _lock: lock })
}

/// A run that goes on.
fn resumed(arguments: &TrainArguments, directory: &Path) -> Result<Begun> {
    let lock = Lock::take(directory)?;
    let checkpoint = directory.join(CHECKPOINT);
    let begun = if checkpoint.is_file() { Some(checkpoint_config(&checkpoint)?) } else { None };
    if begun.is_none() {
        say!("{}: no checkpoint to go on from; from the start", directory.display());
    }
    let saved = RunConfig::read(directory)?;
    let config = arguments.settings.resumed(begun.unwrap_or(saved.train))?;
    let load = arguments.load.resumed(&saved.load)?;
    let scene = arguments.scene.as_deref().unwrap_or(&saved.scene);
    let body = arguments.body.as_deref().or(saved.body.as_deref());
    let mut source = source::load(Some(scene), body, &load)?;
    source.restore(directory, &config)?;
    Ok(Begun { directory: directory.to_owned(), source, config, _lock: lock })
}

/// A short name for default directories.
pub fn scene_name(scene: Option<&str>) -> String {
    let scene = scene.unwrap_or(source::DEMO);
    let name = Path::new(scene).file_stem().map_or(source::DEMO.into(), |s| s.to_string_lossy());
    name.chars().map(|c| if c.is_alphanumeric() || c == '_' { c } else { '-' }).collect()
}

/// Least share of background in masks that is worth a word.
const LEAST_BACKGROUND: f32 = 0.01;

/// What was made of the masks, and of the focal length if it is more than the noise of one that is
/// right.
fn say_corrections(source: &Source, scene: &Scene) {
    let Mending { growth, background } = scene.registered.mending;
    match growth {
        0 => {}
        by if by < 0 => say!("masks: {} pixels larger than the person all around, trimmed", -by),
        by => say!("masks: {by} pixels smaller than the person all around, grown"),
    }
    if background >= LEAST_BACKGROUND {
        say!("masks: {:.1} % of their pixels look like the background beside them, left out", 100.0 * background);
    }
    let focal = |capture: &Capture| capture.train.first().map_or(1.0, |frame| frame.camera.focal.x);
    let (given, found) = (focal(&source.capture), focal(&scene.registered.capture));
    if (found / given - 1.0).abs() > 0.1 {
        say!("focal length: {given:.0} pixels given, {found:.0} found");
    }
}

/// Least share of the masks that the registered body covers.
const LEAST_COVERED: f64 = 0.1;

/// Trains, scores and draws one run; `None` if it stopped early.
pub fn run_one(
    directory: &Path,
    run: &RunConfig,
    source: &Source,
    lpips: Option<&Lpips>,
    options: &RunOptions,
) -> Result<Option<Metrics>> {
    check_memory(PEAK * peak_rss_bytes())?;
    let scene = source.scene(&run.train)?;
    say_corrections(source, &scene);
    let covered = scene.covered()?;
    ensure!(
        covered >= LEAST_COVERED,
        "{}: nothing can be learnt: the body covers {:.0} % of the person in the masks; `check` names likely mistakes",
        run.scene,
        100.0 * covered
    );
    // Before the training, not after it.
    check_pictures(&scene)?;
    if let Some(lpips) = lpips {
        for frame in scored_frames(&scene) {
            lpips.check_size(frame.view.camera.width as usize, frame.view.camera.height as usize)?;
        }
    }
    let checkpoint = directory.join(CHECKPOINT);
    let resumes = options.resume && checkpoint.is_file();
    let began_with = if resumes { Person::colors(directory, &source.model)? } else { None };
    let scene = if let Some(colors) = began_with { scene.with_colors(colors) } else { scene };
    let start = Instant::now();
    let colors = scene.colors()?;
    let prior_seconds = start.elapsed().as_secs_f64();
    still_held(directory)?;
    let kept = Person::save(directory, &scene.registered, &source.model, colors);
    kept.map_err(Error::from).map_err(results_in(directory))?;
    let scored = |drawn: &Drawn<'_>, seconds: f64| {
        score_run(directory, run, &scene, drawn, lpips, unscored(run, drawn, seconds)).map(Some)
    };
    if run.train.method == Method::Prior {
        return scored(&Drawn::Prior(colors.clone()), prior_seconds);
    }
    if run.train.method == Method::Surface {
        let (avatar, report) = telling("fitting the surface", || fit(&scene))?;
        say!("surface of {} triangles, an atlas of {} × {}", report.faces, report.side, report.side);
        still_held(directory)?;
        avatar.save(&baked::path(directory)).map_err(Error::from).map_err(results_in(directory))?;
        let drawn = Drawn::Avatar { body: &scene.body, light: colors.light, avatar: &avatar };
        return scored(&drawn, prior_seconds + report.seconds);
    }
    say_memory(&scene, &run.train)?;
    let mut trainer =
        if resumes { Trainer::resume(&scene, &checkpoint)? } else { Trainer::new(&scene, run.train.clone())? };
    trainer.set_steps(run.train.steps);
    trainer.load_perceptual()?;
    let seconds = optimise(directory, &mut trainer, options);
    if seconds.is_err() || trainer.steps_done() < run.train.steps {
        let named = report::refresh(directory);
        return seconds.and(named).map(|()| None);
    }
    let seconds = seconds?;
    let perceptual = trainer.perceptual();
    let model = trainer.into_model();
    scored(&Drawn::Field { model: &model, perceptual }, seconds)
}

/// Peak memory over that of the loaded capture: 5.2 and 4.9 on captures of 26 and 47 MiB.
const PEAK: u64 = 5;

/// Steps that are tried, and forgotten, to know what memory a run takes.
const TRIED: u64 = 4;

/// Says what memory training takes before it begins. A run of few steps tells soon enough.
fn say_memory(scene: &Scene, config: &Config) -> Result<()> {
    let capture = peak_rss_bytes();
    if capture == 0 || config.steps < 10 * TRIED {
        return Ok(());
    }
    let mut trial = Trainer::new(scene, config.clone())?;
    // With this schedule pose corrections are trained within the trial, too.
    trial.set_steps(TRIED);
    trial.load_perceptual()?;
    // Each with its gradient and two moments.
    let parameters = 4 * size_of::<f32>() as u64 * trial.model().num_parameters() as u64;
    for _ in 0..TRIED {
        trial.step()?;
    }
    let samples = peak_rss_bytes().saturating_sub(capture + parameters);
    let [whole, capture, parameters, samples] =
        [capture + parameters + samples, capture, parameters, samples].map(|bytes| bytes.div_ceil(1 << 20));
    say!("memory: about {whole} MiB (capture {capture}, parameters {parameters}, samples {samples})");
    if let Some(free) = free_bytes().map(|free| (free + peak_rss_bytes()) >> 20).filter(|free| *free < whole) {
        note!("warning: {free} MiB are free: the system may end this (--memory, or smaller sizes by --set)");
    }
    Ok(())
}

/// The scores of a run under `directory`: those it has if it finished earlier with the same
/// settings; else it goes on from its checkpoint, or starts.
pub fn run_unless_finished(
    directory: &Path,
    name: &str,
    run: &RunConfig,
    source: &Source,
    lpips: Option<&Lpips>,
    interval: Duration,
) -> Result<Metrics> {
    unless_finished(directory, directory, run, lpips, |earlier| {
        say!("{name}: training");
        run.write(directory)?;
        let options = RunOptions { resume: earlier, stop_after: None, interval, preview: false };
        let metrics = run_one(directory, run, source, lpips, &options)?;
        metrics.with_context(|| format!("{name}: stopped before its end"))
    })
}

/// The scores under `directory` if they are of the same settings and of the model under `trained`;
/// else what `make` makes, which is told whether a run with these settings has begun there.
///
/// # Errors
/// A run of another scene or with other settings, whose work would be lost.
pub fn unless_finished(
    directory: &Path,
    trained: &Path,
    run: &RunConfig,
    lpips: Option<&Lpips>,
    make: impl FnOnce(bool) -> Result<Metrics>,
) -> Result<Metrics> {
    make_directory(&directory.join("renders"))?;
    let _lock = Lock::take(directory)?;
    let old = if directory.join("config.toml").is_file() { Some(RunConfig::read(directory)?) } else { None };
    if let Some(old) = old.as_ref().filter(|old| !old.same_scene(run)) {
        let body = |run: &RunConfig| run.body.as_ref().map_or(String::new(), |b| format!(" with {}", b.display()));
        bail!(
            "{} holds a run of {}{}; for {}{} give another --out",
            directory.display(),
            old.scene,
            body(old),
            run.scene,
            body(run)
        );
    }
    let differs = old.as_ref().and_then(|old| old.difference(run));
    let begun = [CHECKPOINT, AVATAR, METRICS].iter().any(|name| directory.join(name).exists());
    if let Some(difference) = differs.filter(|_| begun) {
        bail!("{} holds a run with {difference}: give another --out, or remove it", directory.display());
    }
    // Scores without the requested metric are computed again from the checkpoint.
    let named = |metrics: &Metrics| lpips.is_none() || metrics.lpips == network_name(lpips);
    if let Some(metrics) = finished(directory, trained, run)?.filter(named) {
        say!("{}: finished earlier", directory.file_name().unwrap_or_default().to_string_lossy());
        return Ok(metrics);
    }
    make(old.is_some() && differs.is_none())
}

/// The scores under `directory` of the same run and of the model under `trained`; `None` where it
/// has not come to them.
pub fn finished(directory: &Path, trained: &Path, run: &RunConfig) -> Result<Option<Metrics>> {
    let is_same = RunConfig::read(directory).is_ok_and(|old| old.same_scene(run) && old.difference(run).is_none());
    let metrics = if is_same { Metrics::fresh(directory, trained)? } else { None };
    Ok(metrics.filter(|metrics| !run.train.method.has_field() || metrics.steps >= run.train.steps))
}

/// What less of a model reaches on the same frames: the scores of the prior and, of a field, of the
/// surface.
fn baselines(run: &RunConfig, source: &Source, lpips: Option<&Lpips>) -> Result<Vec<Metrics>> {
    let method = run.train.method;
    if method == Method::Prior {
        return Ok(Vec::new());
    }
    let scene = source.scene(&run.train)?;
    let start = Instant::now();
    let colors = scene.colors()?;
    let seconds = start.elapsed().as_secs_f64();
    let split = if scene.eval.is_empty() { Split::TrainView } else { Split::NovelView };
    let scored = |method: Method, drawn: &Drawn<'_>, seconds: f64| -> Result<Metrics> {
        let mut run = run.clone();
        run.train.method = method;
        let mut metrics = unscored(&run, drawn, seconds);
        metrics.lpips = network_name(lpips);
        *split.of(&mut metrics.splits) = Some(drawn.score(&scene, split, lpips, |_, _| {})?);
        Ok(metrics)
    };
    let mut all = vec![scored(Method::Prior, &Drawn::Prior(colors.clone()), seconds)?];
    if method.has_field() {
        let (avatar, report) = fit(&scene)?;
        let drawn = Drawn::Avatar { body: &scene.body, light: colors.light, avatar: &avatar };
        all.push(scored(Method::Surface, &drawn, seconds + report.seconds)?);
    }
    Ok(all)
}
