use glam::Vec3;

use crate::Error;
use crate::error::check_mesh;
use crate::tree::{Child, LANES, MAX_DEPTH, Tree};
use crate::triangle::{Pack, Ray};

/// Sizes of the mesh beyond which an origin's own rounding is larger than the mesh.
const FAR: f32 = 1e15;

/// Margin of the boxes around their faces, in units of the tree, where coordinates are at most 2:
/// two ulp. A ray within a side of a box is then inside whatever the sign of its zeros.
const PADDING: f32 = 2.0 * f32::EPSILON;

/// The point where a ray meets a mesh.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Position along the ray, in units of its direction: the point is origin + t · direction.
    pub t: f32,
    /// The face.
    pub face: u32,
    /// Weights of its corners: non-negative, sum 1.
    pub barycentric: [f32; 3],
}

/// A triangle mesh to cast rays at. Both sides of a triangle are hit, and the intersection is
/// watertight: no ray slips through an edge or a vertex that triangles share.
///
/// The faces keep their connectivity for life; [`RayMesh::refit`] moves the vertices. Queries take
/// `&self` and may run on any number of threads.
pub struct RayMesh {
    faces: Vec<[u32; 3]>,
    /// Multiplied by `scale`, a power of two, so that products neither overflow nor vanish.
    vertices: Vec<Vec3>,
    scale: f32,
    pub(crate) tree: Tree,
    pub(crate) packs: Vec<Pack>,
}

impl RayMesh {
    /// Takes a mesh of `vertices` (V) and `faces` (F). A mesh without faces is never hit.
    ///
    /// # Errors
    /// A vertex that is not finite, or a face that names no vertex.
    pub fn new(vertices: &[Vec3], faces: &[[u32; 3]]) -> Result<Self, Error> {
        check_mesh(vertices, faces)?;
        let scale = power_of_two_scale(vertices);
        let scaled: Vec<Vec3> = vertices.iter().map(|v| *v * scale).collect();
        let mut mesh =
            Self { faces: faces.to_vec(), tree: Tree::new(&scaled, faces), vertices: scaled, scale, packs: Vec::new() };
        mesh.update();
        Ok(mesh)
    }

    /// Moves the vertices (V); the faces stay. Linear in the size of the mesh.
    ///
    /// The tree keeps the shape it was built with: after a change that is no deformation queries
    /// stay exact but become slow. Faces with a vertex that is not finite are nowhere until the
    /// next refit.
    ///
    /// # Panics
    /// If the number of vertices is another than at the start.
    pub fn refit(&mut self, vertices: &[Vec3]) {
        assert_eq!(
            vertices.len(),
            self.vertices.len(),
            "refit: {} vertices, the mesh has {}",
            vertices.len(),
            self.vertices.len()
        );
        self.scale = power_of_two_scale(vertices);
        for (scaled, v) in self.vertices.iter_mut().zip(vertices) {
            *scaled = *v * self.scale;
        }
        self.update();
    }

    fn update(&mut self) {
        let Self { faces, vertices, tree, packs, .. } = self;
        let corners = |face: u32| faces[face as usize].map(|v| vertices[v as usize]);
        packs.clear();
        packs.extend(tree.leaves.iter().map(|leaf| Pack::new(leaf.map(corners))));
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
            bounds.map(|[min, max]| [min - PADDING, max + PADDING])
        });
    }

    /// The first face the ray from `origin` along `direction` (of any length but zero) meets, at t
    /// ≥ 0.
    ///
    /// `None` where it meets none; a ray in the plane of a triangle does not meet it. Also `None`
    /// for a direction of zero, an origin or direction that is not finite, and an origin farther
    /// than 10¹⁵ times the size of the mesh. Of faces hit at the same t it is the lowest.
    #[must_use]
    pub fn first_hit(&self, origin: Vec3, direction: Vec3) -> Option<Hit> {
        let (ray, to_t) = self.ray(origin, direction)?;
        let mut first: Option<Hit> = None;
        let mut end = f32::INFINITY;
        self.walk(&ray, f32::INFINITY, |leaf| {
            let hits = self.packs[leaf].intersect(&ray);
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

    /// Whether the ray meets any face at 0 ≤ t < `t_max`, t in units of `direction`. False for the
    /// rays for which [`RayMesh::first_hit`] is `None`, and for a `t_max` of NaN.
    #[must_use]
    pub fn is_blocked(&self, origin: Vec3, direction: Vec3, t_max: f32) -> bool {
        self.is_blocked_by(origin, direction, t_max, |_| true)
    }

    /// [`RayMesh::is_blocked`] counting only faces that `counts` accepts.
    pub(crate) fn is_blocked_by(
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
        self.walk(&ray, end, |leaf| {
            let t = self.packs[leaf].intersect(&ray).t.to_array();
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

    /// The ray in the units of the tree, its direction multiplied by a power of two; and the factor
    /// that turns a depth along it into one in units of `direction`.
    #[inline(always)]
    pub(crate) fn ray(&self, origin: Vec3, direction: Vec3) -> Option<(Ray, f64)> {
        let longest = direction.abs().max_element();
        let o = origin * self.scale;
        // Written so that NaN falls through.
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

    /// Visits the leaves the ray meets before `end`, nearest box first. `visit` returns the new
    /// end, or `None` to stop.
    #[inline(always)]
    fn walk(&self, ray: &Ray, mut end: f32, mut visit: impl FnMut(usize) -> Option<f32>) {
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
        let mut node = 0u32;
        loop {
            let n = &self.tree.nodes[node as usize];
            let t = n.entry(ray.origin, ray.inverse, end);
            let near = usize::from(t[1] < t[0]);
            let far = 1 - near;
            let mut next = None;
            // A box may begin exactly where a face is hit, so only a later one is out.
            if t[near] <= end && t[near] < f32::INFINITY {
                match n.child(near) {
                    Child::Leaf(leaf) => match visit(leaf as usize) {
                        Some(new) => end = new,
                        None => return,
                    },
                    Child::Node(child) => next = Some(child),
                }
            }
            if t[far] <= end && t[far] < f32::INFINITY {
                match n.child(far) {
                    Child::Leaf(leaf) => match visit(leaf as usize) {
                        Some(new) => end = new,
                        None => return,
                    },
                    Child::Node(child) if next.is_none() => next = Some(child),
                    Child::Node(child) => {
                        stack[height] = (t[far], child);
                        height += 1;
                    }
                }
            }
            node = match next {
                Some(child) => child,
                None => loop {
                    if height == 0 {
                        return;
                    }
                    height -= 1;
                    if stack[height].0 <= end {
                        break stack[height].1;
                    }
                },
            };
        }
    }
}

/// The power of two that brings the largest finite coordinate to about 1.
fn power_of_two_scale(vertices: &[Vec3]) -> f32 {
    inverse_power_of_two(vertices.iter().filter(|v| v.is_finite()).fold(0.0, |m: f32, v| m.max(v.abs().max_element())))
}

/// 2^−n for a `length` in [2^n, 2^(n+1)), within the exponents whose inverse is normal; 1 for 0.
fn inverse_power_of_two(length: f32) -> f32 {
    if length == 0.0 {
        return 1.0;
    }
    let exponent = (length.to_bits() >> 23) as i32 - 127;
    f32::from_bits(((127 - exponent.clamp(-126, 126)) as u32) << 23)
}
