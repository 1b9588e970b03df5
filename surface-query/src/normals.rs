use std::collections::HashMap;

use glam::{DVec3, Vec3};

use crate::triangle::Feature;

/// Unit normal of each vertex, (V): the normals of its faces weighted by the angle the face spans
/// at the vertex (Thürmer and Wüthrich 1998; Bærentzen and Aanæs 2005). Faces are wound
/// counter-clockwise seen from outside.
///
/// The fallback is +Y: for a vertex without faces, or with faces whose normals cancel or have no
/// area. Duplicated vertices along a seam get the normals of their own side.
///
/// ```
/// use glam::Vec3;
///
/// let normals = surface_query::vertex_normals(&[Vec3::ZERO, Vec3::X, Vec3::Y], &[[0, 1, 2]]);
/// assert_eq!(normals, [Vec3::Z; 3]);
/// ```
///
/// # Panics
/// If a face has an index outside `vertices`.
pub fn vertex_normals(vertices: &[Vec3], faces: &[[u32; 3]]) -> Vec<Vec3> {
    let mut sums = vec![DVec3::ZERO; vertices.len()];
    for (i, face) in faces.iter().enumerate() {
        assert!(
            face.iter().all(|&v| (v as usize) < vertices.len()),
            "vertex_normals: face {i} is {face:?} but there are {} vertices",
            vertices.len()
        );
        let corners = face.map(|v| vertices[v as usize].as_dvec3());
        let normal = face_normal(corners);
        for (corner, angle) in corner_angles(corners).into_iter().enumerate() {
            sums[face[corner] as usize] += normal * angle;
        }
    }
    sums.into_iter().map(|sum| sum.normalize_or(DVec3::Y).as_vec3()).collect()
}

/// Unit normal of a triangle, zero where it has no area. Finite for any finite `f32` corners.
#[inline]
fn face_normal([a, b, c]: [DVec3; 3]) -> DVec3 {
    (b - a).cross(c - a).normalize_or_zero()
}

/// Interior angles at the three corners, radians; 0 at a corner whose edges have no length.
#[inline]
fn corner_angles([a, b, c]: [DVec3; 3]) -> [f64; 3] {
    let angle = |u: DVec3, v: DVec3| u.cross(v).length().atan2(u.dot(v));
    let (ab, bc, ca) = (b - a, c - b, a - c);
    [angle(ab, -ca), angle(bc, -ab), angle(ca, -bc)]
}

/// Angle-weighted pseudonormals of faces, edges and vertices (Bærentzen and Aanæs 2005). The sign
/// of a point is that of its offset from the closest point times the pseudonormal there.
pub(crate) struct Pseudonormals {
    /// Edges of each face; edge i goes from corner i to corner i+1.
    face_edges: Vec<[u32; 3]>,
    /// Faces with duplicated vertices merged: the seams of textured meshes are no borders.
    welded: Vec<[u32; 3]>,
    faces: Vec<Vec3>,
    edges: Vec<Vec3>,
    vertices: Vec<Vec3>,
}

impl Pseudonormals {
    /// Connectivity of the mesh; [`Pseudonormals::update`] computes the normals.
    pub fn new(vertices: &[Vec3], faces: &[[u32; 3]]) -> Self {
        let mut positions: HashMap<[u32; 3], u32> = HashMap::with_capacity(vertices.len());
        let merged: Vec<u32> = (vertices.iter())
            .map(|v| {
                let next = positions.len() as u32;
                // Adding zero makes −0 the same as 0.
                *positions.entry((*v + 0.0).to_array().map(f32::to_bits)).or_insert(next)
            })
            .collect();
        let welded: Vec<[u32; 3]> = (faces.iter()).map(|face| face.map(|v| merged[v as usize])).collect();
        let mut numbers: HashMap<(u32, u32), u32> = HashMap::with_capacity(faces.len() * 3 / 2);
        let face_edges = (welded.iter())
            .map(|face| {
                [0, 1, 2].map(|i| {
                    let (a, b) = (face[i], face[(i + 1) % 3]);
                    let next = numbers.len() as u32;
                    *numbers.entry((a.min(b), a.max(b))).or_insert(next)
                })
            })
            .collect();
        Self {
            faces: vec![Vec3::ZERO; faces.len()],
            edges: vec![Vec3::ZERO; numbers.len()],
            vertices: vec![Vec3::ZERO; positions.len()],
            face_edges,
            welded,
        }
    }

    /// Recomputes the normals. Only those of faces have unit length: the sign needs no more.
    pub fn update(&mut self, vertices: &[Vec3], faces: &[[u32; 3]]) {
        self.edges.fill(Vec3::ZERO);
        self.vertices.fill(Vec3::ZERO);
        let topology = self.welded.iter().zip(&self.face_edges);
        for ((face, normal), (welded, edges)) in faces.iter().zip(&mut self.faces).zip(topology) {
            let corners: [DVec3; 3] = face.map(|i| vertices[i as usize].as_dvec3());
            let n = face_normal(corners);
            *normal = n.as_vec3();
            if !n.is_finite() {
                *normal = Vec3::ZERO;
                continue;
            }
            let angles = corner_angles(corners);
            for i in 0..3 {
                self.vertices[welded[i] as usize] += (n * angles[i]).as_vec3();
                self.edges[edges[i] as usize] += *normal;
            }
        }
    }

    /// Pseudonormal of a feature of a face; zero where no adjacent face has an area.
    pub fn of(&self, face: u32, feature: Feature) -> Vec3 {
        let face = face as usize;
        match feature {
            Feature::Face => self.faces[face],
            Feature::Edge(i) => self.edges[self.face_edges[face][i] as usize],
            Feature::Vertex(i) => self.vertices[self.welded[face][i] as usize],
        }
    }
}
