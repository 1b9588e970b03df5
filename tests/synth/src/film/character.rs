//! Rigged characters: a body model made of their own mesh, and their video.

use std::collections::HashMap;

use glam::{Affine3A, DMat4, DVec4, Quat, Vec2, Vec3};
use rayon::prelude::*;
use rigged::Character;
use smpl::{BodyModel, Joint, MotionClip, SparseRows};
use visibility::RayMesh;

use super::config::SynthConfig;
use super::noise::smooth_noise;
use super::perform::{Extent, brought, driven, seconds};
use super::render::{Lamp, Posture};
use super::stage::{Progress, Stage, ring};
use super::texture::{decode, pattern, sample, tinted};
use crate::demo::DemoConfig;
use crate::demo::motion::{Pose, TrackerError, track};
use capture::{Capture, CaptureError};

/// Most vertices, and joints, of a character: every training step encodes all vertices.
const MAX_VERTICES: usize = 200_000;
const MAX_JOINTS: usize = 512;
/// How deep a coefficient of 1 sinks the surface, in metres of a person 1.7 m tall, and at most as
/// a share of the body's thickness there.
const DEPTH: [f32; 2] = [0.01, 0.03];
const DEPTH_SHARE: f32 = 0.3;
/// Fewest vertices that a joint's place is told by.
const FEW: usize = 16;

/// A character as a body model.
struct Figure<'a> {
    character: &'a Character,
    body: BodyModel,
    /// The character's joint for each of the body's, (J).
    joints: Vec<usize>,
    /// Where the body's joints are at rest, (J).
    places: Vec<Vec3>,
    /// From the space of the character's vertices to the body's rest: upright, in the world's unit.
    to_rest: Affine3A,
    /// The body's vertex for each of the character's: vertices in one place are one.
    welded: Vec<u32>,
    /// Length of a metre of a person 1.7 m tall.
    unit: f32,
}

/// Films `character`; with the video come the height that the cameras stand for, the body model and
/// the names of its joints.
pub(super) fn film(
    character: &Character,
    motion: Option<&MotionClip>,
    config: &SynthConfig,
    progress: &Progress<'_>,
) -> Result<(Capture, f32, BodyModel, Vec<String>), CaptureError> {
    let figure = Figure::new(character)?;
    let mut stances = match motion {
        Some(clip) => figure.driven(clip, config.frames)?,
        None => figure.animated(config.frames),
    };
    let frames = stances.len();
    for (i, bones) in stances.iter_mut().enumerate() {
        let sum: Vec3 = bones.iter().zip(&figure.places).map(|(b, &p)| b.transform_point3(p)).sum();
        let place = brought(sum / bones.len() as f32, config.turns, i, frames);
        bones.iter_mut().for_each(|bone| *bone = place * *bone);
    }
    let extents: Vec<Extent> = stances.par_iter().map(|bones| Extent::of(&figure.vertices(bones))).collect();
    let extent = Extent::all(extents);
    let height = extent.height();
    if !(height.is_finite() && height > 0.0) {
        return Err(fault("a motion of finite extent", format!("one that reaches {height}")));
    }
    let down = Affine3A::from_translation(Vec3::NEG_Y * extent.low);
    stances.iter_mut().flatten().for_each(|bone| *bone = down * *bone);

    let poses: Vec<Pose> = stances.iter().map(|bones| figure.pose(bones)).collect();
    let usual = DemoConfig::default();
    let error = TrackerError {
        seed: config.seed,
        rotation: config.pose_noise_degrees.to_radians(),
        translation: usual.translation_noise * figure.unit,
    };
    let stage = Stage {
        cameras: ring(config.size, config.eval_cameras, height)?,
        eval_every: config.eval_every,
        priors: track(&poses, &figure.body.parents, figure.places[0], error),
        betas: vec![config.shape_noise],
        progress,
    };
    let textures = decode(character)?;
    let is_plain = textures.is_empty() && character.tints.iter().all(|tint| *tint == Vec3::ONE);
    let color = |face: u32, weights: [f32; 3]| {
        let corners = character.faces[face as usize].map(|v| v as usize);
        let mean = |values: &[Vec3]| corners.iter().zip(weights).map(|(&v, w)| values[v] * w).sum::<Vec3>();
        let cutoff: f32 = corners.iter().zip(weights).map(|(&v, w)| character.cutoffs[v] * w).sum();
        // The corners of a face are of one material.
        match character.texture_of[corners[0]] {
            Some(texture) => {
                let uv: Vec2 = corners.iter().zip(weights).map(|(&v, w)| character.uvs[v] * w).sum();
                let texel = sample(&textures[texture as usize], uv);
                (texel.w >= cutoff).then(|| tinted(texel.truncate(), mean(&character.tints)))
            }
            None if !is_plain => (cutoff <= 1.0).then(|| tinted(Vec3::ONE, mean(&character.tints))),
            None => {
                let place = |v: usize| figure.body.v_template[figure.welded[v] as usize];
                let at: Vec3 = corners.iter().zip(weights).map(|(&v, w)| place(v) * w).sum();
                Some(pattern(at / figure.unit, character.weights.heaviest(corners[0]).unwrap_or(0)))
            }
        }
    };
    let capture = stage.film("character", |i| {
        let vertices = figure.vertices(&stances[i]);
        let normals = figure.normals(&vertices);
        Posture::new(vertices, normals, &character.faces, &color, Lamp::new(config.lamp, config.seed))
    })?;
    let names = figure.joints.iter().map(|&old| character.joint_names[old].clone()).collect();
    Ok((capture, height, figure.body, names))
}

fn fault(expected: impl Into<String>, actual: impl ToString) -> CaptureError {
    CaptureError::setting("character", expected, actual)
}

impl<'a> Figure<'a> {
    fn new(character: &'a Character) -> Result<Self, CaptureError> {
        let (v, j) = (character.vertices.len(), character.num_joints());
        if v > MAX_VERTICES {
            return Err(fault(format!("at most {MAX_VERTICES} vertices"), v));
        }
        if !(1..=MAX_JOINTS).contains(&j) {
            return Err(fault(format!("1 to {MAX_JOINTS} joints"), j));
        }
        let above = character.joint_parents();
        let joints = sorted(&above);
        let mut number = vec![0; j];
        joints.iter().enumerate().for_each(|(new, &old)| number[old] = new);
        // A second root hangs on the first.
        let parents: Vec<Option<usize>> = joints
            .iter()
            .enumerate()
            .map(|(new, &old)| (new > 0).then(|| above[old].map_or(0, |p| number[p])))
            .collect();

        let to_rest = character.rest().bones[joints[0]];
        let solid = |m: &Affine3A| m.is_finite() && m.matrix3.determinant() != 0.0 && m.inverse().is_finite();
        let name = |old: usize| format!("those of joint {old} `{}`", character.joint_names[old]);
        if !solid(&to_rest) {
            return Err(fault("transforms that can be inverted", name(joints[0])));
        }
        let mut places = Vec::with_capacity(j);
        for &old in &joints {
            let bind = character.inverse_bind[old];
            if !solid(&bind) {
                return Err(fault("inverse bind matrices that can be inverted", name(old)));
            }
            places.push(Vec3::from((to_rest * bind.inverse()).translation));
        }

        let (vertices, welded) = weld(character.vertices.iter().map(|&v| to_rest.transform_point3(v)));
        let faces: Vec<[u32; 3]> = (character.faces.iter().map(|face| face.map(|v| welded[v as usize])))
            .filter(|[a, b, c]| a != b && b != c && c != a)
            .collect();
        let extent = Extent::of(&vertices);
        let unit = extent.height_alone() / 1.7;
        if !(unit.is_finite() && unit > 0.0) || faces.is_empty() {
            return Err(fault(
                "a mesh of some height",
                format!("{} faces, {} high", faces.len(), extent.height_alone()),
            ));
        }
        let mut rows: Vec<Option<usize>> = vec![None; vertices.len()];
        welded.iter().enumerate().rev().for_each(|(old, &new)| rows[new as usize] = Some(old));
        let weights = SparseRows::from_rows(rows.iter().map(|old| {
            let mut row: Vec<(u32, f32)> = old
                .map(|old| character.weights.row(old).map(|(joint, w)| (number[joint] as u32, w)).collect())
                .unwrap_or_default();
            row.sort_unstable_by_key(|(joint, _)| *joint);
            row
        }));
        let regressor = regressor(&vertices, &weights, &places, unit)?;
        let body = BodyModel {
            shapedirs: inward(&vertices, &faces, unit)?,
            posedirs: SparseRows::from_rows(vertices.iter().map(|_| None::<(u32, Vec3)>)),
            weights,
            j_regressor: SparseRows::from_rows(regressor),
            parents,
            v_template: vertices,
            faces,
        };
        body.validate("character")?;
        Ok(Self { character, body, joints, places, to_rest, welded, unit })
    }

    /// The character's vertices, its bones taking rest to world, (J) in the body's order.
    fn vertices(&self, bones: &[Affine3A]) -> Vec<Vec3> {
        let mut own = vec![Affine3A::IDENTITY; bones.len()];
        self.joints.iter().zip(bones).for_each(|(&old, &bone)| own[old] = bone * self.to_rest);
        self.character.skin(&own)
    }

    /// Normals of the character's vertices, without seams where textures are cut.
    fn normals(&self, vertices: &[Vec3]) -> Vec<Vec3> {
        let mut whole = vec![Vec3::ZERO; self.body.num_vertices()];
        self.welded.iter().zip(vertices).for_each(|(&v, &at)| whole[v as usize] = at);
        let normals = surface_query::vertex_normals(&whole, &self.body.faces);
        self.welded.iter().map(|&v| normals[v as usize]).collect()
    }

    /// Rest to world, (J), over the first animation; at rest without one.
    fn animated(&self, frames: usize) -> Vec<Vec<Affine3A>> {
        let from_rest = self.to_rest.inverse();
        let stance = |i: usize| {
            let posed = match self.character.animations.first() {
                Some(animation) => self.character.pose(0, seconds(animation.duration, i, frames)),
                None => self.character.rest(),
            };
            self.joints.iter().map(|&old| posed.bones[old] * from_rest).collect()
        };
        (0..frames).into_par_iter().map(stance).collect()
    }

    fn driven(&self, clip: &MotionClip, frames: usize) -> Result<Vec<Vec<Affine3A>>, CaptureError> {
        let parts = self.joints.iter().zip(&self.places).zip(&self.body.parents);
        let skeleton: Vec<Joint> = parts
            .map(|((&old, &rest), parent)| Joint {
                name: self.character.joint_names[old].clone(),
                parent: parent.map(|p| p as u16),
                rest,
            })
            .collect();
        driven(clip, frames, &skeleton)
    }

    /// The rotations of bones that take rest to world; their stretch, if any, is lost.
    fn pose(&self, bones: &[Affine3A]) -> Pose {
        let turn = |bone: &Affine3A| {
            let rotation = bone.to_scale_rotation_translation().1;
            if rotation.is_finite() { rotation.normalize() } else { Quat::IDENTITY }
        };
        let turns: Vec<Quat> = bones.iter().map(turn).collect();
        let relative = |(j, parent): (usize, &Option<usize>)| {
            parent.map_or(Vec3::ZERO, |p| (turns[p].inverse() * turns[j]).to_scaled_axis())
        };
        let joints = self.body.parents.iter().enumerate().map(relative).collect();
        let root = self.places[0];
        Pose { joints, rotation: turns[0], translation: bones[0].transform_point3(root) - turns[0] * root }
    }
}

/// Joints with parents before children, each tree in one piece, that with most joints first.
fn sorted(parents: &[Option<usize>]) -> Vec<usize> {
    let mut children: Vec<Vec<usize>> = vec![Vec::new(); parents.len()];
    let mut roots = Vec::new();
    for (joint, parent) in parents.iter().enumerate() {
        match parent {
            Some(parent) => children[*parent].push(joint),
            None => roots.push(joint),
        }
    }
    let mut trees: Vec<Vec<usize>> = Vec::new();
    for root in roots {
        let mut tree = vec![root];
        let mut at = 0;
        while at < tree.len() {
            tree.extend_from_slice(&children[tree[at]]);
            at += 1;
        }
        trees.push(tree);
    }
    trees.sort_by_key(|tree| std::cmp::Reverse(tree.len()));
    trees.concat()
}

/// Points without those that repeat another bit for bit, and where each has gone.
fn weld(points: impl Iterator<Item = Vec3>) -> (Vec<Vec3>, Vec<u32>) {
    let mut known: HashMap<[u32; 3], u32> = HashMap::new();
    let mut kept = Vec::new();
    let welded = points
        .map(|point| {
            // −0 is 0.
            let key = (point + Vec3::ZERO).to_array().map(f32::to_bits);
            *known.entry(key).or_insert_with(|| {
                kept.push(point);
                kept.len() as u32 - 1
            })
        })
        .collect();
    (kept, welded)
}

/// The coefficient that sinks the surface: a direction a vertex.
fn inward(vertices: &[Vec3], faces: &[[u32; 3]], unit: f32) -> Result<Vec<Vec3>, CaptureError> {
    let mesh = RayMesh::new(vertices, faces).map_err(|error| fault("a mesh that rays can hit", error))?;
    let normals = surface_query::vertex_normals(vertices, faces);
    let skin = 1e-3 * unit;
    let depth = |(&at, &normal): (&Vec3, &Vec3)| {
        let normal = normal.normalize_or_zero();
        let thickness = mesh.first_hit(at - normal * skin, -normal).map_or(0.0, |hit| hit.t + skin);
        let wanted = DEPTH[0] + (DEPTH[1] - DEPTH[0]) * smooth_noise(at / unit * 5.0);
        -normal * (wanted * unit).min(DEPTH_SHARE * thickness)
    };
    Ok(vertices.par_iter().zip(&normals).map(depth).collect())
}

/// Weights of vertices that give each joint's place, (J).
fn regressor(
    vertices: &[Vec3],
    weights: &SparseRows<f32>,
    places: &[Vec3],
    unit: f32,
) -> Result<Vec<Vec<(u32, f32)>>, CaptureError> {
    let mut near: Vec<Vec<(u32, f32)>> = vec![Vec::new(); places.len()];
    for v in 0..vertices.len() {
        for (joint, w) in weights.row(v).filter(|(_, w)| *w > 0.0) {
            near[joint].push((v as u32, w));
        }
    }
    let all: Vec<(u32, f32)> =
        (0..vertices.len()).step_by(vertices.len().div_ceil(512).max(1)).map(|v| (v as u32, 1.0)).collect();
    let joint = |(near, &place): (&Vec<(u32, f32)>, &Vec3)| {
        let own = if near.len() < FEW { None } else { affine(vertices, near, place, unit) };
        own.or_else(|| affine(vertices, &all, place, unit))
            .ok_or_else(|| fault("a mesh around its joints", "one that is flat"))
    };
    near.iter().zip(places).map(joint).collect()
}

/// Weights w of `near` with Σ w = 1 and Σ w v = `place`, of the least Σ w² / u, u being the weights
/// that come with them.
fn affine(vertices: &[Vec3], near: &[(u32, f32)], place: Vec3, unit: f32) -> Option<Vec<(u32, f32)>> {
    let row = |v: u32| ((vertices[v as usize] - place) / unit).as_dvec3().extend(1.0);
    let mut normal = DMat4::ZERO;
    for &(v, u) in near {
        let a = row(v);
        normal += DMat4::from_cols(a * a.x, a * a.y, a * a.z, a) * f64::from(u);
    }
    let inverse = normal.inverse();
    let lambda = inverse * DVec4::W;
    let out: Vec<(u32, f32)> = near.iter().map(|&(v, u)| (v, (f64::from(u) * row(v).dot(lambda)) as f32)).collect();
    let sum: DVec4 = out.iter().map(|&(v, w)| row(v) * f64::from(w)).sum();
    // Rejects NaN as well: half a millimetre.
    ((sum - DVec4::W).length() < 5e-4).then_some(out)
}
