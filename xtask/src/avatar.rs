//! The avatar of a run for export, with additional motion clips.

use std::path::Path;

use anyhow::{Context, Result, anyhow, ensure};
use clap::Args;
use glam::Vec3;
use occnerf::Method;
use occnerf::bake::{Avatar, Clip, export};
use point_fit::Grounded;
use smpl::{Bvh, Joint, MotionClip};

use crate::baked;
use crate::process::{Lock, note, say, telling};
use crate::run::{CHECKPOINT, RunConfig, identity, make_directory};

/// Options that make an avatar smaller.
#[derive(Args)]
pub struct Sizes {
    /// Most triangles; vertices are merged, those on seams of the texture along them, until there
    /// are no more [default: as they are]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub triangles: Option<u32>,
    /// Longest side of the texture, texels; halved until it is no longer [default: as it is]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub texture: Option<u32>,
    /// Texture as JPEG of this quality, 1 to 100, in place of PNG
    #[arg(long, value_name = "QUALITY", value_parser = clap::value_parser!(u8).range(1..=100))]
    pub jpeg: Option<u8>,
}

impl Sizes {
    /// Reduces triangles and texture.
    pub fn apply(&self, avatar: &mut Avatar) -> Result<()> {
        if let Some(most) = self.triangles {
            avatar.simplify(most as usize)?;
            let left = avatar.faces.len();
            if left > most as usize {
                note!("--triangles {most}: {left} are left, fewer would tear seams or turn triangles over");
            }
        }
        if let Some(side) = self.texture {
            avatar.atlas.shrink(side);
        }
        Ok(())
    }
}

/// The surface of a run, or its baked person, see [`baked::avatar`]; and the lock on the run.
pub fn of_run(run: &Path) -> Result<(Avatar, Lock)> {
    ensure!(run.is_dir(), "{}: no such run", run.display());
    let config = match RunConfig::read(run) {
        // A surface stands for itself.
        Err(_) if baked::path(run).exists() && !run.join(CHECKPOINT).exists() => None,
        read => Some(read?),
    };
    let method = config.as_ref().map_or(Method::Surface, |config| config.train.method);
    ensure!(method != Method::Prior, "{} has no field to bake", run.display());
    let lock = Lock::share(run)?;
    let avatar = match config.filter(|_| method.has_field()) {
        Some(config) => baked::avatar(run, &config)?,
        None => Avatar { source: identity(run)?, ..Avatar::load(&baked::path(run))? },
    };
    Ok((avatar, lock))
}

/// Reads a motion for `skeleton`, y up, of `fps` frames per second, by default as many as the file
/// says.
pub fn load_motion(path: &Path, fps: Option<f32>, skeleton: &[Joint]) -> Result<MotionClip> {
    let is_bvh = path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("bvh"));
    let (mut motion, rate) = if is_bvh {
        let bvh = telling(&format!("reading {}", path.display()), || Bvh::load(path))?;
        let motion = bvh.onto(skeleton).map_err(|fault| anyhow!("{}: {fault}", path.display()))?;
        say!("{}: {} joints, lengths taken for {}", path.display(), bvh.skeleton.len(), bvh.unit);
        (motion, Some(bvh.motion.fps))
    } else {
        telling(&format!("reading {}", path.display()), || MotionClip::load_with_rate(path))?
    };
    if let Some(fps) = fps {
        ensure!((1e-3..=1e6).contains(&fps), "--fps {fps}: expected 0.001 to 1000000");
        motion.fps = fps;
    } else if rate.is_none() {
        say!("{}: no frames per second in it, {} are assumed (--fps)", path.display(), motion.fps);
    }
    let root = skeleton.first().map_or(Vec3::ZERO, |joint| joint.rest);
    export::fit_motion(&motion, skeleton.len(), root).with_context(|| path.display().to_string())
}

/// Adds a motion from a file, named after it.
pub fn add_motion(avatar: &mut Avatar, path: &Path, fps: Option<f32>) -> Result<()> {
    let motion = load_motion(path, fps, &avatar.skeleton)?;
    let stem = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let taken = |name: &str| avatar.clips.iter().any(|clip| clip.name == name);
    let others = (2..).map(|i| format!("{stem} {i}"));
    let name = std::iter::once(stem.clone()).chain(others).find(|name| !taken(name)).unwrap_or(stem);
    avatar.clips.push(Clip { name, motion });
    Ok(())
}

/// Sets the motions from `first` on the floor, and reports the feet.
pub fn ground(avatar: &mut Avatar, first: usize) -> Result<()> {
    let sole = avatar.vertices.iter().map(|v| v.y).fold(f32::INFINITY, f32::min);
    for Clip { name, motion } in avatar.clips.iter_mut().skip(first) {
        let grounded = point_fit::ground(&avatar.skeleton, motion, sole);
        let Grounded { motion: on_floor, sliding, standing, tilt, moved } =
            grounded.with_context(|| format!("--ground: {name}"))?;
        *motion = on_floor;
        if standing == [0.0; 2] {
            note!("{name}: no foot stands still, as of a person who walks on the spot: none is held");
            continue;
        }
        say!(
            "{name}: standing feet, left {:.0} %, right {:.0} % of the frames, slid {:.0} mm/s, now {:.1}; world turned \
             by {:.1}°; body moved by at most {:.0} mm, legs that do not stand by {:.0}",
            100.0 * standing[0],
            100.0 * standing[1],
            1e3 * sliding[0],
            1e3 * sliding[1],
            tilt.to_degrees(),
            1e3 * moved[0],
            1e3 * moved[1]
        );
    }
    // They film the motion as it was.
    avatar.cameras.clear();
    Ok(())
}

/// Makes the parent folder of the file `out`.
pub fn check_folder(out: &Path) -> Result<()> {
    out.parent().map_or(Ok(()), make_directory)?;
    ensure!(!out.is_dir(), "--out {}: is a folder, expected a file", out.display());
    Ok(())
}
