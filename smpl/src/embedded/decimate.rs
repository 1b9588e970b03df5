//! Edge collapse by quadric error (Garland and Heckbert 1997), on half a body open along x = 0.

use std::cmp::Ordering;
use std::collections::BinaryHeap;

use glam::{DMat3, DVec3};

use super::half::Half;

/// Cost of an edge's length beside the distance to the planes: keeps triangles of about one size.
const LENGTH_COST: f64 = 0.01;

/// Height in metres above which, in front, the face is kept finer, and the factor of its cost.
const FACE: f64 = 1.49;
const FACE_COST: f64 = 12.0;

/// No edge grows longer than this, metres.
const MAX_LENGTH: f64 = 0.055;

/// Sum of squared distances to planes, weighted by area: xᵀAx + 2bᵀx + c.
#[derive(Clone, Copy)]
struct Quadric {
    a: DMat3,
    b: DVec3,
    c: f64,
}

impl Quadric {
    const ZERO: Self = Self { a: DMat3::ZERO, b: DVec3::ZERO, c: 0.0 };

    fn plane(normal: DVec3, point: DVec3, weight: f64) -> Self {
        let d = -normal.dot(point);
        Self {
            a: DMat3::from_cols(normal * normal.x, normal * normal.y, normal * normal.z) * weight,
            b: normal * (d * weight),
            c: d * d * weight,
        }
    }

    fn plus(self, other: Self) -> Self {
        Self { a: self.a + other.a, b: self.b + other.b, c: self.c + other.c }
    }

    fn at(&self, x: DVec3) -> f64 {
        x.dot(self.a * x) + 2.0 * self.b.dot(x) + self.c
    }
}

struct Candidate {
    cost: f64,
    edge: [u32; 2],
    position: DVec3,
    /// Versions of the two vertices when the candidate was made.
    versions: [u32; 2],
}

impl PartialEq for Candidate {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}

impl Eq for Candidate {}

impl PartialOrd for Candidate {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Candidate {
    /// The heap's greatest is the cheapest, ties by the vertices.
    fn cmp(&self, other: &Self) -> Ordering {
        (other.cost.total_cmp(&self.cost)).then_with(|| other.edge.cmp(&self.edge))
    }
}

struct Collapser {
    positions: Vec<DVec3>,
    quadrics: Vec<Quadric>,
    faces: Vec<[u32; 3]>,
    alive: Vec<bool>,
    /// Faces around each vertex; may name dead ones.
    around: Vec<Vec<u32>>,
    versions: Vec<u32>,
    heap: BinaryHeap<Candidate>,
}

/// Collapses edges until `target` vertices are left.
pub(super) fn decimate(mesh: Half, target: usize) -> Half {
    let mut state = Collapser::new(&mesh);
    let mut count = mesh.vertices.len();
    while count > target {
        let Some(candidate) = state.heap.pop() else {
            break;
        };
        if state.collapse(&candidate) {
            count -= 1;
        }
    }
    state.finish()
}

impl Collapser {
    fn new(mesh: &Half) -> Self {
        let n = mesh.vertices.len();
        let mut state = Self {
            positions: mesh.vertices.iter().map(|v| v.as_dvec3()).collect(),
            quadrics: vec![Quadric::ZERO; n],
            faces: mesh.faces.clone(),
            alive: vec![true; mesh.faces.len()],
            around: vec![Vec::new(); n],
            versions: vec![0; n],
            heap: BinaryHeap::new(),
        };
        for (i, &face) in mesh.faces.iter().enumerate() {
            let [a, b, c] = face.map(|v| state.positions[v as usize]);
            let cross = (b - a).cross(c - a);
            let plane = Quadric::plane(cross.normalize_or_zero(), a, 0.5 * cross.length());
            for v in face {
                let v = v as usize;
                state.quadrics[v] = state.quadrics[v].plus(plane);
                state.around[v].push(i as u32);
            }
        }
        for v in 0..n as u32 {
            for neighbour in state.neighbours(v) {
                if v < neighbour {
                    state.offer(v, neighbour);
                }
            }
        }
        state
    }

    fn faces_of(&self, v: u32) -> impl Iterator<Item = [u32; 3]> + '_ {
        (self.around[v as usize].iter()).filter(|&&f| self.alive[f as usize]).map(|&f| self.faces[f as usize])
    }

    /// Ascending.
    fn neighbours(&self, v: u32) -> Vec<u32> {
        let mut out: Vec<u32> = self.faces_of(v).flatten().filter(|&n| n != v).collect();
        out.sort_unstable();
        out.dedup();
        out
    }

    fn in_plane(&self, v: u32) -> bool {
        self.positions[v as usize].x == 0.0
    }

    /// Puts the collapse of an edge on the heap.
    fn offer(&mut self, u: u32, v: u32) {
        let (p, q) = (self.positions[u as usize], self.positions[v as usize]);
        let quadric = self.quadrics[u as usize].plus(self.quadrics[v as usize]);
        let length = p.distance_squared(q);
        // Pulled towards the middle, which also makes flat regions solvable.
        let pull = 1e-3 * (quadric.a.x_axis.x + quadric.a.y_axis.y + quadric.a.z_axis.z);
        let middle = p.midpoint(q);
        let a = quadric.a + DMat3::IDENTITY * pull;
        let mut position = a.inverse() * (middle * pull - quadric.b);
        if !position.is_finite() || position.distance_squared(middle) > length {
            position = middle;
        }
        match (self.in_plane(u), self.in_plane(v)) {
            (true, false) => position = p,
            (false, true) => position = q,
            (true, true) => position.x = 0.0,
            (false, false) => {}
        }
        // Area times area: of the size of a quadric's error.
        let cost = quadric.at(position).max(0.0) + LENGTH_COST * length * length;
        let detail = if position.y > FACE && position.z > 0.03 { FACE_COST } else { 1.0 };
        let cost = detail * cost;
        self.heap.push(Candidate {
            cost,
            edge: [u, v],
            position,
            versions: [self.versions[u as usize], self.versions[v as usize]],
        });
    }

    fn collapse(&mut self, candidate: &Candidate) -> bool {
        let [u, v] = candidate.edge;
        if candidate.versions != [self.versions[u as usize], self.versions[v as usize]] {
            return false;
        }
        let shared = self.faces_of(u).filter(|f| f.contains(&v)).count();
        let (nu, nv) = (self.neighbours(u), self.neighbours(v));
        let common = nu.iter().filter(|n| nv.binary_search(n).is_ok()).count();
        // The link condition; an edge between two vertices of the open rim must be on the rim.
        let rim = self.in_plane(u) && self.in_plane(v);
        if common != shared || shared != if rim { 1 } else { 2 } {
            return false;
        }
        let position = candidate.position;
        let long = nu
            .iter()
            .chain(&nv)
            .any(|&n| n != u && n != v && self.positions[n as usize].distance(position) > MAX_LENGTH);
        if long || self.flips(u, v, position) || self.flips(v, u, position) {
            return false;
        }
        self.positions[u as usize] = position;
        self.quadrics[u as usize] = self.quadrics[u as usize].plus(self.quadrics[v as usize]);
        self.versions[u as usize] += 1;
        self.versions[v as usize] = u32::MAX;
        let moved = std::mem::take(&mut self.around[v as usize]);
        for f in moved {
            let face = &mut self.faces[f as usize];
            if !self.alive[f as usize] {
                continue;
            }
            if face.contains(&u) {
                self.alive[f as usize] = false;
            } else {
                for corner in face.iter_mut().filter(|c| **c == v) {
                    *corner = u;
                }
                self.around[u as usize].push(f);
            }
        }
        let alive = &self.alive;
        self.around[u as usize].retain(|&f| alive[f as usize]);
        for n in self.neighbours(u) {
            self.offer(u.min(n), u.max(n));
        }
        true
    }

    /// Whether moving `u` to `position` turns over or flattens a face that does not contain `v`.
    fn flips(&self, u: u32, v: u32, position: DVec3) -> bool {
        self.faces_of(u).filter(|f| !f.contains(&v)).any(|face| {
            let old = face.map(|i| self.positions[i as usize]);
            let new = face.map(|i| if i == u { position } else { self.positions[i as usize] });
            let cross = |[a, b, c]: [DVec3; 3]| (b - a).cross(c - a);
            let (old, new) = (cross(old), cross(new));
            let longest = (0..3)
                .map(|i| {
                    let p = |i: usize| {
                        if face[i] == u { position } else { self.positions[face[i] as usize] }
                    };
                    p(i).distance_squared(p((i + 1) % 3))
                })
                .fold(0.0, f64::max);
            old.dot(new) < 0.5 * old.length() * new.length() || new.length() < 0.15 * longest
        })
    }

    fn finish(self) -> Half {
        let mut index = vec![u32::MAX; self.positions.len()];
        let mut vertices = Vec::new();
        let mut faces = Vec::new();
        for (face, _) in self.faces.iter().zip(&self.alive).filter(|(_, alive)| **alive) {
            faces.push(face.map(|v| {
                let slot = &mut index[v as usize];
                if *slot == u32::MAX {
                    *slot = vertices.len() as u32;
                    vertices.push(self.positions[v as usize].as_vec3());
                }
                *slot
            }));
        }
        Half { vertices, faces }
    }
}
