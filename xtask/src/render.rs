//! `render`: pictures and videos of a trained person.

use std::path::PathBuf;
use std::sync::Arc;

use anyhow::{Context, Result, bail};
use clap::{Args, ValueEnum};
use glam::{Affine3A, Mat3, Vec3};
use indicatif::ProgressBar;
use occnerf::bake::{Avatar, BakedRenderer};
use occnerf::{Body, FieldRenderer, Method, Person, PosedFrame, PosedView, PriorRenderer, Renderer, upright};
use smpl::{BoneNames, Placement, skeleton};
use visibility::Samples;
use volrender::Camera;

use crate::avatar::load_motion;
use crate::process::{Lock, say};
use crate::run::{self, RunConfig, make_directory};
use crate::video::{self, FilmFormat};
use crate::{baked, pictures};

/// Views of an orbit.
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
    /// Every frame of the video while the camera goes round once.
    Allview,
    /// The poses of --motion from the front.
    Pose,
}

#[derive(Args)]
pub struct RenderArguments {
    /// Run directory
    run: PathBuf,
    what: What,
    /// Training frame of `freeview` [default: the first]
    #[arg(long, value_name = "N")]
    frame: Option<usize>,
    /// Motion capture for `pose`: an .npz with poses, trans and fps, as AMASS has them, or a .bvh
    /// of a rig whose joints have the names of SMPL, Mixamo, CMU or VRM
    #[arg(long, value_name = "CLIP", required_if_eq("what", "pose"))]
    motion: Option<PathBuf>,
    /// Frames per second of --motion [default: as the file says]
    #[arg(long, value_name = "N", requires = "motion")]
    fps: Option<f32>,
    /// Size of the pictures, WIDTHxHEIGHT [default: as in training]
    #[arg(long)]
    size: Option<String>,
    /// Where to [default: RUN/renders/WHAT]
    #[arg(long)]
    out: Option<PathBuf>,
    /// What to write besides the pictures
    #[arg(long, default_value = "gif")]
    format: FilmFormat,
    /// Draw the baked person, by rasterising, instead of the field; bakes it first where RUN has
    /// none
    #[arg(long)]
    baked: bool,
    /// Threads [default: all cores]
    #[arg(long)]
    pub threads: Option<usize>,
}

/// Runs the command.
pub fn render(arguments: &RenderArguments) -> Result<()> {
    let size = arguments.size.as_deref().map(parse_size).transpose()?;
    let directory = &arguments.run;
    let run = RunConfig::read(directory)?;
    let _lock = Lock::share(directory)?;
    if arguments.baked && run.train.method == Method::Prior {
        bail!("--baked: {} has no field to bake", directory.display());
    }
    let (model, person, avatar);
    let (body, frames, mut renderer): (_, _, Box<dyn Renderer + '_>) = if !run.train.method.has_field() {
        person = Person::load(directory, &run.train)?;
        let (body, frames, colors) = (&*person.body, &person.frames[..], &person.colors);
        if run.train.method == Method::Prior {
            (body, frames, Box::new(PriorRenderer::new(body, colors)))
        } else {
            avatar = Avatar::load(&baked::path(directory))?;
            (body, frames, Box::new(BakedRenderer::new(&avatar, body.scale, colors.light, Samples::Four)))
        }
    } else {
        model = run::model(directory, &run)?;
        let renderer: Box<dyn Renderer + '_> = if arguments.baked {
            avatar = baked::avatar(directory, &run)?;
            Box::new(BakedRenderer::new(&avatar, model.body().scale, model.light(), Samples::Four))
        } else {
            Box::new(FieldRenderer::new(&model)?)
        };
        (&**model.body(), model.frames(), renderer)
    };
    if let Some(frame) = arguments.frame.filter(|frame| *frame >= frames.len()) {
        bail!("--frame {frame}: {} has frames 0 to {}", run.scene, frames.len() - 1);
    }
    if arguments.motion.is_some() && arguments.what != What::Pose {
        bail!("--motion is for `render RUN pose`");
    }
    let views = views(body, frames, arguments, size)?;
    let name = format!("{:?}", arguments.what).to_lowercase();
    let out = arguments.out.clone().unwrap_or_else(|| directory.join("renders").join(&name));
    make_directory(&out)?;
    let count = views.len();
    let bar = ProgressBar::new(count as u64);
    let drawn = views.enumerate().map(|(i, view)| {
        let rendering = renderer.render(&view, Vec3::splat(1.0))?;
        let picture = pictures::to_rgb(&rendering.image);
        pictures::save(&picture, &out.join(format!("{i:04}.png")))?;
        bar.inc(1);
        Ok(picture)
    });
    let path = video::film(drawn, arguments.format, FPS, &out.join(&name))?;
    bar.finish_and_clear();
    say!("{count} pictures and {}", path.as_ref().unwrap_or(&out).display());
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

/// Lazy views; those of a long motion would fill the memory.
type Views<'a> = Box<dyn ExactSizeIterator<Item = PosedView> + 'a>;

fn views<'a>(
    body: &'a Body,
    frames: &'a [Arc<PosedView>],
    arguments: &RenderArguments,
    size: Option<(u32, u32)>,
) -> Result<Views<'a>> {
    let resized = move |camera: &Camera| size.map_or(*camera, |(w, h)| camera.resized(w, h));
    let frame = &frames[arguments.frame.unwrap_or(0)];
    let angle = |i: usize, count: usize| i as f32 / count as f32 * std::f32::consts::TAU;
    let angles = (0..TURN).map(move |i| angle(i, TURN));
    // The camera of a frame, orbited about the vertical through the body.
    let up = upright(body, frames.iter().map(Arc::as_ref));
    let around = move |frame: &PosedView, angle: f32| {
        let (turn, centre) = (Mat3::from_axis_angle(up, angle), frame.centre());
        let mut camera = frame.camera;
        camera.world_to_camera *= Affine3A::from_mat3_translation(turn, centre - turn * centre);
        frame.seen_by(&resized(&camera))
    };
    Ok(match arguments.what {
        What::Movement => Box::new(frames.iter().map(move |f| f.seen_by(&resized(&f.camera)))),
        What::Freeview => Box::new(angles.map(move |angle| around(frame, angle))),
        What::Allview => {
            let count = frames.len();
            Box::new(frames.iter().enumerate().map(move |(i, f)| around(f, angle(i, count))))
        }
        What::Tpose => {
            let rest = PosedView::new(&frame.camera, body.rest());
            let centre = rest.centre();
            Box::new(angles.map(move |angle| rest.seen_by(&resized(&camera_at(frame, centre, angle)))))
        }
        What::Pose => {
            let path = arguments.motion.as_deref().context("pose: --motion CLIP says which poses")?;
            let joints = body.model.num_joints();
            let rest: Vec<Vec3> = body.canonical.joints.iter().map(|&joint| joint / body.scale).collect();
            let motion = load_motion(path, arguments.fps, &skeleton(BoneNames::Smpl, &body.model.parents, &rest))?;
            let count = motion.trans.len();
            let view = move |i: usize| {
                let (pose, translation) = (&motion.poses[i * joints..][..joints], motion.trans[i]);
                let placement = Placement::Pelvis { translation };
                let posed = body.pose(PosedFrame { betas: &body.mean_betas, pose, placement });
                let view = PosedView::new(&frame.camera, posed);
                view.seen_by(&resized(&camera_at(frame, view.centre(), 0.0)))
            };
            Box::new((0..count).map(view))
        }
    })
}

/// A level camera that looks at `centre`, with the training camera's intrinsics and distance.
fn camera_at(frame: &PosedView, centre: Vec3, angle: f32) -> Camera {
    // Room for outstretched arms.
    let distance = 1.15 * frame.camera.world_to_camera.transform_point3(frame.centre()).length();
    let back = Vec3::new(angle.sin(), 0.0, angle.cos());
    let eye = centre + distance * back;
    let (right, down, forward) = (Vec3::Y.cross(back), -Vec3::Y, -back);
    let rotation = Mat3::from_cols(right, down, forward).transpose();
    let mut camera = frame.camera;
    camera.world_to_camera = Affine3A::from_mat3_translation(rotation, -(rotation * eye));
    camera
}
