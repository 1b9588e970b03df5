//! Bodies as safetensors: this crate's own format, bit-exact and fast to read.

use std::collections::HashMap;
use std::io::Write;
use std::path::Path;

use array_files::{Error as FileError, replace_file};
use glam::Vec3;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};

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
    /// body.save(&path).unwrap();
    /// assert_eq!(BodyModel::load(&path).unwrap(), body);
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
        let file = path.display().to_string();
        self.validate(&file)?;
        let (v, j) = (self.num_vertices(), self.num_joints());
        let vectors = |values: &[Vec3]| values.iter().flat_map(|v| v.to_array()).flat_map(f32::to_le_bytes).collect();
        let integers = |values: &[u32]| values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
        let floats = |values: &[f32]| values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
        let parents = self.parents.iter().flat_map(|p| p.map_or(-1, |p| p as i64).to_le_bytes()).collect();
        let mut tensors: Vec<(String, Dtype, Vec<usize>, Vec<u8>)> = vec![
            ("v_template".to_owned(), Dtype::F32, vec![v, 3], vectors(&self.v_template)),
            ("f".to_owned(), Dtype::U32, vec![self.faces.len(), 3], integers(self.faces.as_flattened())),
            ("shapedirs".to_owned(), Dtype::F32, vec![self.num_betas(), v, 3], vectors(&self.shapedirs)),
            ("parents".to_owned(), Dtype::I64, vec![j], parents),
        ];
        let directions = &self.posedirs;
        let entries = vec![directions.values.len(), 3];
        let mut rows = |key: &str, offsets: &[u32], columns: &[u32], shape: Vec<usize>, values: Vec<u8>| {
            tensors.push((format!("{key}.offsets"), Dtype::U32, vec![offsets.len()], integers(offsets)));
            tensors.push((format!("{key}.columns"), Dtype::U32, vec![columns.len()], integers(columns)));
            tensors.push((format!("{key}.values"), Dtype::F32, shape, values));
        };
        rows("posedirs", &directions.offsets, &directions.columns, entries, vectors(&directions.values));
        for (key, sparse) in [("weights", &self.weights), ("J_regressor", &self.j_regressor)] {
            rows(key, &sparse.offsets, &sparse.columns, vec![sparse.values.len()], floats(&sparse.values));
        }
        let fault = |e: safetensors::SafeTensorError| Error::invalid(&file, "header", e.to_string());
        let mut views = Vec::with_capacity(tensors.len());
        for (name, kind, shape, bytes) in &tensors {
            views.push((name.as_str(), TensorView::new(*kind, shape.clone(), bytes).map_err(fault)?));
        }
        let header = HashMap::from([(FORMAT.0.to_owned(), FORMAT.1.to_owned())]);
        let bytes = safetensors::serialize(views, Some(header)).map_err(fault)?;
        let written = replace_file(path, |to| to.write_all(&bytes));
        written.map_err(|source| FileError::Io { path: path.to_owned(), source }.into())
    }
}

/// Reads what [`BodyModel::save`] writes.
pub(crate) fn parse(file: &str, bytes: &[u8]) -> Result<BodyModel, Error> {
    let fault = |e: safetensors::SafeTensorError| Error::invalid(file, "header", e.to_string());
    let (_, header) = SafeTensors::read_metadata(bytes).map_err(fault)?;
    let found = header.metadata().as_ref().and_then(|m| m.get(FORMAT.0)).map_or("nothing", String::as_str);
    if found != FORMAT.1 {
        return Err(Error::invalid(file, FORMAT.0, format!("{found:?}, expected {:?}", FORMAT.1)));
    }
    let source = Source { file, tensors: SafeTensors::deserialize(bytes).map_err(fault)? };
    let v_template = source.vectors("v_template", &[None, Some(3)])?;
    let v = v_template.len();
    let faces = source.words("f", Dtype::U32, &[None, Some(3)], u32::from_le_bytes)?;
    let parents = source.words("parents", Dtype::I64, &[None], i64::from_le_bytes)?;
    let model = BodyModel {
        v_template,
        faces: faces.chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect(),
        shapedirs: source.vectors("shapedirs", &[None, Some(v), Some(3)])?,
        posedirs: source.rows("posedirs", |key| source.vectors(key, &[None, Some(3)]))?,
        weights: source.rows("weights", |key| source.floats(key))?,
        j_regressor: source.rows("J_regressor", |key| source.floats(key))?,
        parents: parents.iter().map(|&p| usize::try_from(p).ok()).collect(),
    };
    model.validate(file)?;
    Ok(model)
}

struct Source<'a> {
    file: &'a str,
    tensors: SafeTensors<'a>,
}

impl Source<'_> {
    /// The tensor `key`, of type `kind` and shape `pattern` (`None`: any size), word by word.
    fn words<const N: usize, T>(
        &self,
        key: &str,
        kind: Dtype,
        pattern: &[Option<usize>],
        word: fn([u8; N]) -> T,
    ) -> Result<Vec<T>, Error> {
        let missing = || {
            let mut names = self.tensors.names();
            names.sort_unstable();
            FileError::missing(self.file, key, names)
        };
        let view = self.tensors.tensor(key).map_err(|_| missing())?;
        if view.dtype() != kind {
            return Err(Error::invalid(self.file, key, format!("{:?}, expected {kind:?}", view.dtype())));
        }
        let shape = view.shape();
        if shape.len() != pattern.len() || shape.iter().zip(pattern).any(|(n, p)| p.is_some_and(|p| p != *n)) {
            return Err(FileError::shape(self.file, key, shape, pattern).into());
        }
        Ok(view.data().as_chunks::<N>().0.iter().map(|&bytes| word(bytes)).collect())
    }

    fn floats(&self, key: &str) -> Result<Vec<f32>, Error> {
        self.words(key, Dtype::F32, &[None], f32::from_le_bytes)
    }

    fn vectors(&self, key: &str, pattern: &[Option<usize>]) -> Result<Vec<Vec3>, Error> {
        let values = self.words(key, Dtype::F32, pattern, f32::from_le_bytes)?;
        Ok(values.chunks_exact(3).map(Vec3::from_slice).collect())
    }

    fn rows<T>(&self, key: &str, values: impl Fn(&str) -> Result<Vec<T>, Error>) -> Result<SparseRows<T>, Error> {
        let words = |part: &str| self.words(&format!("{key}.{part}"), Dtype::U32, &[None], u32::from_le_bytes);
        let (offsets, columns) = (words("offsets")?, words("columns")?);
        Ok(SparseRows { offsets, columns, values: values(&format!("{key}.values"))? })
    }
}
