//! The part of a run directory that is known before training and that drawing needs without the
//! capture: the body, poses and cameras of the video, the prior's colours.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use glam::{Affine3A, Vec2, Vec3};
use smpl::{BodyModel, Placement};
use volrender::{Aabb, Camera};

use crate::Error;
use crate::capture::{Frame, Light, MAX_BETA, MAX_DISTANCE, Mended, Registered};
use crate::config::Config;
use crate::model::body::{Body, PosedFrame};
use crate::model::colors::PriorColors;
use crate::model::saved::{CHECKPOINT, Contents, array, config_of, parse, read, write};
use crate::model::subdivide::{Subdivided, most_times};
use crate::model::trained::Model;
use crate::model::view::PosedView;

const BODY: &str = "body.safetensors";
const PERSON: &str = "person.safetensors";
const FORMAT: &str = "occnerf-person";
const VERSION: &str = "1";
/// Numbers of a camera: focal lengths, principal point, the columns of the extrinsics.
const CAMERA: usize = 16;
/// Numbers of a placement: whether it is about the origin, rotation, translation.
const PLACEMENT: usize = 7;

/// Largest rotation, radians; largest albedo and slope of the light.
const MAX_ANGLE: f32 = 1e3;
const MAX_COLOR: f32 = 10.0;

/// A person before training.
pub struct Person {
    /// Name of the scene.
    pub scene: String,
    /// The shaped body.
    pub body: Arc<Body>,
    /// The training frames' poses and cameras.
    pub frames: Vec<Arc<PosedView>>,
    /// The colours that the video shows of the prior.
    pub colors: PriorColors,
}

impl Person {
    /// Writes `body.safetensors` and `person.safetensors` into the directory `run`.
    ///
    /// # Errors
    /// Files that cannot be written.
    pub fn save(run: &Path, registered: &Registered, model: &BodyModel, colors: &PriorColors) -> Result<(), Error> {
        let Registered { capture, clothes, fists, .. } = registered;
        model.with_fists(*fists).save(&run.join(BODY))?;
        let (joints, betas) = (model.num_joints(), model.num_betas());
        let vectors = |values: &[Vec3]| values.iter().flat_map(|v| v.to_array()).collect::<Vec<f32>>();
        let mut frames: [Vec<f32>; 4] = Default::default();
        let mut sizes = Vec::new();
        for frame in &capture.train {
            let [cameras, poses, shapes, placements] = &mut frames;
            let Camera { focal, centre, world_to_camera, width, height } = frame.camera;
            cameras.extend([focal.x, focal.y, centre.x, centre.y]);
            cameras.extend(world_to_camera.to_cols_array());
            sizes.extend([u64::from(width), u64::from(height)]);
            poses.extend((0..joints).flat_map(|j| frame.pose.get(j).copied().unwrap_or_default().to_array()));
            shapes.extend((0..betas).map(|b| frame.betas.get(b).copied().unwrap_or_default()));
            placements.extend(match frame.placement {
                Placement::Pelvis { translation } => [&[0.0; 4][..], &translation.to_array()].concat(),
                Placement::Origin { rotation, translation } => {
                    [&[1.0][..], &rotation.to_array(), &translation.to_array()].concat()
                }
            });
        }
        let [cameras, poses, shapes, placements] = frames;
        let seen: Vec<u8> = colors.seen.iter().map(|&seen| seen.into()).collect();
        let arrays = vec![
            array("cameras", cameras),
            array("poses", poses),
            array("betas", shapes),
            array("placements", placements),
            array("mean_betas", padded(&capture.mean_betas, betas)),
            array("colors", vectors(&colors.colors)),
            array("seen", seen),
            array("light", colors.light.slope.to_array().to_vec()),
            array("sizes", sizes),
            array("clothes", &clothes[..]),
        ];
        let header = BTreeMap::from([
            ("format", FORMAT.to_owned()),
            ("version", VERSION.to_owned()),
            ("scene", capture.name.clone()),
            ("frames", capture.train.len().to_string()),
            ("subdivisions", colors.mesh.times().to_string()),
        ]);
        write(&run.join(PERSON), &header, arrays)
    }

    /// The initial colours of `model` in the run directory `run`; `None` where it has none.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Array`] and [`Error::File`] for a file that is damaged.
    pub fn colors(run: &Path, model: &BodyModel) -> Result<Option<PriorColors>, Error> {
        let path = run.join(PERSON);
        if !path.is_file() {
            return Ok(None);
        }
        let bytes = read(&path)?;
        colors(&Contents::parse(&path, &bytes, FORMAT, &[VERSION])?, model).map(Some)
    }

    /// The capture with the registered bodies and focal lengths of the run directory `run`; `None`
    /// where it has none.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Array`] and [`Error::File`] for a file that is damaged, or of other
    /// frames.
    pub fn restore(run: &Path, mended: Mended, model: &BodyModel) -> Result<Option<Registered>, Error> {
        let (path, Mended { mut capture, mending }) = (run.join(PERSON), mended);
        if !path.is_file() {
            return Ok(None);
        }
        let bytes = read(&path)?;
        let contents = Contents::parse(&path, &bytes, FORMAT, &[VERSION])?;
        let frames = capture.train.len();
        let count = contents.require("frames")?;
        if count != frames.to_string() {
            return Err(contents.corrupt(format!("is of {count} frames, the capture has {frames}: it is another")));
        }
        // The body may have had fewer shapes.
        let betas = contents.len("mean_betas").min(model.num_betas());
        let poses = read_poses(&contents, frames, (model.num_joints(), betas))?;
        let cameras = cameras(&contents, frames)?;
        for (Frame { name, camera, .. }, of_run) in capture.train.iter().zip(&cameras) {
            let [found, expected] = [camera, of_run].map(|camera| (camera.width, camera.height));
            if found != expected {
                let what = format!("has frame {name} in {expected:?} pixels, the capture in {found:?}: it is another");
                return Err(contents.corrupt(what));
            }
        }
        for ((frame, (pose, betas, placement)), camera) in capture.train.iter_mut().zip(&poses).zip(cameras) {
            (frame.pose, frame.betas, frame.placement) = (pose.clone(), betas.clone(), *placement);
            frame.camera.focal = camera.focal;
        }
        for view in &mut capture.eval {
            if let Some((pose, betas, placement)) = poses.get(view.train_index) {
                (view.frame.pose, view.frame.betas, view.frame.placement) = (pose.clone(), betas.clone(), *placement);
            }
        }
        capture.mean_betas = mean_betas(&contents, betas)?;
        // Optional array.
        let has = contents.len("clothes") > 0;
        let clothes = if has { contents.floats("clothes", model.num_vertices())? } else { Vec::new() };
        let Aabb { min, max } = Aabb::from_points(&model.v_template);
        below(&contents, "clothes", &clothes, (max - min).length())?;
        // The run's body has them.
        Ok(Some(Registered { capture, clothes, mending, fists: [0.0; 2] }))
    }

    /// Reads the files that [`Person::save`] wrote into the directory `run`.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Array`] and [`Error::File`] for files that are missing or damaged.
    pub fn load(run: &Path, config: &Config) -> Result<Self, Error> {
        let path = run.join(PERSON);
        if !path.is_file() {
            let what = "is missing; `train --resume` writes it, if the capture is still there".to_owned();
            return Err(Error::File { path, what });
        }
        let model = BodyModel::load(&run.join(BODY))?;
        let bytes = read(&path)?;
        let contents = Contents::parse(&path, &bytes, FORMAT, &[VERSION])?;
        let count = contents.require("frames")?;
        let frames: usize = count.parse().ok().filter(|n| (1..=bytes.len()).contains(n)).ok_or_else(|| {
            contents.corrupt(format!("header `frames` is {count:?}, expected a number of frames that fits the file"))
        })?;
        let betas = model.num_betas();
        let body = Arc::new(Body::new(&model, &mean_betas(&contents, betas)?, config)?);
        let cameras = cameras(&contents, frames)?;
        let poses = read_poses(&contents, frames, (model.num_joints(), betas))?;
        let views = cameras.into_iter().zip(&poses).enumerate();
        let view = |(frame, (camera, (pose, betas, placement))): (usize, (Camera, &Pose))| {
            Arc::new(body.view(&camera, frame, PosedFrame { betas, pose, placement: *placement }))
        };
        let frames = views.map(view).collect();
        let colors = colors(&contents, &model)?;
        let scene = contents.require("scene")?.to_owned();
        Ok(Self { scene, body, frames, colors })
    }
}

impl Model {
    /// Reads the model of the run directory `run`, without the capture and the optimiser's moments.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Array`] and [`Error::File`] for files that are missing or damaged.
    pub fn load(run: &Path) -> Result<Self, Error> {
        let path = run.join(CHECKPOINT);
        let bytes = read(&path)?;
        let contents = parse(&path, &bytes)?;
        let config = config_of(&contents)?;
        let Person { scene, body, frames, colors } = Person::load(run, &config)?;
        let trained_on = contents.require("scene")?;
        if trained_on != scene {
            return Err(contents.corrupt(format!("was trained on scene {trained_on:?}, the run's is {scene:?}")));
        }
        let base = if config.field.prior_colors { colors } else { PriorColors::default() };
        let mut model = Self::new(config, body, frames, base)?;
        model.restore(&contents)?;
        Ok(model)
    }
}

/// The colours that a file has of `model`.
fn colors(contents: &Contents<'_>, model: &BodyModel) -> Result<PriorColors, Error> {
    // Optional key.
    let times = contents.header("subdivisions").unwrap_or("0");
    let fits = |&times: &u32| times == 0 || most_times(model.faces.len()) >= times;
    let times = times.parse().ok().filter(fits).ok_or_else(|| {
        contents.corrupt(format!("header `subdivisions` is {times:?}, expected a number that fits the body"))
    })?;
    let mesh = Arc::new(Subdivided::new(model.num_vertices(), &model.faces, times));
    let colors = contents.floats("colors", mesh.anchors.len() * 3)?;
    below(contents, "colors", &colors, MAX_COLOR)?;
    let seen = contents.values("seen", mesh.anchors.len())?.iter().map(|&seen: &u8| seen != 0).collect();
    let slope = contents.floats("light", 3)?;
    below(contents, "light", &slope, MAX_COLOR)?;
    Ok(PriorColors { colors: triples(&colors), seen, light: Light { slope: Vec3::from_slice(&slope) }, mesh })
}

/// Joint rotations, shape and placement of a frame.
type Pose = (Vec<Vec3>, Vec<f32>, Placement);

fn read_poses(contents: &Contents<'_>, frames: usize, (joints, betas): (usize, usize)) -> Result<Vec<Pose>, Error> {
    let poses = contents.floats("poses", frames * joints * 3)?;
    let shapes = contents.floats("betas", frames * betas)?;
    let placements = contents.floats("placements", frames * PLACEMENT)?;
    below(contents, "poses", &poses, MAX_ANGLE)?;
    below(contents, "betas", &shapes, MAX_BETA)?;
    below(contents, "placements", &placements, MAX_DISTANCE)?;
    let pose = |frame: usize| {
        let placement = &placements[frame * PLACEMENT..][..PLACEMENT];
        let (rotation, translation) = (Vec3::from_slice(&placement[1..]), Vec3::from_slice(&placement[4..]));
        let placement = match placement[0] {
            0.0 => Placement::Pelvis { translation },
            _ => Placement::Origin { rotation, translation },
        };
        let poses = triples(&poses[frame * joints * 3..][..joints * 3]);
        (poses, shapes[frame * betas..][..betas].to_vec(), placement)
    };
    Ok((0..frames).map(pose).collect())
}

fn cameras(contents: &Contents<'_>, frames: usize) -> Result<Vec<Camera>, Error> {
    let cameras = contents.floats("cameras", frames * CAMERA)?;
    below(contents, "cameras", &cameras, MAX_DISTANCE)?;
    let sizes = contents.values("sizes", frames * 2)?;
    let each = cameras.chunks_exact(CAMERA).zip(sizes.chunks_exact(2)).enumerate();
    each.map(|(frame, (numbers, size))| {
        camera(numbers, size).ok_or_else(|| contents.corrupt(format!("`cameras` {frame} is no pinhole camera")))
    })
    .collect()
}

fn mean_betas(contents: &Contents<'_>, betas: usize) -> Result<Vec<f32>, Error> {
    let values = contents.floats("mean_betas", betas)?;
    below(contents, "mean_betas", &values, MAX_BETA)?;
    Ok(values)
}

/// Checks that every magnitude is at most `most`.
fn below(contents: &Contents<'_>, key: &str, values: &[f32], most: f32) -> Result<(), Error> {
    match values.iter().find(|value| value.abs() > most) {
        Some(value) => Err(contents.corrupt(format!("`{key}` has {value}, expected numbers up to {most} either way"))),
        None => Ok(()),
    }
}

fn padded(values: &[f32], len: usize) -> Vec<f32> {
    (0..len).map(|i| values.get(i).copied().unwrap_or_default()).collect()
}

fn triples(values: &[f32]) -> Vec<Vec3> {
    values.chunks_exact(3).map(Vec3::from_slice).collect()
}

/// A camera from its numbers; `None` for a degenerate one.
fn camera(numbers: &[f32], size: &[u64]) -> Option<Camera> {
    let mut columns = [0.0; 12];
    columns.copy_from_slice(&numbers[4..]);
    let side = |side: u64| u32::try_from(side).ok().filter(|side| (1..=1 << 14).contains(side));
    let (focal, centre) = (Vec2::from_slice(numbers), Vec2::from_slice(&numbers[2..]));
    let world_to_camera = Affine3A::from_cols_array(&columns);
    let usual = focal.min_element() > 0.0 && world_to_camera.matrix3.determinant() != 0.0;
    Some(Camera { focal, centre, world_to_camera, width: side(size[0])?, height: side(size[1])? }).filter(|_| usual)
}
