//! Rigged characters from glTF 2.0: mesh, skin, hierarchy, and keyframe animations (section 3.11
//! and appendix C).

use glam::{Affine3A, Quat, Vec2, Vec3, Vec4};
use gltf::json::animation::{Interpolation, Property};
use smpl::SparseRows;

/// A rigged character: every triangle mesh of a glTF scene merged into one, with V vertices and J
/// joints.
///
/// Meshes without a skin are bound rigidly to an extra joint for their node; morph targets are at
/// their default weights. Of materials the base colours are read, and holes by their alpha. Not
/// read: normals, sparse accessors, other parts of materials, blending ([`Character::ignored`]
/// names it). Metres, y up, as in glTF.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Character {
    /// Vertices in bind space, as in the file, (V).
    pub vertices: Vec<Vec3>,
    /// Texture coordinates, (V), v downward; zero for primitives without, empty if none has any.
    pub uvs: Vec<Vec2>,
    /// Index into [`Character::textures`] of each vertex, (V); `None` without texture or
    /// coordinates.
    pub texture_of: Vec<Option<u32>>,
    /// Factor of the base colour, linear, (V): the material's times that of the vertex, in [0, 1].
    pub tints: Vec<Vec3>,
    /// Least alpha of the texture that is surface, (V): less is a hole. 0 for opaque materials, the
    /// cutoff over the factor's alpha for `MASK`, half of that as a cutoff for `BLEND`; 2 at most.
    pub cutoffs: Vec<f32>,
    /// Triangles, (F), counter-clockwise seen from outside.
    pub faces: Vec<[u32; 3]>,
    /// Skinning weights, (V, J), rows summing to 1.
    pub weights: SparseRows<f32>,
    /// Inverse bind matrices, (J).
    pub inverse_bind: Vec<Affine3A>,
    /// Names of the joints' nodes, (J); empty where the file gives none.
    pub joint_names: Vec<String>,
    /// Base colours of the materials, as the file encodes them, each image once.
    pub textures: Vec<Texture>,
    /// Features of the file that are not read, in words.
    pub ignored: Vec<String>,
    /// Animations, in the file's order.
    pub animations: Vec<Animation>,
    pub(crate) nodes: Vec<Node>,
    /// Nodes, parents before children.
    pub(crate) order: Vec<usize>,
    /// Node of each joint, (J).
    pub(crate) joint_nodes: Vec<usize>,
}

/// An encoded image, of [`Character::textures`].
#[derive(Clone, Debug, PartialEq)]
pub struct Texture {
    /// The encoded bytes.
    pub bytes: Vec<u8>,
    /// Index in the document.
    pub(crate) image: usize,
}

/// A posed character in world space, from [`Character::pose`].
#[derive(Clone, Debug, PartialEq)]
pub struct CharacterPose {
    /// Vertices, (V).
    pub vertices: Vec<Vec3>,
    /// World transforms of the joints times inverse bind matrices, (J): vertex v is at
    /// Σ w_vi · bones_i · vertices_v.
    pub bones: Vec<Affine3A>,
}

#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Node {
    pub parent: Option<usize>,
    pub rest: Local,
}

impl Character {
    /// Number of joints, J.
    pub fn num_joints(&self) -> usize {
        self.joint_nodes.len()
    }

    /// Parent of each joint, (J): the joint of the nearest ancestor node that is one. Of joints
    /// that share a node, the first is the parent of the others.
    pub fn joint_parents(&self) -> Vec<Option<usize>> {
        let mut first = vec![None; self.nodes.len()];
        for (joint, &node) in self.joint_nodes.iter().enumerate().rev() {
            first[node] = Some(joint);
        }
        let parent = |(joint, &node): (usize, &usize)| {
            if first[node] != Some(joint) {
                return first[node];
            }
            let mut up = self.nodes[node].parent;
            while let Some(node) = up {
                if first[node].is_some() {
                    return first[node];
                }
                up = self.nodes[node].parent;
            }
            None
        };
        self.joint_nodes.iter().enumerate().map(parent).collect()
    }

    /// The character in the pose of the file's nodes.
    pub fn rest(&self) -> CharacterPose {
        self.posed(self.nodes.iter().map(|n| n.rest).collect())
    }

    /// The character at `seconds` of animation `animation`; time is clamped to the keys. Nodes
    /// without a channel keep the file's transform.
    ///
    /// # Panics
    /// If `animation` is out of range.
    pub fn pose(&self, animation: usize, seconds: f32) -> CharacterPose {
        let mut locals: Vec<Local> = self.nodes.iter().map(|n| n.rest).collect();
        self.animations[animation].apply(seconds, &mut locals);
        self.posed(locals)
    }

    /// Linear blend skinning by `bones`, (J): Σ w_vi · bones_i · vertices_v, (V).
    ///
    /// # Panics
    /// Unless there are J bones.
    pub fn skin(&self, bones: &[Affine3A]) -> Vec<Vec3> {
        assert_eq!(bones.len(), self.num_joints(), "skin: bones");
        smpl::skin(&self.vertices, &self.weights, bones)
    }

    fn posed(&self, locals: Vec<Local>) -> CharacterPose {
        let mut world = vec![Affine3A::IDENTITY; self.nodes.len()];
        for &node in &self.order {
            let local = locals[node].matrix();
            world[node] = self.nodes[node].parent.map_or(local, |parent| world[parent] * local);
        }
        let joints = self.joint_nodes.iter().zip(&self.inverse_bind);
        let bones: Vec<Affine3A> = joints.map(|(&node, bind)| world[node] * *bind).collect();
        CharacterPose { vertices: self.skin(&bones), bones }
    }
}

/// Keyframe animation of a character's nodes, applied by [`Character::pose`].
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
