//! Where the frames come from: the embedded demo, or a capture on disk with its body model.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use occnerf::data::{Capture, DemoConfig, LoadOptions, demo, find_body, load_humannerf};
use smpl::BodyModel;

/// Name of the scene that needs no files.
pub const DEMO: &str = "demo";
/// Environment variable that names a body model.
const BODY_VARIABLE: &str = "SMPL_MODEL";

/// A capture with its prior, and where both came from.
pub struct Source {
    pub scene: String,
    pub body: Option<PathBuf>,
    pub capture: Capture,
    pub model: BodyModel,
}

/// Loads `scene` (the demo if `None`); the body is `body`, the variable SMPL_MODEL, or what lies near the scene.
pub fn load(scene: Option<&str>, body: Option<&Path>) -> Result<Source> {
    let scene = scene.unwrap_or(DEMO);
    if scene == DEMO && !Path::new(scene).exists() {
        let model = BodyModel::embedded();
        let capture = demo(&DemoConfig::default(), &model)?;
        return Ok(Source { scene: scene.to_owned(), body: None, capture, model });
    }
    let directory = Path::new(scene);
    if !directory.is_dir() {
        bail!(
            "{scene}: no such directory; expected a capture in HumanNeRF's prepared layout, or no SCENE for the demo"
        );
    }
    if !directory.join("mesh_infos.pkl").is_file() {
        bail!(
            "{scene}: format not recognised: expected HumanNeRF's prepared layout \
             (images/ masks/ cameras.pkl mesh_infos.pkl canonical_joints.pkl), but mesh_infos.pkl is missing"
        );
    }
    let variable = std::env::var_os(BODY_VARIABLE).map(PathBuf::from);
    let body = body.map(Path::to_owned).or(variable).or_else(|| find_body(directory)).with_context(|| {
        format!(
            "{scene}: no body model: give one with --body FILE.npz or {BODY_VARIABLE}, or put body.npz beside images/"
        )
    })?;
    let model = BodyModel::load(&body)?;
    let capture = load_humannerf(directory, &model, &LoadOptions::default())?;
    Ok(Source { scene: scene.to_owned(), body: Some(body), capture, model })
}
