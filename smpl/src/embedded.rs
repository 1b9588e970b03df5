//! The embedded body.
//!
//! `assets/open_body.bin` is the file that [`BodyModel::save`] writes, as four byte planes (byte k
//! of every 32-bit word, for k from 0 to 3), compressed by zlib. Lengths are multiples of 2⁻¹⁶ m,
//! weights of 2⁻¹⁶. Made from the CC0 file `open_body.npz` by
//! `BLESS=1 cargo test -p smpl --lib the_asset`.

use std::io::Read;

use crate::Error;
use crate::load::parse_saved;
use crate::model::BodyModel;

const PACKED: &[u8] = include_bytes!("../assets/open_body.bin");

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
    pub fn embedded() -> Self {
        let mut planes = Vec::new();
        let body = match flate2::read::ZlibDecoder::new(PACKED).read_to_end(&mut planes) {
            Ok(length) => {
                let bytes: Vec<u8> = (0..length).map(|i| planes[i % 4 * (length / 4) + i / 4]).collect();
                parse_saved("the embedded body", &bytes)
            }
            Err(error) => Err(Error::invalid("the embedded body", "asset", error.to_string())),
        };
        body.unwrap_or_else(|error| panic!("embedded: {error}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sparse::SparseRows;

    /// Units per metre, and of a weight of 1.
    const SCALE: f32 = 65536.0;

    /// Rounds a matrix whose rows sum to 1 to rows that sum to exactly 1: the largest entry absorbs
    /// the rounding.
    fn round_rows(matrix: &mut SparseRows<f32>) {
        for row in matrix.offsets.windows(2) {
            let row = &mut matrix.values[row[0] as usize..row[1] as usize];
            row.iter_mut().for_each(|w| *w = (*w * SCALE).round() / SCALE);
            let rest = 1.0 - row.iter().sum::<f32>();
            if let Some(largest) = row.iter_mut().max_by(|a, b| a.total_cmp(b)) {
                *largest += rest;
            }
        }
    }

    fn rounded(mut body: BodyModel) -> BodyModel {
        let vectors = body.v_template.iter_mut().chain(&mut body.shapedirs).chain(&mut body.posedirs.values);
        vectors.for_each(|v| *v = (*v * SCALE).round() / SCALE);
        round_rows(&mut body.weights);
        round_rows(&mut body.j_regressor);
        body
    }

    #[test]
    fn the_body_is_rounded_as_documented() {
        assert_eq!(rounded(BodyModel::embedded()), BodyModel::embedded());
    }

    /// With `BLESS` set, replaces the asset.
    #[test]
    fn the_asset_is_the_open_body() {
        let Some(path) = testkit::files::shared("body/open_body.npz") else { return };
        let body = rounded(BodyModel::load(&path).unwrap());
        if std::env::var_os("BLESS").is_none() {
            assert_eq!(body, BodyModel::embedded());
            return;
        }
        let saved = std::env::temp_dir().join("open_body.safetensors");
        body.save(&saved).unwrap();
        let bytes = std::fs::read(saved).unwrap();
        assert!(bytes.len().is_multiple_of(4));
        let planes: Vec<u8> = (0..4).flat_map(|k| bytes.iter().skip(k).step_by(4)).copied().collect();
        let mut encoder = flate2::read::ZlibEncoder::new(planes.as_slice(), flate2::Compression::best());
        let mut packed = Vec::new();
        encoder.read_to_end(&mut packed).unwrap();
        std::fs::write(concat!(env!("CARGO_MANIFEST_DIR"), "/assets/open_body.bin"), packed).unwrap();
    }
}
