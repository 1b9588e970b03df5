//! The sweep engine: runs points one after another, each in a process of its own, and logs them as
//! a JSON line each in bench.jsonl, from which a later call goes on.

pub mod job;

use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use clap::Args;
use serde::{Deserialize, Serialize};

pub use self::job::{Job, Keep, Outcome, Place};
use crate::results::BENCH_LOG;
use crate::scene::SceneArguments;
use xtask::process::{Lock, say, unwritten};
use xtask::run::{Metrics, check_threads};
use xtask::shard::{Shard, ShardArguments};
use xtask::source::DEMO;

/// What a sweep over captures is run on.
#[derive(Args)]
pub struct Captures {
    /// Captures, as `train` takes them [default: the demo]
    scenes: Vec<String>,
    /// The body model of the captures [default: as in train]
    #[arg(long)]
    body: Option<PathBuf>,
    #[command(flatten)]
    pub load: SceneArguments,
}

impl Captures {
    /// The scenes.
    pub fn scenes(&self) -> Vec<String> {
        if self.scenes.is_empty() { vec![DEMO.to_owned()] } else { self.scenes.clone() }
    }

    /// The scenes; what is wrong with a capture is said before anything is run.
    pub fn checked(&self) -> Result<Vec<String>> {
        let (scenes, load) = (self.scenes(), self.load.options()?);
        scenes.iter().try_for_each(|scene| load.load(scene, self.body.as_deref()).map(drop))?;
        Ok(scenes)
    }

    /// Where the frames of a scene come from.
    pub fn place(&self, scene: &str) -> Result<Place> {
        let load = self.load.options()?.identified(scene, self.body.as_deref())?;
        Ok(Place::Scene { scene: scene.to_owned(), body: self.body.clone(), load })
    }

    /// What makes `train` read the same capture.
    pub fn command_line(&self, scene: &str) -> String {
        let mut text = if scene == DEMO { String::new() } else { format!(" {scene}") };
        if let Some(body) = &self.body {
            text.push_str(&format!(" --body {}", body.display()));
        }
        text + &self.load.command_line()
    }
}

/// How a sweep is run this time.
#[derive(Args)]
pub struct SittingArguments {
    /// Threads of each run [default: all cores]
    #[arg(long)]
    pub threads: Option<usize>,
    /// Begin no run after this many minutes; the same command goes on later [default: no limit]
    #[arg(long)]
    minutes: Option<f64>,
    #[command(flatten)]
    pub part: ShardArguments,
    /// Make the tables a section of tests/lab/RESULTS.md
    #[arg(long)]
    pub publish: bool,
}

impl SittingArguments {
    /// Goes on with the sweep in `out`.
    pub fn open(&self, out: &Path) -> Result<Runner> {
        let minutes = if self.part.merge { 0.0 } else { self.minutes.unwrap_or(1e6) };
        ensure!((0.0..=1e6).contains(&minutes), "--minutes {minutes}: expected 0 to 1000000");
        check_threads(self.threads)?;
        Runner::open(out, self.threads, Duration::from_secs_f64(60.0 * minutes), self.part.shard)
    }
}

/// Why a point is in the sweep.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Kind {
    /// What the single changes are changes of.
    Base,
    /// One factor changed.
    Change,
    /// A named preset as it is.
    Preset,
    /// Another method.
    Baseline,
    /// The base, baked.
    Baked,
    /// A level of difficulty.
    Level,
    /// A row of a table.
    Row,
}

/// A named run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Point {
    /// `pareto`, `stability`, or a table of `reproduce`.
    pub bench: String,
    pub name: String,
    /// What is changed.
    pub factor: String,
    /// How far, where that is a number.
    pub level: Option<f64>,
    pub kind: Kind,
    /// What runs it alone, where `train` can.
    pub command: Option<String>,
    pub job: Job,
}

/// A point and what came of it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Line {
    #[serde(flatten)]
    pub point: Point,
    #[serde(flatten)]
    pub outcome: Outcome,
}

impl Line {
    /// Whether two lines are of one point, so that the later one holds.
    fn replaces(&self, other: &Self) -> bool {
        let (a, b) = (&self.point, &other.point);
        (&a.bench, &a.name, &a.factor) == (&b.bench, &b.name, &b.factor)
            && a.job.place.name() == b.job.place.name()
            && (a.job.method, a.job.config.seed) == (b.job.method, b.job.config.seed)
    }
}

/// Reads a log; of several lines for one point the last holds. A last line that was cut off is left
/// out: its point was not finished.
///
/// # Errors
/// A file that cannot be read, or a line before the last that is none, by its number.
pub fn read(path: &Path) -> Result<Vec<Line>> {
    let text = std::fs::read_to_string(path).with_context(|| path.display().to_string())?;
    let rows: Vec<(usize, &str)> = text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty()).collect();
    let mut lines: Vec<Line> = Vec::new();
    for (at, &(row, content)) in rows.iter().enumerate() {
        match serde_json::from_str::<Line>(content) {
            Ok(line) => put(&mut lines, line),
            Err(_) if at + 1 == rows.len() => {}
            Err(error) => bail!("{}, line {}: {error}", path.display(), row + 1),
        }
    }
    Ok(lines)
}

/// Reads the logs of a sweep: its own, and those of its parts.
fn read_all(directory: &Path) -> Result<Vec<Line>> {
    let entries = std::fs::read_dir(directory).with_context(|| directory.display().to_string())?;
    let of_part = |name: &str| name.starts_with("bench-") && name.ends_with(".jsonl");
    let mut paths: Vec<PathBuf> = entries
        .filter_map(|entry| Some(entry.ok()?.path()))
        .filter(|path| path.file_name().and_then(|n| n.to_str()).is_some_and(|name| name == BENCH_LOG || of_part(name)))
        .collect();
    paths.sort();
    let mut lines: Vec<Line> = Vec::new();
    for path in paths {
        for line in read(&path)? {
            // A part that failed does not replace one that did not.
            if line.outcome.error.is_none() || lines.iter().all(|old| !line.replaces(old)) {
                put(&mut lines, line);
            }
        }
    }
    Ok(lines)
}

/// Adds a line in place of an older one of its point.
fn put(lines: &mut Vec<Line>, line: Line) {
    lines.retain(|old| !line.replaces(old));
    lines.push(line);
}

/// What tells a point from all others, the same in every part; that of the trained run for a baked
/// person: who trains a person bakes them.
fn name(point: &Point) -> String {
    let (config, place) = (&point.job.config, point.job.place.name());
    let trained = point.job.keep.as_ref().and_then(|keep| keep.trained.as_deref()?.file_name()?.to_str());
    let (name, method) = (trained.unwrap_or(&point.name), point.job.method.name());
    format!("{} {place} {} {name} {method} {}", point.bench, point.factor, config.seed)
}

/// A sweep in progress.
pub struct Runner {
    path: PathBuf,
    file: File,
    _lock: Lock,
    shard: Option<Shard>,
    lines: Vec<Line>,
    threads: Option<usize>,
    start: Instant,
    /// No point is begun after this.
    budget: Duration,
    begun: usize,
    /// Names of points without a line.
    left: Vec<String>,
}

impl Runner {
    /// Goes on in `directory`, which is made if need be. A part of a sweep has a log and a lock of
    /// its own, and reads those of the others.
    fn open(directory: &Path, threads: Option<usize>, budget: Duration, shard: Option<Shard>) -> Result<Self> {
        xtask::run::make_directory(directory)?;
        let path = directory.join(shard.map_or(BENCH_LOG.to_owned(), |shard| format!("bench-{}.jsonl", shard.name())));
        let lock = Lock::take(&match shard {
            None => directory.to_owned(),
            Some(shard) => {
                let own = directory.join("parts").join(shard.name());
                xtask::run::make_directory(&own)?;
                own
            }
        })?;
        let own = if path.exists() { read(&path)? } else { Vec::new() };
        // Rewritten, so that a line that was cut off does not spoil the next.
        let text: Vec<String> = own.iter().map(serde_json::to_string).collect::<Result<_, _>>()?;
        xtask::run::write(&path, &text.iter().map(|l| format!("{l}\n")).collect::<String>())?;
        let file = File::options().append(true).open(&path).map_err(unwritten(&path))?;
        let lines = read_all(directory)?;
        let start = Instant::now();
        Ok(Self { path, file, _lock: lock, shard, lines, threads, start, budget, begun: 0, left: Vec::new() })
    }

    /// Runs points in order.
    pub fn run_all(&mut self, points: Vec<Point>) -> Result<Vec<Line>> {
        points.into_iter().filter_map(|point| self.run(point).transpose()).collect()
    }

    /// Runs a point, unless the log has it with the very same job and no error; `None` when time is
    /// up, or another part has it.
    pub fn run(&mut self, point: Point) -> Result<Option<Line>> {
        let there = point.job.keep.as_ref().is_none_or(|Keep { directory, trained }| {
            Metrics::fresh(directory, trained.as_ref().unwrap_or(directory)).is_ok_and(|metrics| metrics.is_some())
        });
        let done = self.lines.iter().find(|l| there && l.point.job == point.job && l.outcome.error.is_none());
        if let Some(done) = done {
            let line = Line { point, outcome: done.outcome.clone() };
            if !self.lines.contains(&line) && self.shard.is_none() {
                self.add(line.clone())?;
            }
            return Ok(Some(line));
        }
        let is_mine = self.shard.is_none_or(|shard| shard.has_name(&name(&point)));
        if is_mine && self.start.elapsed() < self.budget {
            self.begun += 1;
            if let Some(outcome) = job::run(&point.job, self.threads)? {
                let line = Line { point, outcome };
                self.add(line.clone())?;
                say!("{}", summary(&line));
                return Ok(Some(line));
            }
        }
        self.left.push(format!("{} of {}", point.name, point.job.place.name()));
        Ok(None)
    }

    /// Says what was run, and what is left.
    ///
    /// # Errors
    /// With `--merge` if anything is left.
    pub fn end(&self, part: &ShardArguments) -> Result<()> {
        let (begun, minutes) = (self.begun, self.start.elapsed().as_secs_f64() / 60.0);
        say!("{begun} runs in {minutes:.1} minutes");
        match &self.left[..] {
            [] => {}
            [first, ..] if part.merge => {
                bail!("{} points have no scores yet, such as {first}: run their parts again", self.left.len())
            }
            left if self.shard.is_some() => say!("{} are of other parts, or left; --merge draws", left.len()),
            left => say!("{} points are left: the same command goes on with them", left.len()),
        }
        Ok(())
    }

    fn add(&mut self, line: Line) -> Result<()> {
        let text = serde_json::to_string(&line)? + "\n";
        let length = self.file.metadata().map(|m| m.len());
        let written = self.file.write_all(text.as_bytes()).and_then(|()| self.file.sync_data());
        if let (Err(_), Ok(length)) = (&written, length) {
            // No half line stays for others to read.
            let _ = self.file.set_len(length);
        }
        written.map_err(unwritten(&self.path))?;
        put(&mut self.lines, line);
        Ok(())
    }

    /// The log's path.
    pub fn path(&self) -> &Path {
        &self.path
    }
}

/// One line on the terminal.
fn summary(line: &Line) -> String {
    let Line { point, outcome } = line;
    let number = |v: Option<f64>, digits: usize| v.map_or("–".to_owned(), |v| format!("{v:.digits$}"));
    let what = format!("{:<34} {:<10}", point.name, point.job.method.name());
    if let Some(error) = &outcome.error {
        return format!("{what} failed: {error}");
    }
    format!(
        "{what} {:7.1} s  {:6.3} s/frame  psnr_mask {:>5}  psnr_hidden {:>5}  ssim_mask {:>6}  {:4.0} MB",
        outcome.train_seconds,
        outcome.seconds_per_frame,
        number(outcome.psnr_mask, 2),
        number(outcome.psnr_hidden, 2),
        number(outcome.ssim_mask, 4),
        outcome.peak_rss_bytes as f64 / 1e6,
    )
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a failure here is a failed test")]
pub mod tests {
    use occnerf::Preset;

    use super::*;
    use crate::bench::Difficulty;
    use crate::methods::Method;

    /// A line of a point called `name` that scored `psnr` in `seconds`.
    pub fn line(name: &str, factor: &str, kind: Kind, psnr: f64, seconds: f64) -> Line {
        let (method, config) = (Method::Occnerf, Method::Occnerf.preset(Preset::Fast));
        let point = Point {
            bench: "pareto".to_owned(),
            name: name.to_owned(),
            factor: factor.to_owned(),
            level: Some(1.0),
            kind,
            command: Some("cargo xtask train".to_owned()),
            job: Job::new(Place::Made(Difficulty::default()), 3, method, config),
        };
        let (psnr_mask, psnr_hidden) = (Some(psnr), Some(psnr));
        let outcome = Outcome {
            train_seconds: seconds,
            seconds_per_frame: 0.1,
            psnr_mask,
            psnr_hidden,
            ssim_mask: Some(0.5),
            ..Outcome::default()
        };
        Line { point, outcome }
    }

    fn folder(name: &str) -> PathBuf {
        let path = std::env::temp_dir().join(format!("xtask-runner-{name}-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&path);
        std::fs::create_dir_all(&path).unwrap();
        path
    }

    #[test]
    fn a_last_line_that_was_cut_off_is_dropped_and_any_other_damage_is_named() {
        let folder = folder("damage");
        let path = folder.join(BENCH_LOG);
        let (a, b) = (line("a", "k", Kind::Change, 20.0, 3.0), line("b", "k", Kind::Change, 21.0, 4.0));
        let (a, b) = (serde_json::to_string(&a).unwrap(), serde_json::to_string(&b).unwrap());
        std::fs::write(&path, format!("{a}\n{}", &b[..b.len() / 2])).unwrap();
        assert_eq!(read(&path).unwrap().len(), 1);
        let runner = Runner::open(&folder, None, Duration::ZERO, None).unwrap();
        assert_eq!(runner.lines.len(), 1);
        assert!(Runner::open(&folder, None, Duration::ZERO, None).is_err(), "another process has it");
        assert_eq!(std::fs::read_to_string(runner.path()).unwrap(), format!("{a}\n"));
        drop(runner);
        std::fs::write(&path, format!("{a}\nnot json\n{b}\n")).unwrap();
        let message = read(&path).unwrap_err().to_string();
        assert!(message.contains(BENCH_LOG) && message.contains("line 2"), "{message}");
        std::fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn a_finished_point_is_not_run_again_and_its_later_line_holds() {
        let folder = folder("again");
        let old = line("a", "k", Kind::Change, 20.0, 3.0);
        let mut runner = Runner::open(&folder, None, Duration::ZERO, None).unwrap();
        runner.add(old.clone()).unwrap();
        assert_eq!(runner.run(old.point.clone()).unwrap().unwrap(), old);
        // Other settings are another run, for which there is no time here.
        let mut other = old.point.clone();
        other.job.config.steps += 1;
        assert_eq!(runner.run(other).unwrap(), None);
        let mut failed = old.clone();
        failed.outcome.error = Some("out of luck".to_owned());
        runner.add(failed).unwrap();
        assert_eq!(runner.run(old.point.clone()).unwrap(), None);
        assert_eq!((runner.begun, runner.left.len()), (0, 2));
        assert_eq!(read(runner.path()).unwrap().len(), 1);
        std::fs::remove_dir_all(&folder).unwrap();
    }
}
