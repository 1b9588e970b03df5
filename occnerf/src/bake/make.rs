//! Baking of a trained person to an avatar.

use std::ops::{Add, Mul};
use std::sync::Arc;
use std::time::Instant;

use glam::{Affine3A, Vec2, Vec3};
use rayon::prelude::*;
use smpl::{BoneNames, MotionField, SparseRows, skeleton};

use super::avatar::{Atlas, Avatar, Clip, MAX_JOINTS, motion_of_bones, turn_upright};
use super::charts::AtlasLayout;
use super::displacement::displacements;
use super::refine::refine;
use super::surface::{CanonicalField, NormalRay, Place, Texel, dilate, heights, normal_rays, paint, texels};
use crate::Error;
use crate::capture::Light;
use crate::model::body::{Body, surface_point};
use crate::model::encoder::VertexCode;
use crate::model::extent::Extent;
use crate::model::field::SampleBatch;
use crate::model::subdivide::{Anchor, Subdivided, normals, times_until};
use crate::model::trained::{Model, surface_motion, upright};
use crate::model::view::{PosedView, pixel_width};
use crate::scene::prepared::Scene;

/// Target edge length of the surface, pixels of the training frames, and most subdivisions.
const EDGE: f32 = 1.5;
const MOST: u32 = 2;
/// Width of a pixel for which a fitted surface is subdivided, at least, normalised metres: that of
/// the crops which show its outline.
const FINEST: f32 = 0.007;
/// Texels across a pixel of the training frames.
const TEXELS_A_PIXEL: f32 = 2.0;
/// Share of the training frames with a point visible for full confidence.
const FULL_CONFIDENCE: f32 = 0.1;
/// Largest side of the atlas, texels; the resolution of the training frames decides below.
const MAX_SIDE: u32 = 2048;
/// Steps of texture optimisation on the training frames.
const REFINEMENTS: u32 = 4;
/// Frames per second of the video's motion.
const FPS: f32 = 30.0;
/// [`CanonicalField::grazing`]; 2 to 6 cm draw outlines that fit those of pictures (IoU .956 to
/// .960 on the demo, whatever the number of samples), 3 to 4 best.
const GRAZING: f32 = 0.035;

/// Statistics of [`bake`].
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct BakeReport {
    /// Vertices at which a field has no surface, filled from their neighbours.
    pub holes: usize,
    /// Vertices, a copy for each chart.
    pub vertices: usize,
    /// Triangles.
    pub faces: usize,
    /// Side of the atlas.
    pub side: u32,
    /// Texels on the surface.
    pub texels: usize,
    /// Mean squared error over known training pixels on the surface, before the first step of
    /// texture optimisation and before the last.
    pub errors: [f64; 2],
    /// Wall clock, seconds.
    pub seconds: f64,
}

/// Bakes a trained person. The scene of its training gives the confidence and the frames of texture
/// optimisation; without it all confidence is 1 and the texture is the field's.
///
/// # Errors
/// [`Error::Scene`] for a body of more than [`MAX_JOINTS`] joints, one that no camera sees, or one
/// that needs more charts than the atlas has room for; those of frames that cannot be decoded.
pub fn bake(model: &Model, scene: Option<&Scene>) -> Result<(Avatar, BakeReport), Error> {
    let start = Instant::now();
    let pixel = checked_pixel(&model.body, model.frames())?;
    let vertices = model.body.canonical.vertices.len();
    let seen = scene.map_or_else(|| Ok(vec![1.0; vertices]), seen)?;
    let mut code = VertexCode::default();
    model.encode_vertices(&mut code);
    let extent = model.measure_extent(&code);
    let evaluate = |places: &[Place]| evaluate(model, &code, &extent, places);
    let field = CanonicalField { evaluate: &evaluate, grazing: GRAZING, reach: extent.farthest };
    let (mut avatar, mut report) = surface(&model.body, &field, &seen, pixel)?;
    add_motion(&mut avatar, &model.body, model.frames(), model.light());
    if let Some(scene) = scene {
        avatar.name.clone_from(&scene.name);
        report.errors = refine(scene, model.light(), &mut avatar, REFINEMENTS)?;
    }
    report.seconds = start.elapsed().as_secs_f64();
    Ok((avatar, report))
}

/// Fits a surface and its texture to the training frames of a scene, without a field: heights over
/// the prior, and the prior's colours refined.
///
/// # Errors
/// Those of [`bake`].
pub fn fit(scene: &Scene) -> Result<(Avatar, BakeReport), Error> {
    let start = Instant::now();
    let frames: Vec<Arc<PosedView>> = scene.train.iter().map(|frame| Arc::clone(&frame.view)).collect();
    let pixel = checked_pixel(&scene.body, &frames)?;
    let colors = scene.colors()?;
    let (prior, faces) = (&scene.body.canonical.vertices, &scene.body.model.faces);
    let relief = Relief::new(prior, faces, pixel.max(FINEST));
    let clothes = |anchor: &Anchor| -> f32 {
        anchor.terms().map(|(v, w)| w * scene.clothes.get(v as usize).copied().unwrap_or_default()).sum()
    };
    let dressed: Vec<f32> = relief.mesh.anchors.iter().map(clothes).collect();
    let heights = displacements(scene, &relief.mesh, &relief.feet, &dressed)?;
    let paint = |texels: &[Texel]| {
        let colour = |texel: &Texel| colors.at(texel.parent, relief.barycentric(texel, faces)).truncate();
        texels.par_iter().map(colour).collect()
    };
    let (mut avatar, mut report) = assemble(&scene.body, &relief, &heights, &seen(scene)?, pixel, paint)?;
    add_motion(&mut avatar, &scene.body, &frames, colors.light);
    avatar.name.clone_from(&scene.name);
    report.errors = refine(scene, colors.light, &mut avatar, REFINEMENTS)?;
    report.seconds = start.elapsed().as_secs_f64();
    Ok((avatar, report))
}

/// The width of a pixel of the frames, normalised metres, of a body that can be baked.
fn checked_pixel(body: &Body, frames: &[Arc<PosedView>]) -> Result<f32, Error> {
    let joints = body.model.num_joints();
    if joints > MAX_JOINTS {
        return Err(Error::Scene(format!("bake: {joints} joints, at most {MAX_JOINTS}")));
    }
    let pixel = pixel_width(frames.iter().map(Arc::as_ref));
    pixel.ok_or_else(|| Error::Scene("bake: no training frame has the body before its camera".to_owned()))
}

/// Confidence of each vertex of the prior, 0 to 1.
fn seen(scene: &Scene) -> Result<Vec<f32>, Error> {
    let enough = (FULL_CONFIDENCE * scene.train.len() as f32).max(1.0);
    Ok(scene.vertex_frequencies()?.iter().map(|&n| (n as f32 / enough).min(1.0)).collect())
}

/// The subdivided prior that a surface lies over.
pub(super) struct Relief {
    mesh: Subdivided,
    /// (V)
    feet: Vec<NormalRay>,
}

impl Relief {
    /// For pixels of `pixel` normalised metres.
    pub fn new(prior: &[Vec3], faces: &[[u32; 3]], pixel: f32) -> Self {
        let mesh = Subdivided::new(prior.len(), faces, times_until(prior, faces, EDGE * pixel, MOST));
        let feet = normal_rays(&mesh, prior, faces);
        Self { mesh, feet }
    }

    /// Weights of the corners of a texel's face of the prior.
    fn barycentric(&self, texel: &Texel, faces: &[[u32; 3]]) -> [f32; 3] {
        let weight = |corner: u32| {
            let of = |(&v, w): (&u32, f32)| {
                let terms = self.mesh.anchors[v as usize].terms().filter(|term| term.0 == corner);
                terms.map(|term| w * term.1).sum::<f32>()
            };
            texel.corners.iter().zip(texel.weights).map(of).sum()
        };
        faces[texel.parent as usize].map(weight)
    }
}

/// The avatar without name and motion, for a pixel width of `pixel` normalised metres and a
/// confidence `seen` of each vertex of the prior, (V).
pub(super) fn surface(
    body: &Body,
    field: &CanonicalField<'_>,
    seen: &[f32],
    pixel: f32,
) -> Result<(Avatar, BakeReport), Error> {
    let relief = Relief::new(&body.canonical.vertices, &body.model.faces, pixel);
    let (heights, holes) = heights(field, &body.surface, &relief.feet, &relief.mesh);
    let paint = |texels: &[Texel]| paint(field, &body.surface, &relief.feet, &heights, texels);
    let (avatar, report) = assemble(body, &relief, &heights, seen, pixel, paint)?;
    Ok((avatar, BakeReport { holes, ..report }))
}

/// The avatar of a surface at `heights` (V) over a relief; `paint` gives texels their colours.
pub(super) fn assemble(
    body: &Body,
    Relief { mesh, feet }: &Relief,
    heights: &[f32],
    seen: &[f32],
    pixel: f32,
    paint: impl FnOnce(&[Texel]) -> Vec<Vec3>,
) -> Result<(Avatar, BakeReport), Error> {
    let (prior, faces) = (&body.canonical.vertices, &body.model.faces);
    let layout = AtlasLayout::new(prior, faces, pixel / TEXELS_A_PIXEL, MAX_SIDE);
    let layout = layout.ok_or_else(|| Error::Scene("bake: too many charts".to_owned()))?;
    let split = Split::new(mesh, &layout);
    let places = split.places(&layout, feet);
    let describe = |face: u32| (mesh.faces[face as usize], mesh.parents[face as usize]);
    let texels = texels(layout.side, &places, &split.faces, describe)?;
    let colours = paint(&texels);
    let interpolated = |anchor: &Anchor| anchor.terms().map(|(v, w)| w * seen[v as usize]).sum();
    let confidence: Vec<f32> = mesh.anchors.iter().map(interpolated).collect();
    let report = BakeReport {
        vertices: split.vertices.len(),
        faces: split.faces.len(),
        side: layout.side,
        texels: texels.len(),
        ..BakeReport::default()
    };
    let atlas = atlas(layout.side, &texels, &colours, &confidence);
    let (vertices, normals) = split.positions(mesh, feet, heights);
    let (joints, weights) = four_joints(split.rows(mesh, &body.model.weights));
    let posedirs = SparseRows::from_rows(split.rows(mesh, &body.model.posedirs));
    let rest: Vec<Vec3> = body.canonical.joints.iter().map(|joint| joint / body.scale).collect();
    let avatar = Avatar {
        name: "person".to_owned(),
        source: String::new(),
        vertices: vertices.into_iter().map(|v| v / body.scale).collect(),
        normals,
        uvs: places.iter().map(|place| (place / layout.side as f32).clamp(Vec2::ZERO, Vec2::ONE)).collect(),
        faces: split.faces,
        joints,
        weights,
        posedirs,
        atlas,
        light: Light::default(),
        skeleton: skeleton(BoneNames::Smpl, &body.model.parents, &rest),
        betas: body.mean_betas.clone(),
        clips: Vec::new(),
        cameras: Vec::new(),
    };
    Ok((avatar, report))
}

/// Vertices of the surface: a copy of each vertex of the subdivided prior for each of its charts.
struct Split {
    /// Chart and vertex of the subdivided prior.
    vertices: Vec<(u32, u32)>,
    faces: Vec<[u32; 3]>,
}

impl Split {
    fn new(mesh: &Subdivided, layout: &AtlasLayout) -> Self {
        let mut split = Self { vertices: Vec::new(), faces: Vec::with_capacity(mesh.faces.len()) };
        let mut copies: Vec<Vec<(u32, u32)>> = vec![Vec::new(); mesh.anchors.len()];
        for (face, &parent) in mesh.faces.iter().zip(&mesh.parents) {
            let chart = layout.charts[parent as usize];
            split.faces.push(face.map(|v| {
                let copies = &mut copies[v as usize];
                if let Some(&(_, copy)) = copies.iter().find(|(of, _)| *of == chart) {
                    return copy;
                }
                let copy = split.vertices.len() as u32;
                split.vertices.push((chart, v));
                copies.push((chart, copy));
                copy
            }));
        }
        split
    }

    /// Atlas coordinates, texels.
    fn places(&self, layout: &AtlasLayout, feet: &[NormalRay]) -> Vec<Vec2> {
        self.vertices.iter().map(|&(chart, v)| layout.place(chart, feet[v as usize].foot)).collect()
    }

    /// Canonical positions and unit normals, normalised metres.
    fn positions(&self, mesh: &Subdivided, feet: &[NormalRay], heights: &[f32]) -> (Vec<Vec3>, Vec<Vec3>) {
        let raised = |(normal, height): (&NormalRay, &f32)| normal.foot + height * normal.direction;
        let vertices: Vec<Vec3> = feet.iter().zip(heights).map(raised).collect();
        let normals = normals(&vertices, &mesh.faces);
        let each = self.vertices.iter().map(|&(_, v)| {
            let v = v as usize;
            (vertices[v], normals[v].try_normalize().unwrap_or(feet[v].direction))
        });
        each.unzip()
    }

    /// Rows of the prior's vertices, interpolated; columns ascending.
    fn rows<T>(&self, mesh: &Subdivided, of: &SparseRows<T>) -> Vec<Vec<(u32, T)>>
    where
        T: Copy + Add<Output = T>,
        f32: Mul<T, Output = T>,
    {
        let row = |anchor: &Anchor| {
            let mut row: Vec<(u32, T)> = Vec::new();
            for (v, w) in anchor.terms() {
                for (column, value) in of.row(v as usize) {
                    let (column, value) = (column as u32, w * value);
                    match row.binary_search_by_key(&column, |entry| entry.0) {
                        Ok(at) => row[at].1 = row[at].1 + value,
                        Err(at) => row.insert(at, (column, value)),
                    }
                }
            }
            row
        };
        self.vertices.iter().map(|&(_, v)| row(&mesh.anchors[v as usize])).collect()
    }
}

/// The four largest weights of each row, normalised, and their joints.
fn four_joints(rows: Vec<Vec<(u32, f32)>>) -> (Vec<[u16; 4]>, Vec<[f32; 4]>) {
    let heaviest = |mut row: Vec<(u32, f32)>| {
        row.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
        row.truncate(4);
        let total: f32 = row.iter().map(|entry| entry.1).sum();
        let (mut joints, mut weights) = ([0; 4], [0.0; 4]);
        for (i, (joint, weight)) in row.into_iter().enumerate() {
            (joints[i], weights[i]) = (joint as u16, weight / total);
        }
        if total.is_nan() || total <= 0.0 {
            (joints, weights) = ([0; 4], [1.0, 0.0, 0.0, 0.0]);
        }
        (joints, weights)
    };
    rows.into_iter().map(heaviest).unzip()
}

/// The atlas of painted texels, dilated between the charts.
fn atlas(side: u32, texels: &[Texel], colours: &[Vec3], confidence: &[f32]) -> Atlas {
    let count = (side * side) as usize;
    let (mut values, mut known) = (vec![[0.0f32; 4]; count], vec![false; count]);
    for (texel, colour) in texels.iter().zip(colours) {
        let seen: f32 = texel.corners.iter().zip(texel.weights).map(|(&v, w)| w * confidence[v as usize]).sum();
        values[texel.index as usize] = [colour.x, colour.y, colour.z, seen];
        known[texel.index as usize] = true;
    }
    dilate(side as usize, &mut values, &mut known);
    let byte = |x: f32| (x.clamp(0.0, 1.0) * 255.0 + 0.5) as u8;
    Atlas {
        width: side,
        height: side,
        rgb: values.iter().flat_map(|v| [v[0], v[1], v[2]].map(byte)).collect(),
        // Zero means unobserved, so rounding must not reach it.
        confidence: values.iter().map(|v| if v[3] > 0.0 { byte(v[3]).max(1) } else { 0 }).collect(),
    }
}

/// Gives an avatar the motion, cameras and light of a video, in the avatar's world.
pub(super) fn add_motion(avatar: &mut Avatar, body: &Body, frames: &[Arc<PosedView>], light: Light) {
    let turn = turn_upright(upright(body, frames.iter().map(Arc::as_ref)));
    let bones = |view: &Arc<PosedView>| {
        let placed = |bone: &Affine3A| {
            let bone = Affine3A { translation: bone.translation / body.scale, ..*bone };
            Affine3A::from_mat3(turn) * bone
        };
        view.posed.bones.iter().map(placed).collect()
    };
    let bones: Vec<Vec<Affine3A>> = frames.iter().map(bones).collect();
    let camera = |view: &Arc<PosedView>| {
        let mut camera = view.camera;
        camera.world_to_camera.translation /= body.scale;
        camera.world_to_camera *= Affine3A::from_mat3(turn.transpose());
        camera
    };
    avatar.light.slope = turn * light.slope;
    avatar.clips = vec![Clip { name: "video".to_owned(), motion: motion_of_bones(&avatar.skeleton, &bones, FPS) }];
    avatar.cameras = frames.iter().map(camera).collect();
}

/// Density, in 1 / normalised metre and 0 outside the extent, and colour at each of `places`.
fn evaluate(model: &Model, code: &VertexCode, extent: &Extent, places: &[Place]) -> Vec<(f32, Vec3)> {
    let Model { body, config, base, motion, .. } = model;
    let blended = config.surface.distance.needs_neighbours();
    let neighbours = config.needs_neighbours();
    let based = !base.colors.is_empty() && matches!(motion, MotionField::Surface(_));
    let mut batch = SampleBatch::default();
    batch.samples.clear();
    for place in places {
        let samples = &mut batch.samples;
        samples.push_canonical(body, place.at, place.closest, place.distance, neighbours);
        if blended {
            let own = &samples.neighbours[samples.neighbours.len() - body.query.neighbours_per_query()..];
            if let Some(point) = surface_point(body, &config.surface, place.at, own, f32::INFINITY)
                && let (Some(closest), Some(distance)) = (samples.closest.last_mut(), samples.distance.last_mut())
            {
                (*closest, *distance) = (point.closest, point.distance);
            }
        }
        if based {
            samples.base.push(base.logit(place.face, place.barycentric, 1.0));
        }
    }
    model.evaluate(code, &mut batch);
    let likelihood = surface_motion(&config.motion);
    let value = |((place, sigma), rgb): ((&Place, &f32), &Vec3)| {
        let lives = place.distance <= extent.faces[place.face as usize];
        (if lives { likelihood.likelihood(place.distance) * sigma } else { 0.0 }, *rgb)
    };
    places.iter().zip(&batch.sigma).zip(&batch.rgb).map(value).collect()
}
