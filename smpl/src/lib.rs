//! Parametric bodies in SMPL's form.
//!
//! [`BodyModel`] loads, shapes, poses and skins a body, with derivatives; [`MotionField`] maps
//! points of world space back to the canonical pose; [`MotionClip`] is motion capture.
//!
//! ```
//! use glam::Vec3;
//! use smpl::{BodyModel, Placement};
//!
//! let body = BodyModel::embedded();
//! let shaped = body.shaped(&[0.5]);
//! let mut pose = vec![Vec3::ZERO; body.num_joints()];
//! pose[18] = Vec3::new(0.0, -1.2, 0.0); // left elbow
//! let posed = body.pose(&shaped, &pose, Placement::default());
//! assert_eq!(posed.vertices.len(), body.num_vertices());
//! ```
//!
//! # Conventions
//! Right-handed, y up, facing +z, the person's left at +x; angles in radians, rotations as
//! axis-angle vectors. Lengths are in the model's unit: only the default of [`SurfaceMotion`] and
//! [`WeightVolume::gaussian`] assume metres. The canonical space is the rest pose of a [`Shaped`]
//! body. Arithmetic is `f32` and independent of the number of threads.

mod clip;
mod embedded;
mod hands;
mod limbs;
mod load;
mod model;
mod motion;
mod pose;
mod rotation;
mod sparse;

/// The README's example, compiled as a test.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

/// A file that cannot be read or written, or a model that is not valid.
pub use array_files::Error;
pub use clip::{BoneNames, Bvh, Joint, MotionClip, joint_transforms, skeleton};
pub use limbs::Limbs;
pub use model::{BodyModel, Shaped};
pub use motion::{MotionField, MotionFrame, MotionSample, SurfaceMotion, SurfacePoint, WeightVolume};
pub use pose::{Placement, Posed, skin};
pub use rotation::rodrigues;
pub use sparse::SparseRows;
