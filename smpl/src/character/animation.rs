//! Keyframe animation (glTF 2.0, section 3.11 and appendix C).

use glam::{Quat, Vec3, Vec4};

use super::Local;

/// Keyframe animation of a [`super::Character`]'s nodes, applied by [`super::Character::pose`].
#[derive(Clone, Debug, PartialEq)]
pub struct Animation {
    /// Empty if the file gives none.
    pub name: String,
    /// Time of the last key, in seconds.
    pub duration: f32,
    pub(super) channels: Vec<Channel>,
}

#[derive(Clone, Debug, PartialEq)]
pub(super) struct Channel {
    pub(super) node: usize,
    pub(super) part: Part,
    pub(super) interpolation: Interpolation,
    /// Seconds, increasing, at least one.
    pub(super) times: Vec<f32>,
    /// One value per key; in-tangent, value and out-tangent for cubic splines. Vectors have w = 0.
    pub(super) values: Vec<Vec4>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Part {
    Translation,
    Rotation,
    Scale,
}

#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Interpolation {
    Step,
    Linear,
    Cubic,
}

impl Animation {
    /// Replaces the animated transforms. The reader refuses channels of nodes given as matrices.
    pub(super) fn apply(&self, seconds: f32, locals: &mut [Local]) {
        for channel in &self.channels {
            let value = channel.at(seconds);
            if let Local::Parts { scale, rotation, translation } = &mut locals[channel.node] {
                match channel.part {
                    Part::Translation => *translation = value.truncate(),
                    Part::Rotation => *rotation = unit(value),
                    Part::Scale => *scale = value.truncate(),
                }
            }
        }
    }
}

impl Channel {
    fn at(&self, seconds: f32) -> Vec4 {
        let value = |key: usize| match self.interpolation {
            Interpolation::Cubic => self.values[3 * key + 1],
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
            Interpolation::Linear if self.part == Part::Rotation => Vec4::from(unit(a).slerp(unit(b), s)),
            Interpolation::Linear => a.lerp(b, s),
            Interpolation::Cubic => {
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
pub(super) fn unit(q: Vec4) -> Quat {
    q.try_normalize().map_or(Quat::IDENTITY, Quat::from_vec4)
}

/// Pads a vector to four components.
pub(super) fn widen(v: [f32; 3]) -> Vec4 {
    Vec3::from(v).extend(0.0)
}
