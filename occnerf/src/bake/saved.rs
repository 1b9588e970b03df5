//! Avatars as safetensors, bit for bit.

use std::collections::HashMap;
use std::path::Path;

use glam::{Affine3A, Mat3, Vec2, Vec3};
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};
use smpl::{Joint, MotionClip, SparseRows};
use volrender::Camera;

use super::avatar::{Atlas, Avatar, Clip};
use crate::Error;
use crate::capture::Light;

const FORMAT: &str = "occnerf-avatar";
const VERSION: u32 = 2;
/// Key of [`Header`] as JSON in the file's metadata.
const KEY: &str = "avatar";
/// Any size of an axis.
const ANY: usize = usize::MAX;

/// Metadata beside the arrays.
#[derive(Serialize, Deserialize)]
struct Header {
    format: String,
    version: u32,
    name: String,
    #[serde(default, skip_serializing_if = "String::is_empty")]
    source: String,
    joints: Vec<String>,
    /// Slope; even light if absent.
    #[serde(default)]
    light: [f32; 3],
    clips: Vec<(String, f32)>,
}

impl Avatar {
    /// Writes the avatar as `.safetensors`, which [`Avatar::load`] reads back bit for bit. The file is
    /// replaced atomically; equal avatars give equal files.
    ///
    /// Tensors have the names and shapes of the fields; `cameras.intrinsics` is (T, 4): fx fy cx
    /// cy, `cameras.extrinsics` (T, 3, 4), `cameras.size` (T, 2): width, height; clip K has
    /// `clip.K.poses` (T, J, 3) and `clip.K.trans` (T, 3).
    ///
    /// # Errors
    /// [`Error::File`] with what [`Avatar::validate`] finds; [`Error::Io`].
    pub fn save(&self, path: &Path) -> Result<(), Error> {
        self.validate().map_err(|what| file(path, what))?;
        let header = Header {
            format: FORMAT.to_owned(),
            version: VERSION,
            name: self.name.clone(),
            source: self.source.clone(),
            joints: self.skeleton.iter().map(|joint| joint.name.clone()).collect(),
            light: self.light.slope.to_array(),
            clips: self.clips.iter().map(|clip| (clip.name.clone(), clip.motion.fps)).collect(),
        };
        let header = serde_json::to_string(&header).map_err(|e| file(path, format!("header: {e}")))?;
        let tensors = self.tensors();
        let fault = |e: safetensors::SafeTensorError| file(path, format!("header: {e}"));
        let mut views = Vec::with_capacity(tensors.len());
        for (name, kind, shape, bytes) in &tensors {
            views.push((name.as_str(), TensorView::new(*kind, shape.clone(), bytes).map_err(fault)?));
        }
        let bytes = safetensors::serialize(views, Some(HashMap::from([(KEY.to_owned(), header)]))).map_err(fault)?;
        super::write_whole(path, &bytes)
    }

    /// Name, type, shape and bytes of each array.
    fn tensors(&self) -> Vec<(String, Dtype, Vec<usize>, Vec<u8>)> {
        let Self { atlas, posedirs, skeleton, cameras, .. } = self;
        let (v, j, t) = (self.num_vertices(), self.num_joints(), cameras.len());
        let (width, height) = (atlas.width as usize, atlas.height as usize);
        let words = |values: &[u32]| values.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>();
        let flat = |values: &[Vec3]| floats(values.iter().flat_map(|x| x.to_array()));
        let parent = |joint: &Joint| joint.parent.map_or(-1, i32::from).to_le_bytes();
        let intrinsics = |c: &Camera| [c.focal.x, c.focal.y, c.centre.x, c.centre.y];
        let extrinsics = |c: &Camera| {
            let columns = c.world_to_camera.to_cols_array();
            (0..12).map(move |i| columns[3 * (i % 4) + i / 4])
        };
        let mut tensors = Vec::new();
        let mut add = |name: &str, kind: Dtype, shape: &[usize], bytes: Vec<u8>| {
            tensors.push((name.to_owned(), kind, shape.to_vec(), bytes));
        };
        add("vertices", Dtype::F32, &[v, 3], flat(&self.vertices));
        add("normals", Dtype::F32, &[v, 3], flat(&self.normals));
        add("uvs", Dtype::F32, &[v, 2], floats(self.uvs.iter().flat_map(|x| x.to_array())));
        add("faces", Dtype::U32, &[self.faces.len(), 3], words(self.faces.as_flattened()));
        add("joints", Dtype::U16, &[v, 4], self.joints.iter().flatten().flat_map(|x| x.to_le_bytes()).collect());
        add("weights", Dtype::F32, &[v, 4], floats(self.weights.as_flattened().iter().copied()));
        add("posedirs.offsets", Dtype::U32, &[posedirs.offsets.len()], words(&posedirs.offsets));
        add("posedirs.columns", Dtype::U32, &[posedirs.columns.len()], words(&posedirs.columns));
        add("posedirs.values", Dtype::F32, &[posedirs.values.len(), 3], flat(&posedirs.values));
        add("atlas.rgb", Dtype::U8, &[height, width, 3], atlas.rgb.clone());
        add("atlas.confidence", Dtype::U8, &[height, width], atlas.confidence.clone());
        add("parents", Dtype::I32, &[j], skeleton.iter().flat_map(parent).collect());
        add("rest_joints", Dtype::F32, &[j, 3], floats(skeleton.iter().flat_map(|joint| joint.rest.to_array())));
        add("betas", Dtype::F32, &[self.betas.len()], floats(self.betas.iter().copied()));
        add("cameras.intrinsics", Dtype::F32, &[t, 4], floats(cameras.iter().flat_map(intrinsics)));
        add("cameras.extrinsics", Dtype::F32, &[t, 3, 4], floats(cameras.iter().flat_map(extrinsics)));
        let sizes: Vec<u32> = cameras.iter().flat_map(|c| [c.width, c.height]).collect();
        add("cameras.size", Dtype::U32, &[t, 2], words(&sizes));
        for (c, Clip { motion, .. }) in self.clips.iter().enumerate() {
            add(&format!("clip.{c}.poses"), Dtype::F32, &[motion.num_frames(), j, 3], flat(&motion.poses));
            add(&format!("clip.{c}.trans"), Dtype::F32, &[motion.num_frames(), 3], flat(&motion.trans));
        }
        tensors
    }

    /// Reads a file of [`Avatar::save`].
    ///
    /// # Errors
    /// [`Error::Io`]; [`Error::File`] for anything but a complete, valid avatar.
    pub fn load(path: &Path) -> Result<Self, Error> {
        let bytes = crate::model::file::read(path)?;
        let avatar = parse(&bytes).map_err(|what| file(path, what))?;
        avatar.validate().map_err(|what| file(path, what))?;
        Ok(avatar)
    }
}

fn parse(bytes: &[u8]) -> Result<Avatar, String> {
    let not_ours = |e: safetensors::SafeTensorError| format!("is not a whole safetensors file: {e}");
    let (_, metadata) = SafeTensors::read_metadata(bytes).map_err(not_ours)?;
    let header = metadata.metadata().as_ref().and_then(|map| map.get(KEY));
    let header = header.ok_or_else(|| format!("header lacks `{KEY}`: not an avatar"))?;
    let header: Header = serde_json::from_str(header).map_err(|e| format!("header `{KEY}`: {e}"))?;
    if header.format != FORMAT || header.version != VERSION {
        let (format, version) = (header.format, header.version);
        return Err(format!("is {format} version {version}, expected {FORMAT} version {VERSION}"));
    }
    let source = Source(SafeTensors::deserialize(bytes).map_err(not_ours)?);
    let shape = source.view("atlas.confidence")?.shape().to_vec();
    let (height, width) = (shape.first().copied().unwrap_or(0), shape.get(1).copied().unwrap_or(0));
    let j = header.joints.len();
    let parents = source.array("parents", Dtype::I32, &[j], i32::from_le_bytes)?;
    let rest = source.vectors("rest_joints", &[j, 3])?;
    let joint = |((name, parent), rest): ((String, i32), Vec3)| {
        let known = u16::try_from(parent).ok();
        match known.is_some() || parent == -1 {
            true => Ok(Joint { name, parent: known, rest }),
            false => Err(format!("`parents`: {parent} is no joint")),
        }
    };
    let skeleton: Result<Vec<Joint>, String> = header.joints.into_iter().zip(parents).zip(rest).map(joint).collect();
    let clip = |(c, (name, fps)): (usize, (String, f32))| {
        let poses = source.vectors(&format!("clip.{c}.poses"), &[ANY, j, 3])?;
        let trans = source.vectors(&format!("clip.{c}.trans"), &[ANY, 3])?;
        Ok(Clip { name, motion: MotionClip { poses, num_joints: j, trans, fps } })
    };
    let clips: Result<Vec<Clip>, String> = header.clips.into_iter().enumerate().map(clip).collect();
    let bytes = |key: &str, pattern: &[usize]| source.array(key, Dtype::U8, pattern, u8::from_le_bytes);
    let words = |key: &str, pattern: &[usize]| source.array(key, Dtype::U32, pattern, u32::from_le_bytes);
    let uvs = source.floats("uvs", &[ANY, 2])?;
    let joints = source.array("joints", Dtype::U16, &[ANY, 4], u16::from_le_bytes)?;
    Ok(Avatar {
        name: header.name,
        source: header.source,
        vertices: source.vectors("vertices", &[ANY, 3])?,
        normals: source.vectors("normals", &[ANY, 3])?,
        uvs: uvs.chunks_exact(2).map(Vec2::from_slice).collect(),
        faces: words("faces", &[ANY, 3])?.as_chunks().0.to_vec(),
        joints: joints.as_chunks().0.to_vec(),
        weights: source.floats("weights", &[ANY, 4])?.as_chunks().0.to_vec(),
        posedirs: SparseRows {
            offsets: words("posedirs.offsets", &[ANY])?,
            columns: words("posedirs.columns", &[ANY])?,
            values: source.vectors("posedirs.values", &[ANY, 3])?,
        },
        atlas: Atlas {
            width: u32::try_from(width).unwrap_or(u32::MAX),
            height: u32::try_from(height).unwrap_or(u32::MAX),
            rgb: bytes("atlas.rgb", &[height, width, 3])?,
            confidence: bytes("atlas.confidence", &[ANY, ANY])?,
        },
        light: Light { slope: header.light.into() },
        skeleton: skeleton?,
        betas: source.floats("betas", &[ANY])?,
        clips: clips?,
        cameras: cameras(&source)?,
    })
}

fn cameras(source: &Source<'_>) -> Result<Vec<Camera>, String> {
    let sizes = source.array("cameras.size", Dtype::U32, &[ANY, 2], u32::from_le_bytes)?;
    let n = sizes.len() / 2;
    let intrinsics = source.floats("cameras.intrinsics", &[n, 4])?;
    let extrinsics = source.floats("cameras.extrinsics", &[n, 3, 4])?;
    let each = sizes.chunks_exact(2).zip(intrinsics.chunks_exact(4)).zip(extrinsics.chunks_exact(12));
    each.enumerate()
        .map(|(i, ((size, k), e))| {
            let matrix = Mat3::from_cols_array(&[k[0], 0.0, 0.0, 0.0, k[1], 0.0, k[2], k[3], 1.0]);
            let column = |c: usize| Vec3::new(e[c], e[4 + c], e[8 + c]);
            let turn = Mat3::from_cols(column(0), column(1), column(2));
            let world_to_camera = Affine3A::from_mat3_translation(turn, column(3));
            Camera::new(matrix, world_to_camera, size[0], size[1]).map_err(|e| format!("camera {i}: {e}"))
        })
        .collect()
}

/// The arrays of a file.
struct Source<'a>(SafeTensors<'a>);

impl Source<'_> {
    fn view(&self, key: &str) -> Result<TensorView<'_>, String> {
        self.0.tensor(key).map_err(|_| format!("lacks `{key}`"))
    }

    /// The tensor `key` of type `kind` and shape `pattern`, with [`ANY`] for any size, word by word.
    fn array<const N: usize, T>(
        &self,
        key: &str,
        kind: Dtype,
        pattern: &[usize],
        word: fn([u8; N]) -> T,
    ) -> Result<Vec<T>, String> {
        let view = self.view(key)?;
        let shape = view.shape();
        let fits = shape.len() == pattern.len() && shape.iter().zip(pattern).all(|(n, p)| *p == ANY || n == p);
        if view.dtype() != kind || !fits {
            let expected = format!("{kind:?} {pattern:?}").replace(&ANY.to_string(), "_");
            return Err(format!("`{key}` is {:?} {shape:?}, expected {expected}", view.dtype()));
        }
        Ok(view.data().as_chunks::<N>().0.iter().map(|&bytes| word(bytes)).collect())
    }

    fn floats(&self, key: &str, pattern: &[usize]) -> Result<Vec<f32>, String> {
        self.array(key, Dtype::F32, pattern, f32::from_le_bytes)
    }

    fn vectors(&self, key: &str, pattern: &[usize]) -> Result<Vec<Vec3>, String> {
        Ok(self.floats(key, pattern)?.chunks_exact(3).map(Vec3::from_slice).collect())
    }
}

fn floats(values: impl Iterator<Item = f32>) -> Vec<u8> {
    values.flat_map(f32::to_le_bytes).collect()
}

fn file(path: &Path, what: String) -> Error {
    Error::File { path: path.to_owned(), what }
}
