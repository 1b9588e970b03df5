//! Level of detail: edge collapse by quadric error (Garland & Heckbert 1997).

use std::cmp::Reverse;
use std::collections::{BinaryHeap, HashMap, HashSet};

use glam::DVec2;
use smpl::SparseRows;

use super::{Avatar, Clip};
use crate::Error;

/// Poses in which the error is measured: at rest, in which bent joints are straight, and of the
/// video.
const POSES: usize = 4;
/// Coordinates of a vertex: its places in all poses, and in the atlas.
const N: usize = 3 * POSES + 2;
/// Weight of the distance from collapsed vertices, for triangles of even shape where all is flat.
const EVEN: f64 = 1e-3;
/// Least cosine between a triangle's normals before and after a collapse.
const LEAST_COSINE: f64 = 0.2;

impl Avatar {
    /// Reduces the surface to at most `triangles`, or as few as can be reached: a collapse moves a
    /// vertex to a neighbour, along its seam if it is on one, and is refused where it would change
    /// the topology or turn a triangle over, on the surface or in the atlas. What is kept of the
    /// vertices stays as it is. Deterministic.
    ///
    /// # Errors
    /// [`Error::Bake`] with what [`Avatar::validate`] finds.
    pub fn simplify(&mut self, triangles: usize) -> Result<(), Error> {
        self.validate().map_err(Error::Bake)?;
        let mut mesh = Mesh::new(self);
        let mut queue = BinaryHeap::new();
        for point in 0..mesh.about.len() as u32 {
            queue.extend(mesh.ring(point).iter().filter_map(|&(to, _)| mesh.entry(point, to)));
        }
        while mesh.left > triangles {
            let Some(Reverse((_, from, to, version))) = queue.pop() else { break };
            if version != mesh.version(from, to) {
                continue;
            }
            let Some(moved) = mesh.moved(from, to) else { continue };
            mesh.collapse(from, to, &moved);
            for (point, _) in mesh.ring(to) {
                queue.extend(mesh.entry(point, to).into_iter().chain(mesh.entry(to, point)));
            }
        }
        let faces = mesh.faces.into_iter().zip(mesh.alive).filter_map(|(face, alive)| alive.then_some(face)).collect();
        self.keep(faces);
        Ok(())
    }

    /// Replaces the faces, and drops vertices of none.
    fn keep(&mut self, faces: Vec<[u32; 3]>) {
        fn gather<T: Copy>(values: &mut Vec<T>, kept: &[u32]) {
            *values = kept.iter().map(|&v| values[v as usize]).collect();
        }
        let mut kept = faces.as_flattened().to_vec();
        kept.sort_unstable();
        kept.dedup();
        gather(&mut self.vertices, &kept);
        gather(&mut self.normals, &kept);
        gather(&mut self.uvs, &kept);
        gather(&mut self.joints, &kept);
        gather(&mut self.weights, &kept);
        let row = |&v: &u32| self.posedirs.row(v as usize).map(|(term, d)| (term as u32, d));
        self.posedirs = SparseRows::from_rows(kept.iter().map(row));
        self.faces = faces.into_iter().map(|face| face.map(|v| kept.partition_point(|&k| k < v) as u32)).collect();
    }
}

/// Triangles between points; a point has a vertex for each chart that meets there.
struct Mesh<'a> {
    avatar: &'a Avatar,
    /// Vertices of each triangle, (F).
    faces: Vec<[u32; 3]>,
    /// Whether each triangle is left, (F), and their number.
    alive: Vec<bool>,
    left: usize,
    /// The point of each vertex, (V).
    points: Vec<u32>,
    /// Triangles at each point, (P).
    about: Vec<Vec<u32>>,
    /// Coordinates of each vertex, (V).
    places: Vec<Place>,
    /// The error of moving each, (V).
    errors: Vec<Quadric>,
    /// Collapses to or from each point, (P).
    versions: Vec<u32>,
}

/// A candidate: bits of its cost, which order as the cost itself, from, to, version.
type Entry = Reverse<(u64, u32, u32, u32)>;

impl<'a> Mesh<'a> {
    fn new(avatar: &'a Avatar) -> Self {
        let mut known = HashMap::new();
        let mut first = Vec::new();
        let point = |v: usize| {
            let place = (avatar.vertices[v] + 0.0).to_array().map(f32::to_bits);
            let key = (place, avatar.joints[v], avatar.weights[v].map(f32::to_bits));
            *known.entry(key).or_insert_with(|| {
                first.push(v);
                first.len() as u32 - 1
            })
        };
        let points: Vec<u32> = (0..avatar.num_vertices()).map(point).collect();
        let corners = |face: &[u32; 3]| face.map(|v| points[v as usize]);
        let whole = |face: &&[u32; 3]| {
            let [a, b, c] = corners(face);
            a != b && b != c && c != a
        };
        let faces: Vec<[u32; 3]> = avatar.faces.iter().filter(whole).copied().collect();
        let mut about = vec![Vec::new(); first.len()];
        for (face, at) in (0u32..).zip(&faces) {
            corners(at).iter().for_each(|&point| about[point as usize].push(face));
        }
        let places = places(avatar);
        let errors = errors(&places, &faces);
        let (left, versions) = (faces.len(), vec![0; first.len()]);
        Self { avatar, alive: vec![true; left], faces, left, points, about, places, errors, versions }
    }

    /// Points that share an edge with one, ascending, and the number of triangles at that edge.
    fn ring(&self, point: u32) -> Vec<(u32, usize)> {
        let corners = |&face: &u32| self.faces[face as usize].map(|v| self.points[v as usize]);
        let mut all: Vec<u32> = self.about[point as usize].iter().flat_map(corners).filter(|&p| p != point).collect();
        all.sort_unstable();
        all.chunk_by(|a, b| a == b).map(|run| (run[0], run.len())).collect()
    }

    fn version(&self, from: u32, to: u32) -> u32 {
        self.versions[from as usize] + self.versions[to as usize]
    }

    fn entry(&self, from: u32, to: u32) -> Option<Entry> {
        let error = |(a, b): (u32, u32)| {
            let place = &self.places[b as usize];
            self.errors[a as usize].at(place) + self.errors[b as usize].at(place)
        };
        let cost: f64 = self.moved(from, to)?.into_iter().map(error).sum();
        Some(Reverse((cost.max(0.0).to_bits(), from, to, self.version(from, to))))
    }

    /// The vertex that takes the place of each vertex of a point, if it may collapse.
    fn moved(&self, from: u32, to: u32) -> Option<Vec<(u32, u32)>> {
        let (ring, others) = (self.ring(from), self.ring(to));
        let shared = ring.iter().filter(|(p, _)| others.binary_search_by_key(p, |o| o.0).is_ok()).count();
        let dying = ring.iter().find(|(p, _)| *p == to)?.1;
        let borders = ring.iter().filter(|(_, count)| *count == 1).count();
        // The link condition (Dey et al. 1999): no more than the edge's own triangles are pinched.
        let manifold = ring.iter().all(|(_, count)| *count <= 2) && borders <= 2;
        // The last triangle of its part.
        let last = [from, to].iter().all(|&point| self.about[point as usize].len() == dying);
        if !manifold || last || shared != dying || (borders > 0 && dying == 2) {
            return None;
        }
        let corner =
            |face: u32, point: u32| self.faces[face as usize].into_iter().find(|&v| self.points[v as usize] == point);
        let mut moved: Vec<(u32, u32)> = Vec::with_capacity(2);
        for &face in &self.about[from as usize] {
            if let (Some(a), Some(b)) = (corner(face, from), corner(face, to)) {
                match moved.iter().find(|m| m.0 == a) {
                    Some(m) if m.1 != b => return None,
                    Some(_) => {}
                    None => moved.push((a, b)),
                }
            }
        }
        let stays = |&&face: &&u32| corner(face, to).is_none();
        let keeps = |&face: &u32| {
            let before = self.faces[face as usize];
            let mut after = before;
            for v in after.iter_mut().filter(|v| self.points[**v as usize] == from) {
                match moved.iter().find(|m| m.0 == *v) {
                    Some(m) => *v = m.1,
                    // Beyond a seam.
                    None => return false,
                }
            }
            let twin = |&other: &u32| after.iter().all(|&v| corner(other, self.points[v as usize]).is_some());
            !self.about[to as usize].iter().any(twin) && self.same_side(before, after)
        };
        self.about[from as usize].iter().filter(stays).all(keeps).then_some(moved)
    }

    /// Whether a triangle stays on its side, at rest and in the atlas.
    fn same_side(&self, before: [u32; 3], after: [u32; 3]) -> bool {
        let normal = |face: [u32; 3]| {
            let [a, b, c] = face.map(|v| self.avatar.vertices[v as usize].as_dvec3());
            (b - a).cross(c - a)
        };
        let area = |face: [u32; 3]| {
            let [a, b, c] = face.map(|v| self.avatar.uvs[v as usize]);
            (b - a).perp_dot(c - a)
        };
        let (m, n) = (normal(before), normal(after));
        let (p, q) = (area(before), area(after));
        m.dot(n) > LEAST_COSINE * m.length() * n.length() && (p == 0.0 || p.signum() * q > 0.0)
    }

    fn collapse(&mut self, from: u32, to: u32, moved: &[(u32, u32)]) {
        for face in std::mem::take(&mut self.about[from as usize]) {
            let corners = self.faces[face as usize].map(|v| self.points[v as usize]);
            if corners.contains(&to) {
                self.alive[face as usize] = false;
                self.left -= 1;
                corners.iter().for_each(|&point| self.about[point as usize].retain(|&other| other != face));
            } else {
                for &(a, b) in moved {
                    self.faces[face as usize].iter_mut().filter(|v| **v == a).for_each(|v| *v = b);
                }
                self.about[to as usize].push(face);
            }
        }
        for &(a, b) in moved {
            let error = self.errors[a as usize].clone();
            self.errors[b as usize].add(&error);
        }
        self.versions[from as usize] += 1;
        self.versions[to as usize] += 1;
    }
}

/// Coordinates of all vertices, (V), metres.
fn places(avatar: &Avatar) -> Vec<Place> {
    let mut poses = vec![avatar.vertices.clone()];
    if let Some(Clip { motion, .. }) = avatar.clips.first() {
        let frames = motion.num_frames();
        for frame in (1..POSES).map(|i| i * (frames - 1) / (POSES - 1)) {
            let pose = &motion.poses[frame * motion.num_joints..][..motion.num_joints];
            poses.push(avatar.skin(&avatar.bones(pose, motion.trans[frame]), pose).0);
        }
    }
    let area = |face: &[u32; 3]| {
        let ([a, b, c], [p, q, r]) = (face.map(|v| avatar.vertices[v as usize]), face.map(|v| avatar.uvs[v as usize]));
        DVec2::new((b - a).cross(c - a).length().into(), (q - p).perp_dot(r - p).abs().into())
    };
    let areas: DVec2 = avatar.faces.iter().map(area).sum();
    let scale = if areas.y > 0.0 { (areas.x / areas.y).sqrt() } else { 0.0 };
    let place = |v: usize| {
        let mut place = [0.0; N];
        for (at, pose) in place.chunks_exact_mut(3).zip(poses.iter().cycle()) {
            at.copy_from_slice(&pose[v].as_dvec3().to_array());
        }
        place[3 * POSES..].copy_from_slice(&(scale * avatar.uvs[v].as_dvec2()).to_array());
        place
    };
    (0..avatar.num_vertices()).map(place).collect()
}

/// The error of each vertex, (V): distances from the planes of its triangles, and along them from
/// seams and borders.
fn errors(places: &[Place], faces: &[[u32; 3]]) -> Vec<Quadric> {
    let all: HashSet<(u32, u32)> = faces.iter().flat_map(|&[a, b, c]| [(a, b), (b, c), (c, a)]).collect();
    let mut out = vec![Quadric::default(); places.len()];
    for face in faces {
        for corner in 0..3 {
            let [v, w, opposite] = [0, 1, 2].map(|i| face[(corner + i) % 3]);
            let [a, b, c] = [v, w, opposite].map(|v| &places[v as usize]);
            let (edge, side) = (difference(b, a), difference(c, a));
            let along = scaled(&edge, 1.0 / dot(&edge, &edge).sqrt().max(f64::MIN_POSITIVE));
            let up = difference(&side, &scaled(&along, dot(&along, &side)));
            let height = dot(&up, &up).sqrt();
            let up = scaled(&up, 1.0 / height.max(f64::MIN_POSITIVE));
            let area = 0.5 * dot(&edge, &edge).sqrt() * height;
            let error = &mut out[v as usize];
            error.add_point(a, (1.0 + EVEN) * area);
            error.add_plane(&along, a, -area);
            error.add_plane(&up, a, -area);
            if !all.contains(&(w, v)) {
                for end in [v, w] {
                    out[end as usize].add_plane(&up, a, dot(&edge, &edge));
                }
            }
        }
    }
    out
}

/// A point of the space of all coordinates.
type Place = [f64; N];

fn dot(a: &Place, b: &Place) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

fn difference(a: &Place, b: &Place) -> Place {
    std::array::from_fn(|i| a[i] - b[i])
}

fn scaled(a: &Place, by: f64) -> Place {
    a.map(|x| by * x)
}

/// A sum of weighted squared distances, xᵀAx + 2b·x + c.
#[derive(Clone)]
struct Quadric {
    a: [Place; N],
    b: Place,
    c: f64,
}

impl Default for Quadric {
    fn default() -> Self {
        Self { a: [[0.0; N]; N], b: [0.0; N], c: 0.0 }
    }
}

impl Quadric {
    /// Distances from the hyperplane through a point, with a unit normal.
    fn add_plane(&mut self, normal: &Place, at: &Place, weight: f64) {
        let d = dot(normal, at);
        for (row, n) in self.a.iter_mut().zip(normal) {
            row.iter_mut().zip(normal).for_each(|(a, m)| *a += weight * n * m);
        }
        self.b.iter_mut().zip(normal).for_each(|(b, n)| *b -= weight * d * n);
        self.c += weight * d * d;
    }

    /// Distances from a point.
    fn add_point(&mut self, at: &Place, weight: f64) {
        for (i, x) in at.iter().enumerate() {
            self.a[i][i] += weight;
            self.b[i] -= weight * x;
        }
        self.c += weight * dot(at, at);
    }

    fn add(&mut self, other: &Self) {
        self.a.as_flattened_mut().iter_mut().zip(other.a.as_flattened()).for_each(|(a, b)| *a += b);
        self.b.iter_mut().zip(&other.b).for_each(|(a, b)| *a += b);
        self.c += other.c;
    }

    fn at(&self, x: &Place) -> f64 {
        self.a.iter().zip(x).map(|(row, y)| y * dot(row, x)).sum::<f64>() + 2.0 * dot(&self.b, x) + self.c
    }
}
