//! Binary bounding volume hierarchy over triangles, built by obvhs and laid out for SIMD: one cache
//! line a node with the boxes of both children, four triangles a leaf.

use std::collections::HashSet;
use std::time::Duration;

use glam::{DVec3, Vec3, Vec3A, Vec4};
use obvhs::BvhBuildParams;
use obvhs::aabb::Aabb;
use obvhs::bvh2::builder::build_bvh2;

/// Triangles of a leaf: the lanes of a `Vec4`.
pub(crate) const LANES: usize = 4;
/// Flags a child that is a leaf; the other bits are its index.
const LEAF: u32 = 1 << 31;
/// Padding of the boxes: two ulp of the largest coordinates. A ray along a side of a box is then
/// inside whatever the sign of its zeros.
const PADDING: f32 = 2.0 * f32::EPSILON;
/// Deepest tree that is traversed with a stack of fixed size.
pub(crate) const MAX_DEPTH: usize = 96;

/// Bounds of two children: `axes[a]` = (lowest of left, of right, highest of left, of right) along
/// axis a.
#[derive(Clone, Copy)]
pub(crate) struct Node {
    axes: [Vec4; 3],
    children: [u32; 2],
}

/// A child of a node.
#[derive(Clone, Copy)]
pub(crate) enum Child {
    Node(u32),
    Leaf(u32),
}

impl Node {
    #[inline(always)]
    pub fn child(&self, side: usize) -> Child {
        let child = self.children[side];
        if child & LEAF == 0 { Child::Node(child) } else { Child::Leaf(child & !LEAF) }
    }

    /// Depths at which the ray enters each child's box, at least 0; infinity for a miss or beyond
    /// `end`. Conservative: both ends of the interval are widened by more than the rounding error.
    #[inline(always)]
    pub fn entry(&self, origin: [Vec4; 3], inverse: [Vec4; 3], end: f32) -> [f32; 2] {
        let mut enter = Vec4::ZERO;
        let mut leave = Vec4::splat(end);
        for ((axis, o), inverse) in self.axes.iter().zip(origin).zip(inverse) {
            // The two planes of a slab are two lanes apart.
            let t = (*axis - o) * inverse;
            let other = Vec4::new(t.z, t.w, t.x, t.y);
            enter = enter.max(t.min(other));
            leave = leave.min(t.max(other));
        }
        let (enter, leave) = (enter * NEARER, leave * FARTHER);
        [
            if enter.x <= leave.x { enter.x } else { f32::INFINITY },
            if enter.y <= leave.y { enter.y } else { f32::INFINITY },
        ]
    }
}

/// Factors that widen the interval of a ray in a box.
const NEARER: f32 = 1.0 - 1e-6;
const FARTHER: f32 = 1.0 + 1e-6;

/// Bounds of the faces. One that equals another's is grown by up to 10⁻⁵ of the coordinates: the
/// builder joins boxes that are closest to each other, among equal ones a single pair a pass.
fn bounds(vertices: &[Vec3], faces: &[[u32; 3]]) -> Vec<Aabb> {
    let most = vertices.iter().map(|v| v.abs().max_element()).fold(1e-6, f32::max);
    let mut seen = HashSet::new();
    let bounds = |(i, face): (u32, &[u32; 3])| {
        let [a, b, c] = face.map(|i| Vec3A::from(vertices[i as usize]));
        let (low, high) = (a.min(b).min(c), a.max(b).max(c));
        if seen.insert([low, high].map(|corner| corner.to_array().map(f32::to_bits))) {
            return Aabb::new(low, high);
        }
        // A Kronecker sequence: the shares of any two faces differ.
        let shares = (f64::from(i) * DVec3::new(0.819_172_5, 0.671_043_6, 0.549_700_5)).fract();
        let growth = 1e-5 * most * shares.as_vec3a();
        Aabb::new(low - growth, high + growth)
    };
    (0..).zip(faces).map(bounds).collect()
}

pub(crate) struct Tree {
    /// Parents come before their children; the root is the first. Empty for a mesh without faces.
    pub nodes: Vec<Node>,
    /// Faces of each leaf; a leaf of fewer than four repeats its first.
    pub leaves: Vec<[u32; LANES]>,
    pub depth: usize,
}

impl Tree {
    /// Builds over `faces` at the positions `vertices`, which are finite and at most 2.
    pub fn new(vertices: &[Vec3], faces: &[[u32; 3]]) -> Self {
        let boxes = bounds(vertices, faces);
        let mut tree = Self { nodes: Vec::new(), leaves: Vec::new(), depth: 0 };
        if boxes.is_empty() {
            return tree;
        }
        let parameters = BvhBuildParams { max_prims_per_leaf: LANES as u32, ..BvhBuildParams::medium_build() };
        let bvh = build_bvh2(&boxes, parameters, &mut Duration::default());
        let children_of = |node: usize| [0, 1].map(|side| bvh.nodes[node].first_index as usize + side);
        let blank = Node { axes: [Vec4::ZERO; 3], children: [0; 2] };
        tree.nodes.push(blank);
        // A single leaf becomes both children of the root.
        let root = if bvh.nodes[0].is_leaf() { [0, 0] } else { children_of(0) };
        let mut stack = vec![(root, 0, 1)];
        while let Some((children, place, depth)) = stack.pop() {
            tree.depth = tree.depth.max(depth);
            let [left, right] = children.map(|child| bvh.nodes[child].aabb());
            let padding = Vec4::new(-PADDING, -PADDING, PADDING, PADDING);
            tree.nodes[place].axes =
                [0, 1, 2].map(|a| Vec4::new(left.min[a], right.min[a], left.max[a], right.max[a]) + padding);
            for (side, child) in children.into_iter().enumerate() {
                let node = &bvh.nodes[child];
                tree.nodes[place].children[side] = if node.is_leaf() {
                    let first = node.first_index as usize;
                    let primitives = &bvh.primitive_indices[first..first + node.prim_count as usize];
                    tree.leaves.push([0, 1, 2, 3].map(|lane| *primitives.get(lane).unwrap_or(&primitives[0])));
                    (tree.leaves.len() as u32 - 1) | LEAF
                } else {
                    tree.nodes.push(blank);
                    stack.push((children_of(child), tree.nodes.len() - 1, depth + 1));
                    tree.nodes.len() as u32 - 1
                };
            }
        }
        tree
    }
}
