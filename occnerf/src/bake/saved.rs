//! Avatars as safetensors, bit for bit.

use std::collections::HashMap;
use std::path::Path;

use glam::{Affine3A, Mat3, Vec2, Vec3};
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};
use smpl::{MotionClip, SparseRows};
use volrender::Camera;

use super::avatar::{Atlas, Avatar, Clip, Joint};
use crate::Error;
use crate::capture::Light;

const FORMAT: &str = "occnerf-avatar";
const VERSION: u32 = 2;
/// Key of [`Header`] as JSON in the file's metadata.
const KEY: &str = "avatar";
/// Largest file.
const MAX_BYTES: u64 = 1 << 30;

/// Metadata beside the arrays.
#[derive(Serialize, Deserialize)]
struct Header {
    format: String,
    version: u32,
    name: String,
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
        let (v, j, atlas) = (self.num_vertices(), self.num_joints(), &self.atlas);
        let (width, height) = (atlas.width as usize, atlas.height as usize);
        let words = |values: &[u32]| values.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>();
        let flat = |values: &[Vec3]| floats(values.iter().flat_map(|x| x.to_array()));
        let parent = |joint: &Joint| joint.parent.map_or(-1, i32::from).to_le_bytes();
        let rest: Vec<Vec3> = self.skeleton.iter().map(|joint| joint.rest).collect();
        let directions = &self.posedirs;
        let shorts = self.joints.iter().flatten().flat_map(|x| x.to_le_bytes()).collect();
        let cameras = self.cameras.len();
        let intrinsics = self.cameras.iter().flat_map(|c| [c.focal.x, c.focal.y, c.centre.x, c.centre.y]);
        let extrinsics = self.cameras.iter().flat_map(|c| {
            let columns = c.world_to_camera.to_cols_array();
            (0..12).map(move |i| columns[3 * (i % 4) + i / 4])
        });
        let sizes: Vec<u32> = self.cameras.iter().flat_map(|c| [c.width, c.height]).collect();
        let mut tensors = vec![
            ("vertices", Dtype::F32, vec![v, 3], flat(&self.vertices)),
            ("normals", Dtype::F32, vec![v, 3], flat(&self.normals)),
            ("uvs", Dtype::F32, vec![v, 2], floats(self.uvs.iter().flat_map(|x| x.to_array()))),
            ("faces", Dtype::U32, vec![self.faces.len(), 3], words(self.faces.as_flattened())),
            ("joints", Dtype::U16, vec![v, 4], shorts),
            ("weights", Dtype::F32, vec![v, 4], floats(self.weights.as_flattened().iter().copied())),
            ("posedirs.offsets", Dtype::U32, vec![directions.offsets.len()], words(&directions.offsets)),
            ("posedirs.columns", Dtype::U32, vec![directions.columns.len()], words(&directions.columns)),
            ("posedirs.values", Dtype::F32, vec![directions.values.len(), 3], flat(&directions.values)),
            ("atlas.rgb", Dtype::U8, vec![height, width, 3], atlas.rgb.clone()),
            ("atlas.confidence", Dtype::U8, vec![height, width], atlas.confidence.clone()),
            ("parents", Dtype::I32, vec![j], self.skeleton.iter().flat_map(parent).collect()),
            ("rest_joints", Dtype::F32, vec![j, 3], flat(&rest)),
            ("betas", Dtype::F32, vec![self.betas.len()], floats(self.betas.iter().copied())),
            ("cameras.intrinsics", Dtype::F32, vec![cameras, 4], floats(intrinsics)),
            ("cameras.extrinsics", Dtype::F32, vec![cameras, 3, 4], floats(extrinsics)),
            ("cameras.size", Dtype::U32, vec![cameras, 2], words(&sizes)),
        ]
        .into_iter()
        .map(|(name, kind, shape, bytes)| (name.to_owned(), kind, shape, bytes))
        .collect::<Vec<_>>();
        for (c, Clip { motion, .. }) in self.clips.iter().enumerate() {
            let frames = motion.num_frames();
            tensors.push((format!("clip.{c}.poses"), Dtype::F32, vec![frames, j, 3], flat(&motion.poses)));
            tensors.push((format!("clip.{c}.trans"), Dtype::F32, vec![frames, 3], flat(&motion.trans)));
        }
        tensors
    }

    /// Reads a file of [`Avatar::save`].
    ///
    /// # Errors
    /// [`Error::Io`]; [`Error::File`] for anything but a complete, valid avatar.
    pub fn load(path: &Path) -> Result<Self, Error> {
        let io = |source| Error::Io { path: path.to_owned(), source };
        let size = std::fs::metadata(path).map_err(io)?.len();
        if size > MAX_BYTES {
            return Err(file(path, format!("has {size} bytes, expected at most {MAX_BYTES}")));
        }
        let bytes = std::fs::read(path).map_err(io)?;
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
    let source = Source { tensors: SafeTensors::deserialize(bytes).map_err(not_ours)? };
    let [height, width] = source.shape("atlas.confidence")?;
    let j = header.joints.len();
    let parents = source.array("parents", Dtype::I32, &[Some(j)], i32::from_le_bytes)?;
    let rest = source.vectors("rest_joints", &[Some(j), Some(3)])?;
    let joint = |((name, parent), rest): ((String, i32), Vec3)| {
        let known = u16::try_from(parent).ok();
        match known.is_some() || parent == -1 {
            true => Ok(Joint { name, parent: known, rest }),
            false => Err(format!("`parents`: {parent} is no joint")),
        }
    };
    let skeleton: Result<Vec<Joint>, String> = header.joints.into_iter().zip(parents).zip(rest).map(joint).collect();
    let clip = |(c, (name, fps)): (usize, (String, f32))| {
        let poses = source.vectors(&format!("clip.{c}.poses"), &[None, Some(j), Some(3)])?;
        let trans = source.vectors(&format!("clip.{c}.trans"), &[None, Some(3)])?;
        Ok(Clip { name, motion: MotionClip { poses, num_joints: j, trans, fps } })
    };
    let clips: Result<Vec<Clip>, String> = header.clips.into_iter().enumerate().map(clip).collect();
    let bytes = |key: &str, pattern: &[Option<usize>]| source.array(key, Dtype::U8, pattern, u8::from_le_bytes);
    let words = |key: &str, pattern: &[Option<usize>]| source.array(key, Dtype::U32, pattern, u32::from_le_bytes);
    let uvs = source.floats("uvs", &[None, Some(2)])?;
    let joints = source.array("joints", Dtype::U16, &[None, Some(4)], u16::from_le_bytes)?;
    Ok(Avatar {
        name: header.name,
        vertices: source.vectors("vertices", &[None, Some(3)])?,
        normals: source.vectors("normals", &[None, Some(3)])?,
        uvs: uvs.chunks_exact(2).map(Vec2::from_slice).collect(),
        faces: words("faces", &[None, Some(3)])?.as_chunks().0.to_vec(),
        joints: joints.as_chunks().0.to_vec(),
        weights: source.floats("weights", &[None, Some(4)])?.as_chunks().0.to_vec(),
        posedirs: SparseRows {
            offsets: words("posedirs.offsets", &[None])?,
            columns: words("posedirs.columns", &[None])?,
            values: source.vectors("posedirs.values", &[None, Some(3)])?,
        },
        atlas: Atlas {
            width: u32::try_from(width).unwrap_or(u32::MAX),
            height: u32::try_from(height).unwrap_or(u32::MAX),
            rgb: bytes("atlas.rgb", &[Some(height), Some(width), Some(3)])?,
            confidence: bytes("atlas.confidence", &[None, None])?,
        },
        light: Light { slope: header.light.into() },
        skeleton: skeleton?,
        betas: source.floats("betas", &[None])?,
        clips: clips?,
        cameras: cameras(&source)?,
    })
}

fn cameras(source: &Source<'_>) -> Result<Vec<Camera>, String> {
    let sizes = source.array("cameras.size", Dtype::U32, &[None, Some(2)], u32::from_le_bytes)?;
    let n = sizes.len() / 2;
    let intrinsics = source.floats("cameras.intrinsics", &[Some(n), Some(4)])?;
    let extrinsics = source.floats("cameras.extrinsics", &[Some(n), Some(3), Some(4)])?;
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
struct Source<'a> {
    tensors: SafeTensors<'a>,
}

impl Source<'_> {
    fn view(&self, key: &str) -> Result<TensorView<'_>, String> {
        self.tensors.tensor(key).map_err(|_| format!("lacks `{key}`"))
    }

    fn shape<const N: usize>(&self, key: &str) -> Result<[usize; N], String> {
        let view = self.view(key)?;
        view.shape().try_into().map_err(|_| format!("`{key}` has shape {:?}, expected {N} axes", view.shape()))
    }

    /// The tensor `key` of type `kind` and shape `pattern` (`None`: any size), word by word.
    fn array<const N: usize, T>(
        &self,
        key: &str,
        kind: Dtype,
        pattern: &[Option<usize>],
        word: fn([u8; N]) -> T,
    ) -> Result<Vec<T>, String> {
        let view = self.view(key)?;
        let shape = view.shape();
        let fits = shape.len() == pattern.len() && shape.iter().zip(pattern).all(|(n, p)| p.is_none_or(|p| p == *n));
        if view.dtype() != kind || !fits {
            let sizes: Vec<String> = pattern.iter().map(|p| p.map_or("_".to_owned(), |n| n.to_string())).collect();
            let (found, sizes) = (view.dtype(), sizes.join(", "));
            return Err(format!("`{key}` is {found:?} {shape:?}, expected {kind:?} [{sizes}]"));
        }
        Ok(view.data().as_chunks::<N>().0.iter().map(|&bytes| word(bytes)).collect())
    }

    fn floats(&self, key: &str, pattern: &[Option<usize>]) -> Result<Vec<f32>, String> {
        self.array(key, Dtype::F32, pattern, f32::from_le_bytes)
    }

    fn vectors(&self, key: &str, pattern: &[Option<usize>]) -> Result<Vec<Vec3>, String> {
        Ok(self.floats(key, pattern)?.chunks_exact(3).map(Vec3::from_slice).collect())
    }
}

fn floats(values: impl Iterator<Item = f32>) -> Vec<u8> {
    values.flat_map(f32::to_le_bytes).collect()
}

fn file(path: &Path, what: String) -> Error {
    Error::File { path: path.to_owned(), what }
}
