//! First hits of many rays: eight at a time walk the tree together, in the lanes of wide registers.

use glam::Vec3;
use rayon::prelude::*;

use crate::ray_mesh::{Hit, RayMesh};
use crate::tree::{Child, FARTHER, LANES, NEARER, Node};
use crate::triangle::{Pack, Ray};

/// Rays that walk together.
const WIDTH: usize = 8;
/// Rays of a parallel task.
const TASK: usize = 64 * WIDTH;

type Lanes = [f32; WIDTH];

/// A packet, compiled for the widest instructions of the machine. A struct, since the shim through
/// which pulp calls a closure is compiled for the baseline.
struct Walk<'a> {
    mesh: &'a RayMesh,
    rays: &'a [(Vec3, Vec3)],
    hits: &'a mut [Option<Hit>],
    stack: &'a mut Vec<(f32, u32)>,
}

impl pulp::WithSimd for Walk<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) {
        self.mesh.packet(self.rays, self.hits, self.stack);
    }
}

/// AVX2 on x86-64, also where `pulp` is built with AVX-512 and the machine has it: packets are
/// eight wide.
pub(crate) fn arch() -> pulp::Arch {
    #[cfg(target_arch = "x86_64")]
    if let Some(simd) = pulp::x86::V3::try_new() {
        return pulp::Arch::V3(simd);
    }
    pulp::Arch::new()
}

impl RayMesh {
    /// [`RayMesh::first_hit`] of many `rays` (R), each an origin and a direction, into `hits` (R),
    /// overwritten.
    ///
    /// Work is spread over the current rayon pool; the result does not depend on its size. Eight
    /// consecutive rays share one walk through the tree, so put rays that are near each other side
    /// by side: the pixels of a row, or better of a tile. Where faces are hit within rounding of
    /// the same depth another one may be found than for a single ray.
    ///
    /// # Panics
    /// If the lengths differ.
    pub fn first_hits(&self, rays: &[(Vec3, Vec3)], hits: &mut [Option<Hit>]) {
        assert_eq!(rays.len(), hits.len(), "first_hits: {} rays, {} hits", rays.len(), hits.len());
        rays.par_chunks(TASK).zip(hits.par_chunks_mut(TASK)).for_each(|(rays, hits)| {
            let mut stack = Vec::with_capacity(self.tree.depth);
            for (rays, hits) in rays.chunks(WIDTH).zip(hits.chunks_mut(WIDTH)) {
                arch().dispatch(Walk { mesh: self, rays, hits, stack: &mut stack });
            }
        });
    }

    #[inline(always)]
    fn packet(&self, rays: &[(Vec3, Vec3)], hits: &mut [Option<Hit>], stack: &mut Vec<(f32, u32)>) {
        let mut packet = Packet::IDLE;
        let mut to_t = [0.0; WIDTH];
        let mut axes = [[0; 3]; WIDTH];
        for (lane, &(origin, direction)) in rays.iter().enumerate() {
            if let Some((ray, factor)) = self.ray(origin, direction) {
                packet.set(lane, &ray);
                to_t[lane] = factor;
                axes[lane] = ray.axes;
            }
        }
        // Rays of one longest axis at a time; nearly always that is all of them.
        for z in 0..3 {
            let mine: [bool; WIDTH] = std::array::from_fn(|lane| to_t[lane] > 0.0 && axes[lane][2] == z);
            if let Some(first) = (0..WIDTH).find(|&lane| mine[lane]) {
                packet.axes = axes[first];
                for lane in 0..WIDTH {
                    packet.end[lane] = if mine[lane] { f32::INFINITY } else { -1.0 };
                }
                self.walk_packet(&mut packet, stack);
                for lane in (0..WIDTH).filter(|&lane| mine[lane]) {
                    to_t[lane] *= f64::from(packet.end[lane]);
                    axes[lane][2] = 3;
                }
            }
        }
        for (lane, hit) in hits.iter_mut().enumerate() {
            let found = axes[lane][2] == 3 && to_t[lane] < f64::INFINITY;
            *hit = found.then(|| Hit {
                t: to_t[lane] as f32,
                face: packet.face[lane],
                barycentric: packet.barycentric.map(|b| b[lane]),
            });
        }
    }

    #[inline(always)]
    fn walk_packet(&self, packet: &mut Packet, stack: &mut Vec<(f32, u32)>) {
        if self.tree.nodes.is_empty() {
            return;
        }
        stack.clear();
        stack.push((0.0, 0));
        let mut farthest = f32::INFINITY;
        while let Some((entry, node)) = stack.pop() {
            if entry > farthest {
                continue;
            }
            let node = &self.tree.nodes[node as usize];
            let entries = [packet.entry(node, 0), packet.entry(node, 1)];
            let near = usize::from(entries[1] < entries[0]);
            // Leaves at once, nearer first; nodes onto the stack, nearer last.
            for side in [near, 1 - near] {
                if entries[side] < f32::INFINITY
                    && let Child::Leaf(leaf) = node.child(side)
                {
                    packet.intersect(&self.packs[leaf as usize], &self.tree.leaves[leaf as usize]);
                    farthest = packet.end.iter().fold(-1.0, |most, &end| if end > most { end } else { most });
                }
            }
            for side in [1 - near, near] {
                if entries[side] <= farthest
                    && entries[side] < f32::INFINITY
                    && let Child::Node(child) = node.child(side)
                {
                    stack.push((entries[side], child));
                }
            }
        }
    }
}

/// Rays with the same longest axis.
struct Packet {
    origin: [Lanes; 3],
    inverse: [Lanes; 3],
    shear: [Lanes; 3],
    axes: [usize; 3],
    /// Depth of the first hit so far, infinite without; negative for a lane without a ray.
    end: Lanes,
    face: [u32; WIDTH],
    barycentric: [Lanes; 3],
}

impl Packet {
    const IDLE: Self = Self {
        origin: [[0.0; WIDTH]; 3],
        inverse: [[1.0; WIDTH]; 3],
        shear: [[0.0; WIDTH]; 3],
        axes: [0; 3],
        end: [-1.0; WIDTH],
        face: [0; WIDTH],
        barycentric: [[0.0; WIDTH]; 3],
    };

    fn set(&mut self, lane: usize, ray: &Ray) {
        for axis in 0..3 {
            self.origin[axis][lane] = ray.origin[axis].x;
            self.inverse[axis][lane] = ray.inverse[axis].x;
            self.shear[axis][lane] = ray.shear[axis].x;
        }
    }

    /// The nearest depth at which a ray meets a child's box, as [`Node::entry`] has it; infinity
    /// where none does before its end.
    #[inline(always)]
    fn entry(&self, node: &Node, side: usize) -> f32 {
        let mut enter = [0.0; WIDTH];
        let mut leave = self.end;
        for axis in 0..3 {
            let (low, high) = (node.axes[axis][side], node.axes[axis][side + 2]);
            let (origin, inverse) = (&self.origin[axis], &self.inverse[axis]);
            for i in 0..WIDTH {
                let (a, b) = ((low - origin[i]) * inverse[i], (high - origin[i]) * inverse[i]);
                let (first, last) = (less(a, b), more(a, b));
                enter[i] = more(enter[i], first);
                leave[i] = less(leave[i], last);
            }
        }
        let mut nearest = [f32::INFINITY; WIDTH];
        for i in 0..WIDTH {
            let enter = enter[i] * NEARER;
            nearest[i] = if enter <= leave[i] * FARTHER { enter } else { f32::INFINITY };
        }
        nearest.iter().fold(f32::INFINITY, |nearest, &t| less(nearest, t))
    }

    /// Intersects with the triangles of a leaf, as [`Pack::intersect`] does.
    #[inline(always)]
    fn intersect(&mut self, pack: &Pack, faces: &[u32; LANES]) {
        let [kx, ky, kz] = self.axes;
        for (triangle, &face) in faces.iter().enumerate() {
            // Those that only fill up the leaf.
            if triangle > 0 && face == faces[0] {
                break;
            }
            let mut corners = [[[0.0f32; WIDTH]; 3]; 3];
            for (corner, sheared) in pack.corners.iter().zip(&mut corners) {
                let [x, y, z] = [kx, ky, kz].map(|axis| corner[axis][triangle]);
                let [sheared_x, sheared_y, sheared_z] = sheared;
                for i in 0..WIDTH {
                    let depth = z - self.origin[kz][i];
                    sheared_x[i] = x - self.origin[kx][i] - self.shear[0][i] * depth;
                    sheared_y[i] = y - self.origin[ky][i] - self.shear[1][i] * depth;
                    sheared_z[i] = self.shear[2][i] * depth;
                }
            }
            let [a, b, c] = &corners;
            let mut edges = [[0.0f32; WIDTH]; 3];
            let mut on_edge = false;
            for (edge, [p, q]) in edges.iter_mut().zip([[c, b], [a, c], [b, a]]) {
                for i in 0..WIDTH {
                    edge[i] = p[0][i] * q[1][i] - p[1][i] * q[0][i];
                    on_edge |= edge[i] == 0.0;
                }
            }
            if on_edge {
                exact(&mut edges, &corners);
            }
            let [u, v, w] = &edges;
            for i in 0..WIDTH {
                let (u, v, w) = (u[i], v[i], w[i]);
                let positive = (u >= 0.0) & (v >= 0.0) & (w >= 0.0);
                let negative = (u <= 0.0) & (v <= 0.0) & (w <= 0.0);
                let determinant = u + v + w;
                let inverse = 1.0 / determinant;
                let (u, v, w) = (u * inverse, v * inverse, w * inverse);
                let t = u * a[2][i] + v * b[2][i] + w * c[2][i];
                let first = (t < self.end[i]) | ((t == self.end[i]) & (face < self.face[i]));
                let hit = (positive | negative) & (determinant != 0.0) & (t >= 0.0) & first;
                self.end[i] = if hit { t } else { self.end[i] };
                self.face[i] = if hit { face } else { self.face[i] };
                self.barycentric[0][i] = if hit { u } else { self.barycentric[0][i] };
                self.barycentric[1][i] = if hit { v } else { self.barycentric[1][i] };
                self.barycentric[2][i] = if hit { w } else { self.barycentric[2][i] };
            }
        }
    }
}

/// Edge functions that came out as zero, anew: see [`Pack::intersect`].
#[cold]
#[inline(never)]
fn exact(edges: &mut [Lanes; 3], [a, b, c]: &[[Lanes; 3]; 3]) {
    for (edge, [p, q]) in edges.iter_mut().zip([[c, b], [a, c], [b, a]]) {
        for i in 0..WIDTH {
            if edge[i] != 0.0 {
                continue;
            }
            let [px, py, qx, qy] = [p[0][i], p[1][i], q[0][i], q[1][i]].map(f64::from);
            edge[i] = (px * qy - py * qx) as f32;
        }
    }
}

#[inline(always)]
fn less(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

#[inline(always)]
fn more(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}
