//! The crate as its users see it.
#![allow(clippy::unwrap_used, reason = "a failure here is a failed test")]

mod avatar;
mod checkpoint;
mod common;
mod config;
mod evaluation;
mod export;
#[path = "../../lpips/tests/lpips/formula.rs"]
#[allow(dead_code, reason = "the crate lpips uses all of it")]
mod formula;
mod import;
mod odd_frames;
mod person;
mod readme;
mod simplify;
mod training;

use glam::Vec3;
use occnerf::bake::Avatar;
use smpl::Placement;

/// Vertices and normals of an avatar at `seconds` of its first motion.
fn skinned(avatar: &Avatar, seconds: f32) -> (Vec<Vec3>, Vec<Vec3>) {
    let (pose, placement) = avatar.clips[0].motion.at(seconds, avatar.num_joints());
    let (Placement::Pelvis { translation } | Placement::Origin { translation, .. }) = placement;
    avatar.skin(&avatar.bones(&pose, translation), &pose)
}
