//! Values of dictionaries in files; errors name the file and the path of keys.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::path::Path;

use array_files::pickle::{self, Value};
use array_files::{Data, NdArray};
use glam::{DMat3, DVec3};

use super::CaptureError;
use super::names::FrameName;

/// Reads a pickle that a layout demands.
pub(super) fn pickled(path: &Path) -> Result<Value, CaptureError> {
    if !path.is_file() {
        return Err(CaptureError::missing(path, "file"));
    }
    Ok(pickle::read(path)?)
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
        let value = self.value.get(name).map(|value| self.below(name, value));
        value.map_or_else(|| Err(self.lacks(name)), Ok)
    }

    fn lacks(&self, name: &str) -> CaptureError {
        let Value::Dict(items) = self.value else { return self.invalid("a dictionary", self.value.type_name()) };
        let held: Vec<&str> = items.iter().filter_map(|(k, _)| k.as_str()).take(20).collect();
        let found = format!("no such key (there is {})", held.join(", "));
        self.below(name, self.value).invalid("this key", found)
    }

    fn dictionary(&self) -> Result<&'a [(Value, Value)], CaptureError> {
        match self.value {
            Value::Dict(entries) => Ok(entries),
            other => Err(self.invalid("a dictionary", other.type_name())),
        }
    }

    /// Names and values of a dictionary; names that are numbers are written as such.
    pub fn entries(&self) -> Result<Vec<(String, Item<'a>)>, CaptureError> {
        let named = |(key, value): &'a (Value, Value)| {
            let name = match (key, key.as_array()) {
                (Value::Str(text), _) => text.clone(),
                (Value::Int(number), _) => number.to_string(),
                (_, Some(array)) if array.len() == 1 => format!("{}", array.to_f64()[0]),
                _ => return Err(self.invalid("names or numbers as keys", key.type_name())),
            };
            Ok((name.clone(), self.below(&name, value)))
        };
        self.dictionary()?.iter().map(named).collect()
    }

    /// The dictionaries of frames in the order of their names; at least one.
    pub fn frames(&self) -> Result<BTreeMap<FrameName<'a>, Item<'a>>, CaptureError> {
        let mut frames = BTreeMap::new();
        for (key, value) in self.dictionary()? {
            let name = key.as_str().ok_or_else(|| self.invalid("names of frames as keys", key.type_name()))?;
            let frame = self.below(name, value);
            frame.dictionary()?;
            frames.insert(FrameName(name), frame);
        }
        if frames.is_empty() {
            return Err(self.invalid("a frame", "an empty dictionary"));
        }
        Ok(frames)
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

    /// An array, also as nested lists of arrays and numbers.
    pub fn array(&self) -> Result<Cow<'a, NdArray>, CaptureError> {
        match self.value.as_array() {
            Some(array) => Ok(Cow::Borrowed(array)),
            None => self.stack(self.value)?.map(Cow::Owned).map_err(|found| self.invalid("an array", found)),
        }
    }

    /// Stacks nested lists; the inner error is the actual type. Pickles and JSON bound the depth.
    fn stack(&self, value: &Value) -> Result<Result<NdArray, String>, CaptureError> {
        if let Some(array) = value.to_dense(&self.path.display().to_string(), &self.key)? {
            return Ok(Ok(array));
        }
        let scalar = |number| Ok(Ok(NdArray { shape: Vec::new(), data: Data::F64(vec![number]) }));
        let items = match value {
            Value::Bool(flag) => return scalar(f64::from(u8::from(*flag))),
            Value::Int(number) => return scalar(*number as f64),
            Value::Float(number) => return scalar(*number),
            _ => value.items(),
        };
        let Some(items) = items else { return Ok(Err(value.type_name().to_owned())) };
        let (mut shape, mut values) = (None, Vec::new());
        for (i, item) in items.iter().enumerate() {
            let array = match self.stack(item)? {
                Ok(array) => array,
                Err(inner) => return Ok(Err(format!("{inner} in a {}", value.type_name()))),
            };
            let first = shape.get_or_insert_with(|| array.shape.clone());
            if *first != array.shape {
                return Ok(Err(format!("item {i} of shape {:?} after {first:?}", array.shape)));
            }
            values.extend(array.to_f64());
        }
        let shape = [vec![items.len()], shape.unwrap_or_default()].concat();
        Ok(Ok(NdArray { shape, data: Data::F64(values) }))
    }

    /// Shape and finite values of an array.
    pub fn values(&self) -> Result<(Vec<usize>, Vec<f64>), CaptureError> {
        let array = self.array()?;
        let values = array.to_f64();
        // Finite in f32, the type of poses.
        match values.iter().position(|value| !(*value as f32).is_finite()) {
            Some(at) => Err(self.invalid("finite numbers", format!("{} at flat index {at}", values[at]))),
            None => Ok((array.shape.clone(), values)),
        }
    }

    /// Finite numbers of exactly this shape, `None` standing for any extent; axes of length 1 in
    /// front may be left out or added.
    pub fn numbers(&self, shape: &[Option<usize>]) -> Result<Vec<f64>, CaptureError> {
        let array = self.array()?;
        let wanted = &shape[shape.iter().take_while(|n| **n == Some(1)).count()..];
        let mut found = array.shape.as_slice();
        while found.len() > wanted.len() && found[0] == 1 {
            found = &found[1..];
        }
        let fits = |(n, p): (&usize, &Option<usize>)| p.is_none_or(|p| p == *n);
        if found.len() != wanted.len() || !found.iter().zip(wanted).all(fits) {
            let text: Vec<String> = shape.iter().map(|n| n.map_or("_".to_owned(), |n| n.to_string())).collect();
            return Err(self.invalid(format!("shape [{}]", text.join(", ")), format!("shape {:?}", array.shape)));
        }
        Ok(self.values()?.1)
    }

    /// [`Item::numbers`] in single precision.
    pub fn floats(&self, shape: &[Option<usize>]) -> Result<Vec<f32>, CaptureError> {
        Ok(self.numbers(shape)?.into_iter().map(|value| value as f32).collect())
    }

    /// [`Item::numbers`] as rows of `width`.
    pub fn rows(&self, width: usize) -> Result<Vec<Vec<f64>>, CaptureError> {
        Ok(self.numbers(&[None, Some(width)])?.chunks_exact(width).map(<[f64]>::to_vec).collect())
    }

    /// The rows of arrays with these names and widths side by side, `count` of each.
    pub fn table(&self, count: Option<usize>, names: &[(&str, usize)]) -> Result<Vec<Vec<f64>>, CaptureError> {
        let mut table: Option<Vec<Vec<f64>>> = count.map(|count| vec![Vec::new(); count]);
        for &(name, width) in names {
            let item = self.get(name)?;
            let rows = item.rows(width)?;
            let table = table.get_or_insert_with(|| vec![Vec::new(); rows.len()]);
            item.as_long(table.len(), rows.len())?;
            table.iter_mut().zip(rows).for_each(|(row, part)| row.extend(part));
        }
        Ok(table.unwrap_or_default())
    }

    /// A finite number.
    pub fn number(&self) -> Result<f64, CaptureError> {
        match self.values()? {
            (_, values) if values.len() == 1 => Ok(values[0]),
            (shape, _) => Err(self.invalid("a number", format!("shape {shape:?}"))),
        }
    }

    /// A whole number.
    pub fn whole(&self) -> Result<i64, CaptureError> {
        let number = self.number()?;
        let is_whole = number.fract() == 0.0 && number.abs() < 1e15;
        is_whole.then_some(number as i64).ok_or_else(|| self.invalid("a whole number", number.to_string()))
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

    /// A rotation from nine numbers, row by row, to `tolerance` in |R Rᵀ − I|.
    pub fn rotation(&self, values: &[f64], tolerance: f64) -> Result<DMat3, CaptureError> {
        let row = |i: usize| DVec3::from_slice(&values[3 * i..]);
        let matrix = DMat3::from_cols(row(0), row(1), row(2)).transpose();
        let off = (matrix * matrix.transpose() - DMat3::IDENTITY).to_cols_array();
        let is_rotation = off.iter().all(|x| x.abs() <= tolerance) && matrix.determinant() > 0.0;
        is_rotation.then_some(matrix).ok_or_else(|| self.invalid("a rotation matrix", format!("{values:?}")))
    }

    /// Rotation and translation of the first three rows of a (4,4) matrix.
    pub fn rigid(&self, values: &[f64], tolerance: f64) -> Result<(DMat3, DVec3), CaptureError> {
        let turn = self.rotation(&[&values[0..3], &values[4..7], &values[8..11]].concat(), tolerance)?;
        Ok((turn, DVec3::new(values[3], values[7], values[11])))
    }
}
