//! Bodies as safetensors: this crate's own format, bit-exact and fast to read.

use std::path::Path;

use array_files::Error as FileError;
use array_files::tensors::{Tensor, Tensors, write};
use glam::Vec3;

use crate::Error;
use crate::model::BodyModel;
use crate::sparse::SparseRows;

/// Key and value in the header that identify the format and its version.
const FORMAT: (&str, &str) = ("format", "smpl-body 1");

impl BodyModel {
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
    /// What [`BodyModel::validate`] finds; [`Error::File`].
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
        written.map_err(|source| FileError::Io { path: path.to_owned(), source }.into())
    }
}

/// Reads what [`BodyModel::save`] writes.
pub(crate) fn parse(file: &str, bytes: &[u8]) -> Result<BodyModel, Error> {
    let source = Tensors::parse(file, bytes)?;
    let found = source.header(FORMAT.0).unwrap_or("nothing");
    if found != FORMAT.1 {
        return Err(Error::invalid(file, FORMAT.0, format!("{found:?}, expected {:?}", FORMAT.1)));
    }
    let vectors = |key: &str, pattern: &[Option<usize>]| -> Result<Vec<Vec3>, Error> {
        Ok(source.read::<f32>(key, pattern)?.chunks_exact(3).map(Vec3::from_slice).collect())
    };
    let floats = |key: &str| Ok(source.read::<f32>(key, &[None])?);
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
