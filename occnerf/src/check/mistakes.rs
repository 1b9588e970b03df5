//! The usual mistakes, each found by undoing it: where that makes a poor fit good, it was made.

use glam::{Affine3A, Mat3, Vec3};
use rayon::prelude::*;
use smpl::{BodyModel, Placement};
use volrender::Camera;

use super::frame::View;
use crate::capture::{Capture, Frame};
use crate::error::Error;
use crate::model::view::silhouette;

/// What is wrong with a capture as a whole.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub enum Mistake {
    /// The extrinsics map camera to world.
    CameraToWorld,
    /// The camera's y axis points up and its z axis backward, as in OpenGL.
    CameraYUp,
    /// The body is turned about the camera's x axis by so many degrees: it was fitted with another
    /// axis up.
    BodyUp(i32),
    /// Lengths of the camera (or of the body's place) are so many times too large: 1000 for
    /// millimetres.
    Unit(f32),
    /// Rotations in degrees.
    Degrees,
    /// Rotations in radians that were taken for degrees and converted.
    Radians,
    /// The focal length is about so many times too long.
    Focal(f32),
    /// Masks show what is not the person.
    MaskInverted,
    /// The fit of a picture is that of the picture so many frames later.
    FrameShift(i32),
    /// The fit lies beside the person in the mask, whichever of these is undone: it is another's,
    /// or the mask is.
    WrongPerson,
    /// The body is not in the pictures, or far too large or small.
    NoFit,
}

impl std::fmt::Display for Mistake {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::CameraToWorld => f.write_str("the extrinsics are camera to world: give their inverses"),
            Self::CameraYUp => f.write_str(
                "the cameras' y axis points up (OpenGL): multiply extrinsics by diag(1, -1, -1, 1) from the left",
            ),
            Self::BodyUp(degrees) => {
                write!(
                    f,
                    "the body is turned by {degrees} degrees about the x axis: it was fitted with another axis up"
                )
            }
            Self::Unit(factor) if *factor == 1000.0 => {
                f.write_str("translations are in millimetres: divide them by 1000")
            }
            Self::Unit(factor) if *factor == 100.0 => {
                f.write_str("translations are in centimetres: divide them by 100")
            }
            Self::Unit(factor) => write!(f, "translations are {factor} times too large"),
            Self::Degrees => f.write_str("poses are in degrees: multiply them by pi/180"),
            Self::Radians => f.write_str("poses were radians already: multiply them by 180/pi"),
            Self::Focal(factor) if *factor < 1.0 => {
                write!(f, "the focal length is about {:.2} times too short", 1.0 / factor)
            }
            Self::Focal(factor) => write!(f, "the focal length is about {factor:.2} times too long"),
            Self::MaskInverted => f.write_str("the masks are inverted: 255 must be the person"),
            Self::FrameShift(by) => {
                let (count, when) = (by.abs(), if *by > 0 { "later" } else { "earlier" });
                write!(f, "fit and pictures are off by {count}: each picture has the fit of the one {count} {when}")
            }
            Self::WrongPerson => {
                f.write_str("the fit lies beside the mask: another person's fit, or another object's mask")
            }
            Self::NoFit => f.write_str("the body is not where the mask is, nor of its size"),
        }
    }
}

/// Angles above a full turn, and the share of all that must be, to be taken for degrees.
const TURN: f32 = std::f32::consts::TAU;
const DEGREES_SHARE: f32 = 0.05;
/// How much better the overlap must be without a mistake: as a factor, and by how much; and how
/// much of the mask the body must then cover.
const BETTER: f32 = 1.3;
const BETTER_BY: f32 = 0.12;
const COVERS: f32 = 0.75;
/// Share of the picture's border that masks may have.
const BORDER: f32 = 0.5;
/// A fit that covers less of the mask than this is wrong.
const BESIDE: f32 = 0.5;
/// A frame shift must be this many standard errors better than none, and by this much.
const SHIFT_ERRORS: f32 = 4.0;
const SHIFT_BY: f32 = 0.004;
/// Frames that mistakes are undone in.
const UNDONE_VIEWS: usize = 12;
/// Powers of two by which focal lengths are tried to be wrong: a person who is 1.3 times too large
/// is not seen as such by steps of half an octave.
const OCTAVES: [f32; 10] = [0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0];
/// Areas of a body that may be the person's, as multiples of the mask's.
const AREAS: std::ops::Range<f32> = 0.3..8.0;

/// How a silhouette and a mask lie.
#[derive(Clone, Copy, Default)]
pub(super) struct Overlap {
    pub both: usize,
    pub mask: usize,
    /// Pixels of the silhouette that no known occluder covers.
    pub body: usize,
}

impl Overlap {
    pub fn of(silhouette: &[bool], view: &View, inverted: bool) -> Self {
        let mut counts = Self::default();
        for (i, (&body, &mask)) in silhouette.iter().zip(&view.mask).enumerate() {
            let hidden = view.occluder.as_ref().is_some_and(|o| o[i]) && !mask;
            let mask = mask != inverted;
            counts.both += usize::from(body && mask);
            counts.mask += usize::from(mask);
            counts.body += usize::from(body && (mask || !hidden));
        }
        counts
    }

    /// Intersection over union, where nothing is known to stand in front.
    pub fn iou(self) -> f32 {
        self.both as f32 / (self.mask + self.body - self.both).max(1) as f32
    }

    /// Share of the mask that the body covers.
    pub fn covered(self) -> f32 {
        self.both as f32 / self.mask.max(1) as f32
    }
}

/// The mistakes that are likely; none for a good capture.
pub(super) fn find(capture: &Capture, body: &BodyModel, views: &[View]) -> Result<Vec<Mistake>, Error> {
    let angles = || capture.train.iter().flat_map(|frame| frame.pose.iter().skip(1)).map(|axis| axis.length());
    let beyond = angles().filter(|angle| *angle > TURN).count();
    if beyond as f32 > DEGREES_SHARE * angles().count().max(1) as f32 {
        return Ok(vec![Mistake::Degrees]);
    }
    let every = views.len().div_ceil(UNDONE_VIEWS).max(1);
    let few = |times: f32| -> Vec<Posed<'_>> {
        let few = views.par_iter().step_by(every);
        few.map(|view| Posed::new(view, &capture.train[view.index], body, times)).collect()
    };
    let posed = few(1.0);
    let as_given = overlaps(&posed, body, None)?;
    let (given, covered) = mean(&as_given);
    // What would be a possible pose in degrees is nearly none at all in radians.
    if angles().all(|angle| angle < TURN.to_radians()) {
        let (iou, _) = mean(&overlaps(&few(180.0 / std::f32::consts::PI), body, None)?);
        if iou > given {
            return Ok(vec![Mistake::Radians]);
        }
    }
    let focal = OCTAVES.iter().flat_map(|k| [2f32.powf(*k), 2f32.powf(-k)]).map(Mistake::Focal);
    let others = [
        Mistake::CameraToWorld,
        Mistake::CameraYUp,
        Mistake::BodyUp(180),
        Mistake::BodyUp(90),
        Mistake::BodyUp(-90),
        Mistake::Unit(1000.0),
        Mistake::Unit(100.0),
        Mistake::Unit(0.001),
    ];
    // Masks of nearly everything look best with a body that fills the picture: they are judged
    // first.
    let around = views.iter().map(View::border).sum::<f32>() / views.len().max(1) as f32;
    let (iou, covers) = mean(&overlaps(&posed, body, Some(Mistake::MaskInverted))?);
    if around > BORDER && iou > given && covers > given {
        return Ok(vec![Mistake::MaskInverted]);
    }
    let mut undone = Vec::new();
    for mistake in others.into_iter().chain(focal) {
        let (iou, covers) = mean(&overlaps(&posed, body, Some(mistake))?);
        if iou > BETTER * given && iou > given + BETTER_BY && covers > COVERS {
            undone.push((mistake, iou));
        }
    }
    if let Some((mistake, _)) = undone.into_iter().max_by(|a, b| a.1.total_cmp(&b.1)) {
        return Ok(vec![mistake]);
    }
    if covered < BESIDE {
        let sized = |overlap: &&Overlap| AREAS.contains(&(overlap.body as f32 / overlap.mask.max(1) as f32));
        let most = 2 * as_given.iter().filter(sized).count() > as_given.len();
        return Ok(vec![if most { Mistake::WrongPerson } else { Mistake::NoFit }]);
    }
    Ok(shift(capture, body, views)?.into_iter().collect())
}

/// Mean overlap and mean share of the mask covered.
fn mean(overlaps: &[Overlap]) -> (f32, f32) {
    let count = overlaps.len().max(1) as f32;
    let sum = |f: fn(Overlap) -> f32| overlaps.iter().map(|overlap| f(*overlap)).sum::<f32>() / count;
    (sum(Overlap::iou), sum(Overlap::covered))
}

/// A view and its body, which all mistakes share.
struct Posed<'a> {
    view: &'a View,
    placement: Placement,
    vertices: Vec<Vec3>,
    pelvis: Vec3,
}

impl<'a> Posed<'a> {
    /// With joints turned so many times as far as the frame says.
    fn new(view: &'a View, frame: &Frame, body: &BodyModel, times: f32) -> Self {
        let pose: Vec<Vec3> = frame.pose.iter().map(|axis| *axis * times).collect();
        let posed = body.pose(&body.shaped(&frame.betas), &pose, frame.placement);
        let pelvis = posed.joints.first().copied().unwrap_or(Vec3::ZERO);
        Self { view, placement: frame.placement, vertices: posed.vertices, pelvis }
    }

    /// The camera without a mistake. The body moves with it where it must: only how they lie to
    /// each other counts.
    fn undone(&self, mistake: Mistake) -> Camera {
        let mut camera = self.view.camera;
        match mistake {
            Mistake::CameraToWorld => camera.world_to_camera = camera.world_to_camera.inverse(),
            Mistake::CameraYUp => {
                let flip = Affine3A::from_mat3(Mat3::from_diagonal(Vec3::new(1.0, -1.0, -1.0)));
                camera.world_to_camera = flip * camera.world_to_camera;
            }
            Mistake::BodyUp(degrees) => {
                let pelvis = camera.world_to_camera.transform_point3(self.pelvis);
                let turn = Affine3A::from_rotation_x(-(degrees as f32).to_radians());
                let about = Affine3A::from_translation(pelvis) * turn * Affine3A::from_translation(-pelvis);
                camera.world_to_camera = about * camera.world_to_camera;
            }
            Mistake::Unit(factor) => {
                camera.world_to_camera.translation /= factor;
                let (Placement::Pelvis { translation } | Placement::Origin { translation, .. }) = self.placement;
                let closer = Affine3A::from_translation(translation / factor - translation);
                camera.world_to_camera *= closer;
            }
            Mistake::Focal(factor) => camera.focal /= factor,
            _ => {}
        }
        camera
    }

    fn overlap(&self, undo: Option<Mistake>, body: &BodyModel) -> Result<Overlap, Error> {
        let camera = undo.map_or(self.view.camera, |mistake| self.undone(mistake));
        let silhouette = silhouette(&self.vertices, &body.faces, &camera)?;
        Ok(Overlap::of(&silhouette, self.view, undo == Some(Mistake::MaskInverted)))
    }
}

/// The overlap of every view, with a mistake undone.
fn overlaps(posed: &[Posed<'_>], body: &BodyModel, undo: Option<Mistake>) -> Result<Vec<Overlap>, Error> {
    posed.par_iter().map(|posed| posed.overlap(undo, body)).collect()
}

/// Pixels of a camera's image that a frame's body covers.
pub(super) fn outline(frame: &Frame, camera: &Camera, body: &BodyModel) -> Result<Vec<bool>, Error> {
    Ok(silhouette(&posed(frame, body), &body.faces, camera)?)
}

/// The vertices of a frame's body.
pub(super) fn posed(frame: &Frame, body: &BodyModel) -> Vec<Vec3> {
    body.pose(&body.shaped(&frame.betas), &frame.pose, frame.placement).vertices
}

/// The shift of the fit against the pictures that overlaps better than none, beyond chance.
fn shift(capture: &Capture, body: &BodyModel, views: &[View]) -> Result<Option<Mistake>, Error> {
    const SHIFTS: [i32; 4] = [-2, -1, 1, 2];
    let last = capture.train.len() as i32 - 1;
    let inner: Vec<&View> = views.iter().filter(|v| (2..=last - 2).contains(&(v.index as i32))).collect();
    let gain = |views: &[&View]| -> Vec<Result<[f32; 4], Error>> {
        let (Some(first), Some(last)) = (views.first(), views.last()) else { return Vec::new() };
        let (first, last) = (first.index - 2, last.index + 2);
        let posed: Vec<Vec<Vec3>> = capture.train[first..=last].iter().map(|frame| posed(frame, body)).collect();
        let of = |view: &&View| {
            let iou = |by: i32| -> Result<f32, Error> {
                let index = (view.index as i32 + by) as usize;
                let world_to_camera = capture.train[index].camera.world_to_camera;
                let camera = Camera { world_to_camera, ..view.camera };
                Ok(Overlap::of(&silhouette(&posed[index - first], &body.faces, &camera)?, view, false).iou())
            };
            let none = iou(0)?;
            let [a, b, c, d] = SHIFTS.map(iou);
            Ok([a? - none, b? - none, c? - none, d? - none])
        };
        views.iter().map(of).collect()
    };
    // Neighbouring views share their bodies.
    let gains: Result<Vec<[f32; 4]>, Error> = inner.par_chunks(8).flat_map_iter(gain).collect();
    let gains = gains?;
    let count = gains.len() as f32;
    let better = |i: usize| {
        let mean = gains.iter().map(|gain| gain[i]).sum::<f32>() / count;
        let variance = gains.iter().map(|gain| (gain[i] - mean).powi(2)).sum::<f32>() / (count - 1.0);
        let significant = mean > SHIFT_BY && mean > SHIFT_ERRORS * (variance / count).sqrt();
        significant.then_some((SHIFTS[i], mean))
    };
    if gains.len() < 6 {
        return Ok(None);
    }
    let best = (0..SHIFTS.len()).filter_map(better).max_by(|a, b| a.1.total_cmp(&b.1));
    // What lies in the frame `by` later fits this picture: the fit comes so much too early.
    Ok(best.map(|(by, _)| Mistake::FrameShift(-by)))
}
