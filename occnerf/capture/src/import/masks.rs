//! Masks of segmenters: files, their frames, and the meaning of their values.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};

use array_files::npz::{Npz, read_npy};
use array_files::{Data, NdArray};
use png::{ColorType, Decoder, Limits};

use super::file::array;
use super::join::{self, Disjoint};
use super::options::ImportOptions;
use super::video::Video;
use crate::CaptureError;
use crate::image::{MAX_SIDE, alpha, decode, dimensions};
use crate::pictures::{Pictures, file_name, has_extension, listed};

/// The masks of a video.
pub(super) struct Masks {
    /// Kind of the files, for messages.
    pub kind: &'static str,
    /// How they were joined with the pictures, where that is worth a word.
    pub notes: Vec<String>,
    /// The folder or file.
    path: PathBuf,
    frames: BTreeMap<usize, Source>,
    meaning: Meaning,
    /// Those of each occluder.
    occluders: Vec<BTreeMap<usize, Source>>,
}

/// Source of a frame's values.
enum Source {
    File(PathBuf),
    /// In a stack that has been read: row by row.
    Stack(NdArray),
}

impl Source {
    /// The values; `whole` is the stack's file.
    fn levels(&self, whole: &Path) -> Result<Levels, CaptureError> {
        match self {
            Self::File(file) => Levels::load(file),
            Self::Stack(array) => Levels::from_array(whole, array),
        }
    }

    /// The values, checked against the frames' size.
    fn sized(&self, whole: &Path, size: (u32, u32)) -> Result<Levels, CaptureError> {
        let levels = self.levels(whole)?;
        if (levels.width, levels.height) == size {
            return Ok(levels);
        }
        let path = if let Self::File(file) = self { file } else { whole };
        let expected = format!("{}×{}, as the frames", size.0, size.1);
        Err(CaptureError::invalid(path, "size", expected, format!("{}×{}", levels.width, levels.height)))
    }
}

/// Meaning of a value.
#[derive(Clone, PartialEq)]
enum Meaning {
    /// Coverage of the person, of this full scale.
    Coverage(u32),
    /// Coverage of all but the person.
    Background(u32),
    /// Ids of the person and of the occluders.
    Objects(u32, Vec<u32>),
    /// Any value but 0 is the person: one folder an object.
    Any,
}

impl Masks {
    /// Finds the masks of `video` in a folder or a `.npy` file.
    pub fn open(path: &Path, options: &ImportOptions, video: &Video) -> Result<Self, CaptureError> {
        let inner = ["mask_data", "pha"].map(|name| path.join(name)).into_iter().find(|dir| dir.is_dir());
        let dir = inner.as_deref().unwrap_or(path);
        let folders = if path.is_file() { None } else { object_folders(dir)? };
        let ((frames, notes), meaning, kind, occluders) = if let Some(folders) = folders {
            let of = |id: u32| match folders.get(&id) {
                Some(folder) => matched(folder, video),
                None => {
                    let found: Vec<String> = folders.keys().map(u32::to_string).collect();
                    let expected = format!("a folder of object {id}");
                    Err(CaptureError::invalid(dir, "objects", expected, found.join(", ")))
                }
            };
            let person = of(options.object.unwrap_or(1))?;
            let occluders = options.occluder_objects.iter().map(|&id| of(id).map(|(frames, _)| frames));
            let occluders = occluders.collect::<Result<_, _>>()?;
            (person, Meaning::Any, "one folder an object, as SAM 2 writes them", occluders)
        } else {
            let joined = if path.is_file() { stack(path, video)? } else { matched(dir, video)? };
            let mut statistics = ValueStatistics::default();
            for source in joined.0.values() {
                statistics.add(&source.levels(path)?);
            }
            let (meaning, kind) = statistics.meaning(dir, options)?;
            (joined, meaning, kind, Vec::new())
        };
        Ok(Self { kind, notes, path: path.to_owned(), frames, meaning, occluders })
    }

    /// The pictures' own alpha channels, where the first has one.
    pub fn of_alpha(options: &ImportOptions, video: &Video) -> Result<Option<Self>, CaptureError> {
        let has_alpha = alpha(&decode(&video.paths[0])?).is_some();
        has_alpha.then(|| Self::open(&options.frames, options, video)).transpose()
    }

    /// Whether a frame has a mask.
    pub fn has(&self, index: usize) -> bool {
        self.frames.contains_key(&index)
    }

    /// Coverage of the person and of occluders in a frame, row by row, 0 to 255.
    pub fn levels(&self, index: usize, video: &Video) -> Result<(Vec<u8>, Option<Vec<u8>>), CaptureError> {
        let absent = || CaptureError::missing(&self.path, format!("mask of frame {}", video.names[index]));
        let levels = self.frames.get(&index).ok_or_else(absent)?.sized(&self.path, video.size)?;
        let full = |hit: bool| if hit { 255 } else { 0 };
        Ok(match &self.meaning {
            Meaning::Coverage(all) => (levels.values.iter().map(|v| byte(*v, *all)).collect(), None),
            Meaning::Background(all) => (levels.values.iter().map(|v| 255 - byte(*v, *all)).collect(), None),
            Meaning::Objects(object, front) => {
                let person = levels.values.iter().map(|v| full(v == object)).collect();
                let front =
                    (!front.is_empty()).then(|| levels.values.iter().map(|v| full(front.contains(v))).collect());
                (person, front)
            }
            Meaning::Any => {
                let person = levels.values.iter().map(|v| full(*v > 0)).collect();
                let mut front = (!self.occluders.is_empty()).then(|| vec![0; levels.values.len()]);
                for source in self.occluders.iter().filter_map(|frames| frames.get(&index)) {
                    let other = source.sized(&self.path, video.size)?;
                    if let Some(front) = &mut front {
                        front.iter_mut().zip(other.values).for_each(|(front, v)| *front |= full(v > 0));
                    }
                }
                (person, front)
            }
        })
    }
}

/// Coverage in bytes.
fn byte(value: u32, full: u32) -> u8 {
    ((u64::from(value.min(full)) * 255 + u64::from(full / 2)) / u64::from(full.max(1))) as u8
}

/// Most different values of a video's masks.
const MAX_VALUES: usize = 1 << 17;

/// Statistics of the values of a video's masks.
#[derive(Default)]
struct ValueStatistics {
    values: BTreeSet<u32>,
    /// The largest full scale.
    full: u32,
    /// Whether some file has an alpha channel.
    alpha: bool,
    /// Files without palette indices.
    shaded: usize,
    files: usize,
    /// Pixels at the image borders, and of them those of at least half coverage.
    border: usize,
    covered: usize,
}

/// Covered share of the borders above which a mask is the background's.
const BORDER: f64 = 0.5;

impl ValueStatistics {
    fn add(&mut self, levels: &Levels) {
        let mut last = None;
        for &value in &levels.values {
            if last.replace(value) != Some(value) && self.values.len() < MAX_VALUES {
                self.values.insert(value);
            }
        }
        self.shaded += usize::from(!levels.ids);
        self.full = self.full.max(levels.full);
        self.alpha |= levels.alpha;
        self.files += 1;
        let (width, height) = (levels.width as usize, levels.height as usize);
        for (y, row) in levels.values.chunks(width.max(1)).enumerate() {
            let every = if y == 0 || y + 1 == height { 1 } else { width.max(2) - 1 };
            for value in row.iter().step_by(every) {
                self.border += 1;
                self.covered += usize::from(*value > levels.full / 2);
            }
        }
    }

    /// Coverage for alpha, for values of at least half of the full scale outside palettes, or for
    /// 255 alone, of the background if it has most of the border; object ids otherwise.
    fn meaning(&self, dir: &Path, options: &ImportOptions) -> Result<(Meaning, &'static str), CaptureError> {
        let found: Vec<u32> = self.values.iter().copied().filter(|value| *value > 0).collect();
        let shades = self.shaded > 0 && found.iter().any(|&value| value > self.full / 2);
        if self.files > 0 && found.is_empty() {
            let expected = "a pixel of the person in at least one mask";
            return Err(CaptureError::invalid(dir, "all masks", expected, format!("0 in all of {}", self.files)));
        }
        let full = if found == [255] { 255 } else { self.full };
        if found == [255] || shades || self.alpha {
            if options.object.is_some() || !options.occluder_objects.is_empty() {
                let expected = "masks that hold ids of objects (--object, --occluder-objects)";
                return Err(CaptureError::invalid(dir, "values", expected, "coverage from 0 to 255"));
            }
            if self.alpha {
                return Ok((Meaning::Coverage(full), "coverage of the person, in the alpha channel"));
            }
            if self.covered as f64 > BORDER * self.border as f64 {
                let kind = "coverage of all but the person (it is along the border), 0 to 255";
                return Ok((Meaning::Background(full), kind));
            }
            return Ok((Meaning::Coverage(full), "coverage of the person, 0 to 255"));
        }
        let object = options.object.unwrap_or(1);
        for id in [object].iter().chain(&options.occluder_objects) {
            if !found.contains(id) {
                let held: Vec<String> = found.iter().take(20).map(u32::to_string).collect();
                let expected = format!("object {id} in at least one mask");
                return Err(CaptureError::invalid(dir, "values", expected, format!("objects {}", held.join(", "))));
            }
        }
        Ok((Meaning::Objects(object, options.occluder_objects.clone()), "ids of objects"))
    }
}

/// Folders named by numbers, unless there is a mask beside them.
fn object_folders(dir: &Path) -> Result<Option<BTreeMap<u32, PathBuf>>, CaptureError> {
    let mut folders = BTreeMap::new();
    for entry in std::fs::read_dir(dir).map_err(CaptureError::io(dir))? {
        let path = entry.map_err(CaptureError::io(dir))?.path();
        let number = file_name(&path).parse::<u32>().ok();
        match number {
            Some(id) if path.is_dir() => drop(folders.insert(id, path)),
            _ if has_extension(&path, &["png", "jpg", "jpeg", "npy"]) => return Ok(None),
            _ => {}
        }
    }
    Ok((!folders.is_empty()).then_some(folders))
}

/// Masks by the index of their frame, and how they were joined.
type Joined = (BTreeMap<usize, Source>, Vec<String>);

/// Masks (N,H,W), (N,1,H,W) or (N,H,W,1) in one file.
fn stack(path: &Path, video: &Video) -> Result<Joined, CaptureError> {
    let expected = "masks (frames, height, width), or the same with an axis of 1";
    if has_extension(path, &["npz"]) {
        let npz = Npz::open(path)?;
        if npz.keys().len() > 1 {
            return Err(CaptureError::invalid(path, "keys", "one array of masks", npz.keys().join(", ")));
        }
    }
    let array = array(path, expected, |shape| matches!(shape, [_, _, _] | [_, 1, _, _] | [_, _, _, 1]))?;
    let (n, [height, width]) = match array.shape[..] {
        [n, height, width] | [n, 1, height, width] | [n, height, width, _] => (n, [height, width]),
        _ => (0, [0; 2]),
    };
    // At least half of the masks have a picture. A header may claim any number of empty ones.
    let joined = (n <= 2 * video.names.len()).then(|| join::by_index(video, &(0..n).collect())).flatten();
    let joined = joined.ok_or_else(|| {
        let expected = format!("at most {} masks, one a frame", video.names.len());
        CaptureError::invalid(path, "shape", expected, n.to_string())
    })?;
    let each = height * width;
    let part = |(index, at): (usize, Option<usize>)| {
        let span = index * each..(index + 1) * each;
        let data = match &array.data {
            Data::Bool(v) => Data::Bool(v[span].to_vec()),
            Data::I64(v) => Data::I64(v[span].to_vec()),
            Data::F32(v) => Data::F32(v[span].to_vec()),
            Data::F64(v) => Data::F64(v[span].to_vec()),
        };
        Some((at?, Source::Stack(NdArray { shape: vec![height, width], data })))
    };
    let frames = joined.at.into_iter().enumerate().filter_map(part).collect();
    Ok((frames, joined.note.into_iter().collect()))
}

/// The mask files of a folder.
fn matched(dir: &Path, video: &Video) -> Result<Joined, CaptureError> {
    let mut files = listed(dir, &["npy"])?;
    if files.is_empty() {
        files = Pictures::list(dir)?.into_vec();
    }
    if files.is_empty() {
        let expected = "masks: .png, .jpg or .npy files, or a folder of them for each object";
        return Err(CaptureError::invalid(dir, "files", expected, "none"));
    }
    let names: Vec<&str> = files.iter().map(|(name, _)| name.as_str()).collect();
    let joined = join::by_name(video, &names).map_err(|why| match why {
        Disjoint::Twice(number) => {
            CaptureError::invalid(dir, format!("number {number}"), "one mask a frame", "several files")
        }
        Disjoint::Apart => {
            let expected = format!("names or numbers of pictures, as {}", video.names[0]);
            CaptureError::invalid(&files[0].1, "name", expected, names[0])
        }
    })?;
    let absent = joined.at.iter().filter(|at| at.is_none()).count();
    let mut notes: Vec<String> = joined.note.into_iter().collect();
    if absent > 0 {
        notes.push(format!("{absent} of {} masks have no picture", files.len()));
    }
    let files = joined.at.iter().zip(files).filter_map(|(at, (_, path))| Some(((*at)?, Source::File(path))));
    Ok((files.collect(), notes))
}

/// Raw values of a mask file, one a pixel: palette indices, not colours.
pub(super) struct Levels {
    pub width: u32,
    pub height: u32,
    /// Row by row.
    pub values: Vec<u32>,
    /// Full coverage, where values are coverage: 255 or 65535.
    pub full: u32,
    /// Whether values are ids: of a palette, or integers of a `.npy` file.
    pub ids: bool,
    /// Whether values are of an alpha channel.
    pub alpha: bool,
}

impl Levels {
    /// Reads a PNG, JPEG or `.npy` file.
    pub fn load(path: &Path) -> Result<Self, CaptureError> {
        if path.extension().is_some_and(|e| e.eq_ignore_ascii_case("npy")) {
            return Self::from_array(path, &read_npy(path)?);
        }
        if let Some(levels) = indexed(path)? {
            return Ok(levels);
        }
        let picture = decode(path)?;
        let (width, height) = (picture.width(), picture.height());
        if let Some(alpha) = alpha(&picture) {
            let values = alpha.into_iter().map(u32::from).collect();
            return Ok(Self { width, height, values, full: 65535, ids: false, alpha: true });
        }
        // Levels of 8 bits are not scaled: they may be ids.
        let depth = picture.color().bytes_per_pixel() / picture.color().channel_count();
        let scale = if depth > 1 { 1 } else { 257 };
        let rgb = picture.into_rgb16();
        let spread = |p: &image::Rgb<u16>| p[0].abs_diff(p[1]).max(p[1].abs_diff(p[2]));
        if let Some(pixel) = rgb.pixels().find(|p| spread(p) > 16 * 257) {
            let expected = "shades of grey, a palette whose indices are objects, or transparency (alpha)";
            let found = format!("colour {:?}", pixel.0.map(|c| c / 257));
            return Err(CaptureError::invalid(path, "colours", expected, found));
        }
        let values = rgb.pixels().map(|p| u32::from(p[0]) / scale).collect();
        Ok(Self { width, height, values, full: 65535 / scale, ids: false, alpha: false })
    }

    /// From an array (H,W), ignoring axes of length 1; floats are coverage from 0 to 1, or whole
    /// numbers.
    pub fn from_array(path: &Path, array: &NdArray) -> Result<Self, CaptureError> {
        let bare: Vec<usize> = array.shape.iter().copied().filter(|&n| n != 1).collect();
        let sides = match (array.shape.as_slice(), bare.as_slice()) {
            (&[height, width], _) | (_, &[height, width]) => Some((width, height)),
            _ => None,
        };
        let side = |n: usize| u32::try_from(n).ok().filter(|n| (1..=MAX_SIDE).contains(n));
        let sides = sides.and_then(|(width, height)| side(width).zip(side(height)));
        let (width, height) = sides.ok_or_else(|| {
            let expected = format!("(height, width) of 1 to {MAX_SIDE}");
            CaptureError::invalid(path, "shape", expected, format!("{:?}", array.shape))
        })?;
        let wrong = |value: String| {
            CaptureError::invalid(path, "values", "ids of objects from 0, or coverage from 0 to 1", value)
        };
        let whole = |id: i64| u32::try_from(id).map_err(|_| wrong(id.to_string()));
        let (values, ids): (Result<Vec<u32>, _>, bool) = match &array.data {
            Data::Bool(v) => (Ok(v.iter().map(|&b| u32::from(b)).collect()), true),
            Data::I64(v) => (v.iter().map(|&id| whole(id)).collect(), true),
            Data::F32(_) | Data::F64(_) => {
                let values = array.to_f64();
                let ids = values.iter().any(|x| *x > 1.0) && values.iter().all(|x| x.fract() == 0.0);
                let share = |&x: &f64| match ids {
                    true => whole(x as i64),
                    false if (0.0..=1.0).contains(&x) => Ok((x * 65535.0).round() as u32),
                    false => Err(wrong(x.to_string())),
                };
                (values.iter().map(share).collect(), ids)
            }
        };
        let full = if ids { 255 } else { 65535 };
        Ok(Self { width, height, values: values?, full, ids, alpha: false })
    }
}

/// The values of a PNG with a palette or at most 8 bits of grey; `None` for others.
fn indexed(path: &Path) -> Result<Option<Levels>, CaptureError> {
    let file = BufReader::new(File::open(path).map_err(CaptureError::io(path))?);
    let limits = Limits { bytes: (MAX_SIDE as usize).pow(2) };
    let Ok(mut reader) = Decoder::new_with_limits(file, limits).read_info() else { return Ok(None) };
    let info = reader.info();
    let (kind, depth) = (info.color_type, info.bit_depth as usize);
    if !matches!(kind, ColorType::Indexed | ColorType::Grayscale) || depth > 8 {
        return Ok(None);
    }
    // Checks the size.
    let (width, height) = dimensions(path)?;
    let malformed = |what: String| CaptureError::invalid(path, "pixels", "a whole PNG", what);
    let length = reader.output_buffer_size().ok_or_else(|| malformed("no size".to_owned()))?;
    let mut bytes = vec![0; length];
    reader.next_frame(&mut bytes).map_err(|e| malformed(e.to_string()))?;
    let row = (width as usize * depth).div_ceil(8);
    let mask = ((1u16 << depth) - 1) as u8;
    let values = bytes.chunks(row.max(1)).take(height as usize).flat_map(|row| {
        // The leftmost pixel is in the highest bits.
        (0..width as usize).map(move |x| {
            let at = x * depth;
            row.get(at / 8).map_or(0, |byte| u32::from(byte >> (8 - depth - at % 8) & mask))
        })
    });
    let mut values: Vec<u32> = values.collect();
    if kind == ColorType::Grayscale && depth == 1 {
        // One bit of grey is 0 or 255.
        values.iter_mut().for_each(|value| *value *= 255);
    }
    Ok(Some(Levels { width, height, values, full: 255, ids: kind == ColorType::Indexed, alpha: false }))
}
