//! Binary tree of boxes over triangles, built by obvhs and laid out for this crate's traversal: one
//! cache line a node with the boxes of both children, four triangles a leaf.

use std::time::Duration;

use glam::{Vec3, Vec3A, Vec4};
use obvhs::BvhBuildParams;
use obvhs::aabb::Aabb;
use obvhs::bvh2::Bvh2;
use obvhs::bvh2::builder::build_bvh2;

/// Triangles of a leaf: the lanes of a `Vec4`.
pub(crate) const LANES: usize = 4;
/// Marks a child that is a leaf; the other bits are its number.
const LEAF: u32 = 1 << 31;
/// Deepest tree that is walked with a stack of fixed size.
pub(crate) const MAX_DEPTH: usize = 96;

/// Bounds of two children: `axes[a]` = (lowest of left, of right, highest of left, of right) along
/// axis a.
#[derive(Clone, Copy)]
pub(crate) struct Node {
    pub axes: [Vec4; 3],
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

    /// Distances along the ray at which each child's box begins, not before its origin; infinity
    /// where it is missed or lies beyond `end`. Widened at both ends by more than rounding can take
    /// away, so no box that holds a hit is missed, nor seems to begin behind it.
    #[inline(always)]
    pub fn entry(&self, origin: [Vec4; 3], inverse: [Vec4; 3], end: f32) -> [f32; 2] {
        let mut enter = Vec4::ZERO;
        let mut leave = Vec4::splat(end);
        for ((axis, o), inverse) in self.axes.iter().zip(origin).zip(inverse) {
            // Both ends of a slab sit two lanes apart; which is met first depends on the direction.
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

/// Factors that widen what of a ray is in a box.
pub(crate) const NEARER: f32 = 1.0 - 1e-6;
pub(crate) const FARTHER: f32 = 1.0 + 1e-6;

/// Box of a child that holds nothing: turned inside out, so that no ray meets it.
const NOTHING: [Vec3; 2] = [Vec3::MAX, Vec3::MIN];

pub(crate) struct Tree {
    /// Parents come before their children; the root is the first. Empty for a mesh without faces.
    pub nodes: Vec<Node>,
    /// Faces of each leaf; a leaf of fewer than four repeats its first.
    pub leaves: Vec<[u32; LANES]>,
    pub depth: usize,
}

impl Tree {
    /// Builds over the faces at the positions `vertices`, which must be finite and not near
    /// overflow. Call [`Tree::refit`] afterwards.
    pub fn new(vertices: &[Vec3], faces: &[[u32; 3]]) -> Self {
        let boxes: Vec<Aabb> = faces
            .iter()
            .map(|face| {
                let [a, b, c] = face.map(|i| Vec3A::from(vertices[i as usize]));
                Aabb::new(a.min(b).min(c), a.max(b).max(c))
            })
            .collect();
        let mut tree = Self { nodes: Vec::new(), leaves: Vec::new(), depth: 0 };
        if boxes.is_empty() {
            return tree;
        }
        let parameters = BvhBuildParams { max_prims_per_leaf: LANES as u32, ..BvhBuildParams::medium_build() };
        let bvh = build_bvh2(&boxes, parameters, &mut Duration::default());
        tree.flatten(&bvh);
        tree
    }

    fn flatten(&mut self, bvh: &Bvh2) {
        let root = &bvh.nodes[0];
        let blank = Node { axes: [Vec4::ZERO; 3], children: [0; 2] };
        self.nodes.push(blank);
        if root.is_leaf() {
            let leaf = self.leaf(bvh, 0);
            self.nodes[0].children = [leaf, leaf];
            self.depth = 1;
            return;
        }
        // (their node, our node, depth)
        let mut stack = vec![(0usize, 0usize, 1usize)];
        while let Some((theirs, ours, depth)) = stack.pop() {
            self.depth = self.depth.max(depth);
            let first = bvh.nodes[theirs].first_index as usize;
            for side in 0..2 {
                let child = first + side;
                self.nodes[ours].children[side] = if bvh.nodes[child].is_leaf() {
                    self.leaf(bvh, child)
                } else {
                    self.nodes.push(blank);
                    stack.push((child, self.nodes.len() - 1, depth + 1));
                    self.nodes.len() as u32 - 1
                };
            }
        }
    }

    fn leaf(&mut self, bvh: &Bvh2, node: usize) -> u32 {
        let node = &bvh.nodes[node];
        let first = node.first_index as usize;
        let primitives = &bvh.primitive_indices[first..first + node.prim_count as usize];
        let mut faces = [primitives[0]; LANES];
        for (slot, &face) in faces.iter_mut().zip(primitives) {
            *slot = face;
        }
        self.leaves.push(faces);
        (self.leaves.len() as u32 - 1) | LEAF
    }

    /// Recomputes every box. `leaf_box` gives the lowest and highest corner of the faces of a leaf;
    /// `None` if all of them are nowhere.
    pub fn refit(&mut self, leaf_box: impl Fn(&[u32; LANES]) -> Option<[Vec3; 2]>) {
        for n in (0..self.nodes.len()).rev() {
            let [left, right] = [0, 1].map(|side| match self.nodes[n].child(side) {
                Child::Leaf(leaf) => leaf_box(&self.leaves[leaf as usize]).unwrap_or(NOTHING),
                Child::Node(child) => self.nodes[child as usize].bounds(),
            });
            self.nodes[n].axes = [0, 1, 2].map(|a| Vec4::new(left[0][a], right[0][a], left[1][a], right[1][a]));
        }
    }
}

impl Node {
    fn bounds(&self) -> [Vec3; 2] {
        let [x, y, z] = self.axes;
        [Vec3::new(x.x.min(x.y), y.x.min(y.y), z.x.min(z.y)), Vec3::new(x.z.max(x.w), y.z.max(y.w), z.z.max(z.w))]
    }
}
