//! The embedded body and its file format.
//!
//! `assets/open_body.bin` is a zlib stream of zigzag-coded 32-bit integers, stored as four byte
//! planes, least significant first. Lengths are in units of 2⁻¹⁶ m and weights of 2⁻¹⁶; rows of
//! weights sum to exactly 1. In order: V, F, J, B; template, (3, V); faces, (F, 3); shape blend
//! shapes, (3, B·V); parents, (J), −1 for the root; pose blend shapes, skinning weights and joint
//! regressor as sparse rows: length of each row, columns, values ((3, N) for vectors).
//!
//! Made from an SMPL-format npz by
//! `OPEN_BODY=open_body.npz cargo test -p smpl --lib write_the_asset -- --ignored`.

use std::io::Read;

use glam::Vec3;

use crate::model::BodyModel;
use crate::sparse::SparseRows;

const PACKED: &[u8] = include_bytes!("../assets/open_body.bin");
/// Units per metre, and of a weight of 1.
const SCALE: f32 = 65536.0;

impl BodyModel {
    /// A neutral adult that needs no file: the CC0 *open body*, with SMPL's counts of vertices
    /// (6890), faces (13 776), joints (24, in SMPL's order) and betas (10).
    ///
    /// T-pose, metres, y up, facing +z, 1.66 m tall, closed, mirror-symmetric. Derived from
    /// MakeHuman's base mesh hm08, its default rig, weights and macro targets, all of them CC0: no
    /// part of SMPL is in it, and its vertices are not in SMPL's order. Betas, plausible within
    /// ±2: 0 height, 1 weight, 2 female to male, 3 muscle, 4 proportions, 5 to 6 ancestry, 7 torso
    /// width, 8 leg length, 9 arm length and thickness. Pose blend shapes are fitted to the
    /// difference between dual-quaternion and linear skinning. Coordinates are rounded to 15 µm.
    ///
    /// Each call decodes the asset, some ten milliseconds: keep the result.
    ///
    /// ```
    /// let body = smpl::BodyModel::embedded();
    /// assert_eq!((body.num_vertices(), body.num_joints(), body.num_betas()), (6890, 24, 10));
    /// ```
    #[must_use]
    pub fn embedded() -> Self {
        let mut words = Words::unpack(PACKED);
        let sizes = words.take(4);
        let [v, f, j, b] = [0, 1, 2, 3].map(|i| sizes[i] as usize);
        Self {
            v_template: words.vectors(v),
            faces: words.take(3 * f).chunks_exact(3).map(|c| [c[0] as u32, c[1] as u32, c[2] as u32]).collect(),
            shapedirs: words.vectors(b * v),
            parents: words.take(j).into_iter().map(|p| usize::try_from(p).ok()).collect(),
            posedirs: words.rows(v, Words::vectors),
            weights: words.rows(v, Words::scaled),
            j_regressor: words.rows(j, Words::scaled),
        }
    }
}

/// The remaining integers of the asset.
struct Words(std::vec::IntoIter<i32>);

impl Words {
    fn unpack(packed: &[u8]) -> Self {
        let mut planes = Vec::new();
        let read = flate2::read::ZlibDecoder::new(packed).read_to_end(&mut planes);
        assert!(read.is_ok(), "embedded: the asset is damaged: {read:?}");
        let count = planes.len() / 4;
        let word = |i: usize| {
            let zigzag = u32::from_le_bytes([0, 1, 2, 3].map(|k| planes[k * count + i]));
            (zigzag >> 1) as i32 ^ -((zigzag & 1) as i32)
        };
        Self((0..count).map(word).collect::<Vec<i32>>().into_iter())
    }

    fn take(&mut self, count: usize) -> Vec<i32> {
        self.0.by_ref().take(count).collect()
    }

    fn scaled(&mut self, count: usize) -> Vec<f32> {
        self.0.by_ref().take(count).map(|w| w as f32 / SCALE).collect()
    }

    fn vectors(&mut self, count: usize) -> Vec<Vec3> {
        let [x, y, z] = [0; 3].map(|_| self.scaled(count));
        (0..count).map(|i| Vec3::new(x[i], y[i], z[i])).collect()
    }

    fn rows<T>(&mut self, count: usize, values: fn(&mut Self, usize) -> Vec<T>) -> SparseRows<T> {
        let mut offsets = vec![0u32];
        for length in self.0.by_ref().take(count) {
            offsets.push(offsets[offsets.len() - 1] + length as u32);
        }
        let columns: Vec<u32> = (self.0.by_ref()).take(offsets[count] as usize).map(|c| c as u32).collect();
        let values = values(self, columns.len());
        SparseRows { offsets, columns, values }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Quantises `values`, which sum to 1, to integers that sum to [`SCALE`]: the largest absorbs
    /// the rounding.
    fn units(values: &[f32]) -> Vec<i32> {
        let mut words: Vec<i32> = values.iter().map(|x| (x * SCALE).round() as i32).collect();
        let rest = SCALE as i32 - words.iter().sum::<i32>();
        if let Some(largest) = words.iter_mut().max() {
            *largest += rest;
        }
        words
    }

    /// The integers of the file, before zigzag coding.
    fn words(body: &BodyModel) -> Vec<i32> {
        let size = |n: usize| n as i32;
        let vectors = |values: &[Vec3]| {
            let axis = |k: usize| values.iter().map(move |v| (v[k] * SCALE).round() as i32);
            (0..3).flat_map(axis).collect::<Vec<i32>>()
        };
        fn structure<T: Copy>(rows: &SparseRows<T>) -> Vec<i32> {
            let lengths = rows.offsets.windows(2).map(|w| (w[1] - w[0]) as i32);
            lengths.chain(rows.columns.iter().map(|&c| c as i32)).collect()
        }
        let mut out = [body.num_vertices(), body.faces.len(), body.num_joints(), body.num_betas()].map(size).to_vec();
        out.extend(vectors(&body.v_template));
        out.extend(body.faces.as_flattened().iter().map(|&i| i as i32));
        out.extend(vectors(&body.shapedirs));
        out.extend(body.parents.iter().map(|p| p.map_or(-1, size)));
        out.extend(structure(&body.posedirs));
        out.extend(vectors(&body.posedirs.values));
        for matrix in [&body.weights, &body.j_regressor] {
            out.extend(structure(matrix));
            for row in matrix.offsets.windows(2) {
                out.extend(units(&matrix.values[row[0] as usize..row[1] as usize]));
            }
        }
        out
    }

    #[test]
    fn a_decoded_body_has_the_words_it_was_decoded_from() {
        assert_eq!(words(&BodyModel::embedded()), Words::unpack(PACKED).0.as_slice());
    }

    #[test]
    #[ignore = "replaces the asset by the body that OPEN_BODY names"]
    fn write_the_asset() {
        let path = std::env::var("OPEN_BODY").unwrap();
        let words = words(&BodyModel::load(path.as_ref()).unwrap());
        let zigzag = |w: i32| (w.wrapping_shl(1) ^ (w >> 31)).to_le_bytes();
        let planes = (0..4).flat_map(|k| words.iter().map(move |&w| zigzag(w)[k])).collect::<Vec<u8>>();
        let mut encoder = flate2::read::ZlibEncoder::new(planes.as_slice(), flate2::Compression::best());
        let mut packed = Vec::new();
        encoder.read_to_end(&mut packed).unwrap();
        std::fs::write(concat!(env!("CARGO_MANIFEST_DIR"), "/assets/open_body.bin"), packed).unwrap();
    }
}
