//! `convert`: body models to `.safetensors`.

use std::path::PathBuf;

use anyhow::{Context, Error, Result, ensure};
use clap::Args;
use smpl::BodyModel;

use crate::process::{results_in, say, telling};

/// Arguments of `convert`.
#[derive(Args)]
pub struct ConvertArguments {
    /// The body model: .npz, or .pkl as SMPL is released (read as data, never executed).
    input: PathBuf,
    /// The file to write, .safetensors.
    output: PathBuf,
    /// Replaces the output if it is there.
    #[arg(long)]
    force: bool,
}

/// Reads, checks, writes, and reads back.
pub fn convert(arguments: &ConvertArguments) -> Result<()> {
    let (input, output) = (&arguments.input, &arguments.output);
    let extension = output.extension().and_then(|e| e.to_str()).unwrap_or("");
    ensure!(
        extension.eq_ignore_ascii_case("safetensors"),
        "{}: the output's name must end in .safetensors",
        output.display()
    );
    let model = telling(&format!("reading {}", input.display()), || BodyModel::load(input))?;
    if output.exists() {
        let same = std::fs::canonicalize(input).ok() == std::fs::canonicalize(output).ok();
        ensure!(!same, "{}: input and output are the same file", output.display());
        ensure!(arguments.force, "{}: already there (--force replaces it)", output.display());
    }
    model.save(output).map_err(Error::from).map_err(results_in(output))?;
    let back = BodyModel::load(output)?;
    ensure!(back == model, "{}: reads back differently", output.display());
    let size = std::fs::metadata(output).with_context(|| output.display().to_string())?.len();
    say!(
        "{}: {} vertices, {} faces, {} joints, {} betas, {:.1} MB",
        output.display(),
        model.num_vertices(),
        model.faces.len(),
        model.num_joints(),
        model.num_betas(),
        size as f64 / 1e6
    );
    Ok(())
}
