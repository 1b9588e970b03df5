//! `synth`: a capture made to order, in a published dataset format.

use std::path::{Path, PathBuf};

use anyhow::{Context, Error, Result, anyhow, bail, ensure};
use clap::{Args, ValueEnum};
use indicatif::{ProgressBar, ProgressStyle};
use occnerf::capture::Layout;
use rigged::Character;
use smpl::{BodyModel, BoneNames, Bvh, MotionClip, skeleton};
use synth::{BODY, Obstacle, Occlusion, Outfit, SynthConfig, Synthetic, synthesise};

use crate::obstacle::{ObstacleArguments, ObstacleName};
use xtask::place::{beside, not_within, take_place, vacant};
use xtask::process::{results_in, say};
use xtask::run::make_directory;
use xtask::source::is_character;

/// What a finished directory holds, and nothing else does.
const MARK: &str = "synth.json";

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum FormatName {
    /// HumanNeRF's prepared layout, with eval/ cameras.
    Humannerf,
    /// Raw ZJU-MoCap, with occlusion.json.
    ZjuMocap,
    /// HumanNeRF's wild layout, in which OcMotion is distributed: one camera, occluders/, clean/
    /// frames of the same camera.
    Ocmotion,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum OcclusionName {
    /// Nothing in front of the person.
    None,
    /// The paper's fixed rectangle.
    Central,
    /// The same, moving by three tenths of the picture.
    Moving,
    /// A desk and pillars of 3-D geometry, in every frame.
    Objects,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum OutfitName {
    /// Shirt, trousers, shoes and short hair, close to the body.
    Plain,
    /// A skirt to the knees.
    Skirt,
    /// Loose strands to the shoulder blades.
    LongHair,
}

/// What to make, and where to.
#[derive(Args)]
pub struct SynthArguments {
    /// A rigged .glb or .gltf; the embedded person if left out. Its mesh at rest becomes the body
    /// model, with as many joints as the rig has (poses are then 3 numbers a joint, not 72)
    character: Option<PathBuf>,
    /// Directory to write, new or empty
    #[arg(long)]
    out: PathBuf,
    /// Replace what the same command wrote to --out earlier
    #[arg(long)]
    force: bool,
    /// Write no body.safetensors: for the demo of xtask, whose program has the embedded person's
    /// body
    #[arg(long)]
    no_body: bool,
    /// Layout of the files
    #[arg(long, default_value = "humannerf")]
    format: FormatName,
    /// What hides the person
    #[arg(long, default_value = "central")]
    occlusion: OcclusionName,
    #[command(flatten)]
    obstacle: ObstacleArguments,
    /// Frames of the video [default: 100]
    #[arg(long, value_name = "N")]
    frames: Option<usize>,
    /// Pixels a side [default: 192]
    #[arg(long, value_name = "PIXELS")]
    size: Option<u32>,
    /// Cameras kept back [default: 5]; the ocmotion layout has none
    #[arg(long, value_name = "N")]
    eval_cameras: Option<usize>,
    /// Views kept back show every n-th frame [default: 10]
    #[arg(long, value_name = "N")]
    eval_every: Option<usize>,
    /// Motion capture (.npz with poses, trans, fps, or .bvh), for the embedded person or joints
    /// with MakeHuman's, Mixamo's, Unreal's or SMPL's names [default: a walk; a character's first
    /// animation]
    #[arg(long, value_name = "CLIP")]
    motion: Option<PathBuf>,
    /// Full turns added to the motion of a clip or a character over the video, so that all sides
    /// are seen [default: 1.15]
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    turns: Option<f32>,
    /// Error of each bone's orientation in the poses that are written, degrees rms [default: 1.5]
    #[arg(long, value_name = "DEGREES")]
    pose_noise: Option<f32>,
    /// Error of the body's shape: at 1 a character's body lies 1 to 3 cm inside it, the embedded
    /// person's betas are off by
    /// 0.15 under the clothes [default: 1]
    #[arg(long, value_name = "0 to 3")]
    shape_noise: Option<f32>,
    /// Decides the light, the embedded person's shape and clothes, and all errors [default: 0]
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
    /// Strength of the light from one side; at 0 as much comes from everywhere [default: 1]
    #[arg(long, value_name = "0 to 1")]
    lamp: Option<f32>,
    /// What the embedded person wears: a skirt and loose hair are no displacement of the body's
    /// surface
    #[arg(long, default_value = "plain", conflicts_with = "character")]
    outfit: OutfitName,
    /// The embedded person's hands are fists, the body's stay flat
    #[arg(long, conflicts_with = "character")]
    fist: bool,
}

impl SynthArguments {
    fn config(&self) -> Result<SynthConfig> {
        let usual = SynthConfig::default();
        let rectangle = |name| self.obstacle.named(name).map(Occlusion::Rectangle);
        let occlusion = match self.occlusion {
            OcclusionName::None => rectangle(ObstacleName::None)?,
            OcclusionName::Central => rectangle(ObstacleName::Central)?,
            OcclusionName::Moving => rectangle(ObstacleName::Moving)?,
            OcclusionName::Objects => {
                let said = "--occlusion objects has no --share (they stand in every frame) and no --height";
                ensure!(self.obstacle.share.or(self.obstacle.height).is_none(), said);
                let Obstacle { fraction, position, .. } = self.obstacle.named(ObstacleName::Central)?;
                Occlusion::Objects { fraction, position }
            }
        };
        Ok(SynthConfig {
            size: self.size.unwrap_or(usual.size),
            frames: self.frames.unwrap_or(usual.frames),
            eval_cameras: self.eval_cameras.unwrap_or(usual.eval_cameras),
            eval_every: self.eval_every.unwrap_or(usual.eval_every),
            seed: self.seed.unwrap_or(usual.seed),
            lamp: self.lamp.unwrap_or(usual.lamp),
            pose_noise_degrees: self.pose_noise.unwrap_or(usual.pose_noise_degrees),
            shape_noise: self.shape_noise.unwrap_or(usual.shape_noise),
            turns: self.turns.unwrap_or(usual.turns),
            outfit: match self.outfit {
                OutfitName::Plain => Outfit::Plain,
                OutfitName::Skirt => Outfit::Skirt,
                OutfitName::LongHair => Outfit::LongHair,
            },
            fist: self.fist,
            occlusion,
        })
    }
}

/// Runs the command.
pub fn synth(arguments: &SynthArguments) -> Result<()> {
    let SynthArguments { out, force, .. } = arguments;
    let config = arguments.config()?;
    if let Some(path) = arguments.character.as_deref().filter(|path| !is_character(path)) {
        bail!("{}: not a character; expected a .glb or .gltf", path.display());
    }
    vacant(out, *force, MARK)?;
    for (what, path) in [("the character", &arguments.character), ("--motion", &arguments.motion)] {
        if let Some(path) = path {
            not_within(path, out, what)?;
        }
    }
    let layout = match arguments.format {
        FormatName::Humannerf => Layout::HumanNerf,
        FormatName::ZjuMocap => Layout::ZjuMocap,
        FormatName::Ocmotion => Layout::Wild,
    };
    let synthetic = film(arguments.character.as_deref(), arguments.motion.as_deref(), &config)?;
    let (hidden, joints) = (synthetic.hidden_fraction, &synthetic.joints);
    let mark = serde_json::json!({ "config": synthetic.config, "hidden_fraction": hidden, "joints": joints });
    // Everything is written beside the directory, and takes its place when it is complete.
    let partial = beside(out, "partial")?;
    let write = || -> Result<()> {
        make_directory(&partial)?;
        let bar = bar("writing", synthetic.num_pictures(layout));
        let written = synthetic.write(&partial, layout, &|_| bar.inc(1));
        bar.finish_and_clear();
        written.map_err(Error::from).map_err(results_in(&partial))?;
        if arguments.no_body {
            std::fs::remove_file(partial.join(BODY))?;
        }
        xtask::run::write(&partial.join(MARK), &serde_json::to_string_pretty(&mark)?)?;
        take_place(&partial, out, *force, MARK)
    };
    write().inspect_err(|_| drop(std::fs::remove_dir_all(&partial)))?;
    let capture = &synthetic.capture;
    say!(
        "{}: {} frames, {} views kept back, {:.1} % of the person hidden where anything is, {} joints, {} vertices",
        out.display(),
        capture.train.len(),
        if layout == Layout::Wild { capture.train.len().div_ceil(config.eval_every) } else { capture.eval.len() },
        100.0 * synthetic.hidden_fraction,
        synthetic.body.num_joints(),
        synthetic.body.num_vertices(),
    );
    say!("train on it: cargo xtask train {}", out.display());
    Ok(())
}

/// Names of the joints of a character's body in a capture that [`synth()`] wrote; none for other
/// captures.
pub fn joint_names(capture: &Path) -> Result<Vec<String>> {
    #[derive(Default, serde::Deserialize)]
    #[serde(default)]
    struct Mark {
        joints: Vec<String>,
    }
    let path = capture.join(MARK);
    if !path.is_file() {
        return Ok(Vec::new());
    }
    let mark: Mark =
        serde_json::from_str(&std::fs::read_to_string(&path)?).with_context(|| path.display().to_string())?;
    Ok(mark.joints)
}

/// Films `character`, or the embedded person, with a bar.
fn film(character: Option<&Path>, motion: Option<&Path>, config: &SynthConfig) -> Result<Synthetic> {
    let named = |path: &Path| path.display().to_string();
    let character = character.map(|path| Character::load(path).map(|c| (c, named(path)))).transpose()?;
    for what in character.iter().flat_map(|(character, _)| &character.ignored) {
        say!("of the character is left out: {what}");
    }
    let motion = motion.map(load_motion).transpose()?;
    let bar = bar("filming", config.frames);
    let synthetic = synthesise(character.as_ref().map(|(c, _)| c), motion.as_ref(), config, &|_| bar.inc(1));
    bar.finish_and_clear();
    match character {
        Some((_, name)) => synthetic.context(name),
        None => Ok(synthetic?),
    }
}

/// A motion of SMPL's joints.
fn load_motion(path: &Path) -> Result<MotionClip> {
    if path.extension().is_none_or(|extension| !extension.eq_ignore_ascii_case("bvh")) {
        return Ok(MotionClip::load(path)?);
    }
    let body = BodyModel::embedded();
    let motion = Bvh::load(path)?.onto(&skeleton(BoneNames::Smpl, &body.parents, &body.shaped(&[]).joints));
    motion.map_err(|fault| anyhow!("{}: {fault}", path.display()))
}

/// A bar of `length` steps.
fn bar(what: &'static str, length: usize) -> ProgressBar {
    let bar = ProgressBar::new(length as u64);
    if let Ok(style) = ProgressStyle::with_template("{bar:28} {pos}/{len} {msg}  {elapsed}") {
        bar.set_style(style);
    }
    bar.with_message(what)
}
