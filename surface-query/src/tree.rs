//! Bounding volume hierarchy over triangles, built by obvhs and widened for SIMD: eight children a
//! node, whose boxes are tested together, and four triangles a leaf.

use std::collections::HashSet;
use std::time::Duration;

use glam::{DVec3, Vec3, Vec3A, Vec4};
use obvhs::BvhBuildParams;
use obvhs::aabb::Aabb;
use obvhs::bvh2::Bvh2;
use obvhs::bvh2::builder::build_bvh2;

/// Triangles of a leaf: the lanes of a `Vec4`.
pub(crate) const LANES: usize = 4;
/// Children of a node.
pub(crate) const WIDTH: usize = 8;
/// Flags a child that is a leaf; the other bits are its index.
const LEAF: u32 = 1 << 31;
/// Capacity of the fixed traversal stack, enough for a tree 18 nodes deep: triangles spread over
/// all scales of `f32` stay below it.
pub(crate) const STACK: usize = 128;

/// Bounds of the children: lowest and highest corner along each axis, a lane for each child.
#[derive(Clone, Copy)]
pub(crate) struct Node {
    low: [[Vec4; WIDTH / 4]; 3],
    high: [[Vec4; WIDTH / 4]; 3],
    /// The first `count` are in use; the boxes of the others are inside out.
    children: [u32; WIDTH],
    pub count: usize,
}

/// A child of a node.
#[derive(Clone, Copy)]
pub(crate) enum Child {
    Node(u32),
    Leaf(u32),
}

impl Child {
    #[inline(always)]
    pub fn new(code: u32) -> Self {
        if code & LEAF == 0 { Self::Node(code) } else { Self::Leaf(code & !LEAF) }
    }
}

impl Node {
    /// A node without children.
    const EMPTY: Self = Self { low: [[Vec4::MAX; 2]; 3], high: [[Vec4::MIN; 2]; 3], children: [0; WIDTH], count: 0 };

    /// [`Child::new`]'s argument for one of the children.
    #[inline(always)]
    pub fn child(&self, place: usize) -> u32 {
        self.children[place]
    }

    /// Squared distance of a point to the box of each child; rounding never makes it more than the
    /// computed distance of a point inside.
    #[inline(always)]
    pub fn distance_squared(&self, q: [Vec4; 3]) -> [Vec4; WIDTH / 4] {
        let mut sum = [Vec4::ZERO; WIDTH / 4];
        for axis in 0..3 {
            for (half, sum) in sum.iter_mut().enumerate() {
                let d = (self.low[axis][half] - q[axis]).max(q[axis] - self.high[axis][half]).max(Vec4::ZERO);
                *sum += d * d;
            }
        }
        sum
    }

    /// Lowest and highest corner of one child's box.
    pub fn side(&self, place: usize) -> [Vec3; 2] {
        [&self.low, &self.high].map(|corner| Vec3::from(corner.map(|lanes| lanes[place / 4][place % 4])))
    }

    fn set_side(&mut self, place: usize, [low, high]: [Vec3; 2]) {
        for axis in 0..3 {
            self.low[axis][place / 4][place % 4] = low[axis];
            self.high[axis][place / 4][place % 4] = high[axis];
        }
    }

    fn bounds(&self) -> [Vec3; 2] {
        (0..WIDTH).map(|place| self.side(place)).fold(NOTHING, |a, b| [a[0].min(b[0]), a[1].max(b[1])])
    }
}

/// Empty box, inside out: infinitely far from every point.
const NOTHING: [Vec3; 2] = [Vec3::MAX, Vec3::MIN];

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
    /// Most entries of a traversal stack.
    pub stack: usize,
}

impl Tree {
    /// Builds over the faces at the positions `vertices`, which must be finite and not near
    /// overflow. Call [`Tree::refit`] afterwards.
    pub fn new(vertices: &[Vec3], faces: &[[u32; 3]]) -> Self {
        let boxes = bounds(vertices, faces);
        let mut tree = Self { nodes: Vec::new(), leaves: Vec::new(), stack: 0 };
        if boxes.is_empty() {
            return tree;
        }
        let parameters = BvhBuildParams { max_prims_per_leaf: LANES as u32, ..BvhBuildParams::medium_build() };
        let bvh = build_bvh2(&boxes, parameters, &mut Duration::default());
        tree.flatten(&bvh);
        tree
    }

    fn flatten(&mut self, bvh: &Bvh2) {
        let counts = triangles(bvh);
        // (their node, our node, depth)
        let mut stack = vec![(0usize, 0usize, 1usize)];
        self.nodes.push(Node::EMPTY);
        let mut depth = 0;
        while let Some((theirs, ours, level)) = stack.pop() {
            depth = level.max(depth);
            let mut children = vec![theirs];
            // The largest are opened until the node is full.
            while children.len() < WIDTH {
                let area = |child: &usize| bvh.nodes[*child].aabb().half_area();
                let inner = |(_, child): &(usize, &usize)| counts[**child] > LANES;
                let largest = (children.iter().enumerate()).filter(inner);
                let Some((place, _)) = largest.max_by(|a, b| area(a.1).total_cmp(&area(b.1))) else { break };
                let first = bvh.nodes[children[place]].first_index as usize;
                children[place] = first;
                children.push(first + 1);
            }
            self.nodes[ours].count = children.len();
            for (place, child) in children.into_iter().enumerate() {
                self.nodes[ours].children[place] = if counts[child] <= LANES {
                    self.leaf(bvh, child)
                } else {
                    self.nodes.push(Node::EMPTY);
                    stack.push((child, self.nodes.len() - 1, level + 1));
                    self.nodes.len() as u32 - 1
                };
            }
        }
        self.stack = depth * (WIDTH - 1) + 1;
    }

    /// Collapses the subtree below `node` into a leaf.
    fn leaf(&mut self, bvh: &Bvh2, node: usize) -> u32 {
        let (mut stack, mut primitives) = (vec![node], Vec::with_capacity(LANES));
        while let Some(node) = stack.pop() {
            let node = &bvh.nodes[node];
            let first = node.first_index as usize;
            if node.is_leaf() {
                primitives.extend_from_slice(&bvh.primitive_indices[first..first + node.prim_count as usize]);
            } else {
                stack.extend([first, first + 1]);
            }
        }
        let mut faces = [primitives[0]; LANES];
        for (slot, face) in faces.iter_mut().zip(primitives) {
            *slot = face;
        }
        self.leaves.push(faces);
        (self.leaves.len() as u32 - 1) | LEAF
    }

    /// Bounding box of all faces; `None` if there are none.
    pub fn bounds(&self) -> Option<[Vec3; 2]> {
        let [min, max] = self.nodes.first()?.bounds();
        (min.x <= max.x).then_some([min, max])
    }

    /// Recomputes every box. `leaf_box` gives the lowest and highest corner of the faces of a leaf,
    /// `None` if none has finite corners.
    pub fn refit(&mut self, leaf_box: impl Fn(&[u32; LANES]) -> Option<[Vec3; 2]>) {
        for n in (0..self.nodes.len()).rev() {
            for place in 0..self.nodes[n].count {
                let side = match Child::new(self.nodes[n].child(place)) {
                    Child::Leaf(leaf) => leaf_box(&self.leaves[leaf as usize]).unwrap_or(NOTHING),
                    Child::Node(child) => self.nodes[child as usize].bounds(),
                };
                self.nodes[n].set_side(place, side);
            }
        }
    }
}

/// Triangles below each node of `bvh`.
fn triangles(bvh: &Bvh2) -> Vec<usize> {
    // Parents before their children.
    let mut order = vec![0usize];
    let mut next = 0;
    while let Some(node) = order.get(next).map(|&node| &bvh.nodes[node]) {
        if !node.is_leaf() {
            order.extend([node.first_index as usize, node.first_index as usize + 1]);
        }
        next += 1;
    }
    let mut counts = vec![0; bvh.nodes.len()];
    for place in order.into_iter().rev() {
        let node = &bvh.nodes[place];
        let first = node.first_index as usize;
        counts[place] = if node.is_leaf() { node.prim_count as usize } else { counts[first] + counts[first + 1] };
    }
    counts
}
