use std::fmt;

use glam::Vec3;

use crate::Error;
use crate::error::check_mesh;
use crate::tree::{Child, LANES, MAX_DEPTH, Tree};
use crate::triangle::{Ray, Triangles};

/// Distance of an origin, in sizes of the mesh, beyond which its rounding exceeds the mesh.
const FAR: f32 = 1e15;

/// The intersection of a ray with a mesh.
///
/// ```
/// use glam::Vec3;
/// use visibility::RayMesh;
///
/// let vertices = [Vec3::ZERO, Vec3::X, Vec3::Y];
/// let mesh = RayMesh::new(&vertices, &[[0, 1, 2]])?;
/// let hit = mesh.first_hit(Vec3::new(0.25, 0.5, 4.0), -2.0 * Vec3::Z).unwrap();
/// assert_eq!((hit.t, hit.face, hit.barycentric), (2.0, 0, [0.25, 0.25, 0.5]));
/// # Ok::<(), visibility::Error>(())
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Ray parameter: the point is origin + t · direction.
    pub t: f32,
    /// Index of the face.
    pub face: u32,
    /// Barycentric coordinates on the face: non-negative, sum 1.
    pub barycentric: [f32; 3],
}

/// A triangle mesh for ray casts. Both sides of a triangle are hit, and the intersection is
/// watertight: no ray slips through an edge or a vertex that triangles share.
///
/// Queries take `&self` and may run on any number of threads.
///
/// ```
/// use glam::Vec3;
/// use visibility::RayMesh;
///
/// let mesh = RayMesh::new(&[Vec3::ZERO, Vec3::X, Vec3::Y], &[[0, 1, 2]])?;
/// assert!(mesh.first_hit(Vec3::new(0.25, 0.25, 1.0), Vec3::NEG_Z).is_some());
/// assert!(mesh.first_hit(Vec3::ONE, Vec3::NEG_Z).is_none());
/// # Ok::<(), visibility::Error>(())
/// ```
pub struct RayMesh {
    faces: Vec<[u32; 3]>,
    /// Multiplied by `scale`, a power of two, so that products neither overflow nor vanish.
    vertices: Vec<Vec3>,
    scale: f32,
    tree: Tree,
    /// The triangles of each leaf of the tree.
    leaves: Vec<Triangles>,
}

impl RayMesh {
    /// Builds the tree of `vertices` (V) and `faces` (F). A mesh without faces is never hit.
    ///
    /// # Errors
    /// A vertex that is not finite, or a face with an index outside `vertices`.
    pub fn new(vertices: &[Vec3], faces: &[[u32; 3]]) -> Result<Self, Error> {
        check_mesh(vertices, faces)?;
        let largest = vertices.iter().fold(0.0, |largest: f32, v| largest.max(v.abs().max_element()));
        let scale = inverse_power_of_two(largest);
        let vertices: Vec<Vec3> = vertices.iter().map(|v| *v * scale).collect();
        let corners = |face: u32| faces[face as usize].map(|v| vertices[v as usize]);
        let tree = Tree::new(&vertices, faces);
        let leaves = tree.leaves.iter().map(|leaf| Triangles::new(leaf.map(corners))).collect();
        Ok(Self { faces: faces.to_vec(), vertices, scale, tree, leaves })
    }

    /// The first intersection with the ray from `origin` along `direction`, of any length, at t ≥
    /// 0. Of faces at the same t it is the one of lowest index.
    ///
    /// `None` without an intersection. A ray in the plane of a triangle does not intersect it, nor
    /// does one of zero direction, one that is not finite, or one from beyond 10¹⁵ sizes of the
    /// mesh.
    pub fn first_hit(&self, origin: Vec3, direction: Vec3) -> Option<Hit> {
        let (ray, to_t) = self.ray(origin, direction)?;
        let mut first: Option<Hit> = None;
        let mut end = f32::INFINITY;
        self.traverse(&ray, f32::INFINITY, |leaf| {
            let hits = self.leaves[leaf].intersect(&ray);
            let t = hits.t.to_array();
            for lane in 0..LANES {
                let face = self.tree.leaves[leaf][lane];
                let lower = || t[lane] == end && first.is_some_and(|first| face < first.face);
                if t[lane] < end || lower() {
                    end = t[lane];
                    first = Some(Hit {
                        t: (f64::from(end) * to_t) as f32,
                        face,
                        barycentric: hits.barycentric.map(|b| b[lane]),
                    });
                }
            }
            Some(end)
        });
        first
    }

    /// Whether a face that `counts` accepts intersects the ray at 0 ≤ t < `t_max`. False for the
    /// rays for which [`RayMesh::first_hit`] is `None`, and for a `t_max` of NaN.
    pub(crate) fn is_occluded_by(
        &self,
        origin: Vec3,
        direction: Vec3,
        t_max: f32,
        counts: impl Fn(&[u32; 3]) -> bool,
    ) -> bool {
        let Some((ray, to_t)) = self.ray(origin, direction) else {
            return false;
        };
        let end = (f64::from(t_max) / to_t) as f32;
        if end.is_nan() || end <= 0.0 {
            return false;
        }
        let mut blocked = false;
        self.traverse(&ray, end, |leaf| {
            let t = self.leaves[leaf].intersect(&ray).t.to_array();
            for lane in 0..LANES {
                let face = self.tree.leaves[leaf][lane] as usize;
                blocked |= t[lane] < end && counts(&self.faces[face]);
            }
            (!blocked).then_some(end)
        });
        blocked
    }

    /// Whether vertex `index` of the mesh is at `position`.
    pub(crate) fn is_vertex(&self, index: usize, position: Vec3) -> bool {
        self.vertices.get(index) == Some(&(position * self.scale))
    }

    /// The ray in the units of the tree, its direction scaled by a power of two, and the factor
    /// from its depths to those in units of `direction`.
    #[inline(always)]
    fn ray(&self, origin: Vec3, direction: Vec3) -> Option<(Ray, f64)> {
        let longest = direction.abs().max_element();
        let o = origin * self.scale;
        // False for NaN.
        let usable = longest > 0.0 && direction.is_finite() && o.abs().max_element() < FAR;
        if !usable || !origin.is_finite() {
            return None;
        }
        let factor = inverse_power_of_two(longest);
        let mut d = direction * factor;
        let mut to_t = f64::from(factor) / f64::from(self.scale);
        // Denormal lengths take a second step.
        let longest = d.abs().max_element();
        if longest < 1.0 {
            let factor = inverse_power_of_two(longest);
            d *= factor;
            to_t *= f64::from(factor);
        }
        Some((Ray::new(o, d), to_t))
    }

    /// Visits the leaves whose boxes the ray enters before `end`, nearest first. `visit` returns
    /// the new end, or `None` to stop.
    #[inline(always)]
    fn traverse(&self, ray: &Ray, mut end: f32, mut visit: impl FnMut(usize) -> Option<f32>) {
        if self.tree.nodes.is_empty() {
            return;
        }
        let mut fixed = [(0.0f32, 0u32); MAX_DEPTH];
        let mut spill;
        let stack: &mut [(f32, u32)] = if self.tree.depth <= MAX_DEPTH {
            &mut fixed
        } else {
            spill = vec![(0.0, 0); self.tree.depth];
            &mut spill
        };
        let mut height = 0;
        let mut next = Some(0u32);
        while let Some(node) = next.take() {
            let node = &self.tree.nodes[node as usize];
            let t = node.entry(ray.origin, ray.inverse, end);
            let near = usize::from(t[1] < t[0]);
            for side in [near, 1 - near] {
                // Boxes at exactly the depth of the hit may hold a face of lower index.
                if t[side] > end || t[side] == f32::INFINITY {
                    continue;
                }
                match node.child(side) {
                    Child::Leaf(leaf) => match visit(leaf as usize) {
                        Some(new) => end = new,
                        None => return,
                    },
                    Child::Node(child) if next.is_none() => next = Some(child),
                    Child::Node(child) => {
                        stack[height] = (t[side], child);
                        height += 1;
                    }
                }
            }
            while next.is_none() && height > 0 {
                height -= 1;
                let (t, child) = stack[height];
                next = (t <= end).then_some(child);
            }
        }
    }
}

impl fmt::Debug for RayMesh {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (vertices, faces) = (self.vertices.len(), self.faces.len());
        f.debug_struct("RayMesh").field("vertices", &vertices).field("faces", &faces).finish_non_exhaustive()
    }
}

/// 2^−n for a `length` in [2^n, 2^(n+1)), clamped to exponents whose inverse is normal; 1 for 0.
fn inverse_power_of_two(length: f32) -> f32 {
    if length == 0.0 {
        return 1.0;
    }
    let exponent = (length.to_bits() >> 23) as i32 - 127;
    f32::from_bits(((127 - exponent.clamp(-126, 126)) as u32) << 23)
}
