//! The optimisation loop of a run, with log, progress bar and checkpoints.

use std::fs::File;
use std::io::{IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Error, Result, ensure};
use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};
use occnerf::{StepReport, Trainer};

use crate::preview::Preview;
use crate::process::{Ending, Guard, note, one_line, still_held, unwritten};
use crate::run::{self, CHECKPOINT, LOG};

const LOG_EVERY: u64 = 10;
/// Interval of progress lines without a terminal.
const LINE_EVERY: Duration = Duration::from_secs(15);

/// Checkpoint interval.
#[derive(Args, Clone, Copy, Debug)]
pub struct SavingArguments {
    /// Interval between checkpoints, seconds: the most that can be lost
    #[arg(long, value_name = "SECONDS", default_value_t = 30.0)]
    checkpoint_every: f64,
}

impl SavingArguments {
    /// Time between two checkpoints.
    pub fn interval(&self) -> Result<Duration> {
        let seconds = self.checkpoint_every;
        ensure!((0.0..=86_400.0).contains(&seconds), "--checkpoint-every {seconds}: expected 0 to 86400 seconds");
        Ok(Duration::from_secs_f64(seconds))
    }
}

/// Options of one invocation, not stored with the run.
#[derive(Clone, Copy, Debug)]
pub struct RunOptions {
    /// Whether to continue from the checkpoint, if there is one.
    pub resume: bool,
    /// Total steps after which to stop early.
    pub stop_after: Option<u64>,
    /// Checkpoint interval.
    pub interval: Duration,
    /// Whether to write preview pictures.
    pub preview: bool,
}

/// Takes steps until the end or `stop_after`; returns seconds of training, earlier invocations
/// included. A failed write of the log or of a periodic checkpoint is retried later.
///
/// # Errors
/// Of a step, after saving; [`Ending::Unwritten`] for the last checkpoint; [`Ending::Stopped`]
/// after a signal and saving; a diverged training, which replaces no checkpoint.
pub fn optimise(directory: &Path, trainer: &mut Trainer<'_>, options: &RunOptions) -> Result<f64> {
    let guard = Guard::begin();
    let total = trainer.model().config().steps;
    let end = options.stop_after.unwrap_or(total).min(total);
    let earlier = earlier_log(&directory.join(LOG), trainer.steps_done())?;
    let mut log = Log::begin(directory.join(LOG), &earlier.text)?;
    let bar = ProgressBar::new(total);
    let style = "{bar:28} {pos}/{len} steps  {msg}  {elapsed} elapsed, {eta} left";
    bar.set_style(ProgressStyle::with_template(style)?);
    bar.set_position(trainer.steps_done());
    bar.reset_eta();
    let checkpoint = directory.join(CHECKPOINT);
    let (start, mut saved, mut lined) = (Instant::now(), Instant::now(), Instant::now());
    let mut preview = options.preview.then(|| Preview::new(directory));
    let (mut smooth, mut bad) = (None::<StepReport>, 0);
    while trainer.steps_done() < end && guard.signal().is_none() {
        let report = match trainer.step() {
            Ok(report) => report,
            Err(error) => {
                bar.abandon();
                let learnt = match save(trainer, &checkpoint) {
                    Ok(()) => format!("is in {}", checkpoint.display()),
                    Err(error) => format!("could not be saved ({error:#})"),
                };
                let place = format!("step {}; what was learnt {learnt}", trainer.steps_done() + 1);
                return Err(Error::from(error).context(place));
            }
        };
        bad += report.bad_gradients;
        let mean = blend(smooth, report);
        smooth = Some(mean);
        let seconds = earlier.seconds + start.elapsed().as_secs_f64();
        if report.step.is_multiple_of(LOG_EVERY) || report.step == end {
            let mut line = serde_json::to_value(mean)?;
            line["step"] = report.step.into();
            line["seconds"] = seconds.into();
            line["live_samples"] = report.live_samples.into();
            line["bad_gradients"] = bad.into();
            log.add(&line, &bar);
            let message = format!(
                "loss {:.4} (mse {:.4}, perceptual {:.3}, completeness {:.4})  psnr {:.2}",
                mean.loss, mean.mse, mean.perceptual, mean.completeness, mean.psnr
            );
            bar.set_position(report.step);
            if !std::io::stderr().is_terminal() && lined.elapsed() >= LINE_EVERY {
                lined = Instant::now();
                let left = start.elapsed().as_secs_f64() / (bar.position() as f64 - earlier.steps as f64).max(1.0)
                    * (total - report.step) as f64;
                note!("step {}/{total}  {message}  {seconds:.0} s, {left:.0} s left", report.step);
            }
            bar.set_message(message);
        }
        if let Some(Err(error)) = preview.as_mut().map(|preview| preview.draw(trainer.model())) {
            bar.suspend(|| note!("warning: {}; training goes on without a preview", one_line(&error)));
            preview = None;
        }
        if saved.elapsed() >= options.interval && report.step < end {
            if let Err(error) = save(trainer, &checkpoint) {
                if diverged(&error) {
                    bar.abandon();
                    return Err(error);
                }
                bar.suspend(|| note!("warning: {}; training goes on and tries again", one_line(&error)));
            }
            saved = Instant::now();
        }
    }
    bar.set_position(trainer.steps_done());
    let outcome = save(trainer, &checkpoint);
    log.flush(&bar);
    match &outcome {
        Ok(()) if trainer.steps_done() == total => bar.finish(),
        _ => bar.abandon(),
    }
    outcome?;
    if bad > 0 {
        note!("warning: {bad} gradients were not finite and were left out");
    }
    if let Some(signal) = guard.signal() {
        let after = format!(
            "step {} of {total} is saved: --resume --out {} goes on, or the same command if it was reproduce",
            trainer.steps_done(),
            directory.display()
        );
        return Err(Ending::Stopped { signal, after }.into());
    }
    Ok(earlier.seconds + start.elapsed().as_secs_f64())
}

/// Writes the checkpoint.
///
/// # Errors
/// [`Ending::Unwritten`]; a diverged training, with the kept checkpoint.
pub fn save(trainer: &Trainer<'_>, checkpoint: &Path) -> Result<()> {
    checkpoint.parent().map_or(Ok(()), still_held)?;
    trainer.save(checkpoint).map_err(|error| match error {
        occnerf::Error::Io { path, source } => unwritten(&path)(source),
        error if checkpoint.is_file() => {
            Error::from(error).context(format!("{}: the earlier one is kept", checkpoint.display()))
        }
        error => error.into(),
    })
}

fn diverged(error: &Error) -> bool {
    let of_ours = |cause: &(dyn std::error::Error + 'static)| {
        matches!(cause.downcast_ref(), Some(occnerf::Error::Diverged { .. }))
    };
    error.chain().any(of_ours)
}

/// Writer of train.jsonl in whole lines.
struct Log {
    path: PathBuf,
    file: File,
    /// Bytes of whole lines.
    length: u64,
    /// Lines to be written.
    pending: String,
    told: bool,
}

impl Log {
    /// Starts with the lines of earlier invocations.
    fn begin(path: PathBuf, earlier: &str) -> Result<Self> {
        run::write(&path, earlier)?;
        let file = File::options().append(true).open(&path).map_err(unwritten(&path))?;
        Ok(Self { path, file, length: earlier.len() as u64, pending: String::new(), told: false })
    }

    fn add(&mut self, line: &serde_json::Value, bar: &ProgressBar) {
        self.pending.push_str(&format!("{line}\n"));
        self.flush(bar);
    }

    /// Writes all pending lines or none; warns at the first failure.
    fn flush(&mut self, bar: &ProgressBar) {
        match self.file.write_all(self.pending.as_bytes()) {
            Ok(()) => {
                self.length += self.pending.len() as u64;
                self.pending.clear();
            }
            Err(error) => {
                let _ = self.file.set_len(self.length);
                if !std::mem::replace(&mut self.told, true) {
                    bar.suspend(|| note!("warning: {}: {error}; training goes on", self.path.display()));
                }
            }
        }
    }
}

/// Training time of the first `steps` steps of a run by its log, seconds.
pub fn logged_seconds(directory: &Path, steps: u64) -> Result<f64> {
    Ok(earlier_log(&directory.join(LOG), steps)?.seconds)
}

struct EarlierLog {
    text: String,
    seconds: f64,
    steps: u64,
}

/// The log up to the checkpoint's step.
fn earlier_log(path: &Path, steps: u64) -> Result<EarlierLog> {
    let mut log = EarlierLog { text: String::new(), seconds: 0.0, steps };
    if steps == 0 || !path.exists() {
        return Ok(log);
    }
    for line in run::read_text(path)?.lines() {
        let Ok(value) = serde_json::from_str::<serde_json::Value>(line) else { continue };
        if value["step"].as_u64().is_some_and(|s| s <= steps) {
            log.text.push_str(line);
            log.text.push('\n');
            log.seconds = value["seconds"].as_f64().unwrap_or(log.seconds);
        }
    }
    Ok(log)
}

/// Exponential moving average over about fifty steps.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_log_cut_off_or_damaged_anywhere_gives_its_whole_lines() {
        let folder = testkit::files::Directory::new("log");
        let path = folder.file(LOG);
        let earlier = |bytes: &[u8]| {
            std::fs::write(&path, bytes).unwrap();
            earlier_log(&path, 30).unwrap()
        };
        let line = |step: u64| format!("{{\"step\":{step},\"seconds\":{}.5,\"loss\":null}}\n", step);
        let text: String = (1..=4).map(|i| line(10 * i)).collect();
        for length in 0..=text.len() {
            let log = earlier(&text.as_bytes()[..length]);
            let whole = text[..length].matches('\n').count().min(3) as u64;
            // A last line may be whole without its end.
            let least = 10.0 * whole as f64 + if whole > 0 { 0.5 } else { 0.0 };
            assert!(log.seconds == least || log.seconds == least + 10.0 || whole == 0, "{length}: {}", log.seconds);
            assert!(log.text.lines().count() as u64 - whole <= 1);
        }
        let deep = [b'['; 100_000];
        for hostile in [&b"\xff\xfe{\"step\":1,\"seconds\":1e308}\n[1]\nnull\n{\"step\":-1}\n{}\n"[..], &deep] {
            assert!(earlier(hostile).text.lines().count() <= 1);
        }
        for bytes in testkit::files::damaged(text.as_bytes(), 2000) {
            let is_whole = |line: &str| serde_json::from_str::<serde_json::Value>(line).is_ok();
            assert!(earlier(&bytes).text.lines().all(is_whole));
        }
    }
}
