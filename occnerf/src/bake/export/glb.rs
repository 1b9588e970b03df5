//! glTF 2.0 binary: skinned mesh, skeleton, atlas, motions; and VRM 1.0, a humanoid in glTF with
//! its licence.

use glam::{Quat, Vec3};
use serde_json::{Map, Value, json};
use smpl::{BoneNames, SparseRows};
use volrender::Aabb;

use crate::Error;
use crate::bake::{Avatar, Clip, Joint, motion_of_bones};

/// Component types of glTF.
const UNSIGNED_BYTE: u32 = 5121;
const UNSIGNED_SHORT: u32 = 5123;
const UNSIGNED_INT: u32 = 5125;
const FLOAT: u32 = 5126;
/// Targets of buffer views.
const ARRAY_BUFFER: u32 = 34962;
const ELEMENT_ARRAY_BUFFER: u32 = 34963;
/// Texture sampler: linear without mipmaps, which would mix charts; clamped at the edge.
const LINEAR: u32 = 9729;
const CLAMP_TO_EDGE: u32 = 33071;

/// What a glTF holds beside the person.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct GlbOptions<'a> {
    /// The atlas as JPEG of this quality, 1 to 100, in place of PNG.
    pub jpeg: Option<u8>,
    /// Shaded by the lights of the scene it stands in, in place of `KHR_materials_unlit`. The atlas
    /// is the same: the light of the video is in neither.
    pub lit: bool,
    /// Makes a VRM of it, see [`Avatar::to_glb_with`].
    pub vrm: Option<Vrm<'a>>,
}

impl Avatar {
    /// glTF 2.0 binary (`.glb`).
    ///
    /// One skinned mesh (`POSITION`, `NORMAL`, `TEXCOORD_0`, `JOINTS_0`, `WEIGHTS_0` in 16 bits),
    /// `KHR_materials_unlit`, the atlas as PNG, a node a joint with the rest pose as bind pose, and
    /// an animation a clip. The atlas is under even light; that of the video is the scene's extra
    /// `light`, a vector s: a surface with unit normal n is max(1 + s · n + ½ |s| ((ŝ · n)² − ⅓),
    /// 0.2) times as bright, see [`crate::capture::Light`]. Pose blend shapes and confidence are
    /// left out.
    ///
    /// A VRM 1.0 has the extension `VRMC_vrm` with `humanoid` and `meta`; its rest pose, and bind
    /// pose, is the person with level arms, [`Avatar::with_level_arms`].
    ///
    /// # Errors
    /// [`Error::Bake`] with what [`Avatar::validate`] finds, for more than 4 GiB, and for a VRM of
    /// a skeleton without the fifteen joints that it must have.
    pub fn to_glb_with(&self, options: &GlbOptions<'_>) -> Result<Vec<u8>, Error> {
        let Some(vrm) = &options.vrm else { return self.gltf(options, None) };
        self.validate().map_err(Error::Bake)?;
        self.with_level_arms()?.gltf(options, Some(vrm.extension(self)?))
    }

    fn gltf(&self, options: &GlbOptions<'_>, vrm: Option<Value>) -> Result<Vec<u8>, Error> {
        self.validate().map_err(Error::Bake)?;
        let mut file = File::default();
        let attributes = attributes(self, &mut file);
        let indices = file.indices(&self.faces, self.num_vertices());
        let bind: Vec<f32> = self.skeleton.iter().flat_map(|joint| inverse_bind(joint.rest)).collect();
        let bind = file.floats(&bind, "MAT4", None);
        let animations: Vec<Value> = self.clips.iter().map(|clip| animation(self, clip, &mut file)).collect();
        let (picture, kind) = match options.jpeg {
            Some(quality) => (self.atlas.to_jpeg(quality)?, "image/jpeg"),
            None => (self.atlas.to_png()?, "image/png"),
        };
        let picture = file.view(&picture, None);

        let j = self.num_joints();
        let mut nodes: Vec<Value> = (self.skeleton.iter().enumerate())
            .map(|(at, joint)| {
                let origin = joint.parent.map_or(Vec3::ZERO, |parent| self.skeleton[usize::from(parent)].rest);
                let children: Vec<usize> =
                    (0..j).filter(|&child| self.skeleton[child].parent.map(usize::from) == Some(at)).collect();
                let mut node = json!({ "name": joint.name, "translation": (joint.rest - origin).to_array() });
                if !children.is_empty() {
                    node["children"] = json!(children);
                }
                node
            })
            .collect();
        nodes.push(json!({ "name": "person", "mesh": 0, "skin": 0 }));
        let mut root = json!({
            "asset": { "version": "2.0", "generator": concat!("occnerf ", env!("CARGO_PKG_VERSION")) },
            "scene": 0,
            "scenes": [{
                "name": self.name,
                "nodes": [0, j],
                "extras": { "light": self.light.slope.to_array() },
            }],
            "nodes": nodes,
            "meshes": [{ "name": "person", "primitives": [{ "attributes": attributes, "indices": indices, "material": 0 }] }],
            "skins": [{ "joints": (0..j).collect::<Vec<_>>(), "skeleton": 0, "inverseBindMatrices": bind }],
            "materials": [{
                "name": "person",
                "alphaMode": "OPAQUE",
                "pbrMetallicRoughness": {
                    "baseColorTexture": { "index": 0 }, "metallicFactor": 0.0, "roughnessFactor": 0.9
                },
            }],
            "textures": [{ "source": 0, "sampler": 0 }],
            "samplers": [{ "magFilter": LINEAR, "minFilter": LINEAR, "wrapS": CLAMP_TO_EDGE, "wrapT": CLAMP_TO_EDGE }],
            "images": [{ "name": "atlas", "mimeType": kind, "bufferView": picture }],
            "accessors": file.accessors,
            "bufferViews": file.views,
            "buffers": [{ "byteLength": file.bytes.len() }],
        });
        if !animations.is_empty() {
            root["animations"] = json!(animations);
        }
        let mut extensions = Vec::new();
        if !options.lit {
            extensions.push("KHR_materials_unlit");
            root["materials"][0]["extensions"] = json!({ "KHR_materials_unlit": {} });
        }
        if let Some(vrm) = vrm {
            extensions.push("VRMC_vrm");
            root["extensions"] = json!({ "VRMC_vrm": vrm });
        }
        if !extensions.is_empty() {
            root["extensionsUsed"] = json!(extensions);
        }
        container(&root, file.bytes)
    }
}

/// Lays out the two chunks of a binary glTF.
fn container(root: &Value, mut binary: Vec<u8>) -> Result<Vec<u8>, Error> {
    let mut text = serde_json::to_vec(root).map_err(|error| Error::Bake(format!("glTF: {error}")))?;
    text.resize(text.len().next_multiple_of(4), b' ');
    binary.resize(binary.len().next_multiple_of(4), 0);
    let length = |n: usize| u32::try_from(n).map_err(|_| Error::Bake(format!("glTF: {n} bytes, expected below 4 GiB")));
    let total = length(12 + 8 + text.len() + 8 + binary.len())?;
    let mut out = Vec::with_capacity(total as usize);
    out.extend(b"glTF");
    [2, total, length(text.len())?].iter().for_each(|word: &u32| out.extend(word.to_le_bytes()));
    out.extend(b"JSON");
    out.append(&mut text);
    out.extend(length(binary.len())?.to_le_bytes());
    out.extend(b"BIN\0");
    out.append(&mut binary);
    Ok(out)
}

/// Column-major matrix that takes a joint's rest position to the origin.
fn inverse_bind(rest: Vec3) -> [f32; 16] {
    let mut matrix = glam::Mat4::IDENTITY.to_cols_array();
    matrix[12..15].copy_from_slice(&(-rest).to_array());
    matrix
}

fn attributes(avatar: &Avatar, file: &mut File) -> Value {
    let flat = |values: &[Vec3]| values.iter().flat_map(|v| v.to_array()).collect::<Vec<f32>>();
    let normals: Vec<Vec3> = avatar.normals.iter().map(|n| n.normalize_or(Vec3::Y)).collect();
    let uvs: Vec<f32> = avatar.uvs.iter().flat_map(|uv| uv.to_array()).collect();
    let position = file.floats(&flat(&avatar.vertices), "VEC3", Some(ARRAY_BUFFER));
    file.bound(position, &avatar.vertices);
    let normal = file.floats(&flat(&normals), "VEC3", Some(ARRAY_BUFFER));
    let place = file.floats(&uvs, "VEC2", Some(ARRAY_BUFFER));
    let (mut joints, mut weights) = (Vec::new(), Vec::new());
    for (&row, &shares) in avatar.joints.iter().zip(&avatar.weights) {
        let (row, shares) = quantised(row, shares);
        // At most 256 joints.
        joints.extend(row.map(|joint| joint as u8));
        weights.extend(shares.iter().flat_map(|w| w.to_le_bytes()));
    }
    let v = avatar.num_vertices();
    let view = file.view(&joints, Some(ARRAY_BUFFER));
    let joints =
        file.accessor(json!({ "bufferView": view, "componentType": UNSIGNED_BYTE, "count": v, "type": "VEC4" }));
    let view = file.view(&weights, Some(ARRAY_BUFFER));
    let shares = json!({
        "bufferView": view, "componentType": UNSIGNED_SHORT, "count": v, "type": "VEC4", "normalized": true
    });
    let weights = file.accessor(shares);
    json!({ "POSITION": position, "NORMAL": normal, "TEXCOORD_0": place, "JOINTS_0": joints, "WEIGHTS_0": weights })
}

/// A vertex's weights in parts of 65535 with an exact sum, largest first, each joint once; unused
/// entries are 0.
fn quantised(joints: [u16; 4], weights: [f32; 4]) -> ([u16; 4], [u16; 4]) {
    const WHOLE: f32 = 65535.0;
    let mut merged: Vec<(u16, f32)> = Vec::with_capacity(4);
    for (joint, weight) in joints.into_iter().zip(weights) {
        match merged.iter_mut().find(|entry| entry.0 == joint) {
            Some(entry) => entry.1 += weight,
            None => merged.push((joint, weight)),
        }
    }
    merged.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
    let sum: f32 = merged.iter().map(|entry| entry.1).sum();
    let mut parts: Vec<(u16, u16)> =
        merged.iter().map(|&(joint, weight)| (joint, (weight / sum * WHOLE).round() as u16)).collect();
    let others: u32 = parts.iter().skip(1).map(|part| u32::from(part.1)).sum();
    parts[0].1 = (WHOLE as u32 - others.min(WHOLE as u32)) as u16;
    parts.retain(|part| part.1 > 0);
    let part = |i: usize| parts.get(i).copied().unwrap_or((0, 0));
    (std::array::from_fn(|i| part(i).0), std::array::from_fn(|i| part(i).1))
}

fn animation(avatar: &Avatar, Clip { name, motion }: &Clip, file: &mut File) -> Value {
    let (frames, j) = (motion.num_frames(), avatar.num_joints());
    let times: Vec<f32> = (0..frames).map(|frame| frame as f32 / motion.fps).collect();
    let input = file.floats(&times, "SCALAR", None);
    file.accessors[input]["min"] = json!([times[0]]);
    file.accessors[input]["max"] = json!([times[frames - 1]]);
    let (mut samplers, mut channels) = (Vec::new(), Vec::new());
    let mut channel = |output: usize, node: usize, path: &str| {
        channels.push(json!({ "sampler": samplers.len(), "target": { "node": node, "path": path } }));
        samplers.push(json!({ "input": input, "output": output }));
    };
    for joint in 0..j {
        let mut previous = Quat::IDENTITY;
        let turns: Vec<f32> = (0..frames)
            .flat_map(|frame| {
                let turn = Quat::from_scaled_axis(motion.poses[frame * j + joint]).normalize();
                // In the hemisphere of the previous key, so that players take the shorter arc.
                previous = if previous.dot(turn) < 0.0 { -turn } else { turn };
                previous.to_array()
            })
            .collect();
        channel(file.floats(&turns, "VEC4", None), joint, "rotation");
    }
    let places: Vec<f32> = motion.trans.iter().flat_map(|&t| (avatar.skeleton[0].rest + t).to_array()).collect();
    channel(file.floats(&places, "VEC3", None), 0, "translation");
    json!({ "name": name, "samplers": samplers, "channels": channels })
}

/// The binary chunk with its buffer views and accessors.
#[derive(Default)]
struct File {
    bytes: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
}

impl File {
    /// Appends bytes at a multiple of 4; returns the buffer view.
    fn view(&mut self, bytes: &[u8], target: Option<u32>) -> usize {
        self.bytes.resize(self.bytes.len().next_multiple_of(4), 0);
        let mut view = json!({ "buffer": 0, "byteOffset": self.bytes.len(), "byteLength": bytes.len() });
        if let Some(target) = target {
            view["target"] = json!(target);
        }
        self.bytes.extend_from_slice(bytes);
        self.views.push(view);
        self.views.len() - 1
    }

    fn accessor(&mut self, accessor: Value) -> usize {
        self.accessors.push(accessor);
        self.accessors.len() - 1
    }

    fn floats(&mut self, values: &[f32], kind: &str, target: Option<u32>) -> usize {
        let width = match kind {
            "SCALAR" => 1,
            "VEC2" => 2,
            "VEC3" => 3,
            "VEC4" => 4,
            _ => 16,
        };
        let bytes: Vec<u8> = values.iter().flat_map(|x| x.to_le_bytes()).collect();
        let view = self.view(&bytes, target);
        self.accessor(json!({
            "bufferView": view, "componentType": FLOAT, "count": values.len() / width, "type": kind
        }))
    }

    /// Sets the bounds of an accessor.
    fn bound(&mut self, accessor: usize, points: &[Vec3]) {
        let Aabb { min: low, max: high } = Aabb::from_points(points);
        self.accessors[accessor]["min"] = json!(low.to_array());
        self.accessors[accessor]["max"] = json!(high.to_array());
    }

    fn indices(&mut self, faces: &[[u32; 3]], vertices: usize) -> usize {
        let flat = faces.as_flattened();
        // The largest index is reserved for primitive restart.
        let (bytes, kind): (Vec<u8>, u32) = if vertices <= usize::from(u16::MAX) {
            (flat.iter().flat_map(|&i| (i as u16).to_le_bytes()).collect(), UNSIGNED_SHORT)
        } else {
            (flat.iter().flat_map(|i| i.to_le_bytes()).collect(), UNSIGNED_INT)
        };
        let view = self.view(&bytes, Some(ELEMENT_ARRAY_BUFFER));
        self.accessor(json!({ "bufferView": view, "componentType": kind, "count": flat.len(), "type": "SCALAR" }))
    }
}

/// Licence document of VRM 1.0, the one that the format admits.
pub const VRM_LICENCE: &str = "https://vrm.dev/licenses/1.0/";
/// Human bones that a VRM must have.
const REQUIRED: [&str; 15] = [
    "hips",
    "spine",
    "head",
    "leftUpperLeg",
    "rightUpperLeg",
    "leftLowerLeg",
    "rightLowerLeg",
    "leftFoot",
    "rightFoot",
    "leftUpperArm",
    "rightUpperArm",
    "leftLowerArm",
    "rightLowerArm",
    "leftHand",
    "rightHand",
];

/// Authorship and licence of a VRM.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Vrm<'a> {
    /// Name of the author.
    pub author: &'a str,
    /// Address of the licence: [`VRM_LICENCE`], or one that is added to it as `otherLicenseUrl`.
    pub licence: &'a str,
}

impl Vrm<'_> {
    /// The extension `VRMC_vrm`; node j of the glTF is joint j.
    pub(super) fn extension(&self, avatar: &Avatar) -> Result<Value, Error> {
        let bones: Map<String, Value> = (human_bones(&avatar.skeleton).into_iter().enumerate())
            // The ends of SMPL's hands are no human bones.
            .filter_map(|(j, name)| Some((name.filter(|name| !name.ends_with("End"))?, json!({ "node": j }))))
            .collect();
        let missing: Vec<&str> = REQUIRED.into_iter().filter(|bone| !bones.contains_key(*bone)).collect();
        if !missing.is_empty() {
            return Err(Error::Bake(format!("VRM: no joint by name for {}", missing.join(", "))));
        }
        let name = if avatar.name.is_empty() { "person" } else { &avatar.name };
        let mut meta = json!({ "name": name, "authors": [self.author], "licenseUrl": VRM_LICENCE });
        if self.licence != VRM_LICENCE {
            meta["otherLicenseUrl"] = json!(self.licence);
        }
        Ok(json!({ "specVersion": "1.0", "meta": meta, "humanoid": { "humanBones": bones } }))
    }
}

/// VRM's name of each joint that has one.
fn human_bones(skeleton: &[Joint]) -> Vec<Option<String>> {
    let names: Vec<&str> = skeleton.iter().map(|joint| joint.name.as_str()).collect();
    BoneNames::Vrm.translate(&names)
}

impl Avatar {
    /// The avatar at rest with arms level along x, as a T-pose has them; motions stay what they
    /// are. Pose blend shapes are left out.
    ///
    /// # Errors
    /// [`Error::Bake`] for a skeleton whose arms are not known by name.
    pub fn with_level_arms(&self) -> Result<Self, Error> {
        let bones = human_bones(&self.skeleton);
        let joint = |name: &str| {
            let found = bones.iter().position(|bone| bone.as_deref() == Some(name));
            found.ok_or_else(|| Error::Bake(format!("no joint by name for {name}")))
        };
        // Rotations relative to the rest pose, of the joint alone and with those above it.
        let (mut pose, mut globals) = (vec![Vec3::ZERO; self.num_joints()], vec![Quat::IDENTITY; self.num_joints()]);
        let mut levelled = vec![None; self.num_joints()];
        for (side, along) in [("left", Vec3::X), ("right", Vec3::NEG_X)] {
            let [upper, lower, hand] = ["UpperArm", "LowerArm", "Hand"].map(|bone| joint(&format!("{side}{bone}")));
            let [upper, lower, hand] = [upper?, lower?, hand?];
            for (from, to) in [(upper, lower), (lower, hand)] {
                let arm = self.skeleton[to].rest - self.skeleton[from].rest;
                levelled[from] = arm.try_normalize().map(|arm| Quat::from_rotation_arc(arm, along));
            }
        }
        for (j, joint) in self.skeleton.iter().enumerate() {
            let above = joint.parent.map_or(Quat::IDENTITY, |parent| globals[usize::from(parent)]);
            globals[j] = levelled[j].unwrap_or(above);
            pose[j] = (above.inverse() * globals[j]).to_scaled_axis();
        }
        let to_level = self.bones(&pose, Vec3::ZERO);
        let mut avatar = self.clone();
        (avatar.vertices, avatar.normals) = self.skin(&to_level, &pose);
        avatar.posedirs = SparseRows::from_rows(vec![Vec::<(u32, Vec3)>::new(); self.num_vertices()]);
        for (joint, bone) in avatar.skeleton.iter_mut().zip(&to_level) {
            joint.rest = bone.transform_point3(joint.rest);
        }
        let from_level: Vec<_> = to_level.iter().map(glam::Affine3A::inverse).collect();
        for clip in &mut avatar.clips {
            let motion = &clip.motion;
            let frames = motion.poses.chunks_exact(motion.num_joints).zip(&motion.trans).map(|(pose, &trans)| {
                self.bones(pose, trans).into_iter().zip(&from_level).map(|(bone, level)| bone * *level).collect()
            });
            clip.motion = motion_of_bones(&avatar.skeleton, &frames.collect::<Vec<_>>(), motion.fps);
        }
        Ok(avatar)
    }
}

#[cfg(test)]
mod tests {
    use super::quantised;

    #[test]
    fn weights_add_up_whatever_they_are() {
        let mut random = volrender::RandomStream::new(&[7]);
        let mut next = || random.uniform();
        for _ in 0..2000 {
            let raw = [next(), next().powi(4), next().powi(9), if next() < 0.5 { 0.0 } else { next() * 1e-6 }];
            let sum: f32 = raw.iter().sum();
            let joints = [(next() * 5.0) as u16, (next() * 5.0) as u16, (next() * 5.0) as u16, 4];
            let (row, parts) = quantised(joints, raw.map(|w| w / sum));
            assert_eq!(parts.iter().map(|&p| u32::from(p)).sum::<u32>(), 65535);
            for i in 0..4 {
                assert!(parts[i] > 0 || row[i] == 0, "{row:?} {parts:?}");
                assert!((i + 1..4).all(|k| parts[k] == 0 || row[k] != row[i]), "{row:?} {parts:?}");
                let whole: f32 = (0..4).filter(|&k| joints[k] == row[i]).map(|k| raw[k] / sum).sum();
                assert!(parts[i] == 0 || (f32::from(parts[i]) / 65535.0 - whole).abs() < 5e-5);
            }
        }
    }
}
