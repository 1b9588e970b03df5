//! Body models from files, and this crate's own: safetensors, bit-exact and fast to read.

use std::path::Path;

use array_files::npz::Npz;
use array_files::pickle::{self, Value};
use array_files::tensors::{Tensor, Tensors, write};
use array_files::{NdArray, read_file};
use glam::Vec3;

use crate::Error;
use crate::model::{BodyModel, TERMS_PER_JOINT};
use crate::sparse::SparseRows;

/// Key and value in the header that identify the saved format and its version.
const FORMAT: (&str, &str) = ("format", "smpl-body 1");

impl BodyModel {
    /// Reads a body in SMPL's form: an `.npz`, a `.pkl` in the style of the original release
    /// (chumpy arrays, sparse regressor), or this crate's own `.safetensors` ([`BodyModel::save`],
    /// which has an example). The format is recognised by the first bytes, else by the extension.
    /// Nothing in a pickle is executed.
    ///
    /// An npz or pickle needs `v_template` (V,3), `f` (F,3), `weights` (V,J), `J_regressor` (J,V),
    /// `kintree_table` (2,J), `shapedirs` (V,3,B) and `posedirs` (V,3,9(J−1)), for any J and B:
    /// SMPL (24), SMPL-H (52) and SMPL-X (55; B includes the expressions). Other arrays and the
    /// root's parent are ignored.
    ///
    /// # Errors
    /// Any [`Error`]; errors of the content name the array.
    pub fn load(path: &Path) -> Result<Self, Error> {
        let file = path.display().to_string();
        let extension = path.extension().and_then(|e| e.to_str()).unwrap_or("").to_ascii_lowercase();
        let known = ["npz", "pkl", "safetensors"].into_iter().find(|e| *e == extension);
        let bytes = read_file(path)?;
        match kind(&bytes).or(known) {
            Some("npz") => {
                let mut npz = Npz::from_bytes(&file, bytes)?;
                build(&file, |key| npz.array(key))
            }
            Some("safetensors") => parse_saved(&file, &bytes),
            Some(_) => {
                let value = pickle::parse(&file, &bytes)?;
                build(&file, |key| from_pickle(&file, &value, key))
            }
            None => {
                let message = "unknown kind of file (expected .npz, .pkl or .safetensors)";
                Err(Error::invalid(&file, "", message))
            }
        }
    }

    /// Writes the model as `.safetensors`, which [`BodyModel::load`] reads back bit for bit. The
    /// file is replaced atomically.
    ///
    /// ```
    /// use smpl::BodyModel;
    ///
    /// let path = std::env::temp_dir().join("smpl_save_example.safetensors");
    /// let body = BodyModel::embedded();
    /// body.save(&path)?;
    /// assert_eq!(BodyModel::load(&path)?, body);
    /// # std::fs::remove_file(&path).unwrap();
    /// # Ok::<(), smpl::Error>(())
    /// ```
    ///
    /// The header says `format: smpl-body 1`. Tensors: `v_template` (V,3), `f` (F,3), `shapedirs`
    /// (B,V,3), `parents` (J) with −1 for the root; `posedirs`, `weights` and `J_regressor` as
    /// compressed sparse rows, in three parts each: `.offsets`, `.columns` and `.values`. Equal
    /// models give equal files.
    ///
    /// # Errors
    /// What [`BodyModel::validate`] finds; [`Error::Io`].
    pub fn save(&self, path: &Path) -> Result<(), Error> {
        self.validate(&path.display().to_string())?;
        let (v, j) = (self.num_vertices(), self.num_joints());
        let parents: Vec<i64> = self.parents.iter().map(|parent| parent.map_or(-1, |p| p as i64)).collect();
        let mut tensors = vec![
            Tensor::new("v_template", &[v, 3], flat(&self.v_template)),
            Tensor::new("f", &[self.faces.len(), 3], self.faces.as_flattened()),
            Tensor::new("shapedirs", &[self.num_betas(), v, 3], flat(&self.shapedirs)),
            Tensor::new("parents", &[j], parents),
            Tensor::new("posedirs.values", &[self.posedirs.values.len(), 3], flat(&self.posedirs.values)),
            Tensor::new("weights.values", &[self.weights.values.len()], &self.weights.values[..]),
            Tensor::new("J_regressor.values", &[self.j_regressor.values.len()], &self.j_regressor.values[..]),
        ];
        for (key, offsets, columns) in [
            ("posedirs", &self.posedirs.offsets, &self.posedirs.columns),
            ("weights", &self.weights.offsets, &self.weights.columns),
            ("J_regressor", &self.j_regressor.offsets, &self.j_regressor.columns),
        ] {
            for (part, words) in [("offsets", offsets), ("columns", columns)] {
                tensors.push(Tensor::new(format!("{key}.{part}"), &[words.len()], &words[..]));
            }
        }
        let written = write(path, &[(FORMAT.0, FORMAT.1.to_owned())].into(), tensors);
        written.map_err(|source| Error::Io { path: path.to_owned(), source })
    }
}

/// Extension of the format recognised by its first bytes: zip, safetensors (length and opening
/// brace of the header), or a pickle of protocol 2 or later.
fn kind(bytes: &[u8]) -> Option<&'static str> {
    match bytes {
        [b'P', b'K', 3 | 5, 4 | 6, ..] => Some("npz"),
        [_, _, _, _, 0, 0, 0, 0, b'{', ..] => Some("safetensors"),
        [0x80, 2..=5, ..] => Some("pkl"),
        _ => None,
    }
}

/// The array under `key` of the model's dictionary, made dense.
fn from_pickle(file: &str, value: &Value, key: &str) -> Result<NdArray, Error> {
    let Value::Dict(entries) = value else {
        return Err(Error::invalid(file, "", format!("{}, expected a dictionary", value.type_name())));
    };
    let present = || entries.iter().filter_map(|(key, _)| key.as_str());
    let found = value.get(key).ok_or_else(|| Error::missing(file, key, present()))?;
    let other = || Error::invalid(file, key, format!("{}, expected an array", found.type_name()));
    found.to_dense(file, key)?.ok_or_else(other)
}

fn build(file: &str, mut array: impl FnMut(&str) -> Result<NdArray, Error>) -> Result<BodyModel, Error> {
    let v_template = array("v_template")?.to_f32(file, "v_template", &[None, Some(3)])?;
    let v = v_template.len() / 3;

    let kintree = array("kintree_table")?.to_i64(file, "kintree_table", &[Some(2), None])?;
    let j = kintree.len() / 2;
    let parents = parents(file, &kintree)?;

    let faces = array("f")?.to_i64(file, "f", &[None, Some(3)])?;
    let faces =
        faces.iter().map(|&i| u32::try_from(i).map_err(|_| Error::invalid(file, "f", format!("vertex index {i}"))));
    let faces: Vec<u32> = faces.collect::<Result<_, _>>()?;

    let weights = array("weights")?.to_f32(file, "weights", &[Some(v), Some(j)])?;
    let regressor = array("J_regressor")?.to_f32(file, "J_regressor", &[Some(j), Some(v)])?;
    let shapedirs = array("shapedirs")?.to_f32(file, "shapedirs", &[Some(v), Some(3), None])?;
    let terms = TERMS_PER_JOINT * (j - 1);
    let pattern = [Some(v), Some(3), Some(terms)];
    let posedirs = array("posedirs")?.to_f32(file, "posedirs", &pattern)?;

    let b = shapedirs.len() / (3 * v).max(1);
    let shapedirs = (0..b * v)
        .map(|i| {
            let (beta, vertex) = (i / v, i % v);
            Vec3::from([0, 1, 2].map(|axis| shapedirs[(3 * vertex + axis) * b + beta]))
        })
        .collect();
    let posedirs = SparseRows::from_rows((0..v).map(|vertex| {
        let axis = |axis: usize| &posedirs[(3 * vertex + axis) * terms..][..terms];
        let (x, y, z) = (axis(0), axis(1), axis(2));
        (0..terms)
            .map(|t| (t as u32, Vec3::new(x[t], y[t], z[t])))
            .filter(|(_, d)| *d != Vec3::ZERO)
            .collect::<Vec<_>>()
    }));
    let model = BodyModel {
        v_template: triples(&v_template).map(Vec3::from).collect(),
        faces: triples(&faces).collect(),
        shapedirs,
        posedirs,
        weights: sparse(&weights, j),
        j_regressor: sparse(&regressor, v),
        parents,
    };
    model.validate(file)?;
    Ok(model)
}

/// Parents from the two rows of `kintree_table`, parent and joint.
fn parents(file: &str, kintree: &[i64]) -> Result<Vec<Option<usize>>, Error> {
    let (parents, joints) = kintree.split_at(kintree.len() / 2);
    let invalid = |message| Err(Error::invalid(file, "kintree_table", message));
    if joints.is_empty() {
        return invalid("no joints".to_owned());
    }
    if let Some(i) = (0..joints.len()).find(|&i| joints[i] != i as i64) {
        return invalid(format!("column {i} is for joint {}", joints[i]));
    }
    Ok(std::iter::once(None).chain(parents[1..].iter().map(|&p| usize::try_from(p).ok())).collect())
}

fn triples<T: Copy>(values: &[T]) -> impl Iterator<Item = [T; 3]> + '_ {
    values.chunks_exact(3).map(|c| [c[0], c[1], c[2]])
}

/// The non-zero entries of a dense matrix.
fn sparse(dense: &[f32], columns: usize) -> SparseRows<f32> {
    SparseRows::from_rows(dense.chunks_exact(columns.max(1)).map(|row| {
        let entries = row.iter().enumerate().filter(|(_, w)| **w != 0.0);
        entries.map(|(i, &w)| (i as u32, w))
    }))
}

/// Reads what [`BodyModel::save`] writes.
pub(crate) fn parse_saved(file: &str, bytes: &[u8]) -> Result<BodyModel, Error> {
    let source = Tensors::parse(file, bytes)?;
    let found = source.header(FORMAT.0).unwrap_or("nothing");
    if found != FORMAT.1 {
        return Err(Error::invalid(file, FORMAT.0, format!("{found:?}, expected {:?}", FORMAT.1)));
    }
    let vectors = |key: &str, pattern: &[Option<usize>]| -> Result<Vec<Vec3>, Error> {
        Ok(source.read::<f32>(key, pattern)?.chunks_exact(3).map(Vec3::from_slice).collect())
    };
    let floats = |key: &str| source.read::<f32>(key, &[None]);
    let v_template = vectors("v_template", &[None, Some(3)])?;
    let v = v_template.len();
    let parents = source.read::<i64>("parents", &[None])?;
    let model = BodyModel {
        v_template,
        faces: source.read::<u32>("f", &[None, Some(3)])?.as_chunks().0.to_vec(),
        shapedirs: vectors("shapedirs", &[None, Some(v), Some(3)])?,
        posedirs: rows(&source, "posedirs", |key| vectors(key, &[None, Some(3)]))?,
        weights: rows(&source, "weights", floats)?,
        j_regressor: rows(&source, "J_regressor", floats)?,
        parents: parents.iter().map(|&p| usize::try_from(p).ok()).collect(),
    };
    model.validate(file)?;
    Ok(model)
}

fn rows<T>(
    source: &Tensors<'_>,
    key: &str,
    values: impl Fn(&str) -> Result<Vec<T>, Error>,
) -> Result<SparseRows<T>, Error> {
    let [offsets, columns] = ["offsets", "columns"].map(|part| source.read(&format!("{key}.{part}"), &[None]));
    Ok(SparseRows { offsets: offsets?, columns: columns?, values: values(&format!("{key}.values"))? })
}

fn flat(values: &[Vec3]) -> Vec<f32> {
    values.iter().flat_map(|v| v.to_array()).collect()
}
