//! Avatars as safetensors, bit for bit.

use std::path::Path;

use array_files::tensors::{Tensor, Tensors};
use glam::{Affine3A, Mat3, Vec2, Vec3};
use serde::{Deserialize, Serialize};
use smpl::{Joint, MotionClip, SparseRows};
use volrender::Camera;

use super::avatar::{Atlas, Avatar, Clip};
use crate::Error;
use crate::capture::Light;
use crate::model::saved::{read, write};

const FORMAT: &str = "occnerf-avatar";
const VERSION: u32 = 2;
/// Key of [`Header`] as JSON in the file's metadata.
const KEY: &str = "avatar";

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
    /// Writes the avatar as `.safetensors`, which [`Avatar::load`] reads back bit for bit. The file
    /// is replaced atomically; equal avatars give equal files.
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
        write(path, &[(KEY, header)].into(), self.tensors())
    }

    fn tensors(&self) -> Vec<Tensor<'_>> {
        let Self { atlas, posedirs, skeleton, cameras, .. } = self;
        let (v, j, t) = (self.num_vertices(), self.num_joints(), cameras.len());
        let (width, height) = (atlas.width as usize, atlas.height as usize);
        let flat = |values: &[Vec3]| values.iter().flat_map(|x| x.to_array()).collect::<Vec<f32>>();
        let parents: Vec<i32> = skeleton.iter().map(|joint| joint.parent.map_or(-1, i32::from)).collect();
        let rest: Vec<Vec3> = skeleton.iter().map(|joint| joint.rest).collect();
        let uvs: Vec<f32> = self.uvs.iter().flat_map(|uv| uv.to_array()).collect();
        let intrinsics = |c: &Camera| [c.focal.x, c.focal.y, c.centre.x, c.centre.y];
        let extrinsics = |c: &Camera| {
            let columns = c.world_to_camera.to_cols_array();
            (0..12).map(move |i| columns[3 * (i % 4) + i / 4])
        };
        let mut tensors = vec![
            Tensor::new("vertices", &[v, 3], flat(&self.vertices)),
            Tensor::new("normals", &[v, 3], flat(&self.normals)),
            Tensor::new("uvs", &[v, 2], uvs),
            Tensor::new("faces", &[self.faces.len(), 3], self.faces.as_flattened()),
            Tensor::new("joints", &[v, 4], self.joints.as_flattened()),
            Tensor::new("weights", &[v, 4], self.weights.as_flattened()),
            Tensor::new("posedirs.offsets", &[posedirs.offsets.len()], &posedirs.offsets[..]),
            Tensor::new("posedirs.columns", &[posedirs.columns.len()], &posedirs.columns[..]),
            Tensor::new("posedirs.values", &[posedirs.values.len(), 3], flat(&posedirs.values)),
            Tensor::new("atlas.rgb", &[height, width, 3], &atlas.rgb[..]),
            Tensor::new("atlas.confidence", &[height, width], &atlas.confidence[..]),
            Tensor::new("parents", &[j], parents),
            Tensor::new("rest_joints", &[j, 3], flat(&rest)),
            Tensor::new("betas", &[self.betas.len()], &self.betas[..]),
            Tensor::new("cameras.intrinsics", &[t, 4], cameras.iter().flat_map(intrinsics).collect::<Vec<f32>>()),
            Tensor::new("cameras.extrinsics", &[t, 3, 4], cameras.iter().flat_map(extrinsics).collect::<Vec<f32>>()),
            Tensor::new(
                "cameras.size",
                &[t, 2],
                cameras.iter().flat_map(|c| [c.width, c.height]).collect::<Vec<u32>>(),
            ),
        ];
        for (c, Clip { motion, .. }) in self.clips.iter().enumerate() {
            tensors.push(Tensor::new(format!("clip.{c}.poses"), &[motion.num_frames(), j, 3], flat(&motion.poses)));
            tensors.push(Tensor::new(format!("clip.{c}.trans"), &[motion.num_frames(), 3], flat(&motion.trans)));
        }
        tensors
    }

    /// Reads a file of [`Avatar::save`].
    ///
    /// # Errors
    /// [`Error::Io`]; [`Error::Array`] and [`Error::File`] for anything but a complete, valid
    /// avatar.
    pub fn load(path: &Path) -> Result<Self, Error> {
        let avatar = parse(path, &read(path)?)?;
        avatar.validate().map_err(|what| file(path, what))?;
        Ok(avatar)
    }
}

fn parse(path: &Path, bytes: &[u8]) -> Result<Avatar, Error> {
    let source = Tensors::parse(&path.display().to_string(), bytes)?;
    let header = source.header(KEY).ok_or_else(|| file(path, format!("header lacks `{KEY}`: not an avatar")))?;
    let header: Header = serde_json::from_str(header).map_err(|e| file(path, format!("header `{KEY}`: {e}")))?;
    if header.format != FORMAT || header.version != VERSION {
        let (format, version) = (header.format, header.version);
        return Err(file(path, format!("is {format} version {version}, expected {FORMAT} version {VERSION}")));
    }
    let vectors = |key: &str, pattern: &[Option<usize>]| -> Result<Vec<Vec3>, Error> {
        Ok(source.read::<f32>(key, pattern)?.chunks_exact(3).map(Vec3::from_slice).collect())
    };
    let shape = source.shape("atlas.confidence").unwrap_or_default();
    let (height, width) = (shape.first().copied().unwrap_or(0), shape.get(1).copied().unwrap_or(0));
    let j = header.joints.len();
    let parents = source.read::<i32>("parents", &[Some(j)])?;
    let rest = vectors("rest_joints", &[Some(j), Some(3)])?;
    let joint = |((name, parent), rest): ((String, i32), Vec3)| {
        let known = u16::try_from(parent).ok();
        match known.is_some() || parent == -1 {
            true => Ok(Joint { name, parent: known, rest }),
            false => Err(file(path, format!("`parents`: {parent} is no joint"))),
        }
    };
    let skeleton = header.joints.into_iter().zip(parents).zip(rest).map(joint).collect::<Result<_, Error>>()?;
    let clip = |(c, (name, fps)): (usize, (String, f32))| {
        let poses = vectors(&format!("clip.{c}.poses"), &[None, Some(j), Some(3)])?;
        let trans = vectors(&format!("clip.{c}.trans"), &[None, Some(3)])?;
        Ok(Clip { name, motion: MotionClip { poses, num_joints: j, trans, fps } })
    };
    Ok(Avatar {
        name: header.name,
        source: header.source,
        vertices: vectors("vertices", &[None, Some(3)])?,
        normals: vectors("normals", &[None, Some(3)])?,
        uvs: source.read::<f32>("uvs", &[None, Some(2)])?.chunks_exact(2).map(Vec2::from_slice).collect(),
        faces: source.read::<u32>("faces", &[None, Some(3)])?.as_chunks().0.to_vec(),
        joints: source.read::<u16>("joints", &[None, Some(4)])?.as_chunks().0.to_vec(),
        weights: source.read::<f32>("weights", &[None, Some(4)])?.as_chunks().0.to_vec(),
        posedirs: SparseRows {
            offsets: source.read("posedirs.offsets", &[None])?,
            columns: source.read("posedirs.columns", &[None])?,
            values: vectors("posedirs.values", &[None, Some(3)])?,
        },
        atlas: Atlas {
            width: u32::try_from(width).unwrap_or(u32::MAX),
            height: u32::try_from(height).unwrap_or(u32::MAX),
            rgb: source.read("atlas.rgb", &[Some(height), Some(width), Some(3)])?,
            confidence: source.read("atlas.confidence", &[None, None])?,
        },
        light: Light { slope: header.light.into() },
        skeleton,
        betas: source.read("betas", &[None])?,
        clips: header.clips.into_iter().enumerate().map(clip).collect::<Result<_, Error>>()?,
        cameras: cameras(path, &source)?,
    })
}

fn cameras(path: &Path, source: &Tensors<'_>) -> Result<Vec<Camera>, Error> {
    let sizes = source.read::<u32>("cameras.size", &[None, Some(2)])?;
    let n = Some(sizes.len() / 2);
    let intrinsics = source.read::<f32>("cameras.intrinsics", &[n, Some(4)])?;
    let extrinsics = source.read::<f32>("cameras.extrinsics", &[n, Some(3), Some(4)])?;
    let each = sizes.chunks_exact(2).zip(intrinsics.chunks_exact(4)).zip(extrinsics.chunks_exact(12));
    each.enumerate()
        .map(|(i, ((size, k), e))| {
            let matrix = Mat3::from_cols_array(&[k[0], 0.0, 0.0, 0.0, k[1], 0.0, k[2], k[3], 1.0]);
            let column = |c: usize| Vec3::new(e[c], e[4 + c], e[8 + c]);
            let turn = Mat3::from_cols(column(0), column(1), column(2));
            let world_to_camera = Affine3A::from_mat3_translation(turn, column(3));
            Camera::new(matrix, world_to_camera, size[0], size[1]).map_err(|e| file(path, format!("camera {i}: {e}")))
        })
        .collect()
}

fn file(path: &Path, what: String) -> Error {
    Error::File { path: path.to_owned(), what }
}
