//! Reads a [`Character`] from a glTF document.

use std::collections::HashMap;
use std::path::Path;

use array_files::{decode_text, read_file};
use glam::{Affine3A, Mat4, Quat, Vec2, Vec3, Vec4};
use gltf::json::animation::{Interpolation, Property};
use gltf::json::material::AlphaMode;
use gltf::json::validation::Checked;
use gltf::json::{Index, Root};
use serde_json::Value;
use smpl::{Error, SparseRows};

use crate::accessor::Source;
use crate::animation::{Animation, Channel, Local, unit, widen};
use crate::character::{Character, Node};

impl Character {
    /// Reads a `.glb`, or a `.gltf` whose buffers are data URIs or files beside it.
    ///
    /// # Errors
    /// Any [`Error`]; errors of the content name the part of the document.
    pub fn load(path: &Path) -> Result<Self, Error> {
        read(&path.display().to_string(), &read_file(path)?, path.parent())
    }

    /// Reads a character from bytes in memory, which may not refer to other files; `file` names
    /// them in errors.
    ///
    /// # Errors
    /// As for [`Character::load`].
    pub fn from_bytes(file: &str, bytes: &[u8]) -> Result<Self, Error> {
        read(file, bytes, None)
    }
}

fn read(file: &str, bytes: &[u8], folder: Option<&Path>) -> Result<Character, Error> {
    let is_binary = bytes.starts_with(b"glTF");
    let text = if is_binary { String::new() } else { decode_text(bytes) };
    let (json, blob) = if is_binary { chunks(file, bytes)? } else { (text.as_bytes(), None) };
    let root = document(json).map_err(|e| Error::invalid(file, "document", e.to_string()))?;
    let known = |extension: &&String| !UNREAD.contains(&extension.as_str());
    if let Some(extension) = root.extensions_required.iter().find(|extension| !known(extension)) {
        return Err(Error::invalid(file, "extensionsRequired", format!("it requires {extension}, {NOT_READ}")));
    }
    let source = Source::new(file, &root, blob, folder)?;
    let nodes = nodes(&source)?;
    let order = order(&source, &nodes)?;
    let mut out = Character {
        vertices: Vec::new(),
        normals: Vec::new(),
        uvs: Vec::new(),
        texture_of: Vec::new(),
        tints: Vec::new(),
        cutoffs: Vec::new(),
        faces: Vec::new(),
        weights: SparseRows { offsets: vec![0], columns: Vec::new(), values: Vec::new() },
        inverse_bind: Vec::new(),
        joint_names: Vec::new(),
        textures: Vec::new(),
        ignored: ignored(&root),
        animations: animations(&source, &nodes)?,
        nodes,
        order,
        joint_nodes: Vec::new(),
    };
    let mut skins = HashMap::new();
    for index in in_scene(&source)? {
        let node = &root.nodes[index];
        let Some(mesh) = node.mesh else { continue };
        let place = format!("node {index}");
        let joints = match node.skin {
            Some(skin) => match skins.get(&skin.value()) {
                Some(&known) => known,
                None => *skins.entry(skin.value()).or_insert(out.add_skin(&source, skin, &place)?),
            },
            None => out.add_joint(&source, index, Affine3A::IDENTITY),
        };
        let gltf::json::Mesh { primitives, weights: mesh_weights, .. } = source.get(&root.meshes, mesh, &place)?;
        for (i, primitive) in primitives.iter().enumerate() {
            let place = format!("mesh {mesh}, primitive {i}");
            let weights = node.weights.as_ref().or(mesh_weights.as_ref());
            let weights = weights.map_or(&[][..], Vec::as_slice);
            out.add_primitive(&source, &place, primitive, (joints, node.skin.is_some()), weights)?;
        }
    }
    if out.faces.is_empty() {
        return Err(Error::invalid(file, "meshes", "no triangles in the scene"));
    }
    out.wind();
    if out.normals.len() != out.vertices.len() {
        out.normals.clear();
    }
    if !out.uvs.is_empty() {
        out.uvs.resize(out.vertices.len(), Vec2::ZERO);
    }
    Ok(out)
}

/// Said of an extension.
pub(crate) const NOT_READ: &str = "which is not read (gltf-transform copy decodes it)";

/// Extensions without which a document means something else.
const UNREAD: [&str; 4] = ["KHR_draco_mesh_compression", "KHR_texture_basisu", "EXT_texture_webp", INSTANCES];
const INSTANCES: &str = "EXT_mesh_gpu_instancing";

/// The document. Channels without a node, which glTF leaves to extensions, are dropped; scenes may be empty.
fn document(json: &[u8]) -> Result<Root, serde_json::Error> {
    let first = match gltf::json::deserialize::from_slice(json) {
        Ok(root) => return Ok(root),
        Err(error) => error,
    };
    let mut value: Value = serde_json::from_slice(json)?;
    let animations = value.get_mut("animations").and_then(|a| a.as_array_mut()).into_iter().flatten();
    for channels in animations.filter_map(|animation| animation.get_mut("channels")?.as_array_mut()) {
        channels.retain(|channel| channel.get("target").is_none_or(|target| target.get("node").is_some()));
    }
    let scenes = value.get_mut("scenes").and_then(|scenes| scenes.as_array_mut()).into_iter().flatten();
    for scene in scenes.filter_map(|scene| scene.as_object_mut()) {
        scene.entry("nodes").or_insert_with(|| Value::Array(Vec::new()));
    }
    serde_json::from_value(value).map_err(|_| first)
}

/// What a document has that a [`Character`] has not, in words.
fn ignored(root: &Root) -> Vec<String> {
    let is_blended = root.materials.iter().any(|m| m.alpha_mode == Checked::Valid(AlphaMode::Blend));
    let has_instances = root.extensions_used.iter().any(|extension| extension == INSTANCES);
    [
        is_blended.then(|| "blending (alphaMode BLEND): a surface from an alpha of one half on".to_owned()),
        has_instances.then(|| format!("{INSTANCES}: one instance of each")),
    ]
    .into_iter()
    .flatten()
    .collect()
}

/// JSON and binary chunk of a `.glb` (glTF 2.0, section 4.4).
fn chunks<'a>(file: &str, bytes: &'a [u8]) -> Result<(&'a [u8], Option<Vec<u8>>), Error> {
    let invalid = |message: &str| Error::invalid(file, "container", message);
    let word = |at: usize| -> Option<u32> { Some(u32::from_le_bytes(bytes.get(at..at + 4)?.try_into().ok()?)) };
    let chunk = |at: usize, kind: &[u8; 4]| -> Option<&'a [u8]> {
        let length = usize::try_from(word(at)?).ok()?;
        let found = bytes.get(at + 4..at + 8)? == kind;
        bytes.get(at + 8..(at + 8).checked_add(length)?).filter(|_| found)
    };
    if word(4) != Some(2) {
        return Err(invalid("not version 2"));
    }
    if word(8).is_none_or(|length| length as usize > bytes.len()) {
        return Err(invalid("truncated"));
    }
    let json = chunk(12, b"JSON").ok_or_else(|| invalid("no complete JSON chunk"))?;
    let next = 20 + json.len();
    if bytes.len() < next + 8 {
        return Ok((json, None));
    }
    let binary = chunk(next, b"BIN\0").ok_or_else(|| invalid("no complete binary chunk"))?;
    Ok((json, Some(binary.to_vec())))
}

fn nodes(source: &Source<'_>) -> Result<Vec<Node>, Error> {
    let nodes = &source.root.nodes;
    let mut out = Vec::with_capacity(nodes.len());
    for (i, node) in nodes.iter().enumerate() {
        let rest = match &node.matrix {
            Some(matrix) => Local::Matrix(Affine3A::from_mat4(Mat4::from_cols_array(matrix))),
            None => Local::Parts {
                scale: node.scale.map_or(Vec3::ONE, Vec3::from),
                rotation: node.rotation.map_or(Quat::IDENTITY, |q| unit(Vec4::from(q.0))),
                translation: node.translation.map_or(Vec3::ZERO, Vec3::from),
            },
        };
        if !rest.matrix().is_finite() {
            return Err(source.invalid(&format!("node {i}"), "its transform is not finite"));
        }
        out.push(Node { parent: None, rest });
    }
    for (i, node) in nodes.iter().enumerate() {
        for &child in node.children.iter().flatten() {
            source.get(nodes, child, &format!("node {i}"))?;
            if out[child.value()].parent.replace(i).is_some() {
                return Err(source.invalid(&format!("node {child}"), "it has two parents"));
            }
        }
    }
    Ok(out)
}

/// Nodes with parents before children. Nodes not reached from a root are on a cycle or below one.
fn order(source: &Source<'_>, nodes: &[Node]) -> Result<Vec<usize>, Error> {
    let mut children = vec![Vec::new(); nodes.len()];
    let mut order = Vec::with_capacity(nodes.len());
    for (i, node) in nodes.iter().enumerate() {
        match node.parent {
            Some(parent) => children[parent].push(i),
            None => order.push(i),
        }
    }
    let mut at = 0;
    while at < order.len() {
        order.extend_from_slice(&children[order[at]]);
        at += 1;
    }
    if order.len() < nodes.len() {
        return Err(source.invalid("nodes", "the hierarchy has a cycle"));
    }
    Ok(order)
}

/// Nodes of the default scene, else of the first, else all, in the file's order.
fn in_scene(source: &Source<'_>) -> Result<Vec<usize>, Error> {
    let root = source.root;
    let scene = match root.scene {
        Some(scene) => Some(source.get(&root.scenes, scene, "scene")?),
        None => root.scenes.first(),
    };
    let Some(scene) = scene else {
        return Ok((0..root.nodes.len()).collect());
    };
    let mut seen = vec![false; root.nodes.len()];
    let mut stack = scene.nodes.clone();
    while let Some(index) = stack.pop() {
        let node = source.get(&root.nodes, index, "scene")?;
        if !std::mem::replace(&mut seen[index.value()], true) {
            stack.extend(node.children.iter().flatten());
        }
    }
    Ok((0..seen.len()).filter(|&i| seen[i]).collect())
}

/// Consecutive joints of a [`Character`]: first and count.
pub(crate) type Joints = (u32, u32);

impl Character {
    /// Turns faces that a mirroring transform turned inside out.
    fn wind(&mut self) {
        let bones = self.rest().bones;
        for face in &mut self.faces {
            let strongest = self.weights.heaviest(face[0] as usize);
            if strongest.is_some_and(|joint| bones[joint].matrix3.determinant() < 0.0) {
                face.swap(1, 2);
            }
        }
    }

    fn add_joint(&mut self, source: &Source<'_>, node: usize, inverse_bind: Affine3A) -> Joints {
        let first = self.joint_nodes.len() as u32;
        self.joint_nodes.push(node);
        self.joint_names.push(source.root.nodes[node].name.clone().unwrap_or_default());
        self.inverse_bind.push(inverse_bind);
        (first, 1)
    }

    fn add_skin(&mut self, source: &Source<'_>, index: Index<gltf::json::Skin>, place: &str) -> Result<Joints, Error> {
        let skin = source.get(&source.root.skins, index, place)?;
        let place = format!("skin {index}");
        let matrices = match skin.inverse_bind_matrices {
            Some(accessor) => Some(source.floats::<16>(accessor, &place)?),
            None => None,
        };
        let first = self.joint_nodes.len() as u32;
        for (i, &node) in skin.joints.iter().enumerate() {
            source.get(&source.root.nodes, node, &place)?;
            let inverse_bind = match &matrices {
                Some(matrices) => {
                    let few = || format!("{} inverse bind matrices for {} joints", matrices.len(), skin.joints.len());
                    let matrix = matrices.get(i).ok_or_else(|| source.invalid(&place, few()))?;
                    Affine3A::from_mat4(Mat4::from_cols_array(matrix))
                }
                None => Affine3A::IDENTITY,
            };
            self.add_joint(source, node.value(), inverse_bind);
        }
        if skin.joints.is_empty() {
            return Err(source.invalid(&place, "no joints"));
        }
        Ok((first, skin.joints.len() as u32))
    }
}

fn animations(source: &Source<'_>, nodes: &[Node]) -> Result<Vec<Animation>, Error> {
    let mut out = Vec::new();
    for (i, animation) in source.root.animations.iter().enumerate() {
        let mut channels = Vec::new();
        for (k, channel) in animation.channels.iter().enumerate() {
            let place = format!("animation {i}, channel {k}");
            let property = match channel.target.path {
                Checked::Valid(Property::MorphTargetWeights) => continue,
                Checked::Valid(property) => property,
                Checked::Invalid => return Err(source.invalid(&place, "an unknown path")),
            };
            let sampler = source.get(&animation.samplers, channel.sampler, &place)?;
            let node = channel.target.node.value();
            match nodes.get(node).map(|n| n.rest) {
                Some(Local::Parts { .. }) => {}
                Some(Local::Matrix(_)) => {
                    return Err(source.invalid(&place, format!("node {node} is given as a matrix")));
                }
                None => return Err(source.invalid(&place, format!("node {node} of {}", nodes.len()))),
            }
            let times: Vec<f32> = source.floats::<1>(sampler.input, &place)?.into_iter().flatten().collect();
            if times.is_empty() || times.windows(2).any(|w| w[0] >= w[1]) {
                return Err(source.invalid(&place, "times do not increase"));
            }
            let values: Vec<Vec4> = if property == Property::Rotation {
                source.floats::<4>(sampler.output, &place)?.into_iter().map(Vec4::from).collect()
            } else {
                source.floats::<3>(sampler.output, &place)?.into_iter().map(widen).collect()
            };
            let Checked::Valid(interpolation) = sampler.interpolation else {
                return Err(source.invalid(&place, "an unknown interpolation"));
            };
            let values_a_key = if interpolation == Interpolation::CubicSpline { 3 } else { 1 };
            if values.len() != values_a_key * times.len() {
                return Err(source.invalid(&place, format!("{} values for {} keys", values.len(), times.len())));
            }
            channels.push(Channel { node, property, interpolation, times, values });
        }
        let duration = channels.iter().filter_map(|c: &Channel| c.times.last()).copied().fold(0.0, f32::max);
        out.push(Animation { name: animation.name.clone().unwrap_or_default(), duration, channels });
    }
    Ok(out)
}
