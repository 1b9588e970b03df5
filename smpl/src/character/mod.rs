//! Rigged characters from glTF 2.0: mesh, skin, hierarchy, animations.

mod accessor;
mod animation;
mod primitive;
mod read;

use glam::{Affine3A, Quat, Vec2, Vec3, Vec3A};
use rayon::prelude::*;

pub use animation::Animation;

use crate::pose::{CHUNK, blend};
use crate::sparse::SkinningWeights;

/// A rigged character: every triangle mesh of a glTF scene merged into one, with V vertices and J
/// joints.
///
/// Meshes without a skin are bound rigidly to a joint that stands for their node. Not read: morph
/// targets, sparse accessors, materials other than the first base-colour texture. Lengths are
/// metres, y up, as in glTF.
#[derive(Clone, Debug, PartialEq)]
pub struct Character {
    /// Vertices as the file has them, in the space that the inverse bind matrices start from, (V).
    pub vertices: Vec<Vec3>,
    /// Normals in that space, (V); empty if any part of the mesh has none.
    pub normals: Vec<Vec3>,
    /// Texture coordinates, (V), v downward; empty if any part of the mesh has none.
    pub uvs: Vec<Vec2>,
    /// Triangles, (F), counter-clockwise seen from outside.
    pub faces: Vec<[u32; 3]>,
    /// Skinning weights, (V, J), rows summing to 1.
    pub weights: SkinningWeights,
    /// Inverse bind matrices, (J).
    pub inverse_bind: Vec<Affine3A>,
    /// Names of the joints' nodes, (J); empty where the file gives none.
    pub joint_names: Vec<String>,
    /// Base colour of the first material that has a texture, as the file encodes it.
    pub texture: Option<Texture>,
    /// Animations, in the file's order.
    pub animations: Vec<Animation>,
    nodes: Vec<Node>,
    /// Nodes, parents before children.
    order: Vec<usize>,
    /// Node of each joint, (J).
    joint_nodes: Vec<usize>,
}

/// An encoded picture.
#[derive(Clone, Debug, PartialEq)]
pub struct Texture {
    /// Usually `image/png` or `image/jpeg`; empty where the file does not say.
    pub mime: String,
    /// The file's own bytes.
    pub bytes: Vec<u8>,
}

/// A posed character in the world.
#[derive(Clone, Debug, PartialEq)]
pub struct CharacterPose {
    /// Vertices, (V).
    pub vertices: Vec<Vec3>,
    /// Joint frames, (J).
    pub joints: Vec<Affine3A>,
    /// joints · inverse bind, (J): vertex v is at Σ w_vi · bones_i · vertices_v.
    pub bones: Vec<Affine3A>,
}

#[derive(Clone, Debug, PartialEq)]
struct Node {
    parent: Option<usize>,
    rest: Local,
}

/// Transform of a node relative to its parent.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Local {
    Matrix(Affine3A),
    /// Scale, then rotation, then translation.
    Parts {
        scale: Vec3,
        rotation: Quat,
        translation: Vec3,
    },
}

impl Character {
    /// J.
    #[must_use]
    pub fn num_joints(&self) -> usize {
        self.joint_nodes.len()
    }

    /// The nearest joint above each, (J): that of the nearest node above which is a joint. Of
    /// joints that share a node the first is above the others.
    #[must_use]
    pub fn joint_parents(&self) -> Vec<Option<usize>> {
        let mut first = vec![None; self.nodes.len()];
        for (joint, &node) in self.joint_nodes.iter().enumerate().rev() {
            first[node] = Some(joint);
        }
        let above = |(joint, &node): (usize, &usize)| {
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
        self.joint_nodes.iter().enumerate().map(above).collect()
    }

    /// The character as its nodes stand in the file.
    #[must_use]
    pub fn rest(&self) -> CharacterPose {
        self.place(self.nodes.iter().map(|n| n.rest).collect())
    }

    /// The character at `seconds` of animation `animation`, held before its first and after its
    /// last key. Nodes that it does not move stand as in the file.
    ///
    /// # Panics
    /// If there is no such animation.
    #[must_use]
    pub fn pose(&self, animation: usize, seconds: f32) -> CharacterPose {
        let mut locals: Vec<Local> = self.nodes.iter().map(|n| n.rest).collect();
        self.animations[animation].apply(seconds, &mut locals);
        self.place(locals)
    }

    /// Linear blend skinning by `bones`, (J): Σ w_vi · bones_i · vertices_v, (V).
    ///
    /// # Panics
    /// Unless there are J bones.
    #[must_use]
    pub fn skin(&self, bones: &[Affine3A]) -> Vec<Vec3> {
        assert_eq!(bones.len(), self.num_joints(), "skin: bones");
        let mut out = self.vertices.clone();
        out.par_chunks_mut(CHUNK).enumerate().for_each(|(chunk, out)| {
            for (i, vertex) in out.iter_mut().enumerate() {
                let sum = blend(bones, self.weights.row(chunk * CHUNK + i));
                *vertex = sum.transform_point3a(Vec3A::from(*vertex)).into();
            }
        });
        out
    }

    fn place(&self, locals: Vec<Local>) -> CharacterPose {
        let mut world = vec![Affine3A::IDENTITY; self.nodes.len()];
        for &node in &self.order {
            let local = locals[node].matrix();
            world[node] = self.nodes[node].parent.map_or(local, |parent| world[parent] * local);
        }
        let joints: Vec<Affine3A> = self.joint_nodes.iter().map(|&node| world[node]).collect();
        let bones: Vec<Affine3A> = joints.iter().zip(&self.inverse_bind).map(|(joint, bind)| *joint * *bind).collect();
        CharacterPose { vertices: self.skin(&bones), joints, bones }
    }
}

impl Local {
    fn matrix(self) -> Affine3A {
        match self {
            Self::Matrix(matrix) => matrix,
            Self::Parts { scale, rotation, translation } => {
                Affine3A::from_scale_rotation_translation(scale, rotation, translation)
            }
        }
    }
}
