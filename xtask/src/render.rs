//! `render`: pictures and a film of a trained person.

use std::path::PathBuf;

use anyhow::{Context, Result, bail};
use clap::{Args, ValueEnum};
use glam::{Affine3A, Mat3, Vec3};
use indicatif::ProgressBar;
use occnerf::{Method, PreparedFrame, Scene, Trainer, VertexColors, view_of};
use volrender::Camera;

use crate::eval::Model;
use crate::film::{Film, FilmFormat};
use crate::pictures;
use crate::run::{CHECKPOINT, RunConfig, use_threads};

/// Views of a full turn.
const TURN: usize = 36;
const FPS: u32 = 15;

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum What {
    /// The training camera's view of every frame, without the occluder.
    Movement,
    /// One frame from all around.
    Freeview,
    /// The rest pose from all around.
    Tpose,
}

#[derive(Args)]
pub struct RenderArguments {
    /// Run directory
    run: PathBuf,
    what: What,
    /// Training frame of `freeview` [default: the first]
    #[arg(long, default_value_t = 0)]
    frame: usize,
    /// Size of the pictures, WIDTHxHEIGHT [default: as in training]
    #[arg(long)]
    size: Option<String>,
    /// Where to [default: RUN/renders/WHAT]
    #[arg(long)]
    out: Option<PathBuf>,
    /// What besides the pictures
    #[arg(long, default_value = "gif")]
    format: FilmFormat,
    /// Threads [default: all cores]
    #[arg(long)]
    threads: Option<usize>,
}

/// Runs the command.
pub fn render(arguments: &RenderArguments) -> Result<()> {
    use_threads(arguments.threads)?;
    let size = arguments.size.as_deref().map(parse_size).transpose()?;
    let directory = &arguments.run;
    let run = RunConfig::read(directory)?;
    let source = run.source()?;
    let scene = Scene::new(&source.capture, &source.model, &run.train)?;
    let frames = scene.train.len();
    if arguments.frame >= frames {
        bail!("--frame {}: {} has frames 0 to {}", arguments.frame, run.scene, frames - 1);
    }
    let views = views(&scene, arguments, size);
    let trainer;
    let model = if run.train.method == Method::Prior {
        Model::Prior(VertexColors::measure(&scene)?)
    } else {
        trainer = Trainer::resume(&scene, &directory.join(CHECKPOINT))?;
        Model::Field(&trainer)
    };
    let name = format!("{:?}", arguments.what).to_lowercase();
    let out = arguments.out.clone().unwrap_or_else(|| directory.join("renders").join(&name));
    std::fs::create_dir_all(&out).with_context(|| out.display().to_string())?;
    let mut renderer = model.renderer(&scene)?;
    let bar = ProgressBar::new(views.len() as u64);
    let path = arguments.format.extension().map(|extension| out.join(format!("{name}.{extension}")));
    let camera = views.first().map_or(scene.train[0].camera, |view| view.camera);
    let mut film = match &path {
        Some(path) => Film::create(path, arguments.format, (camera.width, camera.height), FPS)?,
        None => Film::None,
    };
    for (i, view) in views.iter().enumerate() {
        let rendering = renderer.render(view, Vec3::splat(1.0))?;
        let picture = pictures::to_rgb(&rendering.image);
        pictures::save(&picture, &out.join(format!("{i:04}.png")))?;
        film.push(&picture)?;
        bar.inc(1);
    }
    bar.finish_and_clear();
    film.finish()?;
    println!("{} pictures and {}", views.len(), path.as_ref().unwrap_or(&out).display());
    Ok(())
}

fn parse_size(text: &str) -> Result<(u32, u32)> {
    let (width, height) = text.split_once('x').context("--size: expected WIDTHxHEIGHT, such as 512x512")?;
    let side = |s: &str| {
        let side: u32 = s.parse().with_context(|| format!("--size: {s:?} is not a whole number"))?;
        anyhow::ensure!((1..=8192).contains(&side), "--size: {side} is not in 1 to 8192");
        Ok(side)
    };
    Ok((side(width)?, side(height)?))
}

fn views(scene: &Scene, arguments: &RenderArguments, size: Option<(u32, u32)>) -> Vec<PreparedFrame> {
    let resized = |camera: &Camera| size.map_or(*camera, |(w, h)| camera.resized(w, h));
    let frame = &scene.train[arguments.frame];
    match arguments.what {
        What::Movement => {
            let view = |f: &PreparedFrame| f.seen_by(&resized(&f.camera));
            scene.train.iter().map(view).collect()
        }
        What::Freeview => (0..TURN)
            .map(|i| {
                let up = scene.up();
                let turn = Mat3::from_axis_angle(up, i as f32 / TURN as f32 * std::f32::consts::TAU);
                let centre = frame.posed.vertices.iter().sum::<Vec3>() / frame.posed.vertices.len() as f32;
                let about = Affine3A::from_mat3_translation(turn, centre - turn * centre);
                let mut camera = frame.camera;
                camera.world_to_camera *= about;
                frame.seen_by(&resized(&camera))
            })
            .collect(),
        What::Tpose => {
            let joints = vec![Vec3::ZERO; scene.model.num_joints()];
            let placement = smpl::Placement::Pelvis { translation: Vec3::ZERO };
            let posed = scene.pose(&scene.mean_betas, &joints, placement);
            let centre = posed.vertices.iter().sum::<Vec3>() / posed.vertices.len() as f32;
            (0..TURN)
                .map(|i| {
                    let angle = i as f32 / TURN as f32 * std::f32::consts::TAU;
                    let camera = camera_at(frame, centre, angle);
                    view_of(scene, &resized(&camera), posed.clone())
                })
                .collect()
        }
    }
}

/// A camera like the training camera's, at the same distance as the subject was, that looks level at `centre`.
fn camera_at(frame: &PreparedFrame, centre: Vec3, angle: f32) -> Camera {
    let body = frame.posed.vertices.iter().sum::<Vec3>() / frame.posed.vertices.len() as f32;
    // Outstretched arms are as wide as the body is high.
    let distance = 1.15 * frame.camera.world_to_camera.transform_point3(body).length();
    let back = Vec3::new(angle.sin(), 0.0, angle.cos());
    let eye = centre + distance * back;
    let (right, down, forward) = (Vec3::Y.cross(back), -Vec3::Y, -back);
    let rotation = Mat3::from_cols(right, down, forward).transpose();
    let mut camera = frame.camera;
    camera.world_to_camera = Affine3A::from_mat3_translation(rotation, -(rotation * eye));
    camera
}
