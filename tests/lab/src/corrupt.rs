//! `corrupt`: a capture with a wrong prior, wrong masks or an obstacle, on disk.

use std::path::PathBuf;

use anyhow::{Error, Result};
use clap::Args;
use synth::write_capture;
use xtask::place::not_within;
use xtask::process::{results_in, say};

use crate::scene::SceneArguments;
use crate::synth::{OutArguments, bar};

/// What a finished directory holds, and nothing else does.
const MARK: &str = "corrupt.json";

/// What is corrupted, and how.
#[derive(Args)]
pub struct CorruptArguments {
    /// A capture, or "demo"
    capture: PathBuf,
    /// The body model of the capture, as of `cargo xtask train`
    #[arg(long)]
    body: Option<PathBuf>,
    #[command(flatten)]
    out: OutArguments,
    #[command(flatten)]
    scene: SceneArguments,
}

/// Runs the command.
pub fn corrupt(arguments: &CorruptArguments) -> Result<()> {
    let options = arguments.scene.options()?;
    not_within(&arguments.capture, &arguments.out.out, "the capture")?;
    let source = arguments
        .out
        .vacant(MARK)
        .and_then(|()| options.load(&arguments.capture.to_string_lossy(), arguments.body.as_deref()))?;
    let capture = &source.capture;
    let pictures = 2 * (capture.train.len() + capture.eval.len());
    arguments.out.fill(MARK, &serde_json::to_string_pretty(&options.corruption)?, |directory| {
        let bar = bar("writing", pictures);
        let written = write_capture(capture, &source.model, directory, &|_| bar.inc(1));
        bar.finish_and_clear();
        written.map_err(Error::from).map_err(results_in(directory))
    })?;
    let (out, frames, views) = (arguments.out.out.display(), capture.train.len(), capture.eval.len());
    say!("{out}: {frames} frames, {views} views kept back");
    Ok(())
}
