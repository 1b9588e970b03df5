//! `probe`: one function of one crate on numpy arrays, for comparing it with another
//! implementation.

mod body;
mod encode;
mod input;
mod output;
mod picture;
mod points;

use std::path::PathBuf;

use anyhow::{Context, Result, bail};
use clap::{Args, ValueEnum};
use rigged::load_mesh;
use smpl::BodyModel;

use input::Input;
use output::Output;
use xtask::network::load_lpips;

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Op {
    /// Posed bodies: betas (B,10), poses (B,72), trans (B,3) -> vertices (B,V,3), joints (B,24,3);
    /// --model
    Skin,
    /// World to rest pose: poses (72), betas (10), trans (3), points (Q,3), kind 0 volume or 1
    /// surface -> canonical (Q,3), NaN where no part of the body is near, likelihood (Q); --model,
    /// in metres
    Motion,
    /// Farthest point sampling: points (N,3), ratio, levels -> level_1, level_2, ...
    Fps,
    /// Nearest points: points (N,3), queries (Q,3), k -> indices (Q,k), distances (Q,k)
    Knn,
    /// Neighbours and distances of a mesh: queries (Q,3) -> indices (Q,4,5), blended (Q,3),
    /// signed_distance (Q), closest_point (Q,3), exact_signed_distance (Q); --mesh
    Surface,
    /// What a camera sees: K (3,3), E (3,4), width, height -> visible (V); --mesh
    Visible,
    /// Hash encoding: points (Q,D) from 0 to 1, D = 2, 3 or 4, resolutions (L), table (L,2^T,F),
    /// optional d_features (Q,L*F)
    /// -> features (Q,L*F), d_table, d_points
    HashEncode,
    /// Volume rendering: sigma (R,S), rgb (R,S,3), edges (R,S+1), background (3), optional d_color
    /// (R,3) -> color (R,3), opacity (R), depth (R), weights (R,S), termination (R), d_sigma, d_rgb
    Composite,
    /// Image metrics: a, b (H,W,3) from 0 to 1, mask (H,W) of booleans -> psnr, ssim, psnr_mask,
    /// ssim_mask; with --lpips: lpips
    Metrics,
}

#[derive(Args)]
pub struct ProbeArguments {
    /// What to compute; arrays are named as follows
    op: Op,
    /// Arrays to read, written by numpy's savez
    #[arg(long = "in", value_name = "IN.npz")]
    input: PathBuf,
    /// Where to write the results
    #[arg(long, value_name = "OUT.npz")]
    out: PathBuf,
    /// Mesh, for surface and visible: .obj, .glb or .gltf at rest, or a body model's template
    #[arg(long)]
    mesh: Option<PathBuf>,
    /// Body model, for skin and motion: .npz or .pkl in SMPL's form
    #[arg(long)]
    model: Option<PathBuf>,
    /// Weights of LPIPS, for metrics: a file or a directory, .safetensors or .pth
    #[arg(long)]
    lpips: Option<PathBuf>,
}

/// Runs the command.
pub fn probe(arguments: &ProbeArguments) -> Result<()> {
    let name = arguments.op.to_possible_value().map(|value| value.get_name().to_owned()).unwrap_or_default();
    let takes_mesh = matches!(arguments.op, Op::Surface | Op::Visible);
    let takes_model = matches!(arguments.op, Op::Skin | Op::Motion);
    for (option, given, taken) in
        [("--mesh", arguments.mesh.is_some(), takes_mesh), ("--model", arguments.model.is_some(), takes_model)]
    {
        if given != taken {
            bail!("probe {name} {} {option}", if taken { "needs" } else { "takes no" });
        }
    }
    if arguments.lpips.is_some() && arguments.op != Op::Metrics {
        bail!("probe {name} takes no --lpips");
    }
    let path = &arguments.input;
    let mesh = || Ok::<_, anyhow::Error>(load_mesh(arguments.mesh.as_deref().context("no --mesh")?)?);
    let model = || Ok::<_, anyhow::Error>(BodyModel::load(arguments.model.as_deref().context("no --model")?)?);
    let mut output = Output::default();
    match arguments.op {
        Op::Skin => {
            body::skin(Input::open(path, &["betas", "poses", "trans"], &[])?, &model()?, &mut output)?;
        }
        Op::Motion => {
            let input = Input::open(path, &["poses", "betas", "trans", "points", "kind"], &[])?;
            body::motion(input, &model()?, &mut output)?;
        }
        Op::Fps => points::fps(Input::open(path, &["points", "ratio", "levels"], &[])?, &mut output)?,
        Op::Knn => points::knn(Input::open(path, &["points", "queries", "k"], &[])?, &mut output)?,
        Op::Surface => points::surface(Input::open(path, &["queries"], &[])?, &mesh()?, &mut output)?,
        Op::Visible => {
            picture::visible(Input::open(path, &["K", "E", "width", "height"], &[])?, &mesh()?, &mut output)?;
        }
        Op::HashEncode => {
            encode::encode(Input::open(path, &["points", "resolutions", "table"], &["d_features"])?, &mut output)?;
        }
        Op::Composite => {
            let input = Input::open(path, &["sigma", "rgb", "edges", "background"], &["d_color"])?;
            picture::composite(input, &mut output)?;
        }
        Op::Metrics => {
            let lpips = load_lpips(arguments.lpips.as_deref())?;
            picture::metrics(Input::open(path, &["a", "b", "mask"], &[])?, lpips.as_ref(), &mut output)?;
        }
    }
    output.write(&arguments.out)
}
