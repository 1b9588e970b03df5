//! Small triangle meshes with known shape.

use std::collections::HashMap;

use glam::Vec3;

/// An indexed triangle mesh.
#[derive(Clone, Debug, PartialEq)]
pub struct TriMesh {
    /// Positions, (V).
    pub vertices: Vec<Vec3>,
    /// Vertex indices of each triangle, (F); counter-clockwise seen from outside where the mesh is
    /// closed.
    pub faces: Vec<[u32; 3]>,
}

impl TriMesh {
    /// A mesh of the same faces with every vertex passed through `f`.
    #[must_use]
    pub fn map(mut self, f: impl FnMut(Vec3) -> Vec3) -> Self {
        self.vertices = self.vertices.into_iter().map(f).collect();
        self
    }

    /// Signed volume, Σ a·(b×c)/6: positive for a closed mesh wound outward.
    #[must_use]
    pub fn volume(&self) -> f64 {
        self.faces
            .iter()
            .map(|face| {
                let [a, b, c] = face.map(|i| self.vertices[i as usize].as_dvec3());
                a.dot(b.cross(c)) / 6.0
            })
            .sum()
    }

    /// Whether every directed edge is met by exactly one opposite one: closed, manifold at edges,
    /// and consistently wound.
    #[must_use]
    pub fn is_closed(&self) -> bool {
        let mut edges: HashMap<(u32, u32), u32> = HashMap::new();
        for face in &self.faces {
            for i in 0..3 {
                *edges.entry((face[i], face[(i + 1) % 3])).or_default() += 1;
            }
        }
        edges.iter().all(|(&(a, b), &count)| count == 1 && edges.get(&(b, a)) == Some(&1))
    }
}

/// Unit sphere about the origin: an icosahedron whose faces are split in four `subdivisions` times,
/// so 10 · 4ⁿ + 2 vertices and 20 · 4ⁿ faces.
#[must_use]
pub fn icosphere(subdivisions: u32) -> TriMesh {
    let phi = (1.0 + 5.0_f32.sqrt()) / 2.0;
    let mut vertices: Vec<Vec3> = Vec::new();
    for (a, b) in [(-1.0, phi), (1.0, phi), (-1.0, -phi), (1.0, -phi)] {
        vertices.push(Vec3::new(a, b, 0.0));
    }
    for i in 0..4 {
        let v = vertices[i];
        vertices.push(Vec3::new(v.z, v.x, v.y));
    }
    for i in 0..4 {
        let v = vertices[i];
        vertices.push(Vec3::new(v.y, v.z, v.x));
    }
    for v in &mut vertices {
        *v = v.normalize_or_zero();
    }
    let mut faces: Vec<[u32; 3]> = vec![
        [0, 11, 5],
        [0, 5, 1],
        [0, 1, 7],
        [0, 7, 10],
        [0, 10, 11],
        [1, 5, 9],
        [5, 11, 4],
        [11, 10, 2],
        [10, 7, 6],
        [7, 1, 8],
        [3, 9, 4],
        [3, 4, 2],
        [3, 2, 6],
        [3, 6, 8],
        [3, 8, 9],
        [4, 9, 5],
        [2, 4, 11],
        [6, 2, 10],
        [8, 6, 7],
        [9, 8, 1],
    ];
    for _ in 0..subdivisions {
        let mut midpoints: HashMap<(u32, u32), u32> = HashMap::new();
        let mut midpoint = |a: u32, b: u32, vertices: &mut Vec<Vec3>| {
            *midpoints.entry((a.min(b), a.max(b))).or_insert_with(|| {
                let m = (vertices[a as usize] + vertices[b as usize]).normalize_or_zero();
                vertices.push(m);
                vertices.len() as u32 - 1
            })
        };
        let mut finer = Vec::with_capacity(faces.len() * 4);
        for [a, b, c] in faces {
            let ab = midpoint(a, b, &mut vertices);
            let bc = midpoint(b, c, &mut vertices);
            let ca = midpoint(c, a, &mut vertices);
            finer.extend([[a, ab, ca], [b, bc, ab], [c, ca, bc], [ab, bc, ca]]);
        }
        faces = finer;
    }
    TriMesh { vertices, faces }
}

/// Box about the origin with half extents `half`: 8 vertices, 12 faces. Vertex i has the sign of
/// axis j positive where bit j of i is set.
#[must_use]
pub fn cuboid(half: Vec3) -> TriMesh {
    let vertices = (0..8)
        .map(|i| {
            let sign = |bit: u32| if i >> bit & 1 == 1 { 1.0 } else { -1.0 };
            half * Vec3::new(sign(0), sign(1), sign(2))
        })
        .collect();
    let faces = [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]]
        .iter()
        .flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]])
        .collect();
    TriMesh { vertices, faces }
}

/// Torus about the y axis: `around` × `tube` vertices, ring radius `ring`, tube radius `radius`.
///
/// # Panics
/// Unless both counts are at least 3.
#[must_use]
pub fn torus(ring: f32, radius: f32, around: u32, tube: u32) -> TriMesh {
    assert!(around >= 3 && tube >= 3, "torus: {around} × {tube}, need ≥ 3");
    let angle = |i: u32, n: u32| i as f32 / n as f32 * std::f32::consts::TAU;
    let mut vertices = Vec::new();
    let mut faces = Vec::new();
    for i in 0..around {
        let (sin, cos) = angle(i, around).sin_cos();
        for j in 0..tube {
            let (tube_sin, tube_cos) = angle(j, tube).sin_cos();
            let r = ring + radius * tube_cos;
            vertices.push(Vec3::new(r * cos, radius * tube_sin, r * sin));
            let at = |i: u32, j: u32| (i % around) * tube + j % tube;
            let [a, b, c, d] = [at(i, j), at(i, j + 1), at(i + 1, j + 1), at(i + 1, j)];
            faces.extend([[a, b, c], [a, c, d]]);
        }
    }
    TriMesh { vertices, faces }
}

/// Open sheet on [−1, 1]² in the plane z = 0 with (n+1)² vertices and 2n² faces, normals along +z.
///
/// # Panics
/// If `n` is 0.
#[must_use]
pub fn open_grid(n: u32) -> TriMesh {
    assert!(n > 0, "open_grid: no cells");
    let at = |i: u32| i as f32 / n as f32 * 2.0 - 1.0;
    let mut vertices = Vec::new();
    let mut faces = Vec::new();
    for row in 0..=n {
        for column in 0..=n {
            vertices.push(Vec3::new(at(column), at(row), 0.0));
            if row < n && column < n {
                let a = row * (n + 1) + column;
                let c = a + n + 2;
                faces.extend([[a, a + 1, c], [a, c, c - 1]]);
            }
        }
    }
    TriMesh { vertices, faces }
}
