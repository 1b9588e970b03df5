//! Reads a [`Character`] from a glTF document.

use std::borrow::Cow;
use std::collections::HashMap;
use std::path::Path;

use array_files::{decode_text, read_file};
use glam::{Affine3A, Mat4, Quat, Vec2, Vec3, Vec4};
use gltf::Glb;
use gltf::json::accessor::{Accessor, Type};
use gltf::json::animation::{Interpolation, Property};
use gltf::json::material::AlphaMode;
use gltf::json::mesh::{Mode, Primitive, Semantic};
use gltf::json::texture::Info;
use gltf::json::validation::Checked;
use gltf::json::{Index, Root};
use serde_json::Value;
use smpl::Error;

use crate::accessor::Source;
use crate::character::{Animation, Channel, Character, Local, Node, Texture, unit, widen};
use crate::mesh::MAX_COORDINATE;

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
    let (json, blob) = if bytes.starts_with(b"glTF") {
        let glb = container(file, bytes)?;
        (glb.json, glb.bin.map(Cow::into_owned))
    } else {
        (decode_text(bytes).into_bytes().into(), None)
    };
    let root = document(&json).map_err(|e| Error::invalid(file, "document", e.to_string()))?;
    let known = |extension: &&String| !UNREAD.contains(&extension.as_str());
    if let Some(extension) = root.extensions_required.iter().find(|extension| !known(extension)) {
        return Err(Error::invalid(file, "extensionsRequired", format!("it requires {extension}, {NOT_READ}")));
    }
    let source = Source::new(file, &root, blob, folder)?;
    let nodes = nodes(&source)?;
    let order = order(&source, &nodes)?;
    let (ignored, animations) = (ignored(&root), animations(&source, &nodes)?);
    let mut out = Character { ignored, animations, nodes, order, ..Character::default() };
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
    if !out.uvs.is_empty() {
        out.uvs.resize(out.vertices.len(), Vec2::ZERO);
    }
    Ok(out)
}

/// Said of an extension.
const NOT_READ: &str = "which is not read (gltf-transform copy decodes it)";

/// Extensions without which a document means something else.
const UNREAD: [&str; 4] = ["KHR_draco_mesh_compression", "KHR_texture_basisu", "EXT_texture_webp", INSTANCES];
const INSTANCES: &str = "EXT_mesh_gpu_instancing";

/// The document. Channels without a node, which glTF leaves to extensions, are dropped; scenes may
/// be empty.
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
fn container<'a>(file: &str, bytes: &'a [u8]) -> Result<Glb<'a>, Error> {
    let invalid = |message: &str| Error::invalid(file, "container", message);
    let length = bytes.get(8..12).and_then(|length| length.try_into().ok()).map_or(0, u32::from_le_bytes);
    // `Glb` subtracts the length of the header unchecked, and takes bytes behind the end for a chunk.
    let whole = bytes.get(..length as usize).filter(|whole| whole.len() >= 12);
    let whole = whole.ok_or_else(|| invalid("truncated"))?;
    Glb::from_slice(whole).map_err(|error| invalid(&error.to_string()))
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
type Joints = (u32, u32);

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

impl Character {
    /// Appends a primitive's vertices, morphed by `morph`, and triangles. If `skinned`, its joint
    /// indices are relative to `joints`; else it is bound to the first of those.
    fn add_primitive(
        &mut self,
        source: &Source<'_>,
        place: &str,
        primitive: &Primitive,
        (joints, skinned): (Joints, bool),
        morph: &[f32],
    ) -> Result<(), Error> {
        let invalid = |message: String| source.invalid(place, message);
        let Checked::Valid(mode @ (Mode::Triangles | Mode::TriangleStrip | Mode::TriangleFan)) = primitive.mode else {
            return Ok(());
        };
        let attribute = |semantic| primitive.attributes.get(&Checked::Valid(semantic)).copied();
        let positions = attribute(Semantic::Positions).ok_or_else(|| invalid("no positions".to_owned()))?;
        // Without it a document may have all there is, once more.
        let others = primitive.extensions.as_ref().map(|extensions| &extensions.others);
        let is_draco = others.is_some_and(|others| others.contains_key("KHR_draco_mesh_compression"));
        if is_draco && source.get(&source.root.accessors, positions, place)?.buffer_view.is_none() {
            return Err(invalid(format!("KHR_draco_mesh_compression {NOT_READ}")));
        }
        let mut positions = source.floats::<3>(positions, &format!("{place}, POSITION"))?;
        for (target, &weight) in primitive.targets.iter().flatten().zip(morph).filter(|(_, weight)| **weight != 0.0) {
            let Some(displacements) = target.positions else { continue };
            let displacements = source.floats::<3>(displacements, &format!("{place}, morph target"))?;
            if displacements.len() != positions.len() {
                let message = format!("a morph target of {} for {} positions", displacements.len(), positions.len());
                return Err(invalid(message));
            }
            let moved = positions.iter_mut().flatten().zip(displacements.iter().flatten());
            moved.for_each(|(position, by)| *position += weight * by);
        }
        if let Some(far) = positions.iter().find(|p| p.iter().any(|x| x.is_nan() || x.abs() > MAX_COORDINATE)) {
            return Err(invalid(format!("POSITION {far:?}: expected coordinates of at most {MAX_COORDINATE}")));
        }
        let (first, count) = (self.vertices.len() as u32, positions.len());
        self.vertices.extend(positions.into_iter().map(Vec3::from));
        let fits = |n: usize, name: &str| {
            if n == count { Ok(()) } else { Err(invalid(format!("{n} {name} for {count} positions"))) }
        };
        let material = primitive.material.map(|index| source.get(&source.root.materials, index, place)).transpose()?;
        let base = material.map(|material| &material.pbr_metallic_roughness);
        let factor = base.map_or(Vec4::ONE, |base| Vec4::from(base.base_color_factor.0));
        let colours = match attribute(Semantic::Colors(0)) {
            Some(colours) => {
                let place = format!("{place}, COLOR_0");
                let kind = &source.get(&source.root.accessors, colours, &place)?.type_;
                let colours: Vec<Vec4> = match kind {
                    Checked::Valid(Type::Vec3) => {
                        source.floats::<3>(colours, &place)?.into_iter().map(|c| Vec3::from(c).extend(1.0)).collect()
                    }
                    _ => source.floats::<4>(colours, &place)?.into_iter().map(Vec4::from).collect(),
                };
                fits(colours.len(), "COLOR_0")?;
                colours
            }
            None => vec![Vec4::ONE; count],
        };
        let cutoff = match material.map(|material| (material.alpha_mode, material.alpha_cutoff)) {
            Some((Checked::Valid(AlphaMode::Mask), cutoff)) => cutoff.map_or(0.5, |cutoff| cutoff.0),
            Some((Checked::Valid(AlphaMode::Blend), _)) => 0.5,
            _ => 0.0,
        };
        for colour in colours.into_iter().map(|colour| colour * factor) {
            self.tints.push(colour.truncate().clamp(Vec3::ZERO, Vec3::ONE));
            self.cutoffs.push(if cutoff > 0.0 { (cutoff / colour.w.max(0.0)).min(2.0) } else { 0.0 });
        }
        let colour = base.and_then(|base| base.base_color_texture.as_ref());
        let transform = colour.and_then(|c| c.extensions.as_ref()?.texture_transform.as_ref());
        let set = transform.and_then(|t| t.tex_coord).or(colour.map(|c| c.tex_coord)).unwrap_or(0);
        if let Some(uvs) = attribute(Semantic::TexCoords(set)) {
            let uvs = source.floats::<2>(uvs, &format!("{place}, TEXCOORD"))?;
            fits(uvs.len(), "TEXCOORD")?;
            let turned = |uv: Vec2| match transform {
                Some(t) => Vec2::from_angle(-t.rotation.0).rotate(uv * Vec2::from(t.scale.0)) + Vec2::from(t.offset.0),
                None => uv,
            };
            self.uvs.resize(first as usize, Vec2::ZERO);
            self.uvs.extend(uvs.into_iter().map(|uv| turned(Vec2::from(uv))));
        }
        let has_uvs = self.uvs.len() == self.vertices.len();
        let texture = colour.filter(|_| has_uvs).map(|colour| self.add_texture(source, place, colour)).transpose()?;
        self.texture_of.resize(self.vertices.len(), texture);
        let corners: Vec<u32> = match primitive.indices {
            Some(accessor) => {
                source.indices::<1>(accessor, &format!("{place}, indices"))?.into_iter().flatten().collect()
            }
            None => (0..count as u32).collect(),
        };
        let corners: Vec<u32> = match mode {
            Mode::TriangleFan => corners.windows(2).skip(1).flat_map(|pair| [corners[0], pair[0], pair[1]]).collect(),
            Mode::TriangleStrip => {
                let turned = |(i, c): (usize, &[u32])| if i % 2 == 0 { [c[0], c[1], c[2]] } else { [c[1], c[0], c[2]] };
                corners.windows(3).enumerate().flat_map(turned).collect()
            }
            _ => corners,
        };
        if !corners.len().is_multiple_of(3) {
            return Err(invalid(format!("{} triangle corners", corners.len())));
        }
        if let Some(bad) = corners.iter().find(|&&c| c as usize >= count) {
            return Err(invalid(format!("index {bad} of {count} vertices")));
        }
        self.faces.extend(corners.chunks_exact(3).map(|c| [c[0], c[1], c[2]].map(|i| first + i)));

        let mut rows: Vec<Vec<(u32, f32)>> = vec![Vec::new(); count];
        for set in 0.. {
            let Some(indices) = attribute(Semantic::Joints(set)).filter(|_| skinned) else {
                break;
            };
            let Some(weights) = attribute(Semantic::Weights(set)) else {
                return Err(invalid(format!("JOINTS_{set} without weights")));
            };
            influences(source, &format!("{place}, set {set}"), indices, weights, joints, &mut rows)?;
        }
        for row in rows {
            self.push_weights(row, joints.0);
        }
        Ok(())
    }

    /// Index of a base colour's image, read if no primitive before has it.
    fn add_texture(&mut self, source: &Source<'_>, place: &str, colour: &Info) -> Result<u32, Error> {
        let root = source.root;
        let texture = source.get(&root.textures, colour.index, place)?;
        let index = texture.source;
        if let Some(known) = self.textures.iter().position(|known| known.image == index.value()) {
            return Ok(known as u32);
        }
        if index.value() >= root.images.len() && texture.extensions.is_some() {
            let names = texture.extensions.iter().flat_map(|e| e.others.keys()).map(String::as_str).collect::<Vec<_>>();
            return Err(source.invalid(place, format!("a texture of {} alone, which is not read", names.join(", "))));
        }
        let image = source.get(&root.images, index, place)?;
        let place = format!("image {index}");
        let bytes = match (image.buffer_view, &image.uri) {
            (Some(view), _) => {
                let bytes = source.view(view, &place)?.1;
                source.spend(&place, bytes.len() as u64)?;
                bytes.to_vec()
            }
            (None, Some(uri)) => source.resolve(&place, uri)?,
            (None, None) => return Err(source.invalid(&place, "neither a URI nor a buffer view")),
        };
        self.textures.push(Texture { bytes, image: index.value() });
        Ok(self.textures.len() as u32 - 1)
    }

    /// Appends a vertex's weights, normalised, with one entry per joint. A vertex without weights,
    /// undefined in glTF, is bound to `default`.
    fn push_weights(&mut self, mut row: Vec<(u32, f32)>, default: u32) {
        if row.is_empty() {
            row.push((default, 1.0));
        }
        row.sort_by_key(|&(joint, _)| joint);
        row.dedup_by(|next, kept| {
            let same = next.0 == kept.0;
            kept.1 += if same { next.1 } else { 0.0 };
            same
        });
        let sum: f64 = row.iter().map(|&(_, w)| f64::from(w)).sum();
        for (joint, weight) in row {
            self.weights.columns.push(joint);
            self.weights.values.push((f64::from(weight) / sum) as f32);
        }
        self.weights.offsets.push(self.weights.columns.len() as u32);
    }
}

/// Adds one set of four joints and weights per vertex.
fn influences(
    source: &Source<'_>,
    place: &str,
    indices: Index<Accessor>,
    weights: Index<Accessor>,
    joints: Joints,
    rows: &mut [Vec<(u32, f32)>],
) -> Result<(), Error> {
    let (indices, weights) = (source.indices::<4>(indices, place)?, source.floats::<4>(weights, place)?);
    if indices.len() != rows.len() || weights.len() != rows.len() {
        let message = format!("{} joints and {} weights for {} positions", indices.len(), weights.len(), rows.len());
        return Err(source.invalid(place, message));
    }
    for (row, (indices, weights)) in rows.iter_mut().zip(indices.into_iter().zip(weights)) {
        for (index, weight) in indices.into_iter().zip(weights) {
            if !(0.0..=1e6).contains(&weight) {
                return Err(source.invalid(place, format!("a weight of {weight}")));
            }
            if weight == 0.0 {
                continue;
            }
            if index >= joints.1 {
                return Err(source.invalid(place, format!("joint {index} of {}", joints.1)));
            }
            row.push((joints.0 + index, weight));
        }
    }
    Ok(())
}
