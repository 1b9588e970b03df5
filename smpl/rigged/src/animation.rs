//! Keyframe animation (glTF 2.0, section 3.11 and appendix C).

use glam::{Affine3A, Quat, Vec3, Vec4};
use gltf::json::animation::{Interpolation, Property};

/// Keyframe animation of a character's nodes, applied by [`Character::pose`](crate::Character::pose).
#[derive(Clone, Debug, PartialEq)]
pub struct Animation {
    /// Empty if the file gives none.
    pub name: String,
    /// Time of the last key, in seconds.
    pub duration: f32,
    pub(crate) channels: Vec<Channel>,
}

#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Channel {
    pub(crate) node: usize,
    /// Translation, rotation or scale.
    pub(crate) property: Property,
    pub(crate) interpolation: Interpolation,
    /// Seconds, increasing, at least one.
    pub(crate) times: Vec<f32>,
    /// One value per key; in-tangent, value and out-tangent for cubic splines. Vectors have w = 0.
    pub(crate) values: Vec<Vec4>,
}

/// Transform of a node relative to its parent.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Local {
    Matrix(Affine3A),
    /// Scale, then rotation, then translation.
    Parts {
        scale: Vec3,
        rotation: Quat,
        translation: Vec3,
    },
}

impl Local {
    pub fn matrix(self) -> Affine3A {
        match self {
            Self::Matrix(matrix) => matrix,
            Self::Parts { scale, rotation, translation } => {
                Affine3A::from_scale_rotation_translation(scale, rotation, translation)
            }
        }
    }
}

impl Animation {
    /// Replaces the animated transforms. The reader refuses channels of nodes given as matrices.
    pub(crate) fn apply(&self, seconds: f32, locals: &mut [Local]) {
        for channel in &self.channels {
            let value = channel.at(seconds);
            if let Local::Parts { scale, rotation, translation } = &mut locals[channel.node] {
                match channel.property {
                    Property::Translation => *translation = value.truncate(),
                    Property::Rotation => *rotation = unit(value),
                    Property::Scale => *scale = value.truncate(),
                    Property::MorphTargetWeights => {}
                }
            }
        }
    }
}

impl Channel {
    fn at(&self, seconds: f32) -> Vec4 {
        let value = |key: usize| match self.interpolation {
            Interpolation::CubicSpline => self.values[3 * key + 1],
            _ => self.values[key],
        };
        // The key at or before `seconds`; NaN counts as before the first.
        let next = self.times.partition_point(|&t| t <= seconds);
        let Some(key) = next.checked_sub(1) else {
            return value(0);
        };
        if next == self.times.len() {
            return value(key);
        }
        let step = self.times[next] - self.times[key];
        let s = (seconds - self.times[key]) / step;
        let (a, b) = (value(key), value(next));
        match self.interpolation {
            Interpolation::Step => a,
            Interpolation::Linear if self.property == Property::Rotation => Vec4::from(unit(a).slerp(unit(b), s)),
            Interpolation::Linear => a.lerp(b, s),
            Interpolation::CubicSpline => {
                let (out, into) = (self.values[3 * key + 2] * step, self.values[3 * next] * step);
                let (s2, s3) = (s * s, s * s * s);
                a * (2.0 * s3 - 3.0 * s2 + 1.0)
                    + out * (s3 - 2.0 * s2 + s)
                    + b * (3.0 * s2 - 2.0 * s3)
                    + into * (s3 - s2)
            }
        }
    }
}

/// The unit quaternion along `q`; the identity for zero.
pub(crate) fn unit(q: Vec4) -> Quat {
    q.try_normalize().map_or(Quat::IDENTITY, Quat::from_vec4)
}

/// Pads a vector to four components.
pub(crate) fn widen(v: [f32; 3]) -> Vec4 {
    Vec3::from(v).extend(0.0)
}
