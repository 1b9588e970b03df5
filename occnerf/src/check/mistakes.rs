//! Common convention errors, each detected by the gain in overlap from undoing it.

use glam::{Affine3A, Mat3, Vec3};
use rayon::prelude::*;
use smpl::{BodyModel, Placement};
use volrender::Camera;

use super::faults::View;
use crate::capture::{Capture, Frame};
use crate::error::Error;
use crate::model::view::silhouette;

/// A systematic error of a capture.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub enum Mistake {
    /// The extrinsics map camera to world.
    CameraToWorld,
    /// The camera's y axis points up and its z axis backward, as in OpenGL.
    CameraYUp,
    /// The body is rotated about the camera's x axis by this many degrees: another axis was up.
    BodyUp(i32),
    /// Translations of the camera (or of the body) are too large by this factor: 1000 for
    /// millimetres.
    Unit(f32),
    /// Rotations in degrees.
    Degrees,
    /// Rotations in radians, converted as if in degrees.
    Radians,
    /// The focal length is too long by about this factor.
    Focal(f32),
    /// Focal length and principal point are those of pictures larger by this factor.
    Scaled(f32),
    /// The principal point is far from the picture's centre: 0 where it was left out.
    PrincipalPoint,
    /// The pictures are mirrored left to right, the fit is not, or the reverse.
    Mirrored,
    /// Masks are inverted.
    MaskInverted,
    /// The fit of a picture belongs to the picture this many frames later.
    FrameShift(i32),
    /// The fit lies beside the mask: they are of different people.
    WrongPerson,
    /// The body is outside the pictures, or of another size.
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
            Self::Scaled(factor) => write!(
                f,
                "the intrinsics are of pictures {factor:.2} times as large: multiply focal length and principal point by {:.2}",
                1.0 / factor
            ),
            Self::PrincipalPoint => f.write_str("the principal point is far off: it is the centre of the picture"),
            Self::Mirrored => f.write_str("pictures and fit are mirrored, left to right: flip the pictures"),
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

/// Degrees are detected by this share of angles above a full turn.
const TURN: f32 = std::f32::consts::TAU;
const DEGREES_SHARE: f32 = 0.05;
/// Least gain in overlap from undoing an error, as a factor and as a difference, and least share of
/// the mask covered then.
const BETTER: f32 = 1.3;
const BETTER_BY: f32 = 0.12;
const COVERS: f32 = 0.75;
/// Largest share of the image border inside a mask.
const BORDER: f32 = 0.5;
/// Least share of the mask that a fit covers.
const BESIDE: f32 = 0.5;
/// Least gain in overlap from a frame shift: in standard errors, and as a difference.
const SHIFT_ERRORS: f32 = 4.0;
const SHIFT_BY: f32 = 0.004;
/// Most frames for this.
const UNDONE_VIEWS: usize = 12;
/// Focal length errors to try, octaves; finer below one, where the overlap changes fast.
const OCTAVES: [f32; 10] = [0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0];
/// Focal lengths below this share of the picture's width, and their errors to try.
const TINY: f32 = 0.05;
const TINY_OCTAVES: [f32; 8] = [4.5, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 11.0];
/// Share of the picture that no body covers.
const FILLED: f32 = 0.9;
/// Sizes of other pictures that intrinsics may be of, and bisections of the best focal length.
const SCALES: [f32; 10] = [0.25, 1.0 / 3.0, 0.5, 2.0 / 3.0, 0.75, 4.0 / 3.0, 1.5, 2.0, 3.0, 4.0];
const REFINEMENTS: usize = 5;
/// Least distance of a wrong principal point from the centre, as a share of the picture's side.
const OFF_CENTRE: f32 = 0.2;
/// Plausible areas of the silhouette, as multiples of the mask's.
const AREAS: std::ops::Range<f32> = 0.3..8.0;

/// Pixel counts of a silhouette and a mask.
#[derive(Clone, Copy, Default)]
pub(super) struct Overlap {
    pub both: usize,
    pub mask: usize,
    /// Pixels of the silhouette outside known occluders.
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

    /// Intersection over union outside known occluders.
    pub fn iou(self) -> f32 {
        self.both as f32 / (self.mask + self.body - self.both).max(1) as f32
    }

    /// Share of the mask inside the silhouette.
    pub fn covered(self) -> f32 {
        self.both as f32 / self.mask.max(1) as f32
    }
}

/// Likely errors; none for a good capture.
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
    // Radians converted as if in degrees are close to the rest pose.
    if angles().all(|angle| angle < TURN.to_radians()) {
        let (iou, _) = mean(&overlaps(&few(180.0 / std::f32::consts::PI), body, None)?);
        if iou > given {
            return Ok(vec![Mistake::Radians]);
        }
    }
    let focal = OCTAVES.iter().flat_map(|k| [2f32.powf(*k), 2f32.powf(-k)]).map(Mistake::Focal);
    // A field of view of 169° or more is no camera's: only other focal lengths are likely.
    let tiny = views.iter().any(|view| view.camera.focal.max_element() < TINY * view.camera.width as f32);
    let wide = TINY_OCTAVES.map(|k| Mistake::Focal(2f32.powf(-k)));
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
    // First: an inverted mask overlaps best with a body that fills the image.
    let around = views.iter().map(View::border).sum::<f32>() / views.len().max(1) as f32;
    let (iou, covers) = mean(&overlaps(&posed, body, Some(Mistake::MaskInverted))?);
    if around > BORDER && iou > BETTER * given && iou > given + BETTER_BY && covers > given {
        return Ok(vec![Mistake::MaskInverted]);
    }
    let mut best: Option<(Mistake, f32)> = None;
    let pictures = SCALES.map(Mistake::Scaled).into_iter().chain([Mistake::PrincipalPoint, Mistake::Mirrored]);
    let usual = others.into_iter().chain(pictures).filter(|_| !tiny);
    let all = usual.chain(focal).chain(wide.into_iter().filter(|_| tiny));
    // No overlap exceeds 1.
    for mistake in all.filter(|_| BETTER * given < 1.0) {
        let is_off = views.iter().any(|view| off_centre(&view.camera) > OFF_CENTRE);
        if mistake == Mistake::PrincipalPoint && !is_off {
            continue;
        }
        let (iou, covers) = mean(&overlaps(&posed, body, Some(mistake))?);
        let is_likely = iou > BETTER * given && iou > given + BETTER_BY && covers > COVERS;
        if is_likely && best.is_none_or(|(_, most)| iou > most) {
            best = Some((mistake, iou));
        }
    }
    if let Some((mistake, iou)) = best {
        return Ok(vec![match mistake {
            Mistake::Focal(factor) => Mistake::Focal(refined(factor, iou, &posed, body)?),
            mistake => mistake,
        }]);
    }
    if covered < BESIDE {
        let sized = |overlap: &&Overlap| AREAS.contains(&(overlap.body as f32 / overlap.mask.max(1) as f32));
        let most = 2 * as_given.iter().filter(sized).count() > as_given.len();
        return Ok(vec![if most { Mistake::WrongPerson } else { Mistake::NoFit }]);
    }
    Ok(shift(capture, body, views)?.into_iter().collect())
}

/// The focal length error of most overlap near `factor`, whose overlap is `most`.
fn refined(mut factor: f32, mut most: f32, posed: &[Posed<'_>], body: &BodyModel) -> Result<f32, Error> {
    let mut octaves = 0.25;
    for _ in 0..REFINEMENTS {
        for other in [factor * 2f32.powf(octaves), factor * 2f32.powf(-octaves)] {
            let (iou, _) = mean(&overlaps(posed, body, Some(Mistake::Focal(other)))?);
            if iou > most {
                (factor, most) = (other, iou);
            }
        }
        octaves /= 2.0;
    }
    Ok(factor)
}

/// Largest distance of the principal point from the centre, as a share of the side.
fn off_centre(camera: &Camera) -> f32 {
    let size = glam::Vec2::new(camera.width as f32, camera.height as f32);
    (camera.centre / size - 0.5).abs().max_element()
}

/// Mean overlap and mean share of the mask covered.
fn mean(overlaps: &[Overlap]) -> (f32, f32) {
    let count = overlaps.len().max(1) as f32;
    let sum = |f: fn(Overlap) -> f32| overlaps.iter().map(|overlap| f(*overlap)).sum::<f32>() / count;
    (sum(Overlap::iou), sum(Overlap::covered))
}

/// A view and its posed body.
struct Posed<'a> {
    view: &'a View,
    placement: Placement,
    vertices: Vec<Vec3>,
    pelvis: Vec3,
}

impl<'a> Posed<'a> {
    /// Poses the body with the frame's rotations scaled by `times`.
    fn new(view: &'a View, frame: &Frame, body: &BodyModel, times: f32) -> Self {
        let pose: Vec<Vec3> = frame.pose.iter().map(|axis| *axis * times).collect();
        let posed = body.pose(&body.shaped(&frame.betas), &pose, frame.placement);
        let pelvis = posed.joints.first().copied().unwrap_or(Vec3::ZERO);
        Self { view, placement: frame.placement, vertices: posed.vertices, pelvis }
    }

    /// The camera with a mistake undone; corrections of the body are applied to the camera.
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
            Mistake::Scaled(factor) => {
                camera.focal /= factor;
                camera.centre /= factor;
            }
            Mistake::PrincipalPoint => {
                camera.centre = glam::Vec2::new(camera.width as f32, camera.height as f32) / 2.0;
            }
            _ => {}
        }
        camera
    }

    fn overlap(&self, undo: Option<Mistake>, body: &BodyModel) -> Result<Overlap, Error> {
        let camera = undo.map_or(self.view.camera, |mistake| self.undone(mistake));
        let mut silhouette = silhouette(&self.vertices, &body.faces, &camera)?;
        if undo == Some(Mistake::Mirrored) {
            silhouette.chunks_exact_mut(camera.width as usize).for_each(<[bool]>::reverse);
        }
        let inverted = undo == Some(Mistake::MaskInverted);
        // A body before the whole picture fits any mask.
        let filled = silhouette.iter().filter(|body| **body).count() as f32 > FILLED * silhouette.len() as f32;
        if filled && undo.is_some() && !inverted {
            return Ok(Overlap::default());
        }
        Ok(Overlap::of(&silhouette, self.view, inverted))
    }
}

/// Overlap of every view, with a mistake undone.
fn overlaps(posed: &[Posed<'_>], body: &BodyModel, undo: Option<Mistake>) -> Result<Vec<Overlap>, Error> {
    posed.par_iter().map(|posed| posed.overlap(undo, body)).collect()
}

/// The vertices of a frame's body.
pub(super) fn posed(frame: &Frame, body: &BodyModel) -> Vec<Vec3> {
    body.pose(&body.shaped(&frame.betas), &frame.pose, frame.placement).vertices
}

/// The frame shift with the largest significant gain in overlap.
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
    // The fit of the frame `by` later overlaps with this picture.
    Ok(best.map(|(by, _)| Mistake::FrameShift(-by)))
}
