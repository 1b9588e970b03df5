//! Texts, and values of an estimator's file; errors name the file and the path of keys.

use std::path::Path;

use array_files::NdArray;
use array_files::npz::{Npz, read_npy};
use array_files::pickle::Value;
use glam::{DMat3, DVec3};

use crate::CaptureError;
use crate::files::read_text;

/// Largest |R Rᵀ − I| of a rotation matrix: estimators write `f32`, EasyMocap a few decimals.
const ORTHONORMAL: f64 = 1e-2;

/// Largest text: COLMAP's images.txt has some 100 kilobytes a picture.
const MAX_TEXT: u64 = 256 << 20;

/// Reads a text file.
pub(super) fn text(path: &Path) -> Result<String, CaptureError> {
    read_text(path, MAX_TEXT)
}

/// A value and its path of keys.
#[derive(Clone)]
pub(super) struct Item<'a> {
    pub path: &'a Path,
    pub key: String,
    pub value: &'a Value,
}

impl<'a> Item<'a> {
    pub fn new(path: &'a Path, value: &'a Value) -> Self {
        Self { path, key: String::new(), value }
    }

    pub fn invalid(&self, expected: impl Into<String>, actual: impl Into<String>) -> CaptureError {
        let key = if self.key.is_empty() { "the file" } else { &self.key };
        CaptureError::invalid(self.path, key, expected, actual)
    }

    fn below(&self, name: &str, value: &'a Value) -> Item<'a> {
        let key = if self.key.is_empty() { name.to_owned() } else { format!("{}.{name}", self.key) };
        Item { path: self.path, key, value }
    }

    /// The value under `name`, if there is one.
    pub fn find(&self, name: &str) -> Option<Item<'a>> {
        self.value.get(name).filter(|value| **value != Value::None).map(|value| self.below(name, value))
    }

    /// The value under `name`.
    pub fn get(&self, name: &str) -> Result<Item<'a>, CaptureError> {
        self.find(name).ok_or_else(|| {
            let held: Vec<&str> = match self.value {
                Value::Dict(items) => items.iter().filter_map(|(k, _)| k.as_str()).take(20).collect(),
                _ => Vec::new(),
            };
            let found = if held.is_empty() { self.value.type_name().to_owned() } else { held.join(", ") };
            self.below(name, self.value).invalid("this key", format!("none (there is {found})"))
        })
    }

    /// Names and values of a dictionary; names that are numbers are written as such.
    pub fn entries(&self) -> Result<Vec<(String, Item<'a>)>, CaptureError> {
        let Value::Dict(entries) = self.value else {
            return Err(self.invalid("a dictionary", self.value.type_name()));
        };
        let named = |(key, value): &'a (Value, Value)| {
            let name = match (key, key.as_array()) {
                (Value::Str(text), _) => text.clone(),
                (Value::Int(number), _) => number.to_string(),
                (_, Some(array)) if array.len() == 1 => format!("{}", array.to_f64()[0]),
                _ => return Err(self.invalid("names or numbers as keys", key.type_name())),
            };
            Ok((name.clone(), self.below(&name, value)))
        };
        entries.iter().map(named).collect()
    }

    /// The items of a list.
    pub fn list(&self) -> Result<Vec<Item<'a>>, CaptureError> {
        let items = self.value.items().ok_or_else(|| self.invalid("a list", self.value.type_name()))?;
        let item = |(i, value)| Item { path: self.path, key: format!("{}[{i}]", self.key), value };
        Ok(items.iter().enumerate().map(item).collect())
    }

    /// Entry `i` of the list under `name`.
    pub fn entry(&self, name: &str, i: usize) -> Result<Item<'a>, CaptureError> {
        let list = self.get(name)?;
        let items = list.value.items().ok_or_else(|| list.invalid("a list", list.value.type_name()))?;
        let short = || list.invalid(format!("an entry {i}, one a track"), format!("{} entries", items.len()));
        let value = items.get(i).ok_or_else(short)?;
        Ok(Item { path: list.path, key: format!("{}[{i}]", list.key), value })
    }

    pub fn array(&self) -> Result<&'a NdArray, CaptureError> {
        self.value.as_array().ok_or_else(|| self.invalid("an array", self.value.type_name()))
    }

    /// Finite numbers of exactly this shape, `None` standing for any extent; axes of length 1 in
    /// front may be left out.
    pub fn numbers(&self, shape: &[Option<usize>]) -> Result<Vec<f64>, CaptureError> {
        let array = self.array()?;
        let mut wanted = shape;
        while wanted.len() > array.shape.len() && wanted.first() == Some(&Some(1)) {
            wanted = &wanted[1..];
        }
        let fits = |(n, p): (&usize, &Option<usize>)| p.is_none_or(|p| p == *n);
        if array.shape.len() != wanted.len() || !array.shape.iter().zip(wanted).all(fits) {
            let text: Vec<String> = shape.iter().map(|n| n.map_or("_".to_owned(), |n| n.to_string())).collect();
            return Err(self.invalid(format!("shape [{}]", text.join(", ")), format!("shape {:?}", array.shape)));
        }
        let values = array.to_f64();
        // Finite in f32, the type of poses.
        match values.iter().position(|value| !(*value as f32).is_finite()) {
            Some(at) => Err(self.invalid("finite numbers", format!("{} at flat index {at}", values[at]))),
            None => Ok(values),
        }
    }

    /// [`Item::numbers`] as rows of `width`.
    pub fn rows(&self, width: usize) -> Result<Vec<Vec<f64>>, CaptureError> {
        Ok(self.numbers(&[None, Some(width)])?.chunks_exact(width).map(<[f64]>::to_vec).collect())
    }

    /// A whole number.
    pub fn whole(&self) -> Result<i64, CaptureError> {
        let number = match (self.value, self.value.as_array()) {
            (Value::Int(number), _) => Some(*number),
            (Value::Bool(flag), _) => Some(i64::from(*flag)),
            (_, Some(array)) if array.len() == 1 => {
                let value = array.to_f64()[0];
                (value.fract() == 0.0 && value.abs() < 1e15).then_some(value as i64)
            }
            _ => None,
        };
        number.ok_or_else(|| self.invalid("a whole number", self.value.type_name()))
    }

    /// A finite number.
    pub fn number(&self) -> Result<f64, CaptureError> {
        let number = match (self.value, self.value.as_array()) {
            (Value::Int(number), _) => Some(*number as f64),
            (Value::Float(number), _) => Some(*number),
            (_, Some(array)) if array.len() == 1 => Some(array.to_f64()[0]),
            _ => None,
        };
        let number = number.ok_or_else(|| self.invalid("a number", self.value.type_name()))?;
        if !(number as f32).is_finite() {
            return Err(self.invalid("a finite number", number.to_string()));
        }
        Ok(number)
    }

    /// Numbers of a list of `count`, or of an array of them.
    pub fn few(&self, count: usize) -> Result<Vec<f64>, CaptureError> {
        if self.value.as_array().is_some() {
            return self.numbers(&[Some(count)]);
        }
        let items = self.list()?;
        if items.len() != count {
            return Err(self.invalid(format!("{count} numbers"), format!("{}", items.len())));
        }
        items.iter().map(Item::number).collect()
    }

    /// Indices of frames: whole numbers, none below 0.
    pub fn indices(&self) -> Result<Vec<usize>, CaptureError> {
        let values = self.numbers(&[None])?;
        let whole = |(i, value): (usize, &f64)| {
            let fits = *value >= 0.0 && value.fract() == 0.0 && *value < 1e9;
            fits.then_some(*value as usize).ok_or_else(|| self.invalid("indices", format!("{value} at {i}")))
        };
        values.iter().enumerate().map(whole).collect()
    }

    /// Checks that a list has `length` entries.
    pub fn as_long(&self, length: usize, found: usize) -> Result<(), CaptureError> {
        if length == found {
            return Ok(());
        }
        Err(self.invalid(format!("{length} entries, one a frame of the person"), format!("{found}")))
    }

    /// A rotation from nine numbers, row by row.
    pub fn rotation(&self, values: &[f64]) -> Result<DMat3, CaptureError> {
        turn(values).ok_or_else(|| self.invalid("a rotation matrix", format!("{values:?}")))
    }

    /// Rotation and translation of a (4,4) matrix, row by row.
    pub fn rigid(&self, values: &[f64]) -> Result<(DMat3, DVec3), CaptureError> {
        let turn = self.rotation(&[&values[0..3], &values[4..7], &values[8..11]].concat())?;
        Ok((turn, DVec3::new(values[3], values[7], values[11])))
    }
}

/// The rotation of nine numbers, row by row; `None` unless they are one.
pub(super) fn turn(values: &[f64]) -> Option<DMat3> {
    let row = |i: usize| DVec3::from_slice(&values[3 * i..]);
    let matrix = DMat3::from_cols(row(0), row(1), row(2)).transpose();
    let off = (matrix * matrix.transpose() - DMat3::IDENTITY).to_cols_array();
    (off.iter().all(|x| x.abs() <= ORTHONORMAL) && matrix.determinant() > 0.0).then_some(matrix)
}

/// The arrays of an archive as a dictionary.
pub(super) fn dictionary(npz: &mut Npz) -> Result<Value, CaptureError> {
    let keys = npz.keys().to_vec();
    let entries = keys.into_iter().map(|key| Ok((Value::Str(key.clone()), npz.value(&key)?)));
    Ok(Value::Dict(entries.collect::<Result<_, array_files::Error>>()?))
}

/// Groups of three numbers.
/// The array of a `.npy` file, or the only one of an `.npz` archive whose shape `fits`; `expected` says which.
pub(super) fn array(path: &Path, expected: &str, fits: impl Fn(&[usize]) -> bool) -> Result<NdArray, CaptureError> {
    if path.extension().is_none_or(|e| e != "npz") {
        let array = read_npy(path)?;
        let fits = fits(&array.shape);
        let found = || CaptureError::invalid(path, "the file", expected, format!("shape {:?}", array.shape));
        return if fits { Ok(array) } else { Err(found()) };
    }
    let mut npz = Npz::open(path)?;
    let keys = npz.keys().to_vec();
    let arrays = keys.iter().filter_map(|key| npz.array(key).ok());
    let mut fitting = arrays.filter(|array| fits(&array.shape));
    match (fitting.next(), fitting.next()) {
        (Some(array), None) => Ok(array),
        (first, _) => {
            let found = format!("{} of {}", if first.is_some() { "several" } else { "none" }, keys.join(", "));
            Err(CaptureError::invalid(path, "arrays", format!("one of {expected}"), found))
        }
    }
}

pub(super) fn vectors(values: &[f64]) -> Vec<DVec3> {
    values.chunks_exact(3).map(DVec3::from_slice).collect()
}
