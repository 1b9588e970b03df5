//! Masks of segmenters: files, their frames, and the meaning of their values.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use array_files::npz::read_npy;
use array_files::{Data, NdArray};

use super::levels::Levels;
use super::options::ImportOptions;
use super::video::Video;
use crate::names::FrameName;
use crate::pictures::file_name;
use crate::{CaptureError, pictures::Pictures};

/// The masks of a video.
pub(super) struct Masks {
    /// Kind of the files, for messages.
    pub kind: &'static str,
    frames: BTreeMap<usize, Source>,
    meaning: Meaning,
    /// Files of each occluder.
    occluders: Vec<BTreeMap<usize, PathBuf>>,
}

/// Source of a frame's values.
enum Source {
    File(PathBuf),
    /// In a stack that has been read: row by row.
    Stack(NdArray),
}

/// Meaning of a value.
#[derive(Clone, PartialEq)]
enum Meaning {
    /// Coverage of the person, 255 being all.
    Coverage,
    /// Coverage of all but the person.
    Background,
    /// Ids of the person and of the occluders.
    Objects(u8, Vec<u8>),
    /// Any value but 0 is the person: one folder an object.
    Any,
}

impl Masks {
    /// Finds the masks of `video` in a folder or a `.npy` file.
    pub fn open(path: &Path, options: &ImportOptions, video: &Video) -> Result<Self, CaptureError> {
        if path.is_file() {
            return Self::stack(path, options, video);
        }
        let inner = ["mask_data", "pha"].map(|name| path.join(name)).into_iter().find(|dir| dir.is_dir());
        let dir = inner.as_deref().unwrap_or(path);
        let object = options.object.unwrap_or(1);
        if let Some(folders) = object_folders(dir)? {
            let find = |id: u8| {
                folders.get(&id).ok_or_else(|| {
                    let found: Vec<String> = folders.keys().map(u8::to_string).collect();
                    CaptureError::invalid(dir, "objects", format!("a folder of object {id}"), found.join(", "))
                })
            };
            let frames = matched(find(object)?, video)?.into_iter().map(|(i, path)| (i, Source::File(path)));
            let occluders = options.occluder_objects.iter().map(|&id| matched(find(id)?, video));
            return Ok(Self {
                kind: "one folder an object, as SAM 2 writes them",
                frames: frames.collect(),
                meaning: Meaning::Any,
                occluders: occluders.collect::<Result<_, _>>()?,
            });
        }
        let files = matched(dir, video)?;
        let mut statistics = ValueStatistics::default();
        for path in files.values() {
            statistics.add(&Levels::load(path)?);
        }
        let (meaning, kind) = statistics.meaning(dir, options)?;
        let frames = files.into_iter().map(|(i, path)| (i, Source::File(path))).collect();
        Ok(Self { kind, frames, meaning, occluders: Vec::new() })
    }

    /// Masks (N,H,W) in one file.
    fn stack(path: &Path, options: &ImportOptions, video: &Video) -> Result<Self, CaptureError> {
        let array = read_npy(path)?;
        let &[n, height, width] = array.shape.as_slice() else {
            return Err(CaptureError::invalid(path, "shape", "(frames, height, width)", format!("{:?}", array.shape)));
        };
        if n > video.names.len() {
            let expected = format!("at most {} masks, one a frame", video.names.len());
            return Err(CaptureError::invalid(path, "shape", expected, n.to_string()));
        }
        let (each, mut statistics, mut frames) = (height * width, ValueStatistics::default(), BTreeMap::new());
        for index in 0..n {
            let span = index * each..(index + 1) * each;
            let data = match &array.data {
                Data::Bool(v) => Data::Bool(v[span].to_vec()),
                Data::I64(v) => Data::I64(v[span].to_vec()),
                Data::F32(v) => Data::F32(v[span].to_vec()),
                Data::F64(v) => Data::F64(v[span].to_vec()),
            };
            let part = NdArray { shape: vec![height, width], data };
            statistics.add(&Levels::from_array(path, &part)?);
            frames.insert(index, Source::Stack(part));
        }
        let (meaning, kind) = statistics.meaning(path, options)?;
        Ok(Self { kind, frames, meaning, occluders: Vec::new() })
    }

    /// Whether a frame has a mask.
    pub fn has(&self, index: usize) -> bool {
        self.frames.contains_key(&index)
    }

    /// Coverage of the person and of occluders in a frame, row by row, 0 to 255.
    pub fn levels(&self, path: &Path, index: usize, video: &Video) -> Result<(Vec<u8>, Option<Vec<u8>>), CaptureError> {
        let levels = match self.frames.get(&index) {
            Some(Source::File(file)) => Levels::load(file)?.sized(file, video.size)?,
            Some(Source::Stack(array)) => Levels::from_array(path, array)?.sized(path, video.size)?,
            None => return Err(CaptureError::missing(path, format!("mask of frame {}", video.names[index]))),
        };
        let full = |hit: bool| if hit { 255 } else { 0 };
        Ok(match &self.meaning {
            Meaning::Coverage => (levels.values, None),
            Meaning::Background => (levels.values.iter().map(|v| 255 - v).collect(), None),
            Meaning::Objects(object, front) => {
                let person = levels.values.iter().map(|v| full(v == object)).collect();
                let front =
                    (!front.is_empty()).then(|| levels.values.iter().map(|v| full(front.contains(v))).collect());
                (person, front)
            }
            Meaning::Any => {
                let person = levels.values.iter().map(|v| full(*v > 0)).collect();
                let mut front = (!self.occluders.is_empty()).then(|| vec![0; levels.values.len()]);
                for file in self.occluders.iter().filter_map(|files| files.get(&index)) {
                    let other = Levels::load(file)?.sized(file, video.size)?;
                    if let Some(front) = &mut front {
                        front.iter_mut().zip(other.values).for_each(|(front, v)| *front |= full(v > 0));
                    }
                }
                (person, front)
            }
        })
    }
}

/// Statistics of the values of a video's masks.
struct ValueStatistics {
    values: [bool; 256],
    /// Whether every file has palette indices.
    palette: bool,
    files: usize,
    /// Pixels at the image borders, and of them those above half coverage.
    border: usize,
    covered: usize,
}

/// Covered share of the borders above which a mask is the background's.
const BORDER: f64 = 0.5;

impl Default for ValueStatistics {
    fn default() -> Self {
        Self { values: [false; 256], palette: true, files: 0, border: 0, covered: 0 }
    }
}

impl ValueStatistics {
    fn add(&mut self, levels: &Levels) {
        levels.values.iter().for_each(|&value| self.values[usize::from(value)] = true);
        self.palette &= levels.ids;
        self.files += 1;
        let (width, height) = (levels.width as usize, levels.height as usize);
        for (y, row) in levels.values.chunks(width.max(1)).enumerate() {
            let every = if y == 0 || y + 1 == height { 1 } else { width.max(2) - 1 };
            for value in row.iter().step_by(every) {
                self.border += 1;
                self.covered += usize::from(*value >= 128);
            }
        }
    }

    /// Coverage for values of 128 and above outside palettes, or 255 alone, of the background if it
    /// has most of the border; object ids otherwise.
    fn meaning(&self, dir: &Path, options: &ImportOptions) -> Result<(Meaning, &'static str), CaptureError> {
        let found: Vec<usize> = (1..256).filter(|&value| self.values[value]).collect();
        let shades = found.iter().any(|&value| value >= 128);
        if self.files > 0 && found.is_empty() {
            let expected = "a pixel of the person in at least one mask";
            return Err(CaptureError::invalid(dir, "all masks", expected, format!("0 in all of {}", self.files)));
        }
        if found == [255] || (shades && !self.palette) {
            if options.object.is_some() || !options.occluder_objects.is_empty() {
                let expected = "masks that hold ids of objects (--object, --occluder-objects)";
                return Err(CaptureError::invalid(dir, "values", expected, "coverage from 0 to 255"));
            }
            if self.covered as f64 > BORDER * self.border as f64 {
                return Ok((Meaning::Background, "coverage of all but the person (it is along the border), 0 to 255"));
            }
            return Ok((Meaning::Coverage, "coverage of the person, 0 to 255"));
        }
        let object = options.object.unwrap_or(1);
        for id in [object].iter().chain(&options.occluder_objects) {
            if !found.contains(&usize::from(*id)) {
                let held: Vec<String> = found.iter().take(20).map(usize::to_string).collect();
                let expected = format!("object {id} in at least one mask");
                return Err(CaptureError::invalid(dir, "values", expected, format!("objects {}", held.join(", "))));
            }
        }
        Ok((Meaning::Objects(object, options.occluder_objects.clone()), "ids of objects"))
    }
}

/// Folders named by numbers, unless there is a mask beside them.
fn object_folders(dir: &Path) -> Result<Option<BTreeMap<u8, PathBuf>>, CaptureError> {
    let mut folders = BTreeMap::new();
    for entry in std::fs::read_dir(dir).map_err(CaptureError::io(dir))? {
        let path = entry.map_err(CaptureError::io(dir))?.path();
        let number = file_name(&path).parse::<u8>().ok();
        match number {
            Some(id) if path.is_dir() => drop(folders.insert(id, path)),
            _ if is_mask(&path) => return Ok(None),
            _ => {}
        }
    }
    Ok((!folders.is_empty()).then_some(folders))
}

fn is_mask(path: &Path) -> bool {
    let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
    matches!(extension.as_deref(), Some("png" | "jpg" | "jpeg" | "npy"))
}

/// Mask files by the index of their frame: by name if all have a frame's name, in order if there are
/// as many as frames, else by number from 0.
fn matched(dir: &Path, video: &Video) -> Result<BTreeMap<usize, PathBuf>, CaptureError> {
    let mut files = arrays(dir)?;
    if files.is_empty() {
        files = Pictures::list(dir)?.iter().map(|(name, path)| (name.clone(), path.clone())).collect();
    }
    if files.is_empty() {
        let expected = "masks: .png, .jpg or .npy files, or a folder of them for each object";
        return Err(CaptureError::invalid(dir, "files", expected, "none"));
    }
    files.sort_by(|a, b| FrameName(&a.0).cmp(&FrameName(&b.0)));
    let names: BTreeMap<&str, usize> = video.names.iter().enumerate().map(|(i, name)| (name.as_str(), i)).collect();
    if files.iter().all(|(name, _)| names.contains_key(name.as_str())) {
        return Ok(files.into_iter().map(|(name, path)| (names[name.as_str()], path)).collect());
    }
    if files.len() == video.names.len() {
        return Ok(files.into_iter().enumerate().map(|(i, (_, path))| (i, path)).collect());
    }
    let (mut found, mut twice) = (BTreeMap::new(), BTreeSet::new());
    for (name, path) in files {
        let digits = name.rfind(|c: char| c.is_ascii_digit()).map(|end| {
            let start = name[..end].rfind(|c: char| !c.is_ascii_digit()).map_or(0, |at| at + 1);
            name[start..=end].parse::<usize>().unwrap_or(usize::MAX)
        });
        let number = digits.filter(|&number| number < video.names.len());
        let number = number.ok_or_else(|| {
            let expected = format!("a frame's name, or a number below {}, the number of frames", video.names.len());
            CaptureError::invalid(&path, "name", expected, name.as_str())
        })?;
        if found.insert(number, path).is_some() {
            twice.insert(number);
        }
    }
    match twice.first() {
        Some(number) => {
            Err(CaptureError::invalid(dir, format!("number {number}"), "one mask a frame", "several files"))
        }
        None => Ok(found),
    }
}

/// `.npy` files by name without extension.
fn arrays(dir: &Path) -> Result<Vec<(String, PathBuf)>, CaptureError> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(dir).map_err(CaptureError::io(dir))? {
        let path = entry.map_err(CaptureError::io(dir))?.path();
        if path.extension().is_some_and(|e| e == "npy") {
            let stem = path.file_stem().map_or(String::new(), |s| s.to_string_lossy().into_owned());
            files.push((stem, path));
        }
    }
    Ok(files)
}
