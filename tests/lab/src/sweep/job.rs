//! A run of a sweep: its description, its outcome, and the child process that takes it there.

use std::ffi::OsStr;
use std::io::{BufRead, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use glam::Vec3;
use occnerf::bake::{BakedRenderer, bake, fit};
use occnerf::capture::Capture;
use occnerf::{
    Config, FieldRenderer, Lpips, Model, PreparedFrame, PriorColors, PriorRenderer, Renderer, Scene, SplitMetrics,
    evaluate,
};
use serde::{Deserialize, Serialize};
use smpl::BodyModel;
use visibility::Samples;

use crate::bench::Difficulty;
use crate::methods::Method;
use crate::scene::SceneOptions;
use xtask::auto::weigh;
use xtask::eval::{Drawn, score_run};
use xtask::network::load_lpips;
use xtask::process::{Ending, Guard, one_line, peak_rss_bytes, say, telling};
use xtask::run::{Metrics, RunConfig};
use xtask::source;
use xtask::source::Source;
use xtask::train::{run_unless_finished, unless_finished};

/// Longest job on standard input.
const MAX_JOB_BYTES: u64 = 1 << 20;
/// A run that is not kept is ended after this time and counts as failed.
const LIMIT: Duration = Duration::from_secs(30 * 60);
/// Time between two checkpoints of a kept run.
const INTERVAL: Duration = Duration::from_secs(30);
/// Time that a kept run has to write its checkpoint after a signal.
const GRACE: Duration = Duration::from_secs(60);
/// Exit code of a run whose directory another process holds, see [`xtask::process::EXIT_CODES`].
const BUSY: i32 = 4;

/// Where the frames come from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Place {
    /// As `train` reads them.
    Scene { scene: String, body: Option<PathBuf>, load: SceneOptions },
    /// Made for the purpose.
    Made(Difficulty),
}

impl Place {
    /// What charts and tables call it.
    pub fn name(&self) -> &str {
        match self {
            Self::Scene { scene, .. } => scene,
            Self::Made(_) => source::DEMO,
        }
    }

    fn load(&self) -> Result<(Capture, BodyModel)> {
        match self {
            Self::Scene { scene, body, load } => {
                let source = load.load(scene, body.as_deref())?;
                Ok((source.capture, source.model))
            }
            Self::Made(difficulty) => difficulty.make(),
        }
    }
}

/// A run to be measured.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Job {
    pub place: Place,
    /// At most this many unseen views are scored, evenly chosen.
    pub views: usize,
    pub method: Method,
    pub config: Config,
    /// Scores the baked person instead of the field, with four samples a pixel or one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bake: Option<bool>,
    /// Weights of LPIPS.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lpips: Option<PathBuf>,
    /// Run directory, scored and drawn as `train` does it; measured and forgotten where there is
    /// none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub keep: Option<Keep>,
}

/// The run directory of a job. A sweep's folder may be moved: equality is that of names inside it.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Keep {
    pub directory: PathBuf,
    /// Directory of the trained run whose baked person is scored; trained first if need be.
    pub trained: Option<PathBuf>,
}

impl PartialEq for Keep {
    fn eq(&self, other: &Self) -> bool {
        let name = |path: &Path| path.iter().rev().take(2).map(OsStr::to_owned).collect::<Vec<_>>();
        let names = |keep: &Self| (name(&keep.directory), keep.trained.as_deref().map(name));
        names(self) == names(other)
    }
}

impl Job {
    /// A run that is measured and forgotten.
    pub fn new(place: Place, views: usize, method: Method, config: Config) -> Self {
        Self { place, views, method, config, bake: None, lpips: None, keep: None }
    }
}

/// What came of it; all zero or none where there is an error.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Outcome {
    pub error: Option<String>,
    /// Baking included, and what `auto` tries.
    pub train_seconds: f64,
    pub seconds_per_frame: f64,
    pub psnr_mask: Option<f64>,
    pub ssim_mask: Option<f64>,
    pub psnr_hidden: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lpips: Option<f64>,
    pub parameters: usize,
    pub peak_rss_bytes: u64,
    /// Left out by the optimiser.
    pub bad_gradients: usize,
    /// Losses of steps and numbers of scored pictures that are not finite.
    pub non_finite: usize,
    /// All scores of a kept run.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub metrics: Option<Metrics>,
}

/// Trains and scores in the run directory, unless it holds the finished run.
fn keep_run(job: &Job, Keep { directory, trained }: &Keep) -> Result<Outcome> {
    let Place::Scene { scene, body, load } = &job.place else { bail!("a capture made on the spot is not kept") };
    let source = load.load(scene, body.as_deref())?;
    let run = RunConfig::new(&source, job.config.clone())?;
    let (lpips, name) =
        (load_lpips(job.lpips.as_deref())?, directory.file_name().unwrap_or_default().to_string_lossy());
    let metrics = match trained {
        Some(trained) => baked_unless_finished(directory, trained, &run, &source, lpips.as_ref())?,
        None => job.method.run_unless_finished(directory, &name, &run, &source, lpips.as_ref(), INTERVAL)?,
    };
    let mut outcome = Outcome {
        train_seconds: metrics.train_seconds,
        parameters: metrics.parameters,
        peak_rss_bytes: metrics.peak_rss_bytes,
        ..Outcome::default()
    };
    if let Some((_, split)) = metrics.splits.first() {
        outcome.take(split);
    }
    Ok(Outcome { metrics: Some(metrics), ..outcome })
}

/// The scores under `directory` of the baked person of the run under `trained`, which is trained
/// first if need be. Baking time adds to the run's seconds; parameters are texel colours and
/// vertices.
fn baked_unless_finished(
    directory: &Path,
    trained: &Path,
    run: &RunConfig,
    source: &Source,
    lpips: Option<&Lpips>,
) -> Result<Metrics> {
    let [name, of] = [directory, trained].map(|path| path.file_name().unwrap_or_default().to_string_lossy());
    unless_finished(directory, trained, run, lpips, |_| {
        let metrics = run_unless_finished(trained, &of, run, source, lpips, INTERVAL)?;
        say!("{name}: baking");
        run.write(directory)?;
        let (model, scene) = (Model::load(trained)?, source.scene(&run.train)?);
        let (avatar, report) = telling("baking", || bake(&model, Some(&scene)))?;
        let (train_seconds, parameters) = (metrics.train_seconds + report.seconds, avatar.num_parameters());
        let drawn = Drawn::Avatar { body: model.body(), light: model.light(), avatar: &avatar };
        score_run(directory, run, &scene, &drawn, lpips, Metrics { train_seconds, parameters, ..metrics })
    })
}

/// The prepared scene of a job with its views thinned, and its method; what `auto` chooses counts
/// as training.
fn prepared(job: &Job, outcome: &mut Outcome) -> Result<(Scene, Method)> {
    let thin = |capture: &mut Capture| {
        let stride = capture.eval.len().div_ceil(job.views.max(1)).max(1);
        capture.eval = std::mem::take(&mut capture.eval).into_iter().step_by(stride).collect();
    };
    let (Place::Scene { scene, body, load }, Method::Auto) = (&job.place, job.method) else {
        let (mut capture, model) = job.place.load()?;
        thin(&mut capture);
        return Ok((Scene::new(&capture, &model, &job.config)?, job.method));
    };
    let mut source = load.load(scene, body.as_deref())?;
    thin(&mut source.capture);
    source.scene(&job.config)?;
    let start = Instant::now();
    let method = if weigh(&mut source, &job.config)?.field { Method::Occnerf } else { Method::Surface };
    let scene = source.scene(&job.config)?;
    outcome.train_seconds = start.elapsed().as_secs_f64();
    Ok((scene, method))
}

/// Trains and scores.
fn measure(job: &Job) -> Result<Outcome> {
    if let Some(keep) = &job.keep {
        return keep_run(job, keep);
    }
    let lpips = load_lpips(job.lpips.as_deref())?;
    let mut outcome = Outcome::default();
    let (scene, method) = prepared(job, &mut outcome)?;
    let start = Instant::now();
    if method == Method::Prior {
        let colors = PriorColors::measure(&scene)?;
        outcome.train_seconds += start.elapsed().as_secs_f64();
        outcome.parameters = 3 * colors.colors.len();
        score(&scene, &mut PriorRenderer::new(&scene.body, &colors), lpips.as_ref(), &mut outcome)?;
    } else if method == Method::Surface {
        let colors = scene.colors()?;
        let (avatar, _) = fit(&scene)?;
        outcome.train_seconds += start.elapsed().as_secs_f64();
        outcome.parameters = avatar.num_parameters();
        let mut renderer = BakedRenderer::new(&avatar, scene.body.scale, colors.light, Samples::Four);
        score(&scene, &mut renderer, lpips.as_ref(), &mut outcome)?;
    } else {
        let mut trainer = method.trainer(&scene, job.config.clone())?;
        for _ in 0..job.config.steps {
            let report = trainer.step()?;
            outcome.non_finite += usize::from(!report.loss.is_finite());
            outcome.bad_gradients += report.bad_gradients;
        }
        let model = trainer.into_model();
        let baked = job.bake.map(|_| bake(&model, Some(&scene))).transpose()?;
        outcome.train_seconds += start.elapsed().as_secs_f64();
        outcome.parameters = model.num_parameters();
        match &baked {
            Some((avatar, _)) => {
                let samples = if job.bake == Some(true) { Samples::Four } else { Samples::One };
                let mut renderer = BakedRenderer::new(avatar, model.body().scale, model.light(), samples);
                score(&scene, &mut renderer, lpips.as_ref(), &mut outcome)?;
            }
            None => score(&scene, &mut FieldRenderer::new(&model)?, lpips.as_ref(), &mut outcome)?,
        }
    }
    outcome.peak_rss_bytes = peak_rss_bytes();
    Ok(outcome)
}

fn score(scene: &Scene, renderer: &mut dyn Renderer, lpips: Option<&Lpips>, outcome: &mut Outcome) -> Result<()> {
    let frames: Vec<&PreparedFrame> = scene.eval.iter().collect();
    let mut bad = 0;
    // The first picture pays for what later ones find ready.
    if let Some(first) = frames.first() {
        renderer.render(&first.view, Vec3::ZERO)?;
    }
    let metrics = evaluate(scene, renderer, &frames, lpips, |_, rendering| {
        let numbers = rendering.image.pixels.iter().chain(&rendering.opacity);
        bad += numbers.filter(|x| !x.is_finite()).count();
    })?;
    outcome.non_finite += bad;
    outcome.take(&metrics);
    Ok(())
}

impl Outcome {
    fn take(&mut self, split: &SplitMetrics) {
        self.seconds_per_frame = split.render_seconds_per_frame;
        self.psnr_mask = split.psnr_mask;
        self.ssim_mask = split.ssim_mask;
        self.psnr_hidden = split.psnr_hidden;
        self.lpips = split.lpips_full;
    }

    fn failed(error: &anyhow::Error) -> Self {
        Self { error: Some(one_line(error)), ..Self::default() }
    }
}

/// The child's part: a job as the first line of standard input, which stays open, its outcome, an
/// error among them, as the last line of standard output.
///
/// # Errors
/// Where standard input is no job; an [`Ending`] of the run.
pub fn serve() -> Result<()> {
    let mut text = String::new();
    std::io::stdin().lock().take(MAX_JOB_BYTES).read_line(&mut text).context("standard input")?;
    let job: Job = serde_json::from_str(&text).context("standard input is not a job")?;
    // Standard input ends when the sweep does: the outcome is not needed then.
    std::thread::spawn(|| {
        let _ = std::io::copy(&mut std::io::stdin().lock(), &mut std::io::sink());
        std::process::exit(1);
    });
    let outcome = match measure(&job) {
        Err(error) if error.chain().any(|cause| cause.is::<Ending>()) => return Err(error),
        other => other.unwrap_or_else(|error| Outcome::failed(&error)),
    };
    say!("{}", serde_json::to_string(&outcome)?);
    Ok(())
}

/// Runs a job in a process of its own, so that its peak of memory is its own and nothing it does
/// ends a sweep: an error, a panic, and a run longer than the limit come back as
/// [`Outcome::error`]. `None`: another process works in the run directory.
///
/// # Errors
/// Where no process can be started; [`Ending::Stopped`] where a signal came.
pub fn run(job: &Job, threads: Option<usize>) -> Result<Option<Outcome>> {
    let program = std::env::current_exe().context("the path of this program")?;
    let mut command = Command::new(program);
    command.args(["bench", "point"]);
    if let Some(threads) = threads {
        command.args(["--threads", &threads.to_string()]);
    }
    // Standard error is the child's too: bars and warnings of a run are seen as it goes.
    command.stdin(Stdio::piped()).stdout(Stdio::piped());
    let mut child = command.spawn().context("cannot start a run")?;
    let guard = Guard::begin();
    let outcome = converse(&mut child, job, &guard);
    // Whatever happened, nothing is left running.
    if outcome.is_err() {
        let _ = child.kill();
        let _ = child.wait();
    }
    if let Some(signal) = guard.signal() {
        let after = "what has been run is in the log: the same command goes on".to_owned();
        return Err(Ending::Stopped { signal, after }.into());
    }
    Ok(outcome.unwrap_or_else(|error| Some(Outcome::failed(&error))))
}

fn converse(child: &mut Child, job: &Job, guard: &Guard) -> Result<Option<Outcome>> {
    let mut pipe = child.stdout.take().context("no output")?;
    let out = std::thread::spawn(move || {
        let mut bytes = Vec::new();
        let _ = pipe.read_to_end(&mut bytes);
        String::from_utf8_lossy(&bytes).into_owned()
    });
    let mut input = child.stdin.take().context("no input")?;
    input.write_all((serde_json::to_string(job)? + "\n").as_bytes()).context("handing over the job")?;
    let (start, mut stopped) = (Instant::now(), None);
    let status = loop {
        if let Some(status) = child.try_wait()? {
            break status;
        }
        if guard.signal().is_some() {
            // The terminal sent the signal to the child too.
            let since: &Instant = stopped.get_or_insert_with(Instant::now);
            if job.keep.is_none() || since.elapsed() > GRACE {
                bail!("stopped by a signal");
            }
        }
        if job.keep.is_none() && start.elapsed() > LIMIT {
            bail!("stopped after {:.0} s", LIMIT.as_secs_f64());
        }
        std::thread::sleep(Duration::from_millis(20));
    };
    let out = out.join().unwrap_or_default();
    match status.code() {
        Some(0) => {
            let line = out.trim_end().lines().last().unwrap_or_default();
            serde_json::from_str(line).map(Some).context("unexpected answer of a run")
        }
        Some(BUSY) => Ok(None),
        _ => bail!("{status}"),
    }
}
