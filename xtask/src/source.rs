//! Where the frames come from: the embedded demo, a character filmed on the spot, or a capture on
//! disk with its body model.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};
use clap::{Args, ValueEnum};
use occnerf::capture::{Area, Capture, Layout, LoadOptions, find_body, load_capture, own_body};
use occnerf::{Config, Person, Scene, mend_masks};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use smpl::BodyModel;
use synth::{DemoConfig, Obstacle, Perturbation, SynthConfig, Synthetic, demo};

use crate::film::{film, is_character};
use crate::obstacle::ObstacleArguments;

/// Name of the scene that needs no files.
pub const DEMO: &str = "demo";
/// Environment variable that names a body model.
const BODY_VARIABLE: &str = "SMPL_MODEL";

/// A capture with its prior, and where both came from.
pub struct Source {
    /// `demo`, a character or a directory.
    pub scene: String,
    /// The body model's file.
    pub body: Option<PathBuf>,
    /// How the capture was read and corrupted.
    pub load: SceneOptions,
    /// Frames with masks, cameras and poses.
    pub capture: Capture,
    /// The body model.
    pub model: BodyModel,
    /// The capture as so many rounds of registration have corrected it.
    registered: RefCell<Option<(usize, Capture)>>,
}

impl Source {
    /// Gives the capture the bodies that the run in `directory` was begun with, if it kept them: its
    /// masks are mended before, by the bodies as they are given, as they were then.
    pub fn restore(&mut self, directory: &Path, config: &Config) -> Result<()> {
        if config.registration.rounds > 0 {
            mend_masks(&mut self.capture, &self.model)?;
        }
        Person::restore(directory, &mut self.capture, &self.model)?;
        Ok(())
    }

    /// The capture made ready for a run. Bodies are registered once for all runs that ask for the
    /// same number of rounds one after another.
    ///
    /// # Errors
    /// Those of [`Scene::new`].
    pub fn scene(&self, config: &Config) -> Result<Scene> {
        let rounds = config.registration.rounds;
        if rounds == 0 || self.capture.registered {
            return Ok(Scene::new(&self.capture, &self.model, config)?);
        }
        let mut kept = self.registered.borrow_mut();
        if let Some((_, capture)) = kept.as_ref().filter(|kept| kept.0 == rounds) {
            return Ok(Scene::new(capture, &self.model, config)?);
        }
        let scene = Scene::new(&self.capture, &self.model, config)?;
        *kept = Some((rounds, scene.capture.clone()));
        Ok(scene)
    }
}

/// How the files of a scene are read, and the capture corrupted.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SceneOptions {
    /// How the files are read.
    pub files: LoadOptions,
    /// Corruptions of the capture once it is read.
    pub corruption: Corruption,
}

/// Corruptions of a capture for experiments.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Corruption {
    /// The simulated obstacle before the training camera of raw ZJU-MoCap. `None`: what
    /// `occlusion.json` says, or the default [`Obstacle`] where there is none.
    pub occlusion: Option<Obstacle>,
    /// Errors of priors and masks.
    pub wrong: Perturbation,
}

impl SceneOptions {
    /// Whether all but the errors of priors and masks is as by default.
    fn only_wrong(&self) -> bool {
        self.files == LoadOptions::default() && self.corruption.occlusion.is_none()
    }
}

/// Puts the simulated obstacle before the training camera of raw ZJU-MoCap.
fn occlude(capture: &mut Capture, directory: &Path, occlusion: Option<Obstacle>) -> Result<()> {
    if Layout::detect(directory)? != Layout::ZjuMocap {
        ensure!(
            occlusion.is_none(),
            "occlusion: expected none (the masks of {} say what is hidden), found an obstacle",
            directory.display()
        );
        return Ok(());
    }
    let recorded = directory.join("occlusion.json").is_file();
    if recorded && occlusion.is_some() {
        // The obstacle asked for stands in place of the recorded one.
        let nowhere = Area { columns: 0..0, rows: 0..0 };
        capture.train.iter_mut().for_each(|frame| frame.source.hide(nowhere.clone()));
    }
    if !recorded || occlusion.is_some() {
        occlusion.unwrap_or_default().hide(&mut capture.train)?;
    }
    Ok(())
}

/// What a capture's files leave open.
#[derive(Args, Clone, Debug, Serialize)]
#[serde(rename_all = "kebab-case")]
pub struct LoadArguments {
    /// Longest side in pixels that pictures are reduced to [default: as they are]
    #[arg(long, value_name = "PIXELS")]
    resize: Option<u32>,
    /// Train on every n-th frame [default: 1]
    #[arg(long, value_name = "N")]
    stride: Option<usize>,
    /// Train on at most this many frames [default: all]
    #[arg(long, value_name = "N")]
    max_frames: Option<usize>,
    /// Keep back views of every n-th training frame [default: 1]
    #[arg(long, value_name = "N")]
    eval_stride: Option<usize>,
    /// Training camera of a ZJU-MoCap capture, by folder or by number from 1 [default: the first]
    #[arg(long, value_name = "NAME")]
    camera: Option<String>,
    /// Simulated obstacle before the training camera of a ZJU-MoCap capture [default:
    /// occlusion.json, else central]
    #[arg(long)]
    occlusion: Option<ObstacleName>,
    #[command(flatten)]
    #[serde(flatten)]
    obstacle: ObstacleArguments,
    /// Most memory that a capture's bodies and decoded pictures may take, in MiB; where pictures do
    /// not fit they stay packed, and those beyond it are decoded whenever they are needed
    /// [default: 1024]
    #[arg(long, value_name = "MIB", value_parser = clap::value_parser!(u64).range(1..=1 << 24))]
    memory: Option<u64>,
    /// Make the prior and the masks as wrong as something makes them; the options below change
    /// single errors of it
    #[arg(long)]
    wrong: Option<WrongName>,
    /// Turn every bone of the prior by so many degrees (root mean square), to see what a method
    /// bears [default: 0]
    #[arg(long, value_name = "DEGREES")]
    wrong_pose: Option<f32>,
    /// Change every shape coefficient of the prior by so many standard deviations [default: 0]
    #[arg(long, value_name = "N")]
    wrong_shape: Option<f32>,
    /// Move the prior by so many metres of a body 1.7 m high (root mean square) [default: 0]
    #[arg(long, value_name = "METRES")]
    wrong_translation: Option<f32>,
    /// Change the prior's distance from the camera by so many per cent (root mean square)
    /// [default: 0]
    #[arg(long, value_name = "PERCENT")]
    wrong_depth: Option<f32>,
    /// Make the bones of the prior's limbs longer or shorter by so many per cent (standard
    /// deviation) [default: 0]
    #[arg(long, value_name = "PERCENT")]
    wrong_limbs: Option<f32>,
    /// Let the edges of the training masks go to and fro by up to so many pixels [default: 0]
    #[arg(long, value_name = "PIXELS")]
    wrong_edge: Option<f32>,
    /// Grow the training masks by so many pixels, or shrink them [default: 0]
    #[arg(long, value_name = "PIXELS", allow_negative_numbers = true)]
    wrong_mask: Option<i32>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, ValueEnum)]
#[serde(rename_all = "kebab-case")]
enum ObstacleName {
    /// No obstacle.
    None,
    /// The paper's: half of the person on four fifths of the frames.
    Central,
    /// The same, moving by three tenths of the picture.
    Moving,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, ValueEnum)]
#[serde(rename_all = "kebab-case")]
enum WrongName {
    /// What estimators and segmenters make of a real video: poses by 4°, 2 cm, depth by 2 %, limbs
    /// by 5 %, shape by 1, ragged masks.
    Real,
}

impl LoadArguments {
    /// A capture as it is.
    pub fn none() -> Self {
        /// The options alone.
        #[derive(clap::Parser)]
        struct Line {
            #[command(flatten)]
            load: LoadArguments,
        }
        <Line as clap::Parser>::parse_from([""]).load
    }

    /// The same for the library.
    pub fn options(&self) -> Result<SceneOptions> {
        let occlusion = match self.occlusion {
            Some(ObstacleName::None) => Some(self.obstacle.none()?),
            Some(ObstacleName::Moving) => Some(self.obstacle.moving()),
            Some(ObstacleName::Central) => Some(self.obstacle.central()),
            None => self.obstacle.given().then(|| self.obstacle.central()),
        };
        let as_wrong = self.wrong.map_or(Perturbation::NONE, |WrongName::Real| Perturbation::REAL);
        let wrong = Perturbation {
            pose_degrees: self.wrong_pose.unwrap_or(as_wrong.pose_degrees),
            shape: self.wrong_shape.unwrap_or(as_wrong.shape),
            translation: self.wrong_translation.unwrap_or(as_wrong.translation),
            depth_percent: self.wrong_depth.unwrap_or(as_wrong.depth_percent),
            limbs_percent: self.wrong_limbs.unwrap_or(as_wrong.limbs_percent),
            ragged_pixels: self.wrong_edge.unwrap_or(as_wrong.ragged_pixels),
            mask_pixels: self.wrong_mask.unwrap_or(as_wrong.mask_pixels),
        };
        let files = LoadOptions {
            resize: self.resize,
            stride: self.stride.unwrap_or(1),
            max_frames: self.max_frames,
            eval_stride: self.eval_stride.unwrap_or(1),
            camera: self.camera.clone(),
            max_bytes: self.memory.map_or(LoadOptions::default().max_bytes, |mib| mib << 20),
            ..LoadOptions::default()
        };
        Ok(SceneOptions { files, corruption: Corruption { occlusion, wrong } })
    }

    /// The same as on the command line: every flag that was given.
    pub fn command_line(&self) -> String {
        let flags = serde_json::to_string(self).and_then(|text| serde_json::from_str::<BTreeMap<String, Value>>(&text));
        let given = flags.unwrap_or_default().into_iter().filter(|(_, value)| !value.is_null());
        given.map(|(flag, value)| format!(" --{flag} {}", value.to_string().trim_matches('"'))).collect()
    }

    /// How a run to be resumed read its capture, checked against what is asked for.
    pub fn resumed(&self, saved: &SceneOptions) -> Result<SceneOptions> {
        let asked = self.options()?;
        if asked != SceneOptions::default() && asked != *saved {
            bail!(
                "the run to resume read its capture with other options; leave them out, or start a new run with --out"
            );
        }
        let mut resumed = saved.clone();
        if self.memory.is_some() {
            resumed.files.max_bytes = asked.files.max_bytes;
        }
        Ok(resumed)
    }
}

/// Loads `scene`, the demo if it is `None` or named [`DEMO`]; the body is `body`, the capture's own,
/// that of the variable SMPL_MODEL, or what lies near the scene.
pub fn load(scene: Option<&str>, body: Option<&Path>, options: &SceneOptions) -> Result<Source> {
    let (scene, wrong) = (scene.unwrap_or(DEMO), options.corruption.wrong);
    let name = scene.to_owned();
    if scene == DEMO {
        if !options.only_wrong() {
            bail!("the demo takes none of the options that say how a capture is read");
        }
        let mut model = BodyModel::embedded();
        let mut capture = demo(&DemoConfig::default(), &model)?;
        wrong.apply(&mut capture, &model)?;
        wrong.spoil_body(&mut model);
        return Ok(Source {
            scene: name,
            body: None,
            load: options.clone(),
            capture,
            model,
            registered: RefCell::default(),
        });
    }
    let directory = Path::new(scene);
    if directory.is_file() && is_character(directory) {
        if !options.only_wrong() || body.is_some() {
            bail!("{scene}: a character takes none of the options of a capture; use synth to choose how it is filmed");
        }
        let Synthetic { mut capture, mut body, .. } = film(Some(directory), None, &SynthConfig::default())?;
        wrong.apply(&mut capture, &body)?;
        wrong.spoil_body(&mut body);
        return Ok(Source {
            scene: name,
            body: None,
            load: options.clone(),
            capture,
            model: body.with_limb_lengths(),
            registered: RefCell::default(),
        });
    }
    if !directory.is_dir() {
        bail!("{scene}: no such directory; expected a capture, a .glb or .gltf character, or no SCENE for the demo");
    }
    let variable = std::env::var_os(BODY_VARIABLE).map(PathBuf::from);
    let body = match body.map(Path::to_owned).or_else(|| own_body(directory)).or(variable) {
        Some(body) => body,
        None => find_body(directory).with_context(|| {
            format!("a capture needs the body model it was fitted with (--body FILE.npz, or {BODY_VARIABLE})")
        })?,
    };
    let mut model = BodyModel::load(&body)?;
    let mut capture = load_capture(directory, &model, &options.files)?;
    occlude(&mut capture, directory, options.corruption.occlusion)?;
    wrong.apply(&mut capture, &model)?;
    wrong.spoil_body(&mut model);
    Ok(Source {
        scene: name,
        body: Some(body),
        load: options.clone(),
        capture,
        model: model.with_limb_lengths(),
        registered: RefCell::default(),
    })
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        load: LoadArguments,
    }

    #[test]
    fn a_command_line_made_of_options_says_all_of_them() {
        let words = "x --resize 64 --stride 2 --max-frames 9 --eval-stride 3 --camera B2 --occlusion moving --fraction 0.4 \
                     --share 0.7 --position -0.1 --height 0.5 --memory 2048 --wrong-pose 2.5 --wrong-shape 1 --wrong-mask -3";
        let wrong = "x --wrong real --wrong-translation 0.05 --wrong-depth 3 --wrong-limbs 4 --wrong-edge 1";
        for words in [words, wrong, "x"] {
            let load = Line::parse_from(words.split_whitespace()).load;
            let again = format!("x{}", load.command_line());
            assert_eq!(again.split_whitespace().count(), words.split_whitespace().count(), "{again}");
            let options = load.options().unwrap();
            let read = Line::parse_from(again.split_whitespace()).load.options().unwrap();
            assert_eq!((read.files.max_bytes, read), (options.files.max_bytes, options));
        }
    }

    #[test]
    fn a_run_is_resumed_with_its_own_options_and_any_memory() {
        let load = |words: &str| Line::parse_from(words.split_whitespace()).load;
        let saved = load("x --resize 64 --memory 9").options().unwrap();
        for (words, mebibytes) in
            [("x", 9), ("x --resize 64", 9), ("x --memory 20", 20), ("x --memory 20 --resize 64", 20)]
        {
            let resumed = load(words).resumed(&saved).unwrap();
            assert_eq!((resumed.files.max_bytes, &resumed), (mebibytes << 20, &saved));
        }
        assert!(load("x --resize 65").resumed(&saved).is_err() && load("x --stride 2").resumed(&saved).is_err());
    }
}
