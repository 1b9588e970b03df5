//! The clothed person: a finer mesh than the body's, stood off it by the clothes, that follows the
//! body's bones.

use std::collections::HashMap;

use glam::Vec3;
use smpl::{BodyModel, Posed, Shaped, SparseRows};

use super::landmarks::Landmarks;
use super::outfit::{Outfit, Sheet};

/// A person at rest, ready to be posed.
pub(super) struct Person {
    pub landmarks: Landmarks,
    /// Triangles of the finer mesh.
    pub faces: Vec<[u32; 3]>,
    /// The first of `faces` that is not the body's.
    pub sheets: usize,
    /// Places on the naked body at rest, or on a sheet, one a vertex: what colours are looked up
    /// by.
    pub rest: Vec<Vec3>,
    /// `rest` with the clothes on.
    clothed: Vec<Vec3>,
    /// The two vertices of the body's mesh that a vertex lies halfway between; the same twice for
    /// an old one; none of sheets.
    ends: Vec<[u32; 2]>,
    weights: SparseRows<f32>,
}

/// Faces split in four at the midpoints of their edges, and the vertices that each new vertex lies
/// between.
fn subdivide(vertices: usize, faces: &[[u32; 3]]) -> (Vec<[u32; 3]>, Vec<[u32; 2]>) {
    let mut ends: Vec<[u32; 2]> = (0..vertices as u32).map(|v| [v, v]).collect();
    let mut middles: HashMap<[u32; 2], u32> = HashMap::new();
    let mut finer = Vec::with_capacity(faces.len() * 4);
    for &[a, b, c] in faces {
        let [ab, bc, ca] = [[a, b], [b, c], [c, a]].map(|[i, j]| {
            let edge = [i.min(j), i.max(j)];
            *middles.entry(edge).or_insert_with(|| {
                ends.push(edge);
                ends.len() as u32 - 1
            })
        });
        finer.extend([[a, ab, ca], [b, bc, ab], [c, ca, bc], [ab, bc, ca]]);
    }
    (finer, ends)
}

impl Person {
    /// Dresses `shaped`, a body of `model` in SMPL's T-pose, with flat hands or fists.
    pub fn new(model: &BodyModel, shaped: &Shaped, outfit: Outfit, fist: bool) -> Self {
        let landmarks = Landmarks::new(shaped);
        let (mut faces, ends) = subdivide(shaped.vertices.len(), &model.faces);
        let mut rest: Vec<Vec3> =
            ends.iter().map(|[a, b]| shaped.vertices[*a as usize].midpoint(shaped.vertices[*b as usize])).collect();
        let normals = surface_query::vertex_normals(&rest, &faces);
        let mut clothed: Vec<Vec3> = rest
            .iter()
            .zip(&normals)
            .map(|(&p, &n)| p + n * (landmarks.thickness(landmarks.figure(p)) * landmarks.unit))
            .collect();
        if fist {
            clothed.iter_mut().for_each(|v| *v = landmarks.rest(landmarks.fist(landmarks.figure(*v))));
        }
        let sheet = Sheet::new(outfit, &landmarks);
        let (sheets, first) = (faces.len(), rest.len() as u32);
        faces.extend(sheet.faces.iter().map(|face| face.map(|v| first + v)));
        rest.extend(sheet.places.iter().map(|&q| landmarks.rest(q)));
        clothed.extend_from_slice(&rest[first as usize..]);
        let of_body = ends.iter().map(|[a, b]| {
            let mut row: Vec<(u32, f32)> = Vec::new();
            for v in [*a, *b] {
                for (joint, w) in model.weights.row(v as usize) {
                    match row.iter_mut().find(|(j, _)| *j == joint as u32) {
                        Some((_, sum)) => *sum += 0.5 * w,
                        None => row.push((joint as u32, 0.5 * w)),
                    }
                }
            }
            row.sort_unstable_by_key(|(joint, _)| *joint);
            row
        });
        let weights = SparseRows::from_rows(of_body.chain(sheet.weights));
        Self { landmarks, faces, sheets, rest, clothed, ends, weights }
    }

    /// Vertices of the clothed mesh under the bones of `posed`, the same body posed.
    pub fn posed(&self, posed: &Posed) -> Vec<Vec3> {
        let offset = |v: u32| posed.pose_offsets[v as usize];
        let bent = self.ends.iter().map(|&[a, b]| offset(a).midpoint(offset(b))).chain(std::iter::repeat(Vec3::ZERO));
        let bent: Vec<Vec3> = self.clothed.iter().zip(bent).map(|(clothed, bent)| clothed + bent).collect();
        smpl::skin(&bent, &self.weights, &posed.bones)
    }
}
