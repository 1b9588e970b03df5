//! Rigged characters from glTF 2.0: mesh, skin, hierarchy, animations.

use glam::{Affine3A, Vec2, Vec3};
use smpl::SkinningWeights;

use crate::animation::{Animation, Local};

/// A rigged character: every triangle mesh of a glTF scene merged into one, with V vertices and J
/// joints.
///
/// Meshes without a skin are bound rigidly to an extra joint for their node; morph targets are at
/// their default weights. Of materials the base colours are read, and holes by their alpha. Not
/// read: sparse accessors, other parts of materials, blending ([`Character::ignored`] names it). Metres, y up, as in glTF.
#[derive(Clone, Debug, PartialEq)]
pub struct Character {
    /// Vertices in bind space, as in the file, (V).
    pub vertices: Vec<Vec3>,
    /// Normals in bind space, (V); empty if any primitive has none.
    pub normals: Vec<Vec3>,
    /// Texture coordinates, (V), v downward; zero for primitives without, empty if none has any.
    pub uvs: Vec<Vec2>,
    /// Index into [`Character::textures`] of each vertex, (V); `None` without texture or coordinates.
    pub texture_of: Vec<Option<u32>>,
    /// Factor of the base colour, linear, (V): the material's times that of the vertex, in [0, 1].
    pub tints: Vec<Vec3>,
    /// Least alpha of the texture that is surface, (V): less is a hole. 0 for opaque materials, the
    /// cutoff over the factor's alpha for `MASK`, half of that as a cutoff for `BLEND`; 2 at most.
    pub cutoffs: Vec<f32>,
    /// Triangles, (F), counter-clockwise seen from outside.
    pub faces: Vec<[u32; 3]>,
    /// Skinning weights, (V, J), rows summing to 1.
    pub weights: SkinningWeights,
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
    /// Media type, usually `image/png` or `image/jpeg`; empty if the file does not state it.
    pub mime: String,
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
    /// Joint frames, (J).
    pub joints: Vec<Affine3A>,
    /// joints · inverse bind, (J): vertex v is at Σ w_vi · bones_i · vertices_v.
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

    /// Parent of each joint, (J): the joint of the nearest ancestor node that is one. Of joints that
    /// share a node, the first is the parent of the others.
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
        let joints: Vec<Affine3A> = self.joint_nodes.iter().map(|&node| world[node]).collect();
        let bones: Vec<Affine3A> = joints.iter().zip(&self.inverse_bind).map(|(joint, bind)| *joint * *bind).collect();
        CharacterPose { vertices: self.skin(&bones), joints, bones }
    }
}
