//! Buffers and accessors of glTF, with every range checked before it is read.

use std::cell::Cell;
use std::path::{Component, Path};

use array_files::read_file;
use base64::Engine;
use gltf::json::accessor::{Accessor, ComponentType};
use gltf::json::buffer::{Buffer, View};
use gltf::json::validation::Checked;
use gltf::json::{Index, Root};
use meshoptimizer_rs::Workspace;
use meshoptimizer_rs::codec::{BufferView, Filter, Mode};
use serde::Deserialize;
use serde_json::Value;
use smpl::Error;

/// Total decoded size of all accessors, in bytes: 256 MiB.
const MAX_DECODED_BYTES: u64 = 1 << 28;
/// Total size of buffers and images, in bytes: 512 MiB. A document may name one file many times.
const MAX_RESOLVED_BYTES: u64 = 1 << 29;

/// Extensions of buffer views that meshoptimizer compressed.
const MESHOPT: [&str; 2] = ["EXT_meshopt_compression", "KHR_meshopt_compression"];

/// One of [`MESHOPT`].
#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Compressed {
    buffer: usize,
    #[serde(default)]
    byte_offset: u64,
    byte_length: u64,
    byte_stride: usize,
    count: usize,
    mode: String,
    filter: Option<String>,
}

/// Whether a buffer stands for what compressed views hold.
fn is_fallback(buffer: &Buffer) -> bool {
    let others = buffer.extensions.iter().flat_map(|extensions| extensions.others.values());
    others.into_iter().any(|extension| extension.get("fallback") == Some(&Value::Bool(true)))
}

/// A document with its buffers. Every index and range is checked where it is used.
pub(crate) struct Source<'a> {
    pub(crate) file: &'a str,
    pub(crate) root: &'a Root,
    /// Directory of files it may refer to; `None` allows none.
    folder: Option<&'a Path>,
    data: Vec<Vec<u8>>,
    /// What is in compressed buffer views.
    decompressed: Vec<Option<Vec<u8>>>,
    /// Remaining budget of decoded bytes: many accessors may share one range.
    left: Cell<u64>,
    /// Remaining budget of bytes of URIs and images.
    resolvable: Cell<u64>,
}

impl<'a> Source<'a> {
    /// `blob` is the binary chunk of a `.glb`; other buffers are data URIs or files in `folder`.
    pub(crate) fn new(
        file: &'a str,
        root: &'a Root,
        mut blob: Option<Vec<u8>>,
        folder: Option<&'a Path>,
    ) -> Result<Self, Error> {
        let mut source = Self {
            file,
            root,
            folder,
            data: Vec::new(),
            decompressed: Vec::new(),
            left: Cell::new(MAX_DECODED_BYTES),
            resolvable: Cell::new(MAX_RESOLVED_BYTES),
        };
        for (i, buffer) in root.buffers.iter().enumerate() {
            let place = format!("buffer {i}");
            let bytes = match &buffer.uri {
                Some(uri) => source.resolve(&place, uri)?,
                None if is_fallback(buffer) => {
                    source.data.push(Vec::new());
                    continue;
                }
                None => blob.take().ok_or_else(|| source.invalid(&place, "neither a URI nor a binary chunk"))?,
            };
            if buffer.byte_length.0 > bytes.len() as u64 {
                let message = format!("{} bytes declared, {} present", buffer.byte_length.0, bytes.len());
                return Err(source.invalid(&place, message));
            }
            source.data.push(bytes);
        }
        for (i, view) in root.buffer_views.iter().enumerate() {
            let others = view.extensions.as_ref().map(|extensions| &extensions.others);
            let compressed = MESHOPT.iter().find_map(|name| others?.get(*name));
            let place = format!("buffer view {i}");
            let bytes = compressed.map(|compressed| source.decompress(&place, view, compressed)).transpose()?;
            source.decompressed.push(bytes);
        }
        Ok(source)
    }

    /// The item at `index`; errors name `place`.
    pub(crate) fn get<'b, T>(&self, items: &'b [T], index: Index<T>, place: &str) -> Result<&'b T, Error> {
        let missing = || self.invalid(place, format!("index {index} of {}", items.len()));
        items.get(index.value()).ok_or_else(missing)
    }

    /// The bytes of a buffer view.
    pub(crate) fn view(&self, index: Index<View>, place: &str) -> Result<(&View, &[u8]), Error> {
        let view = self.get(&self.root.buffer_views, index, place)?;
        if let Some(Some(bytes)) = self.decompressed.get(index.value()) {
            return Ok((view, bytes));
        }
        let bytes = self.range(view.buffer.value(), view.byte_offset.unwrap_or_default().0, view.byte_length.0);
        let outside = || self.invalid(place, format!("buffer view {index} leaves its buffer"));
        Ok((view, bytes.ok_or_else(outside)?))
    }

    fn range(&self, buffer: usize, start: u64, length: u64) -> Option<&[u8]> {
        let (start, end) = (usize::try_from(start).ok()?, usize::try_from(start.checked_add(length)?).ok()?);
        self.data.get(buffer)?.get(start..end)
    }

    fn decompress(&self, place: &str, view: &View, compressed: &Value) -> Result<Vec<u8>, Error> {
        let Compressed { buffer, byte_offset, byte_length, byte_stride, count, mode, filter } =
            Compressed::deserialize(compressed).map_err(|error| self.invalid(place, error.to_string()))?;
        let outside = || self.invalid(place, "its compressed bytes leave their buffer");
        let bytes = self.range(buffer, byte_offset, byte_length).ok_or_else(outside)?;
        self.spend(place, view.byte_length.0)?;
        let decode = || {
            let filter = filter.map_or(Ok(Filter::None), |filter| Filter::parse(&filter))?;
            let layout = BufferView::new(Mode::parse(&mode)?, filter, count, byte_stride)?;
            layout.validate_parent(view.byte_length.0 as usize, view.byte_stride.map(|stride| stride.0))?;
            layout.decode(bytes, &mut Workspace::default())
        };
        decode().map_err(|error| self.invalid(place, format!("not of meshopt ({mode}): {error}")))
    }

    /// Elements of N components, decoded by `component` from the bytes of one; `None` from it is an
    /// error.
    fn elements<const N: usize, T: Copy + Default>(
        &self,
        index: Index<Accessor>,
        place: &str,
        component: impl Fn(ComponentType, bool, &[u8]) -> Option<T>,
    ) -> Result<Vec<[T; N]>, Error> {
        let accessor = self.get(&self.root.accessors, index, place)?;
        let place = format!("{place} (accessor {index})");
        let invalid = |message: &str| Err(self.invalid(&place, message.to_owned()));
        let (Checked::Valid(dimensions), Checked::Valid(kind)) = (accessor.type_, accessor.component_type) else {
            return invalid("of an unknown type");
        };
        if dimensions.multiplicity() != N {
            return invalid(&format!("{dimensions:?}, expected {N} components"));
        }
        if accessor.sparse.is_some() {
            return invalid("sparse accessors are not read");
        }
        let kind = kind.0;
        let count = accessor.count.0;
        let charge = || {
            let cost = count.saturating_mul((N * size_of::<T>()) as u64);
            let left = self.left.get().checked_sub(cost);
            // The limit is of all accessors together.
            let claimed = u128::from(MAX_DECODED_BYTES - self.left.get()) + u128::from(cost);
            let too_large = || too_large(self.file, &place, claimed, MAX_DECODED_BYTES);
            left.map(|left| self.left.set(left)).ok_or_else(too_large)
        };
        // Without a view, zeros.
        let Some(view) = accessor.buffer_view else {
            return charge().map(|()| vec![[T::default(); N]; count as usize]);
        };
        let (view, bytes) = self.view(view, &place)?;
        let width = kind.size();
        let size = N * width;
        let stride = view.byte_stride.map_or(size, |stride| stride.0);
        let start = accessor.byte_offset.unwrap_or_default().0;
        let last = count.checked_sub(1).and_then(|n| n.checked_mul(stride as u64));
        let end = last.and_then(|n| n.checked_add(size as u64)).and_then(|n| n.checked_add(start));
        if count > 0 && end.is_none_or(|end| end > bytes.len() as u64) {
            return invalid(&format!("{count} elements leave its buffer view"));
        }
        if stride < size {
            return invalid(&format!("a stride of {stride} for elements of {size} bytes"));
        }
        charge()?;
        // Both fit: they lie within the bytes.
        let (count, start) = (count as usize, start as usize);
        let mut out = Vec::with_capacity(count);
        for i in 0..count {
            let element = &bytes[start + i * stride..][..size];
            let mut values = [T::default(); N];
            for (value, bytes) in values.iter_mut().zip(element.chunks_exact(width)) {
                let Some(decoded) = component(kind, accessor.normalized, bytes) else {
                    return invalid(&format!("element {i} is of the wrong type ({kind:?}) or not finite"));
                };
                *value = decoded;
            }
            out.push(values);
        }
        Ok(out)
    }

    /// Finite floats; integers if normalised, or where the document quantises
    /// (KHR_mesh_quantization).
    pub(crate) fn floats<const N: usize>(&self, index: Index<Accessor>, place: &str) -> Result<Vec<[f32; N]>, Error> {
        let quantized = self.root.extensions_required.iter().any(|name| name == "KHR_mesh_quantization");
        self.elements(index, place, |kind, normalized, bytes| {
            let (value, most) = match kind {
                ComponentType::F32 => {
                    return Some(f32::from_le_bytes(bytes.try_into().ok()?)).filter(|x| x.is_finite());
                }
                ComponentType::U8 => (f32::from(*bytes.first()?), 255.0),
                ComponentType::U16 => (f32::from(u16::from_le_bytes(bytes.try_into().ok()?)), 65535.0),
                ComponentType::I8 => (f32::from(*bytes.first()? as i8), 127.0),
                ComponentType::I16 => (f32::from(i16::from_le_bytes(bytes.try_into().ok()?)), 32767.0),
                ComponentType::U32 => return None,
            };
            match normalized {
                true => Some((value / most).max(-1.0)),
                false => quantized.then_some(value),
            }
        })
    }

    /// Unsigned integers.
    pub(crate) fn indices<const N: usize>(&self, index: Index<Accessor>, place: &str) -> Result<Vec<[u32; N]>, Error> {
        self.elements(index, place, |kind, _, bytes| match kind {
            ComponentType::U8 => Some(u32::from(*bytes.first()?)),
            ComponentType::U16 => Some(u32::from(u16::from_le_bytes(bytes.try_into().ok()?))),
            ComponentType::U32 => Some(u32::from_le_bytes(bytes.try_into().ok()?)),
            _ => None,
        })
    }

    /// Bytes of a data URI, or of a file in the folder. URIs that leave the folder are refused.
    pub(crate) fn resolve(&self, place: &str, uri: &str) -> Result<Vec<u8>, Error> {
        if let Some(rest) = uri.strip_prefix("data:") {
            let Some((_, text)) = rest.split_once(";base64,") else {
                return Err(self.invalid(place, "a data URI that is not base64"));
            };
            self.spend(place, text.len() as u64 / 4 * 3)?;
            let bytes = base64::engine::general_purpose::STANDARD.decode(text);
            return bytes.map_err(|e| self.invalid(place, e));
        }
        let decoded = percent_decoded(uri);
        let path = Path::new(&decoded);
        let inside = path.components().all(|c| matches!(c, Component::Normal(_) | Component::CurDir));
        match self.folder {
            Some(folder) if inside => {
                let path = folder.join(path);
                // Before it is read.
                self.spend(place, std::fs::metadata(&path).map_or(0, |file| file.len()))?;
                read_file(&path)
            }
            _ => Err(self.invalid(place, format!("the URI {uri:?} does not name a file beside it"))),
        }
    }

    /// Charges the bytes of a URI or an image to the document's budget.
    pub(crate) fn spend(&self, place: &str, bytes: u64) -> Result<(), Error> {
        let left = self.resolvable.get().checked_sub(bytes).ok_or_else(|| {
            let claimed = u128::from(MAX_RESOLVED_BYTES - self.resolvable.get()) + u128::from(bytes);
            too_large(self.file, place, claimed, MAX_RESOLVED_BYTES)
        })?;
        self.resolvable.set(left);
        Ok(())
    }

    pub(crate) fn invalid(&self, place: &str, message: impl ToString) -> Error {
        Error::invalid(self.file, place, message)
    }
}

fn too_large(file: &str, place: &str, claimed: u128, limit: u64) -> Error {
    Error::too_large(file, place, claimed, limit)
}

/// A URI with its %XX replaced by their bytes.
fn percent_decoded(uri: &str) -> String {
    let (mut out, mut rest) = (Vec::new(), uri.as_bytes());
    while let Some((&first, after)) = rest.split_first() {
        let is_hex = |hex: &&[u8]| first == b'%' && hex.iter().all(u8::is_ascii_hexdigit);
        let digits = after.get(..2).filter(is_hex).and_then(|hex| std::str::from_utf8(hex).ok());
        match digits.and_then(|hex| u8::from_str_radix(hex, 16).ok()) {
            Some(byte) => (out.push(byte), rest = &after[2..]).1,
            None => (out.push(first), rest = after).1,
        }
    }
    String::from_utf8_lossy(&out).into_owned()
}
