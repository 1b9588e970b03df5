use std::fmt;

use glam::{DVec3, Vec3, Vec4};

use crate::Error;
use crate::error::check_mesh;
use crate::normals::Pseudonormals;
use crate::tree::{Child, LANES, STACK, Tree, WIDTH};
use crate::triangle::{Foot, Pack, closest_on_triangle};

/// Distance, in radii of the mesh, from which queries are answered in `f64`: beyond it `f32` takes
/// faces on either side of an edge for equally near.
const FAR: f32 = 32.0;
/// Distance, in radii of the mesh, from which the closest point depends on the direction alone to
/// within 10⁻¹⁰ of the distance, and to which farther queries are moved to find it.
const HORIZON: f64 = 1e5;

/// The closest point of a mesh, from [`MeshDistance::closest`].
///
/// ```
/// use glam::Vec3;
/// use surface_query::MeshDistance;
///
/// let mesh = MeshDistance::new(&[Vec3::ZERO, Vec3::X, Vec3::Y], &[[0, 1, 2]])?;
/// let closest = mesh.closest(Vec3::new(0.25, 0.5, -3.0));
/// assert_eq!((closest.face, closest.barycentric), (0, [0.25, 0.25, 0.5]));
/// assert_eq!((closest.point, closest.signed_distance), (Vec3::new(0.25, 0.5, 0.0), -3.0));
/// # Ok::<(), surface_query::Error>(())
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Closest {
    /// Index of the face that holds the point; one of them where several share it.
    pub face: u32,
    /// Barycentric coordinates of the point: non-negative, sum 1.
    pub barycentric: [f32; 3],
    /// Position of the point.
    pub point: Vec3,
    /// Distance from the point to the query, positive outside.
    pub signed_distance: f32,
}

/// Exact signed distance to a triangle mesh: a bounding volume hierarchy finds the closest point,
/// the angle-weighted pseudonormal of the face, edge or vertex that holds it gives the sign
/// (Bærentzen and Aanæs 2005).
///
/// Queries take `&self` and may run on any number of threads. [`MeshDistance::refit`] moves the
/// vertices of a deforming mesh.
///
/// ```
/// use glam::Vec3;
/// use surface_query::MeshDistance;
///
/// // A tetrahedron, counter-clockwise seen from outside.
/// let mut vertices = [Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z];
/// let faces = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]];
/// let mut mesh = MeshDistance::new(&vertices, &faces)?;
/// assert_eq!(mesh.closest(Vec3::new(0.25, 0.25, -2.0)).signed_distance, 2.0);
/// assert_eq!(mesh.closest(Vec3::new(0.25, 0.25, 0.125)).signed_distance, -0.125);
///
/// // The same faces, moved.
/// vertices.iter_mut().for_each(|v| v.z -= 1.0);
/// mesh.refit(&vertices);
/// assert_eq!(mesh.closest(Vec3::new(0.25, 0.25, -2.0)).signed_distance, 1.0);
/// # Ok::<(), surface_query::Error>(())
/// ```
///
/// **Accuracy.** The tree is searched in `f32` with an allowance for rounding; the remaining faces
/// are compared in `f64`. The distance is the true one rounded to `f32`, whatever the unit of
/// length and however far the query. Only slivers, triangles several hundred times as long as high,
/// may lose to a face that is farther by up to 10⁻⁶ of their length.
///
/// **Sign.** Negative inside, positive outside of a closed mesh without self-intersections. The
/// crate's README says what the sign means on other meshes.
pub struct MeshDistance {
    faces: Vec<[u32; 3]>,
    /// Multiplied by `scale`, a power of two: exact, and products of four lengths stay in range.
    vertices: Vec<Vec3>,
    scale: f32,
    /// Centre and half the longest side of the bounding box, scaled.
    centre: Vec3,
    radius: f32,
    /// Bound of the rounding error of a distance in `f32`, scaled.
    error: f32,
    tree: Tree,
    /// The triangles of each leaf of the tree.
    packs: Vec<Pack>,
    pseudonormals: Pseudonormals,
}

impl MeshDistance {
    /// Builds the tree of `vertices` (V) and `faces` (F), counter-clockwise seen from outside.
    /// Vertices at exactly the same position here share a pseudonormal, also after a refit.
    ///
    /// # Errors
    /// No faces, a vertex that is not finite, or a face with an index outside `vertices`.
    pub fn new(vertices: &[Vec3], faces: &[[u32; 3]]) -> Result<Self, Error> {
        check_mesh(vertices, faces)?;
        if faces.is_empty() {
            return Err(Error("no faces".to_owned()));
        }
        let scale = power_of_two_scale(vertices);
        let scaled: Vec<Vec3> = vertices.iter().map(|v| *v * scale).collect();
        let mut this = Self {
            faces: faces.to_vec(),
            tree: Tree::new(&scaled, faces),
            vertices: scaled,
            scale,
            centre: Vec3::ZERO,
            radius: 0.0,
            error: 0.0,
            packs: Vec::new(),
            pseudonormals: Pseudonormals::new(vertices, faces),
        };
        this.update();
        Ok(this)
    }

    /// Moves the vertices (V) and keeps the faces, in time linear in the size of the mesh.
    ///
    /// The topology of the tree stays: after a large rearrangement queries are exact but slow.
    /// Faces with a vertex that is not finite are ignored until the next refit.
    ///
    /// # Panics
    /// If the number of vertices changes.
    pub fn refit(&mut self, vertices: &[Vec3]) {
        let (found, expected) = (vertices.len(), self.vertices.len());
        assert_eq!(found, expected, "refit: {found} vertices, the mesh has {expected}");
        self.scale = power_of_two_scale(vertices);
        for (scaled, v) in self.vertices.iter_mut().zip(vertices) {
            *scaled = *v * self.scale;
        }
        self.update();
    }

    fn update(&mut self) {
        let Self { faces, vertices, tree, packs, pseudonormals, .. } = self;
        let corners = |face: u32| faces[face as usize].map(|v| vertices[v as usize]);
        packs.clear();
        packs.extend((tree.leaves.iter()).map(|leaf| {
            Pack::new([0, 1, 2, 3].map(|lane| {
                // Padding lanes never hit.
                let filler = lane > 0 && leaf[lane] == leaf[0];
                if filler { [Vec3::NAN; 3] } else { corners(leaf[lane]) }
            }))
        }));
        let longest = (faces.iter())
            .map(|face| face.map(|v| vertices[v as usize]))
            .map(|[a, b, c]| {
                let edges = [a.distance_squared(b), b.distance_squared(c), c.distance_squared(a)];
                edges.into_iter().fold(0.0, f32::max)
            })
            .filter(|longest| longest.is_finite())
            .fold(0.0, f32::max)
            .sqrt();
        tree.refit(|leaf| {
            let mut bounds: Option<[Vec3; 2]> = None;
            for &face in leaf {
                let [a, b, c] = corners(face);
                if !(a.is_finite() && b.is_finite() && c.is_finite()) {
                    continue;
                }
                let [min, max] = bounds.unwrap_or([a, a]);
                bounds = Some([min.min(a).min(b).min(c), max.max(a).max(b).max(c)]);
            }
            bounds
        });
        pseudonormals.update(vertices, faces);
        if let Some([min, max]) = self.tree.bounds() {
            self.centre = (min + max) / 2.0;
            self.radius = ((max - min) / 2.0).max_element();
            // A point of a triangle is built from the query's offset and two edges, each rounded a
            // few times.
            self.error = 16.0 * f32::EPSILON * longest;
        }
    }

    /// The point of the mesh closest to `query`.
    ///
    /// Its point and distance are NaN for a query that is not finite, and where a refit left no
    /// face with finite vertices. A distance beyond the range of `f32` is infinite.
    pub fn closest(&self, query: Vec3) -> Closest {
        let undefined = Closest { face: 0, barycentric: [1.0, 0.0, 0.0], point: Vec3::NAN, signed_distance: f32::NAN };
        self.closest_within(query, f32::INFINITY).unwrap_or(undefined)
    }

    /// The point of the mesh closest to `query`, if it is at most `max_distance` away. The tighter
    /// the bound, the faster the query.
    ///
    /// `None` also for a query that is not finite, and a `max_distance` that is negative or NaN.
    pub fn closest_within(&self, query: Vec3, max_distance: f32) -> Option<Closest> {
        let q = query * self.scale;
        let reach = max_distance * self.scale;
        if !(query.is_finite() && reach >= 0.0) {
            return None;
        }
        let exact = query.as_dvec3() * f64::from(self.scale);
        let scale = f64::from(self.scale);
        let is_near = (q - self.centre).abs().max_element() <= self.radius * FAR;
        let (face, foot, beyond) = if is_near && self.tree.stack <= STACK {
            // A little more than asked for: the exact comparison follows.
            let (face, foot) = self.nearest(q, exact, (reach * (1.0 + 1e-5) + f32::MIN_POSITIVE).min(1e18))?;
            (face, foot, DVec3::ZERO)
        } else {
            let from_centre = exact - self.centre.as_dvec3();
            let moved = from_centre.clamp_length_max(HORIZON * f64::from(self.radius));
            let (face, foot) = self.nearest_foot(self.centre.as_dvec3() + moved, f64::INFINITY)?;
            (face, foot, from_centre - moved)
        };
        let distance = (foot.offset + beyond).length() / scale;
        if distance > f64::from(max_distance) {
            return None;
        }
        let side = foot.offset.dot(self.pseudonormals.of(face, foot.feature).as_dvec3());
        let point = if beyond == DVec3::ZERO { exact - foot.offset } else { self.interpolate(face, foot.barycentric) };
        Some(Closest {
            face,
            barycentric: foot.barycentric.map(|w| w as f32),
            point: (point / scale).as_vec3(),
            signed_distance: if side < 0.0 { -distance } else { distance } as f32,
        })
    }

    /// Unsigned distance from `query` to one face: as the bound of
    /// [`MeshDistance::closest_within`], with the closest face of a neighbouring query, it makes
    /// the search several times faster.
    ///
    /// ```
    /// # use glam::Vec3;
    /// # use surface_query::MeshDistance;
    /// let mesh = MeshDistance::new(&[Vec3::ZERO, Vec3::X, Vec3::Y], &[[0, 1, 2]])?;
    /// assert_eq!(mesh.distance_to_face(Vec3::new(0.2, 0.2, -3.0), 0), 3.0);
    /// # Ok::<(), surface_query::Error>(())
    /// ```
    ///
    /// # Panics
    /// If `face` is out of range.
    pub fn distance_to_face(&self, query: Vec3, face: u32) -> f32 {
        let scale = f64::from(self.scale);
        (self.foot(face, query.as_dvec3() * scale).offset.length() / scale) as f32
    }

    /// Nearest face within about `reach` and its closest point; `q` and `exact` are the scaled
    /// query.
    #[inline(always)]
    fn nearest(&self, q: Vec3, exact: DVec3, reach: f32) -> Option<(u32, Foot)> {
        let q = [q.x, q.y, q.z].map(Vec4::splat);
        let mut search = Search::new(reach, self.error);
        let mut stack = [(0.0f32, 0u32); STACK];
        // The root.
        let mut height = 1;
        while let Some(child) = pop(&stack, &mut height, search.bound) {
            match Child::new(child) {
                Child::Leaf(leaf) => search.visit(leaf, self.packs[leaf as usize].distance_squared(q).to_array()),
                Child::Node(node) => {
                    let node = &self.tree.nodes[node as usize];
                    let bound = Vec4::splat(search.bound);
                    let base = height;
                    for (half, d) in node.distance_squared(q).into_iter().enumerate() {
                        let mut within = d.cmple(bound).bitmask();
                        let d = d.to_array();
                        while within != 0 {
                            let lane = within.trailing_zeros() as usize;
                            within &= within - 1;
                            // The nearest on top.
                            let entry = (d[lane], node.child(WIDTH / 2 * half + lane));
                            let mut place = height;
                            while place > base && stack[place - 1].0 < entry.0 {
                                stack[place] = stack[place - 1];
                                place -= 1;
                            }
                            stack[place] = entry;
                            height += 1;
                        }
                    }
                }
            }
        }
        if search.overflowed {
            return self.nearest_foot(exact, f64::from(search.bound));
        }
        (search.candidates())
            .map(|(leaf, lane)| {
                let face = self.tree.leaves[leaf][lane];
                (face, self.foot(face, exact))
            })
            .min_by(|a, b| a.1.distance_squared.total_cmp(&b.1.distance_squared))
    }

    fn corners(&self, face: u32) -> [DVec3; 3] {
        self.faces[face as usize].map(|v| self.vertices[v as usize].as_dvec3())
    }

    /// Closest point of one face to the scaled query `q`.
    fn foot(&self, face: u32, q: DVec3) -> Foot {
        closest_on_triangle(self.corners(face), q)
    }

    /// Scaled position of barycentric coordinates on a face.
    fn interpolate(&self, face: u32, barycentric: [f64; 3]) -> DVec3 {
        self.corners(face).into_iter().zip(barycentric).map(|(corner, weight)| corner * weight).sum()
    }

    /// Nearest face and its closest point, if its squared distance is at most `best`, in `f64`.
    fn nearest_foot(&self, q: DVec3, mut best: f64) -> Option<(u32, Foot)> {
        let mut found = None;
        let mut stack = vec![(0.0, 0u32)];
        while let Some((d, node)) = stack.pop() {
            if d > best {
                continue;
            }
            match Child::new(node) {
                Child::Node(node) => {
                    let node = &self.tree.nodes[node as usize];
                    let base = stack.len();
                    stack.extend((0..node.count).map(|place| {
                        let [min, max] = node.side(place).map(Vec3::as_dvec3);
                        (q.distance_squared(q.clamp(min, max.max(min))), node.child(place))
                    }));
                    // The nearest last, to be popped first.
                    stack[base..].sort_unstable_by(|a, b| b.0.total_cmp(&a.0));
                }
                Child::Leaf(leaf) => {
                    for &face in &self.tree.leaves[leaf as usize] {
                        let foot = self.foot(face, q);
                        if foot.distance_squared <= best {
                            best = foot.distance_squared;
                            found = Some((face, foot));
                        }
                    }
                }
            }
        }
        found
    }
}

impl fmt::Debug for MeshDistance {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (vertices, faces) = (self.vertices.len(), self.faces.len());
        f.debug_struct("MeshDistance").field("vertices", &vertices).field("faces", &faces).finish_non_exhaustive()
    }
}

/// Capacity for faces to compare in `f64`. Six meet at a usual vertex; where the capacity is
/// exceeded the whole search is repeated in `f64`.
const MAX_CANDIDATES: usize = 32;

/// Candidates for the nearest face, given that `f32` distances are off by up to `error`.
struct Search {
    error: f32,
    /// Smallest squared distance so far.
    best: f32,
    /// Squared distance up to which a face may still be the nearest.
    bound: f32,
    candidates: [(f32, u32); MAX_CANDIDATES],
    count: usize,
    /// Set when the candidates exceed the capacity.
    overflowed: bool,
}

impl Search {
    /// A search for faces within about `reach`.
    #[inline(always)]
    fn new(reach: f32, error: f32) -> Self {
        Self {
            error,
            best: f32::INFINITY,
            bound: allow(reach, error),
            candidates: [(0.0, 0); MAX_CANDIDATES],
            count: 0,
            overflowed: false,
        }
    }

    /// Adds the faces of a leaf by squared distance; NaN distances are ignored.
    #[inline(always)]
    fn visit(&mut self, leaf: u32, squared: [f32; LANES]) {
        for (lane, d) in squared.into_iter().enumerate() {
            if d <= self.bound {
                self.keep(d, leaf * LANES as u32 + lane as u32);
            }
        }
    }

    #[inline(always)]
    fn keep(&mut self, d: f32, slot: u32) {
        if d < self.best {
            self.best = d;
            self.bound = self.bound.min(allow(d.sqrt(), self.error));
        }
        if self.count == MAX_CANDIDATES {
            self.sift();
        }
        if let Some(free) = self.candidates.get_mut(self.count) {
            *free = (d, slot);
            self.count += 1;
        } else {
            self.overflowed = true;
        }
    }

    /// Drops the candidates beyond the current bound.
    #[cold]
    fn sift(&mut self) {
        let mut kept = 0;
        for i in 0..self.count {
            if self.candidates[i].0 <= self.bound {
                self.candidates[kept] = self.candidates[i];
                kept += 1;
            }
        }
        self.count = kept;
    }

    /// Leaf and lane of the candidates within the bound.
    fn candidates(&self) -> impl Iterator<Item = (usize, usize)> + '_ {
        (self.candidates[..self.count].iter())
            .filter(|(d, _)| *d <= self.bound)
            .map(|&(_, slot)| (slot as usize / LANES, slot as usize % LANES))
    }
}

/// Square of a distance plus the error.
#[inline(always)]
fn allow(distance: f32, error: f32) -> f32 {
    let with_error = (distance + error) * (1.0 + 1e-6);
    with_error * with_error + f32::MIN_POSITIVE
}

/// Pops the next node within the bound.
#[inline(always)]
fn pop(stack: &[(f32, u32)], height: &mut usize, bound: f32) -> Option<u32> {
    while *height > 0 {
        *height -= 1;
        let (d, node) = stack[*height];
        if d <= bound {
            return Some(node);
        }
    }
    None
}

/// The power of two that brings the largest finite coordinate to about 1, clamped to exponents
/// whose inverse is normal.
fn power_of_two_scale(vertices: &[Vec3]) -> f32 {
    let largest = vertices.iter().filter(|v| v.is_finite()).fold(0.0, |m: f32, v| m.max(v.abs().max_element()));
    if largest == 0.0 {
        return 1.0;
    }
    let exponent = (largest.to_bits() >> 23) as i32 - 127;
    f32::from_bits(((127 - exponent.clamp(-126, 126)) as u32) << 23)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tree_deeper_than_the_fixed_stack_gives_the_same_distances() {
        let ball = testkit::mesh::icosphere(3);
        let usual = MeshDistance::new(&ball.vertices, &ball.faces).unwrap();
        assert!(usual.tree.stack <= STACK, "{} places", usual.tree.stack);
        let mut deep = MeshDistance::new(&ball.vertices, &ball.faces).unwrap();
        deep.tree.stack = STACK + 1;
        for i in 0..400 {
            let turn = i as f32 * 2.4;
            let q = Vec3::new(turn.cos(), turn.sin(), i as f32 / 200.0 - 1.0) * (0.3 + i as f32 * 0.003);
            for reach in [0.2, f32::INFINITY] {
                let (one, other) = (usual.closest_within(q, reach), deep.closest_within(q, reach));
                let distance = |c: Closest| c.signed_distance;
                assert_eq!(one.map(distance), other.map(distance), "{q}");
            }
        }
    }
}
