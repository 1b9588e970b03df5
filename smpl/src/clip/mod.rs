//! Motion capture: clips in SMPL parameters, BVH files, and retargeting between skeletons.

mod bvh;
mod motion_clip;
mod retarget;
mod skeleton;

pub use bvh::Bvh;
pub use motion_clip::MotionClip;
pub use skeleton::{BoneNames, Joint, joint_transforms, skeleton};
