//! `train`: from frames to a scored and drawn person.

use std::io::{IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};
use occnerf::{Lpips, Method, Person, Scene, StepReport, Trainer, VertexColors, checkpoint_config};

use crate::capacity::{self, CapacityName};
use crate::compare::compare;
use crate::eval::{Drawn, Split, check_pictures, load_lpips, network_name, score_run, scored_frames, unscored};
use crate::run::{CHECKPOINT, LOG, METRICS, Metrics, RunConfig, existing_directory, new_directory, use_threads};
use crate::settings::SettingArguments;
use crate::source::{self, LoadArguments, Source};
use crate::{run, table};

/// A checkpoint this often, so that a power cut costs little.
const CHECKPOINT_EVERY: Duration = Duration::from_secs(30);
const LOG_EVERY: u64 = 10;
/// Without a terminal the progress is a line this often.
const LINE_EVERY: Duration = Duration::from_secs(15);

#[derive(Args)]
pub struct TrainArguments {
    /// A capture (raw ZJU-MoCap, or HumanNeRF's prepared or wild layout), or a rigged .glb or .gltf character, of which one
    /// is made as synth does; the embedded demo if left out
    pub scene: Option<String>,
    /// Run directory [default: runs/SCENE-METHOD]
    #[arg(long)]
    pub out: Option<PathBuf>,
    /// The body model of the capture, .npz, .pkl or .safetensors [default: body.npz or
    /// body.safetensors in the capture, the variable SMPL_MODEL, or body/*.npz near the capture]
    #[arg(long)]
    pub body: Option<PathBuf>,
    #[command(flatten)]
    pub load: LoadArguments,
    #[command(flatten)]
    pub settings: SettingArguments,
    /// Sizes of the model [default: preset]
    #[arg(long, conflicts_with = "compare")]
    pub capacity: Option<CapacityName>,
    /// Threads [default: all cores]; the result does not depend on it
    #[arg(long)]
    pub threads: Option<usize>,
    /// Weights to score LPIPS with: SqueezeNet 1.1, VGG16 or AlexNet, .safetensors or .pth, a file or a directory
    #[arg(long, value_name = "PATH")]
    pub lpips: Option<PathBuf>,
    /// Go on with the run in --out from its checkpoint
    #[arg(long)]
    pub resume: bool,
    /// Stop after this many steps in all, leaving a checkpoint to resume from
    #[arg(long)]
    pub stop_after: Option<u64>,
    /// Train every method under both pixel rules and print one table
    #[arg(long, conflicts_with_all = ["resume", "stop_after"])]
    pub compare: bool,
}

/// Runs the command.
pub fn train(arguments: &TrainArguments) -> Result<()> {
    use_threads(arguments.threads)?;
    let lpips = load_lpips(arguments.lpips.as_deref())?;
    if arguments.compare {
        return compare(arguments, lpips.as_ref());
    }
    let method = arguments.settings.config()?.method;
    let name = format!("{}-{}", scene_name(arguments.scene.as_deref()), method.name());
    let out = arguments.out.as_deref();
    let (directory, mut config) = if arguments.resume {
        let directory = existing_directory(out, &name)?;
        let capacity = capacity::resumed(&directory, arguments.capacity)?;
        let saved = checkpoint_config(&directory.join(CHECKPOINT))?;
        let config = arguments.settings.resumed(saved, capacity.as_ref())?;
        (directory, config)
    } else {
        (PathBuf::new(), arguments.settings.config()?)
    };
    let source = if arguments.resume {
        let saved = RunConfig::read(&directory)?;
        let load = arguments.load.resumed(&saved.load)?;
        let scene = arguments.scene.as_deref().unwrap_or(&saved.scene);
        source::load(Some(scene), arguments.body.as_deref().or(saved.body.as_deref()), &load)?
    } else {
        source::load(arguments.scene.as_deref(), arguments.body.as_deref(), &arguments.load.options()?)?
    };
    let mut chosen = None;
    if !arguments.resume && arguments.capacity == Some(CapacityName::Auto) {
        let capacity = capacity::measure(&source, &config, &arguments.settings.set)?;
        capacity.apply(&mut config);
        config.validate()?;
        chosen = Some(capacity);
    }
    // The directory of a new run is made only now, so that bad input leaves nothing behind.
    let directory = if arguments.resume { directory } else { new_directory(out, &name)? };
    let run =
        RunConfig { scene: source.scene.clone(), body: source.body.clone(), load: source.load.clone(), train: config };
    run.write(&directory)?;
    println!("run: {}", directory.display());
    if let Some(capacity) = &chosen {
        capacity::save(&directory, capacity)?;
        print!("capacity from the scene:\n{capacity}");
    }
    let Some(metrics) = run_one(&directory, &run, &source, lpips.as_ref(), arguments.resume, arguments.stop_after)?
    else {
        println!("stopped; go on with --resume --out {}", directory.display());
        return Ok(());
    };
    let mut rows = vec![(metrics.method.clone(), &metrics)];
    let prior;
    if run.train.method != Method::Prior {
        prior = prior_metrics(&run, &source, lpips.as_ref())?;
        rows.insert(0, (prior.method.clone(), &prior));
    }
    println!("\n{}:\n{}", metrics.splits.title(), table::markdown(&rows));
    println!("pictures: {}", directory.join("renders").display());
    Ok(())
}

/// A short name for default directories.
pub fn scene_name(scene: Option<&str>) -> String {
    let scene = scene.unwrap_or(source::DEMO);
    let name = Path::new(scene).file_stem().map_or(source::DEMO.into(), |s| s.to_string_lossy());
    name.chars().map(|c| if c.is_alphanumeric() || c == '_' { c } else { '-' }).collect()
}

/// Trains, scores and draws one run; `None` if it stopped early.
pub fn run_one(
    directory: &Path,
    run: &RunConfig,
    source: &Source,
    lpips: Option<&Lpips>,
    resume: bool,
    stop_after: Option<u64>,
) -> Result<Option<Metrics>> {
    let scene = Scene::new(&source.capture, &source.model, &run.train)?;
    // Before the training, not after it.
    check_pictures(&scene)?;
    if let Some(lpips) = lpips {
        for frame in scored_frames(&scene) {
            lpips.check_size(frame.view.camera.width as usize, frame.view.camera.height as usize)?;
        }
    }
    let start = Instant::now();
    let colors = VertexColors::measure(&scene)?;
    let prior_seconds = start.elapsed().as_secs_f64();
    Person::save(directory, &source.capture, &source.model, &colors)?;
    if run.train.method == Method::Prior {
        let prior = Drawn::Prior(colors);
        let metrics = unscored(run, &prior, prior_seconds);
        return score_run(directory, run, &scene, &prior, lpips, metrics).map(Some);
    }
    let checkpoint = directory.join(CHECKPOINT);
    let mut trainer =
        if resume { Trainer::resume(&scene, &checkpoint)? } else { Trainer::new(&scene, run.train.clone())? };
    trainer.set_steps(run.train.steps);
    trainer.load_perceptual()?;
    let seconds = optimise(directory, &mut trainer, stop_after)?;
    if trainer.steps_done() < run.train.steps {
        return Ok(None);
    }
    capacity::prune(directory, &mut trainer, &checkpoint)?;
    let perceptual = trainer.perceptual();
    let model = trainer.into_model();
    let trained = Drawn::Field { model: &model, perceptual };
    let metrics = unscored(run, &trained, seconds);
    score_run(directory, run, &scene, &trained, lpips, metrics).map(Some)
}

/// The scores of a run under `directory`: those it has if it finished earlier with the same settings; else it goes on from its
/// checkpoint, or starts.
pub fn run_unless_finished(
    directory: &Path,
    name: &str,
    run: &RunConfig,
    source: &Source,
    lpips: Option<&Lpips>,
) -> Result<Metrics> {
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
    let earlier = old.is_some_and(|old| old.train == run.train && old.load == run.load);
    if earlier && directory.join(METRICS).is_file() {
        let metrics = Metrics::read(directory)?;
        // Scores that lack what is asked for now are made anew from the checkpoint.
        if lpips.is_none() || metrics.lpips == network_name(lpips) {
            println!("{name}: finished earlier");
            return Ok(metrics);
        }
    }
    println!("{name}: training");
    std::fs::create_dir_all(directory.join("renders"))?;
    run.write(directory)?;
    let resume = earlier && directory.join(CHECKPOINT).is_file();
    let metrics = run_one(directory, run, source, lpips, resume, None)?;
    metrics.with_context(|| format!("{name}: stopped before its end"))
}

/// The scores of the prior baseline on the same frames.
fn prior_metrics(run: &RunConfig, source: &Source, lpips: Option<&Lpips>) -> Result<Metrics> {
    let mut prior = run.clone();
    prior.train.method = Method::Prior;
    let scene = Scene::new(&source.capture, &source.model, &prior.train)?;
    let start = Instant::now();
    let colors = VertexColors::measure(&scene)?;
    let drawn = Drawn::Prior(colors);
    let mut metrics = unscored(&prior, &drawn, start.elapsed().as_secs_f64());
    metrics.lpips = network_name(lpips);
    let split = if scene.eval.is_empty() { Split::TrainView } else { Split::NovelView };
    *split.of(&mut metrics.splits) = Some(drawn.score(&scene, split, lpips, |_, _| {})?);
    Ok(metrics)
}

/// Takes steps until the end or `stop_after`, with a log, a bar and checkpoints; returns seconds of training, those
/// of earlier sittings included.
fn optimise(directory: &Path, trainer: &mut Trainer<'_>, stop_after: Option<u64>) -> Result<f64> {
    let total = trainer.model().config().steps;
    let end = stop_after.unwrap_or(total).min(total);
    let log_path = directory.join(LOG);
    let earlier = earlier_log(&log_path, trainer.steps_done())?;
    run::write(&log_path, &earlier.text)?;
    let mut log = std::fs::File::options().append(true).open(&log_path).context(LOG)?;
    let bar = ProgressBar::new(total);
    let style = "{bar:28} {pos}/{len} steps  {msg}  {elapsed} elapsed, {eta} left";
    bar.set_style(ProgressStyle::with_template(style)?);
    bar.set_position(trainer.steps_done());
    bar.reset_eta();
    let checkpoint = directory.join(CHECKPOINT);
    let (start, mut saved, mut lined) = (Instant::now(), Instant::now(), Instant::now());
    let (mut smooth, mut bad, mut restarts) = (None::<StepReport>, 0, None);
    while trainer.steps_done() < end {
        let report = match trainer.step() {
            Ok(report) => report,
            Err(error) => {
                bar.abandon();
                let learnt = match trainer.save(&checkpoint) {
                    Ok(()) => format!("is in {}", checkpoint.display()),
                    Err(error) => format!("could not be saved ({error})"),
                };
                let place = format!("step {}; what was learnt {learnt}", trainer.steps_done() + 1);
                return Err(anyhow::Error::from(error).context(place));
            }
        };
        bad += report.bad_gradients;
        if restarts.replace(report.restarts).is_some_and(|before| before < report.restarts) {
            let said = format!("step {}: nothing was left of the person", report.step);
            bar.suspend(|| eprintln!("{said}; begun anew at a tenth of the learning rates"));
        }
        let mean = blend(smooth, report);
        smooth = Some(mean);
        let seconds = earlier.seconds + start.elapsed().as_secs_f64();
        if report.step.is_multiple_of(LOG_EVERY) || report.step == end {
            let mut line = serde_json::to_value(mean)?;
            line["step"] = report.step.into();
            line["seconds"] = seconds.into();
            line["live_samples"] = report.live_samples.into();
            line["bad_gradients"] = bad.into();
            writeln!(log, "{line}").context(LOG)?;
            let message = format!(
                "loss {:.4} (mse {:.4}, perceptual {:.3}, completeness {:.4})  psnr {:.2}",
                mean.loss, mean.mse, mean.perceptual, mean.completeness, mean.psnr
            );
            bar.set_position(report.step);
            if !std::io::stderr().is_terminal() && lined.elapsed() >= LINE_EVERY {
                lined = Instant::now();
                let left = start.elapsed().as_secs_f64() / (bar.position() as f64 - earlier.steps as f64).max(1.0)
                    * (total - report.step) as f64;
                eprintln!("step {}/{total}  {message}  {seconds:.0} s, {left:.0} s left", report.step);
            }
            bar.set_message(message);
        }
        if saved.elapsed() >= CHECKPOINT_EVERY {
            trainer.save(&checkpoint)?;
            saved = Instant::now();
        }
    }
    trainer.save(&checkpoint)?;
    bar.finish();
    if bad > 0 {
        eprintln!("warning: {bad} gradients were not finite and were left out");
    }
    Ok(earlier.seconds + start.elapsed().as_secs_f64())
}

/// Seconds of training that the first `steps` steps of the run in `directory` took, as far as its log knows.
pub fn logged_seconds(directory: &Path, steps: u64) -> Result<f64> {
    Ok(earlier_log(&directory.join(LOG), steps)?.seconds)
}

struct EarlierLog {
    text: String,
    seconds: f64,
    steps: u64,
}

/// The log up to the checkpoint; lines of steps that the checkpoint does not hold are dropped.
fn earlier_log(path: &Path, steps: u64) -> Result<EarlierLog> {
    let mut log = EarlierLog { text: String::new(), seconds: 0.0, steps };
    if steps == 0 || !path.exists() {
        return Ok(log);
    }
    for line in std::fs::read_to_string(path).with_context(|| path.display().to_string())?.lines() {
        let Ok(value) = serde_json::from_str::<serde_json::Value>(line) else { continue };
        if value["step"].as_u64().is_some_and(|s| s <= steps) {
            log.text.push_str(line);
            log.text.push('\n');
            log.seconds = value["seconds"].as_f64().unwrap_or(log.seconds);
        }
    }
    Ok(log)
}

/// A running mean over about fifty steps.
fn blend(mean: Option<StepReport>, new: StepReport) -> StepReport {
    let Some(old) = mean else { return new };
    let mix = |old: f64, new: f64| old + 0.02 * (new - old);
    StepReport {
        loss: mix(old.loss, new.loss),
        mse: mix(old.mse, new.mse),
        perceptual: mix(old.perceptual, new.perceptual),
        completeness: mix(old.completeness, new.completeness),
        psnr: mix(old.psnr, new.psnr),
        ..new
    }
}
