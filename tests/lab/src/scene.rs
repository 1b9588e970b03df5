//! Captures as they are read and corrupted for an experiment.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, Result, anyhow, bail, ensure};
use clap::{Args, ValueEnum};
use glam::Vec3;
use occnerf::capture::{Area, Capture, Frame, Layout, LoadOptions};
use point_fit::Anchor;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use smpl::{BodyModel, BoneNames, Bvh, Joint, MotionClip, Placement, rodrigues};
use synth::{Obstacle, Perturbation};
use volrender::RandomStream;
use xtask::run::RunConfig;
use xtask::source::{DEMO, LoadArguments, Source, load_with};

use crate::obstacle::{ObstacleArguments, ObstacleName};
use crate::synth::joint_names;

/// Begins the recorded scene of a run on a corrupted capture, before the JSON of the scene and its
/// [`Corruption`]. No file has such a name, so `xtask` refuses the run.
const CORRUPTED: &str = "lab:";
/// Stream of the noise of key points.
const NOISE: u64 = 0x4f50_454e;

/// How the files of a scene are read, and the capture corrupted.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SceneOptions {
    pub files: LoadOptions,
    pub corruption: Corruption,
    /// Identity of what is read ([`Source::identity`]); empty where unknown.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub capture: String,
}

/// Corruptions of a capture.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Corruption {
    /// The simulated obstacle before the training camera of raw ZJU-MoCap. `None`: what
    /// `occlusion.json` says, or the default [`Obstacle`] where there is none.
    pub occlusion: Option<Obstacle>,
    /// The open body in place of the capture's, which has SMPL's joints or is a character's: at 0
    /// in its mean shape, with the capture's angles; else fitted to SAM 3D Body's key points of the
    /// capture's body, and to vertices if its mesh is the same, each coordinate with normal noise
    /// of this standard deviation, in millimetres.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub open_body: Option<f32>,
    /// Errors of priors and masks.
    pub wrong: Perturbation,
}

impl SceneOptions {
    /// The same for the capture as it is now.
    pub fn identified(self, scene: &str, body: Option<&Path>) -> Result<Self> {
        let capture = self.load(scene, body)?.identity()?;
        Ok(Self { capture, ..self })
    }

    /// The capture, corrupted; the scene of the source names the corruption.
    pub fn load(&self, scene: &str, body: Option<&Path>) -> Result<Source> {
        let mut corruption = self.corruption;
        let mut source = load_with(Some(scene), body, &self.files, |capture, model| {
            corruption.occlusion = occlude(capture, Path::new(scene), corruption.occlusion)?;
            if let Some(noise) = corruption.open_body {
                put_open_body(capture, model, 1e-3 * noise, &joint_names(Path::new(scene))?)?;
            }
            corruption.wrong.apply(capture, model)?;
            corruption.wrong.corrupt_body(model);
            Ok(())
        })?;
        if corruption != Corruption::default() {
            source.scene = format!("{CORRUPTED}{}", serde_json::to_string(&(scene, corruption))?);
        }
        Ok(source)
    }
}

/// Puts the open body in place of the capture's: see [`Corruption::open_body`]; `noise` in metres.
/// `names` are those of a character's joints.
fn put_open_body(capture: &mut Capture, model: &mut BodyModel, noise: f32, names: &[String]) -> Result<()> {
    let open = BodyModel::embedded();
    let joints = model.num_joints();
    if joints == names.len() {
        return retarget(capture, model, noise, open, names);
    }
    let expected = "--open-body: expected SMPL's 24 joints, or a character of `lab synth`";
    ensure!(joints == open.num_joints(), "{expected}, found {joints} joints");
    let anchors = |body: &BodyModel| point_fit::joint_set(body, "mhr70").unwrap_or_default();
    // Both bodies have the same points.
    let is_mesh = model.faces == open.faces;
    let mesh = (0..open.num_vertices()).filter(|v| is_mesh && v.is_multiple_of(54));
    let mesh: Vec<Anchor> = mesh.map(|v| Anchor { vertices: vec![(v, 1.0)], ..Anchor::default() }).collect();
    let [own, other] = [anchors(model), anchors(&open)]
        .map(|set| set.into_iter().flatten().chain(mesh.iter().cloned()).collect::<Vec<_>>());
    let mut random = RandomStream::new(&[NOISE]);
    let mut seen = Vec::new();
    for frame in &mut capture.train {
        let shaped = model.shaped(&frame.betas);
        let posed = model.pose(&shaped, &frame.pose, frame.placement);
        for anchor in own.iter().filter(|_| noise > 0.0) {
            let joints = anchor.joints.iter().map(|(j, w)| *w * posed.joints[*j]);
            let point: Vec3 = joints.chain(anchor.vertices.iter().map(|(v, w)| *w * posed.vertices[*v])).sum();
            seen.push(point + noise * Vec3::from_array([(); 3].map(|()| random.normal())));
        }
        // The pelvis stays.
        let rest = open.shaped(&[]).joints[0];
        match &mut frame.placement {
            Placement::Origin { rotation, translation } => *translation = posed.joints[0] - rodrigues(*rotation) * rest,
            Placement::Pelvis { translation } => *translation = posed.joints[0] - rest,
        }
        frame.betas.clear();
    }
    capture.mean_betas.clear();
    if noise > 0.0 {
        let fitted = point_fit::fit(&open, &other, &seen)?;
        for (frame, found) in capture.train.iter_mut().zip(fitted.frames) {
            (frame.pose, frame.betas) = (found.pose, fitted.betas.clone());
            frame.placement = Placement::Pelvis { translation: found.translation };
        }
        capture.mean_betas = fitted.betas;
    }
    share_bodies(capture);
    *model = open;
    Ok(())
}

/// Puts the open body in place of a character: the shape that fits its joints by their names, with
/// the character's angles or, with noise, fitted ones.
fn retarget(capture: &mut Capture, model: &mut BodyModel, noise: f32, open: BodyModel, names: &[String]) -> Result<()> {
    let smpl = BoneNames::Smpl.of_body(open.num_joints());
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    let roles =
        BoneNames::Smpl.translate(&names).into_iter().map(|role| smpl.iter().position(|s| role.as_ref() == Some(s)));
    let roles: Vec<(usize, usize)> = roles.enumerate().filter_map(|(joint, role)| Some((joint, role?))).collect();
    let Some(&(hips, _)) = roles.iter().find(|(_, role)| *role == 0) else {
        bail!("--open-body: no joint named for hips")
    };
    let skeleton = |names: &[&str], parents: &[Option<usize>], rest: Vec<Vec3>| -> Vec<Joint> {
        let parts = names.iter().zip(parents).zip(rest);
        parts.map(|((name, p), rest)| Joint { name: (*name).to_owned(), parent: p.map(|p| p as u16), rest }).collect()
    };
    let rest = model.shaped(&capture.mean_betas).joints;
    let mut random = RandomStream::new(&[NOISE]);
    let (mut poses, mut trans, mut seen, mut places) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    for frame in &capture.train {
        let posed = model.pose(&model.shaped(&frame.betas), &frame.pose, frame.placement);
        let root = if let Placement::Origin { rotation, .. } = frame.placement { rotation } else { frame.pose[0] };
        poses.extend(std::iter::once(root).chain(frame.pose[1..].iter().copied()));
        trans.push(posed.joints[0] - rest[0]);
        let mut off = || noise * Vec3::from_array([(); 3].map(|()| random.normal()));
        seen.extend(roles.iter().map(|(joint, _)| posed.joints[*joint] + off()));
        places.push(posed.joints[hips]);
    }
    let anchors: Vec<Anchor> = roles.iter().map(|(_, role)| Anchor::joint(*role)).collect();
    let fitted = point_fit::fit(&open, &anchors, &seen)?;
    let shape = open.shaped(&fitted.betas).joints;
    let motion = MotionClip { poses, num_joints: names.len(), trans, fps: 30.0 };
    let source = Bvh { skeleton: skeleton(&names, &model.parents, rest), motion, unit: "m" };
    let smpl: Vec<&str> = smpl.iter().map(String::as_str).collect();
    let target = skeleton(&smpl, &open.parents, shape.clone());
    let motion = source.onto(&target).map_err(|fault| anyhow!("--open-body: {fault}"))?;
    let carried = motion.poses.chunks(smpl.len()).zip(places).map(|(pose, place)| (pose.to_vec(), place - shape[0]));
    let carried: Vec<_> = if noise > 0.0 {
        fitted.frames.into_iter().map(|frame| (frame.pose, frame.translation)).collect()
    } else {
        carried.collect()
    };
    for (frame, (pose, translation)) in capture.train.iter_mut().zip(carried) {
        (frame.pose, frame.betas) = (pose, fitted.betas.clone());
        frame.placement = Placement::Pelvis { translation };
    }
    capture.mean_betas = fitted.betas;
    share_bodies(capture);
    *model = open;
    Ok(())
}

/// Gives views kept back the bodies of their instants.
fn share_bodies(capture: &mut Capture) {
    for view in &mut capture.eval {
        if let Some(frame) = capture.train.get(view.train_index) {
            let Frame { pose, betas, placement, .. } = frame;
            (view.frame.pose, view.frame.betas, view.frame.placement) = (pose.clone(), betas.clone(), *placement);
        }
    }
}

/// Puts the simulated obstacle before the training camera of raw ZJU-MoCap, and returns it.
fn occlude(capture: &mut Capture, directory: &Path, occlusion: Option<Obstacle>) -> Result<Option<Obstacle>> {
    if directory == Path::new(DEMO) || Layout::detect(directory)? != Layout::ZjuMocap {
        let scene = directory.display();
        ensure!(occlusion.is_none(), "{scene}: takes no obstacle, only raw ZJU-MoCap does");
        return Ok(None);
    }
    let recorded = directory.join("occlusion.json").is_file();
    if recorded && occlusion.is_some() {
        // The obstacle asked for stands in place of the recorded one.
        let nowhere = Area { columns: 0..0, rows: 0..0 };
        capture.train.iter_mut().for_each(|frame| frame.source.hide(nowhere.clone()));
    }
    let obstacle = if recorded { occlusion } else { Some(occlusion.unwrap_or_default()) };
    obstacle.iter().try_for_each(|obstacle| obstacle.hide(&mut capture.train).map(drop))?;
    Ok(obstacle)
}

/// A run, and its capture with the bodies and the errors that it was trained with.
pub fn of_run(directory: &Path) -> Result<(RunConfig, Source)> {
    let run = RunConfig::read(directory)?;
    let (scene, corruption) = match run.scene.strip_prefix(CORRUPTED) {
        Some(text) => serde_json::from_str(text).with_context(|| format!("{}: config.toml", directory.display()))?,
        None => (run.scene.clone(), Corruption::default()),
    };
    let options = SceneOptions { files: run.load.clone(), corruption, capture: String::new() };
    let mut source = options.load(&scene, run.body.as_deref())?;
    source.restore(directory, &run.train)?;
    Ok((run, source))
}

/// What a capture's files leave open, and what is made wrong of it.
#[derive(Args, Clone, Debug, Serialize)]
#[serde(rename_all = "kebab-case")]
pub struct SceneArguments {
    #[command(flatten)]
    #[serde(flatten)]
    load: LoadArguments,
    /// Simulated obstacle before the training camera of a ZJU-MoCap capture [default:
    /// occlusion.json, else central]
    #[arg(long)]
    occlusion: Option<ObstacleName>,
    #[command(flatten)]
    #[serde(flatten)]
    obstacle: ObstacleArguments,
    /// Put the open body in place of the capture's: 0 with the capture's angles in its mean shape,
    /// else fitted to SAM 3D Body's key points (of a character, its joints) with noise of this
    /// standard deviation, in millimetres
    #[arg(long, value_name = "MM")]
    open_body: Option<f32>,
    /// Make the prior and the masks as wrong as something makes them; the options below change
    /// single errors of it
    #[arg(long)]
    wrong: Option<WrongName>,
    /// Turn every bone of the prior by this many degrees (root mean square), to see what a method
    /// bears [default: 0]
    #[arg(long, value_name = "DEGREES")]
    wrong_pose: Option<f32>,
    /// Change every shape coefficient of the prior by this many standard deviations [default: 0]
    #[arg(long, value_name = "N")]
    wrong_shape: Option<f32>,
    /// Move the prior by this many metres of a body 1.7 m high (root mean square) [default: 0]
    #[arg(long, value_name = "METRES")]
    wrong_translation: Option<f32>,
    /// Change the prior's distance from the camera by this many per cent (root mean square)
    /// [default: 0]
    #[arg(long, value_name = "PERCENT")]
    wrong_depth: Option<f32>,
    /// Make the bones of the prior's limbs longer or shorter by this many per cent (standard
    /// deviation) [default: 0]
    #[arg(long, value_name = "PERCENT")]
    wrong_limbs: Option<f32>,
    /// Displace the edges of the training masks in and out by up to this many pixels [default: 0]
    #[arg(long, value_name = "PIXELS")]
    wrong_edge: Option<f32>,
    /// Grow the training masks by this many pixels, or shrink them [default: 0]
    #[arg(long, value_name = "PIXELS", allow_negative_numbers = true)]
    wrong_mask: Option<i32>,
    /// Give the training frames key points, off by this many pixels of a body 250 high [default: 0,
    /// none]
    #[arg(long, value_name = "PIXELS")]
    wrong_keypoints: Option<f32>,
    /// Blur, exposure, a backdrop with pieces of it in the training masks, feet cut off, a thing
    /// that is held [default: false]
    #[arg(long, value_name = "BOOL")]
    wrong_pictures: Option<bool>,
    /// Another draw of these errors [default: 0]
    #[arg(long, value_name = "SEED")]
    wrong_draw: Option<u64>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, ValueEnum)]
#[serde(rename_all = "kebab-case")]
enum WrongName {
    /// What cameras, estimators and segmenters make of a real video: poses by 2.5°, 1 cm, depth by
    /// 2 %, limbs by 2.5 %, shape by 0.5, key points by 1.5 pixels, ragged masks with the backdrop
    /// in them, blur.
    Real,
}

impl SceneArguments {
    /// The same as options.
    pub fn options(&self) -> Result<SceneOptions> {
        let name = self.occlusion.or(self.obstacle.given().then_some(ObstacleName::Central));
        let occlusion = name.map(|name| self.obstacle.named(name)).transpose()?;
        let as_wrong = self.wrong.map_or(Perturbation::NONE, |WrongName::Real| Perturbation::REAL);
        let wrong = Perturbation {
            pose_degrees: self.wrong_pose.unwrap_or(as_wrong.pose_degrees),
            shape: self.wrong_shape.unwrap_or(as_wrong.shape),
            translation: self.wrong_translation.unwrap_or(as_wrong.translation),
            depth_percent: self.wrong_depth.unwrap_or(as_wrong.depth_percent),
            limbs_percent: self.wrong_limbs.unwrap_or(as_wrong.limbs_percent),
            ragged_pixels: self.wrong_edge.unwrap_or(as_wrong.ragged_pixels),
            mask_pixels: self.wrong_mask.unwrap_or(as_wrong.mask_pixels),
            keypoint_pixels: self.wrong_keypoints.unwrap_or(as_wrong.keypoint_pixels),
            photographed: self.wrong_pictures.unwrap_or(as_wrong.photographed),
            seed: self.wrong_draw.unwrap_or(as_wrong.seed),
        };
        let (files, corruption) = (self.load.options()?, Corruption { occlusion, open_body: self.open_body, wrong });
        Ok(SceneOptions { files, corruption, capture: String::new() })
    }

    /// The same as on the command line: every flag that was given.
    pub fn command_line(&self) -> String {
        let flags = serde_json::to_string(self).and_then(|text| serde_json::from_str::<BTreeMap<String, Value>>(&text));
        let given = flags.unwrap_or_default().into_iter().filter(|(_, value)| !value.is_null());
        given.map(|(flag, value)| format!(" --{flag} {}", value.to_string().trim_matches('"'))).collect()
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a failure here is a failed test")]
mod tests {
    use clap::Parser;
    use synth::DemoConfig;

    use super::*;

    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        load: SceneArguments,
    }

    #[test]
    fn the_open_body_stands_where_the_captures_body_stood() {
        let demo = DemoConfig { size: 16, frames: 100, eval_cameras: 1, ..DemoConfig::default() };
        let body = BodyModel::embedded();
        let joints = |capture: &Capture, model: &BodyModel| -> Vec<Vec<Vec3>> {
            let frames = capture.train.iter().chain(capture.eval.iter().map(|view| &view.frame));
            frames.map(|f| model.pose(&model.shaped(&f.betas), &f.pose, f.placement).joints).collect()
        };
        let names = BoneNames::Smpl.of_body(body.num_joints());
        for (noise, most, names) in [(0.0, 0.12, &[][..]), (1e-4, 0.05, &[]), (0.0, 0.12, &names), (1e-4, 0.05, &names)]
        {
            let (mut capture, mut model) = (synth::demo(&demo, &body).unwrap(), body.clone());
            let before = joints(&capture, &model);
            put_open_body(&mut capture, &mut model, noise, names).unwrap();
            for (before, after) in before.iter().zip(joints(&capture, &model)) {
                let off: Vec<f32> = before.iter().zip(&after).map(|(a, b)| a.distance(*b)).collect();
                let worst = off.iter().copied().fold(0.0, f32::max);
                assert!(worst > 1e-4 && worst < most && (noise > 0.0 || off[0] < 1e-5), "{noise}: {off:?}");
            }
        }
    }

    #[test]
    fn a_command_line_made_of_options_says_all_of_them() {
        let words = "x --resize 64 --stride 2 --max-frames 9 --eval-stride 3 --camera B2 --occlusion moving --fraction 0.4 \
                     --share 0.7 --position -0.1 --height 0.5 --memory 2048 --open-body 15 --wrong-pose 2.5 --wrong-shape 1 --wrong-mask -3";
        let wrong = "x --wrong real --wrong-translation 0.05 --wrong-depth 3 --wrong-limbs 4 --wrong-edge 1 \
                     --wrong-keypoints 2 --wrong-pictures false";
        for words in [words, wrong, "x"] {
            let load = Line::parse_from(words.split_whitespace()).load;
            let again = format!("x{}", load.command_line());
            assert_eq!(again.split_whitespace().count(), words.split_whitespace().count(), "{again}");
            let read = Line::parse_from(again.split_whitespace()).load.options().unwrap();
            assert_eq!(read, load.options().unwrap());
        }
    }
}
