//! `export`: a trained person in standard formats.

use std::io::Write;
use std::path::PathBuf;

use anyhow::{Context, Error, Result, bail};
use clap::{Args, ValueEnum};
use glam::Vec3;
use occnerf::bake::{Avatar, export};
use occnerf::replace_file;

use crate::avatar;
use crate::process::{results_in, say, unwritten};

/// Largest triangle edge of a splat, metres.
const PATCH: f32 = 0.009;

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Format {
    /// Skinned, textured avatar with its motions: glTF binary for Blender, three.js, Unity, Unreal,
    /// Godot.
    Glb,
    /// One pose as 3-D Gaussian splats, for viewers of such scenes.
    Ply,
    /// One pose as a mesh with colours at its vertices, and .mtl and .png beside it.
    Obj,
    /// The corrected poses as motion capture in AMASS's form.
    Npz,
}

#[derive(Args)]
pub struct ExportArguments {
    /// Run directory
    run: PathBuf,
    /// What to write [default: by the extension of --out]
    #[arg(long)]
    format: Option<Format>,
    /// File to write
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Motion capture, an .npz with poses, trans and fps, as AMASS has them: added to a glb, in
    /// place of the video's motion elsewhere
    #[arg(long, value_name = "CLIP.npz")]
    motion: Option<PathBuf>,
    /// Frames per second of --motion [default: as the file says]
    #[arg(long, value_name = "N", requires = "motion")]
    fps: Option<f32>,
    /// Frame of the motion whose pose a ply or an obj shows [default: the first]
    #[arg(long, value_name = "N")]
    frame: Option<usize>,
}

/// Runs the command.
pub fn export(arguments: &ExportArguments) -> Result<()> {
    let out = &arguments.out;
    let format = format(arguments)?;
    if arguments.frame.is_some() && !matches!(format, Format::Ply | Format::Obj) {
        bail!("--frame is of one pose: --format ply or obj");
    }
    let (mut person, _lock) = avatar::of_run(&arguments.run)?;
    if let Some(path) = &arguments.motion {
        avatar::add_motion(&mut person, path, arguments.fps)?;
    }
    // The folder is made only now, so that bad input leaves nothing behind.
    avatar::check_folder(out)?;
    let clip = if arguments.motion.is_some() { person.clips.len() - 1 } else { 0 };
    match format {
        Format::Glb => {
            let bytes = person.to_glb()?;
            replace_file(out, |to| to.write_all(&bytes)).map_err(unwritten(out))?;
            let names: Vec<&str> = person.clips.iter().map(|clip| clip.name.as_str()).collect();
            let size = bytes.len() as f64 * 1e-6;
            say!("{}: {size:.1} MB, {} triangles, motions: {}", out.display(), person.faces.len(), names.join(", "));
        }
        Format::Ply => {
            let (vertices, _) = posed(&person, clip, arguments)?;
            let splats = export::splats(&person, &vertices, PATCH)?;
            splats.write(out).map_err(Error::from).map_err(results_in(out))?;
            say!("{}: {} splats", out.display(), splats.centres.len());
        }
        Format::Obj => {
            let (vertices, normals) = posed(&person, clip, arguments)?;
            export::write_obj(&person, &vertices, &normals, out)
                .map_err(Error::from)
                .map_err(results_in(out.parent().unwrap_or(out)))?;
            say!("{}: {} triangles", out.display(), person.faces.len());
        }
        Format::Npz => {
            export::write_amass(&person, clip, out).map_err(Error::from).map_err(results_in(out))?;
            say!("{}: {} frames", out.display(), person.clips[clip].motion.num_frames());
        }
    }
    Ok(())
}

/// The format asked for, or that of the file's extension; both must agree.
fn format(arguments: &ExportArguments) -> Result<Format> {
    let out = &arguments.out;
    let extension = out.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default();
    let named = Format::from_str(&extension, true).ok();
    match (arguments.format, named) {
        (Some(asked), Some(named)) if asked != named => {
            bail!("--out {}: a name of another format than --format {asked:?}", out.display())
        }
        (Some(format), _) | (None, Some(format)) => Ok(format),
        (None, None) => bail!("--out {}: expected .glb, .ply, .obj or .npz, or --format", out.display()),
    }
}

/// Vertices and normals of the person at `--frame`.
fn posed(person: &Avatar, clip: usize, arguments: &ExportArguments) -> Result<(Vec<Vec3>, Vec<Vec3>)> {
    let motion = &person.clips.get(clip).context("the person has no motion")?.motion;
    let (frame, frames) = (arguments.frame.unwrap_or(0), motion.num_frames());
    if frame >= frames {
        bail!("--frame {frame}: the motion has frames 0 to {}", frames - 1);
    }
    let pose = &motion.poses[frame * motion.num_joints..][..motion.num_joints];
    let bones = person.bones(pose, motion.trans[frame]);
    Ok(person.skin(&bones, pose))
}
