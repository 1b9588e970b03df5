//! Subdivision of the canonical prior: four triangles for one.

use std::collections::HashMap;

use glam::Vec3;

/// A point of the prior: vertices of one face, ascending, with their weights.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Anchor {
    pub corners: [u32; 3],
    pub weights: [f32; 3],
}

impl Anchor {
    pub fn vertex(v: u32) -> Self {
        Self { corners: [v; 3], weights: [1.0, 0.0, 0.0] }
    }

    /// Halfway between two points of one face.
    fn middle(a: &Self, b: &Self) -> Self {
        let mut terms: Vec<(u32, f32)> = Vec::with_capacity(6);
        for anchor in [a, b] {
            for (v, w) in anchor.terms() {
                match terms.iter_mut().find(|(other, _)| *other == v) {
                    Some((_, sum)) => *sum += 0.5 * w,
                    None => terms.push((v, 0.5 * w)),
                }
            }
        }
        terms.sort_by_key(|&(v, _)| v);
        let mut middle = Self::vertex(terms.first().map_or(0, |t| t.0));
        for (i, &(v, w)) in terms.iter().take(3).enumerate() {
            (middle.corners[i], middle.weights[i]) = (v, w);
        }
        middle
    }

    /// Vertices that count, with their weights.
    pub fn terms(&self) -> impl Iterator<Item = (u32, f32)> + use<> {
        self.corners.into_iter().zip(self.weights).filter(|&(_, w)| w > 0.0)
    }

    /// A quantity of the vertices, interpolated.
    pub fn mix(&self, values: &[Vec3]) -> Vec3 {
        self.terms().map(|(v, w)| w * values[v as usize]).sum()
    }
}

/// A subdivided mesh.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Subdivided {
    /// (V)
    pub anchors: Vec<Anchor>,
    /// (F)
    pub faces: Vec<[u32; 3]>,
    /// The face of the prior that each face is part of, (F).
    pub parents: Vec<u32>,
    times: u32,
}

impl Subdivided {
    /// Puts four faces, of equal area, in the place of each, `times` over. Vertices of the prior
    /// keep their indices.
    pub fn new(vertices: usize, faces: &[[u32; 3]], times: u32) -> Self {
        let mut mesh = Self {
            anchors: (0..vertices as u32).map(Anchor::vertex).collect(),
            faces: faces.to_vec(),
            parents: (0..faces.len() as u32).collect(),
            times,
        };
        for _ in 0..times {
            let mut middles: HashMap<(u32, u32), u32> = HashMap::with_capacity(mesh.faces.len() * 3 / 2);
            let mut finer = Vec::with_capacity(4 * mesh.faces.len());
            for &[a, b, c] in &mesh.faces {
                let anchors = &mut mesh.anchors;
                let mut middle = |a: u32, b: u32| {
                    *middles.entry((a.min(b), a.max(b))).or_insert_with(|| {
                        anchors.push(Anchor::middle(&anchors[a as usize], &anchors[b as usize]));
                        anchors.len() as u32 - 1
                    })
                };
                let (ab, bc, ca) = (middle(a, b), middle(b, c), middle(c, a));
                finer.extend([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]);
            }
            mesh.faces = finer;
            mesh.parents = mesh.parents.iter().flat_map(|&parent| [parent; 4]).collect();
        }
        mesh
    }

    /// Number of subdivisions.
    pub fn times(&self) -> u32 {
        self.times
    }

    /// The face that a point of a `face` of the prior lies in, and its weights of that face's
    /// corners.
    pub fn locate(&self, face: u32, barycentric: [f32; 3]) -> (u32, [f32; 3]) {
        let divide = |(face, [a, b, c]): (u32, [f32; 3]), _| {
            let (first, [a, b, c]) = (4 * face, [2.0 * a, 2.0 * b, 2.0 * c]);
            if a > 1.0 {
                (first, [a - 1.0, b, c])
            } else if b > 1.0 {
                (first + 1, [a, b - 1.0, c])
            } else if c > 1.0 {
                (first + 2, [a, b, c - 1.0])
            } else {
                (first + 3, [1.0 - c, 1.0 - a, 1.0 - b])
            }
        };
        (0..self.times).fold((face, barycentric), divide)
    }
}

/// Most faces that colours are measured on.
const MOST_FACES: usize = 1 << 20;

/// Subdivisions that keep a mesh within [`MOST_FACES`].
pub(crate) fn most_times(faces: usize) -> u32 {
    (1..10).take_while(|times| faces <= MOST_FACES >> (2 * times)).count() as u32
}

/// How often a mesh must be subdivided for its mean edge to be no longer than `longest`, up to
/// `most`: each time makes four times the faces.
pub(crate) fn times_until(vertices: &[Vec3], faces: &[[u32; 3]], longest: f32, most: u32) -> u32 {
    let edges = faces.iter().map(|face| {
        let [a, b, c] = face.map(|v| vertices[v as usize]);
        f64::from(a.distance(b) + b.distance(c) + c.distance(a)) / 3.0
    });
    let mean = edges.sum::<f64>() as f32 / faces.len().max(1) as f32;
    (0..most).find(|&times| mean / 2f32.powi(times as i32) <= longest).unwrap_or(most)
}

/// Unit normals of vertices: the area-weighted sum of those of the faces about them, zero where
/// there are none.
pub(crate) fn normals(vertices: &[Vec3], faces: &[[u32; 3]]) -> Vec<Vec3> {
    let mut sums = vec![Vec3::ZERO; vertices.len()];
    for face in faces {
        let [a, b, c] = face.map(|v| vertices[v as usize]);
        let normal = (b - a).cross(c - a);
        face.iter().for_each(|&v| sums[v as usize] += normal);
    }
    sums.into_iter().map(Vec3::normalize_or_zero).collect()
}

/// Vertices that share an edge with each, ascending.
pub(crate) fn neighbours(vertices: usize, faces: &[[u32; 3]]) -> Vec<Vec<u32>> {
    let mut lists: Vec<Vec<u32>> = vec![Vec::with_capacity(8); vertices];
    for &[a, b, c] in faces {
        for (from, to) in [(a, b), (b, c), (c, a), (b, a), (c, b), (a, c)] {
            lists[from as usize].push(to);
        }
    }
    for list in &mut lists {
        list.sort_unstable();
        list.dedup();
    }
    lists
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn a_place_of_the_prior_is_found_in_the_face_that_it_lies_in(
            face in 0u32..20, a in 0.0f32..=1.0, b in 0.0f32..=1.0, times in 0u32..4, snap in 0u32..4,
        ) {
            let ball = testkit::mesh::icosphere(0);
            // On edges and corners of finer faces as well.
            let snapped = |x: f32| if snap == 0 { x } else { (x * 8.0).round() / 8.0 };
            let (a, b) = (snapped(a), snapped(b));
            let barycentric = if a + b > 1.0 { [1.0 - a, 1.0 - b, a + b - 1.0] } else { [a, b, 1.0 - a - b] };
            let fine = Subdivided::new(ball.vertices.len(), &ball.faces, times);
            let (found, weights) = fine.locate(face, barycentric);
            prop_assert_eq!(fine.parents[found as usize], face);
            prop_assert!(weights.iter().all(|w| (-1e-5..=1.0 + 1e-5).contains(w)), "{weights:?}");
            let corner = |v: u32| fine.anchors[v as usize].mix(&ball.vertices);
            let at: Vec3 = fine.faces[found as usize].into_iter().zip(weights).map(|(v, w)| w * corner(v)).sum();
            let corners = ball.faces[face as usize].into_iter().zip(barycentric);
            let expected: Vec3 = corners.map(|(v, w)| w * ball.vertices[v as usize]).sum();
            prop_assert!(at.distance(expected) < 1e-5, "{at}, expected {expected}");
        }
    }

    #[test]
    fn a_subdivided_sphere_has_four_times_the_faces_and_the_same_shape() {
        let ball = testkit::mesh::icosphere(1);
        let fine = Subdivided::new(ball.vertices.len(), &ball.faces, 2);
        assert_eq!((fine.faces.len(), fine.anchors.len()), (16 * ball.faces.len(), 8 * ball.faces.len() + 2));
        let vertices: Vec<Vec3> = fine.anchors.iter().map(|anchor| anchor.mix(&ball.vertices)).collect();
        let mesh = testkit::TriMesh { vertices, faces: fine.faces.clone() };
        assert!(mesh.is_closed() && (mesh.volume() - ball.volume()).abs() < 1e-5);
        for (face, &parent) in fine.faces.iter().zip(&fine.parents) {
            let corners = ball.faces[parent as usize];
            for &v in face {
                let anchor = &fine.anchors[v as usize];
                assert!(anchor.terms().all(|(v, _)| corners.contains(&v)));
                assert!((anchor.weights.iter().sum::<f32>() - 1.0).abs() < 1e-6);
            }
        }
    }
}
