//! `export`: a trained person in standard formats.

use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, Error, Result, bail, ensure};
use clap::{Args, ValueEnum};
use glam::Vec3;
use occnerf::bake::export::{GlbOptions, VRM_LICENCE, Vrm};
use occnerf::bake::{Avatar, export};
use occnerf::replace_file;
use smpl::{BoneNames, Bvh};

use crate::avatar::{self, Sizes};
use crate::process::{results_in, say, unwritten};

/// Largest triangle edge of a splat, metres.
const PATCH: f32 = 0.009;

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Format {
    /// Skinned, textured avatar with its motions: glTF binary for Blender, three.js, Unity, Unreal,
    /// Godot.
    Glb,
    /// The same as VRM 1.0, arms level at rest, for avatars on the web and in games.
    Vrm,
    /// One pose as 3-D Gaussian splats, for viewers of such scenes.
    Ply,
    /// One pose as a mesh with colours at its vertices, and .mtl and .png beside it.
    Obj,
    /// The corrected poses as motion capture in AMASS's form.
    Npz,
    /// Skeleton and motion, in centimetres, rotations Z X Y, for Blender and motion capture tools.
    Bvh,
}

/// Names of joints.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Bones {
    /// `pelvis`, `left_knee`
    Smpl,
    /// `mixamorig:Hips`, `mixamorig:LeftLeg`
    Mixamo,
    /// `hips`, `leftLowerLeg`
    Vrm,
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
    /// Motion capture, an .npz with poses, trans and fps, as AMASS has them, or a .bvh of a rig
    /// whose joints have the names of SMPL, Mixamo, CMU or VRM: added to a glb or vrm, in place of
    /// the video's motion elsewhere
    #[arg(long, value_name = "CLIP")]
    motion: Option<PathBuf>,
    /// Frames per second of --motion [default: as the file says]
    #[arg(long, value_name = "N", requires = "motion")]
    fps: Option<f32>,
    /// Frame of the motion whose pose a ply or an obj shows [default: the first]
    #[arg(long, value_name = "N")]
    frame: Option<usize>,
    /// A ply of every frame of the motion, NAME-0000.ply and on
    #[arg(long, conflicts_with = "frame")]
    frames: bool,
    /// Set the motion on level ground, where feet that stand do not slide
    #[arg(long)]
    ground: bool,
    /// Names of the joints in a glb, vrm or bvh; those of rigged characters stay
    #[arg(long, value_enum, default_value = "smpl")]
    bones: Bones,
    /// A glb or vrm that is shaded by the lights of the scene it stands in [default: drawn as it
    /// is]
    #[arg(long)]
    lit: bool,
    #[command(flatten)]
    sizes: Sizes,
    /// Author that a vrm names [default: unknown]
    #[arg(long, value_name = "NAME")]
    author: Option<String>,
    /// Licence of a vrm, added to the one that the format demands [default:
    /// https://vrm.dev/licenses/1.0/ alone]
    #[arg(long, value_name = "URL")]
    licence: Option<String>,
}

/// Runs the command.
pub fn export(arguments: &ExportArguments) -> Result<()> {
    let out = &arguments.out;
    let format = format(arguments)?;
    let sizes = &arguments.sizes;
    let skinned = matches!(format, Format::Glb | Format::Vrm);
    let still = matches!(format, Format::Ply | Format::Obj);
    for (given, fits, what) in [
        (arguments.frame.is_some(), still, "--frame is of one pose: --format ply or obj"),
        (arguments.frames, format == Format::Ply, "--frames is of a ply"),
        (sizes.texture.is_some() || sizes.jpeg.is_some(), skinned, "--texture and --jpeg are of a glb or vrm"),
        (arguments.lit, skinned, "--lit is of a glb or vrm"),
        (sizes.triangles.is_some(), skinned || still, "--triangles is of a glb, vrm, ply or obj"),
        (
            arguments.author.is_some() || arguments.licence.is_some(),
            format == Format::Vrm,
            "--author and --licence are of a vrm",
        ),
    ] {
        ensure!(fits || !given, what);
    }
    let (mut person, _lock) = avatar::of_run(&arguments.run)?;
    if let Some(path) = &arguments.motion {
        avatar::add_motion(&mut person, path, arguments.fps)?;
    }
    let clip = if arguments.motion.is_some() { person.clips.len() - 1 } else { 0 };
    if arguments.ground {
        avatar::ground(&mut person, if skinned { 0 } else { clip })?;
    }
    rename(&mut person, arguments.bones);
    sizes.apply(&mut person)?;
    // The folder is made only now, so that bad input leaves nothing behind.
    avatar::check_folder(out)?;
    match format {
        Format::Glb | Format::Vrm => {
            let author = arguments.author.as_deref().unwrap_or("unknown");
            let vrm = Vrm { author, licence: arguments.licence.as_deref().unwrap_or(VRM_LICENCE) };
            let vrm = Some(vrm).filter(|_| format == Format::Vrm);
            let bytes = person.to_glb_with(&GlbOptions { jpeg: sizes.jpeg, lit: arguments.lit, vrm })?;
            replace_file(out, |to| to.write_all(&bytes)).map_err(unwritten(out))?;
            let names: Vec<&str> = person.clips.iter().map(|clip| clip.name.as_str()).collect();
            let size = bytes.len() as f64 * 1e-6;
            say!("{}: {size:.1} MB, {} triangles, motions: {}", out.display(), person.faces.len(), names.join(", "));
        }
        Format::Ply => {
            let write = |frame: usize, out: &Path| -> Result<()> {
                let (vertices, _) = posed(&person, clip, frame)?;
                let splats = export::splats(&person, &vertices, PATCH)?;
                splats.write(out).map_err(Error::from).map_err(results_in(out))?;
                say!("{}: {} splats", out.display(), splats.centres.len());
                Ok(())
            };
            if !arguments.frames {
                return write(arguments.frame.unwrap_or(0), out);
            }
            let name = out.file_stem().unwrap_or_default().to_string_lossy();
            for frame in 0..person.clips.get(clip).map_or(0, |clip| clip.motion.num_frames()) {
                write(frame, &out.with_file_name(format!("{name}-{frame:04}.ply")))?;
            }
        }
        Format::Obj => {
            let (vertices, normals) = posed(&person, clip, arguments.frame.unwrap_or(0))?;
            export::write_obj(&person, &vertices, &normals, out)
                .map_err(Error::from)
                .map_err(results_in(out.parent().unwrap_or(out)))?;
            say!("{}: {} triangles", out.display(), person.faces.len());
        }
        Format::Npz => {
            export::write_amass(&person, clip, out).map_err(Error::from).map_err(results_in(out))?;
            say!("{}: {} frames", out.display(), person.clips[clip].motion.num_frames());
        }
        Format::Bvh => {
            let motion = person.clips.get(clip).context("the person has no motion")?.motion.clone();
            let frames = motion.num_frames();
            let bvh = Bvh { skeleton: person.skeleton, motion, unit: "centimetres" };
            bvh.save(out).map_err(Error::from).map_err(results_in(out))?;
            say!("{}: {frames} frames of {} joints, in centimetres", out.display(), bvh.skeleton.len());
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
        (None, None) => bail!("--out {}: expected .glb, .vrm, .ply, .obj, .npz or .bvh, or --format", out.display()),
    }
}

/// Gives the joints the names of a scheme, as far as it has such.
fn rename(person: &mut Avatar, bones: Bones) {
    let scheme = match bones {
        Bones::Smpl => BoneNames::Smpl,
        Bones::Mixamo => BoneNames::Mixamo,
        Bones::Vrm => BoneNames::Vrm,
    };
    let names: Vec<&str> = person.skeleton.iter().map(|joint| joint.name.as_str()).collect();
    let names = scheme.translate(&names);
    person.skeleton.iter_mut().zip(names).for_each(|(joint, name)| {
        if let Some(name) = name {
            joint.name = name;
        }
    });
}

/// Vertices and normals of the person at a frame of a clip.
fn posed(person: &Avatar, clip: usize, frame: usize) -> Result<(Vec<Vec3>, Vec<Vec3>)> {
    let motion = &person.clips.get(clip).context("the person has no motion")?.motion;
    let frames = motion.num_frames();
    if frame >= frames {
        bail!("--frame {frame}: the motion has frames 0 to {}", frames - 1);
    }
    let pose = &motion.poses[frame * motion.num_joints..][..motion.num_joints];
    let bones = person.bones(pose, motion.trans[frame]);
    Ok(person.skin(&bones, pose))
}
