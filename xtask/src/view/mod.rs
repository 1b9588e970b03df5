//! `view`: an interactive viewer of a trained person in one HTML file.

use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::PathBuf;

use anyhow::{Context, Result};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use clap::Args;
use occnerf::bake::Avatar;
use occnerf::bake::export::GlbOptions;
use serde_json::{Value, json};
use volrender::Camera;

use crate::avatar::{self, Sizes};
use crate::process::say;
use crate::report::{self, escape};
use crate::run::PERSON;

const PAGE: &str = include_str!("page.html");
const STYLE: &str = include_str!("page.css");
const SCRIPTS: [&str; 3] = [include_str!("person.js"), include_str!("draw.js"), include_str!("page.js")];

#[derive(Args)]
pub struct ViewArguments {
    /// Run directory
    run: PathBuf,
    /// Another motion to choose, besides the video's: an .npz with poses, trans and fps, as AMASS
    /// has them, or a .bvh; repeatable
    #[arg(long, value_name = "CLIP")]
    motion: Vec<PathBuf>,
    /// Frames per second of every --motion [default: as the files say]
    #[arg(long, value_name = "N", requires = "motion")]
    fps: Option<f32>,
    #[command(flatten)]
    sizes: Sizes,
    /// Where to [default: RUN/person.html]
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
}

/// Runs the command.
pub fn view(arguments: &ViewArguments) -> Result<()> {
    let (mut person, _lock) = avatar::of_run(&arguments.run)?;
    for path in &arguments.motion {
        avatar::add_motion(&mut person, path, arguments.fps)?;
    }
    arguments.sizes.apply(&mut person)?;
    let out = arguments.out.clone().unwrap_or_else(|| arguments.run.join(PERSON));
    avatar::check_folder(&out)?;
    let page = page(&person, arguments.sizes.jpeg)?;
    crate::run::write(&out, &page)?;
    if arguments.out.is_none() {
        report::refresh(&arguments.run)?;
    }
    say!("{}: {:.1} MB, opens in any browser with WebGL 2", out.display(), page.len() as f64 * 1e-6);
    Ok(())
}

/// The whole page, its texture as JPEG of quality `jpeg` or as PNG.
fn page(person: &Avatar, jpeg: Option<u8>) -> Result<String> {
    let name = if person.name.is_empty() { "person" } else { &person.name };
    let extra = json!({
        "cameras": person.cameras.iter().map(camera).collect::<Vec<_>>(),
        "light": person.light.slope.to_array(),
        "confidence": STANDARD.encode(person.atlas.confidence_to_png()?),
    });
    let facts = format!("{} triangles, {} joints", person.faces.len(), person.num_joints());
    let glb = STANDARD.encode(person.to_glb_with(&GlbOptions { jpeg, ..Default::default() })?);
    let mut hasher = DefaultHasher::new();
    (&glb, name).hash(&mut hasher);
    let nonce = format!("{:016x}", hasher.finish());
    let script = SCRIPTS.concat();
    fill(
        PAGE,
        &[
            ("nonce", &nonce),
            ("source", &escape(&person.source)),
            ("title", &escape(name)),
            ("facts", &escape(&facts)),
            ("style", STYLE),
            ("script", &script),
            ("avatar", &glb),
            // `<` could end the script element.
            ("extra", &extra.to_string().replace('<', "\\u003c")),
        ],
    )
}

/// Substitutes `{key}` in a template, in one pass.
fn fill(template: &str, parts: &[(&str, &str)]) -> Result<String> {
    let mut out = String::with_capacity(template.len() + parts.iter().map(|part| part.1.len()).sum::<usize>());
    let mut rest = template;
    while let Some((before, after)) = rest.split_once('{') {
        let (key, after) = after.split_once('}').context("the page's template has a place without an end")?;
        let part = parts.iter().find(|part| part.0 == key);
        out.push_str(before);
        out.push_str(part.with_context(|| format!("the page's template has an unknown place {key:?}"))?.1);
        rest = after;
    }
    out.push_str(rest);
    Ok(out)
}

/// Intrinsics fx fy cx cy, size, and the rows of the extrinsics.
fn camera(camera: &Camera) -> Value {
    let columns = camera.world_to_camera.to_cols_array();
    let rows: Vec<f32> = (0..12).map(|i| columns[3 * (i % 4) + i / 4]).collect();
    let k = [camera.focal.x, camera.focal.y, camera.centre.x, camera.centre.y];
    json!({ "k": k, "size": [camera.width, camera.height], "e": rows })
}
