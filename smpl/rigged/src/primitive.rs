//! Mesh primitives of a character.

use glam::{Vec2, Vec3, Vec4};
use gltf::json::Index;
use gltf::json::accessor::{Accessor, Type};
use gltf::json::material::AlphaMode;
use gltf::json::mesh::{Mode, Primitive, Semantic};
use gltf::json::texture::Info;
use gltf::json::validation::Checked;
use smpl::Error;

use crate::accessor::Source;
use crate::character::{Character, Texture};
use crate::mesh::MAX_COORDINATE;
use crate::read::{Joints, NOT_READ};

impl Character {
    /// Appends a primitive's vertices, morphed by `morph`, and triangles. If `skinned`, its joint
    /// indices are relative to `joints`; else it is bound to the first of those.
    pub(crate) fn add_primitive(
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
        if let Some(normals) = attribute(Semantic::Normals) {
            let normals = source.floats::<3>(normals, &format!("{place}, NORMAL"))?;
            fits(normals.len(), "NORMAL")?;
            self.normals.extend(normals.into_iter().map(Vec3::from));
        }
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
        let (found, bytes) = match (image.buffer_view, &image.uri) {
            (Some(view), _) => {
                let bytes = source.view(view, &place)?.1;
                source.spend(&place, bytes.len() as u64)?;
                (String::new(), bytes.to_vec())
            }
            (None, Some(uri)) => source.resolve(&place, uri)?,
            (None, None) => return Err(source.invalid(&place, "neither a URI nor a buffer view")),
        };
        let mime = image.mime_type.as_ref().map_or(found, |mime| mime.0.clone());
        self.textures.push(Texture { mime, bytes, image: index.value() });
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
