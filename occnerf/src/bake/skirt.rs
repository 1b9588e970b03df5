//! Skirts: a closed surface around both thighs, added to a body where masks reach beyond it.
//!
//! Points have cylindrical coordinates about an axis between the legs at rest and belong to pelvis
//! and thighs by height and side. The frames' masks carve the region (visual hull, Laurentini
//! 1994), and so do the silhouettes of the dressed prior; the skirt is where the first hull is
//! wider than the second. Poses, displacement and texture treat the extended body like any other.

use std::f32::consts::TAU;

use glam::Vec3;
use rayon::prelude::*;
use smpl::{BodyModel, BoneNames, skeleton};
use visibility::{Fragment, RasterOptions, Rasterizer};

use crate::Error;
use crate::config::OccludedRule;
use crate::model::body::Body;
use crate::model::subdivide::normals;
use crate::model::view::{PosedView, pinhole};
use crate::scene::labels::{Label, dilate, label_pixels};
use crate::scene::prepared::{PreparedFrame, Scene};
use crate::scene::registration::Crop;
use crate::scene::seen::dressed;

/// Angles around the axis, and the distances of rings and of radii, normalised metres.
const ANGLES: usize = 48;
const RING: f32 = 0.03;
const STEP: f32 = 0.01;
/// Height of the first ring above the pelvis, largest number of radii, and least radius of a skirt.
const WAIST: f32 = 0.12;
const RADII: usize = 70;
const NARROWEST: f32 = 0.03;
/// Most frames that carve, and frames in flight.
const MOST_FRAMES: usize = 96;
const TOGETHER: usize = 8;
/// Share of the votes for background beyond the hull.
const CARVED: f32 = 0.35;
/// Distance of certain background from unknown pixels, and of anything certain from the arms.
const UNSURE: f32 = 0.25;
const ARMS: f32 = 0.04;
/// Least difference of the median radii of a skirt's ring and the prior's, and of those at the
/// distance `BELOW` the hips.
const WIDER: f32 = 0.015;
const LOOSE: f32 = 0.035;
const BELOW: f32 = 0.18;
/// Least ratio of a ring's median radius to that of the ring above; below the hem are legs.
const TAPER: f32 = 0.8;
/// Largest ratio of a radius to the median of its ring.
const OVAL: f32 = 1.15;

/// The model of a scene's body with a skirt; `None` where the masks show none, and for a body whose
/// joints have no names.
///
/// # Errors
/// Pictures that cannot be read or are too large.
pub fn skirted(scene: &Scene) -> Result<Option<BodyModel>, Error> {
    let Some(tube) = Tube::new(&scene.body) else { return Ok(None) };
    let stride = scene.learnt.len().div_ceil(MOST_FRAMES).max(1);
    let frames: Vec<usize> = scene.learnt.iter().copied().step_by(stride).collect();
    let mut sums = [(); 2].map(|()| vec![[0.0f32; 2]; tube.rings * ANGLES * RADII]);
    for frames in frames.chunks(TOGETHER) {
        let votes = frames.par_iter().map(|&frame| tube.votes(scene, &scene.train[frame]));
        for votes in votes.collect::<Result<Vec<_>, Error>>()? {
            for (sum, vote) in sums.iter_mut().zip(&votes).flat_map(|(sums, votes)| sums.iter_mut().zip(votes)) {
                sum[usize::from(*vote > 0.0)] += vote.abs();
            }
        }
    }
    let [mask, prior] = sums.map(|sums| hull(&sums));
    let middle = |radii: &[f32], ring: usize| radii.get(ring * ANGLES..(ring + 1) * ANGLES).map(median);
    let wider = |ring: usize, least: f32| {
        let middles = (middle(&mask, ring), middle(&prior, ring));
        matches!(middles, (Some(mask), Some(prior)) if mask >= prior + least)
    };
    let below = ((tube.axis.y - tube.hip + BELOW) / RING) as usize;
    if !wider(below, LOOSE) {
        return Ok(None);
    }
    let first = (0..=below).rev().take_while(|&ring| wider(ring, WIDER)).last().unwrap_or(below);
    let goes_on = |&ring: &usize| {
        let above = middle(&mask, ring.saturating_sub(1));
        wider(ring, WIDER) && middle(&mask, ring) >= above.map(|above| TAPER * above)
    };
    let hem = (below..).take_while(goes_on).last().unwrap_or(below);
    // The uppermost ring is inside the body.
    let first = first.saturating_sub(1);
    let oval = |ring: &[f32]| {
        let middle = median(ring);
        ring.iter().map(move |radius| radius.clamp(middle / OVAL, middle * OVAL)).collect::<Vec<f32>>()
    };
    let radii: Vec<f32> = mask[first * ANGLES..(hem + 1) * ANGLES].chunks(ANGLES).flat_map(oval).collect();
    Ok(Some(tube.sewn(&scene.body, first, &radii)))
}

fn median(values: &[f32]) -> f32 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f32::total_cmp);
    sorted[sorted.len() / 2]
}

/// Radius of the hull in each direction, (rings, angles), by sums of votes for background and for
/// the inside, (rings, angles, radii).
fn hull(sums: &[[f32; 2]]) -> Vec<f32> {
    let inside = |[out, inside]: &&[f32; 2]| inside + out > 0.0 && *out <= CARVED * (out + inside);
    sums.chunks(RADII).map(|along| along.iter().take_while(inside).count() as f32 * STEP).collect()
}

/// The region of skirts about a body at rest.
struct Tube {
    /// Pelvis, left and right hip.
    joints: [u32; 3],
    /// Positions of axis, hips and knees, and half the distance of the hips, normalised metres.
    axis: Vec3,
    hip: f32,
    knee: f32,
    half: f32,
    rings: usize,
    /// Whether each vertex of the body is of an arm, (V).
    arms: Vec<bool>,
}

impl Tube {
    fn new(body: &Body) -> Option<Self> {
        let rest = &body.canonical.joints;
        let names = skeleton(BoneNames::Smpl, &body.model.parents, rest);
        let joint = |name: &str| names.iter().position(|joint| joint.name == name);
        let [pelvis, left, right] = [joint("pelvis")?, joint("left_hip")?, joint("right_hip")?];
        let middle = |a: usize, b: usize| 0.5 * (rest[a] + rest[b]);
        let (hips, knees) = (middle(left, right), middle(joint("left_knee")?, joint("right_knee")?));
        let ankles = middle(joint("left_ankle")?, joint("right_ankle")?);
        let is_arm =
            |joint: usize| ["shoulder", "elbow", "wrist", "hand"].iter().any(|word| names[joint].name.contains(word));
        let weights = &body.model.weights;
        let arms = (0..weights.num_rows()).map(|v| weights.heaviest(v).is_some_and(is_arm)).collect();
        let top = rest[pelvis].y + WAIST;
        let rings = ((top - ankles.y) / RING).max(0.0) as usize;
        let half = 0.5 * (rest[left].x - rest[right].x).abs();
        (half > 0.0 && hips.y > knees.y).then_some(Self {
            joints: [pelvis, left, right].map(|j| j as u32),
            axis: Vec3::new(hips.x, top, hips.z),
            hip: hips.y,
            knee: knees.y,
            half,
            rings,
            arms,
        })
    }

    fn y(&self, ring: usize) -> f32 {
        self.axis.y - ring as f32 * RING
    }

    /// The point at rest at this radius.
    fn place(&self, ring: usize, angle: usize, radius: f32) -> Vec3 {
        let (sin, cos) = (TAU * angle as f32 / ANGLES as f32).sin_cos();
        Vec3::new(self.axis.x + radius * sin, self.y(ring), self.axis.z + radius * cos)
    }

    /// Weights of pelvis, left and right hip: the thighs' grow from hips to knees, left and right
    /// blend between the hips.
    fn weights(&self, at: Vec3) -> [f32; 3] {
        let thighs = ((self.hip - at.y) / (self.hip - self.knee)).clamp(0.0, 1.0);
        let side = (0.5 + 0.5 * (at.x - self.axis.x) / self.half).clamp(0.0, 1.0);
        let left = side * side * (3.0 - 2.0 * side);
        [1.0 - thighs, thighs * left, thighs * (1.0 - left)]
    }

    fn posed(&self, view: &PosedView, at: Vec3) -> Vec3 {
        let bone = |(joint, w): (u32, f32)| w * view.posed.bones[joint as usize].transform_point3(at);
        self.joints.into_iter().zip(self.weights(at)).map(bone).sum()
    }

    /// What a frame's mask, and the prior's silhouette, say of each point, (rings, angles, radii):
    /// positive for inside, negative for background. A radius counts most where it lies in the
    /// image plane.
    fn votes(&self, scene: &Scene, frame: &PreparedFrame) -> Result<[Vec<f32>; 2], Error> {
        let (view, faces) = (&frame.view, &scene.body.model.faces);
        let mut clothed = view.posed.vertices.clone();
        if !scene.clothes.is_empty() {
            clothed = dressed(&clothed, &normals(&clothed, faces), &scene.clothes);
        }
        let [mut mask, mut prior] = [(); 2].map(|()| vec![0.0; self.rings * ANGLES * RADII]);
        let Some(crop) = Crop::new(&view.camera, &frame.pixels()?, &clothed) else { return Ok([mask, prior]) };
        let (camera, options) = (&crop.camera, RasterOptions::default());
        let drawn = Rasterizer::default().faces(&clothed, faces, &pinhole(camera), &options)?;
        let body: Vec<bool> = drawn.iter().map(Option::is_some).collect();
        let width = camera.width as usize;
        let metre = camera.focal.x / camera.world_to_camera.transform_point3(view.centre()).z.max(1e-3);
        let (rule, occluder) = (OccludedRule::Unknown, crop.occluder.as_deref());
        let labels = label_pixels(rule, &crop.coverage(), &body, occluder, width, metre);
        let is_arm = |found: &Option<Fragment>| found.is_some_and(|f| self.arms[faces[f.face as usize][0] as usize]);
        let near_arms = dilate(&drawn.iter().map(is_arm).collect::<Vec<_>>(), width, ARMS * metre);
        let unknown: Vec<bool> = labels.iter().map(|&label| label == Label::Unknown).collect();
        let unsure = dilate(&unknown, width, UNSURE * metre);
        let seen = |i: usize| match labels[i] {
            _ if near_arms[i] => 0.0,
            Label::Subject => 1.0,
            Label::Background if !unsure[i] => -1.0,
            _ => 0.0,
        };
        let eye = camera.centre_of_projection();
        let cells = (0..self.rings).flat_map(|ring| (0..ANGLES).map(move |angle| (ring, angle)));
        for (cell, (ring, angle)) in cells.enumerate() {
            let along = |step: usize| self.posed(view, self.place(ring, angle, step as f32 * STEP));
            let (axis, end) = (along(0), along(RADII));
            let foreshortening = (end - axis).normalize_or_zero().dot((eye - axis).normalize_or_zero());
            let weight = (1.0 - foreshortening * foreshortening).powi(4);
            for step in 0..RADII {
                let pixel = camera.project(along(step)).and_then(|p| crop.pixel(p.truncate()));
                let Some(pixel) = pixel else { continue };
                let at = cell * RADII + step;
                mask[at] = weight * seen(pixel);
                prior[at] = mask[at].abs() * if body[pixel] { 1.0 } else { -1.0 };
            }
        }
        Ok([mask, prior])
    }

    /// The model of a body with a closed surface of rings from `first` down, at `radii` (rings,
    /// angles).
    fn sewn(&self, body: &Body, first: usize, radii: &[f32]) -> BodyModel {
        let (rings, around) = (radii.len() / ANGLES, |angle: usize| angle % ANGLES);
        let mean = |ring: usize, angle: usize| -> f32 {
            let about = [(0, 0), (0, 1), (0, ANGLES - 1), (1, 0), (-1, 0)];
            let of = |(down, on): (isize, usize)| {
                let ring = ring.saturating_add_signed(down).min(rings - 1);
                radii[ring * ANGLES + around(angle + on)]
            };
            (about.into_iter().map(of).sum::<f32>() / about.len() as f32).max(NARROWEST)
        };
        let mut places = Vec::with_capacity(rings * ANGLES + 2);
        for ring in 0..rings {
            places.extend((0..ANGLES).map(|angle| self.place(first + ring, angle, mean(ring, angle))));
        }
        places.extend([first, first + rings - 1].map(|ring| self.place(ring, 0, 0.0)));
        let before = body.model.num_vertices() as u32;
        let at = |ring: usize, angle: usize| before + (ring * ANGLES + around(angle)) as u32;
        let [top, bottom] = [0, 1].map(|pole| before + (rings * ANGLES + pole) as u32);
        let mut model = body.model.clone();
        for angle in 0..ANGLES {
            model.faces.push([top, at(0, angle), at(0, angle + 1)]);
            model.faces.push([bottom, at(rings - 1, angle + 1), at(rings - 1, angle)]);
            for ring in 1..rings {
                let [a, b] = [at(ring - 1, angle), at(ring - 1, angle + 1)];
                let [c, d] = [at(ring, angle), at(ring, angle + 1)];
                model.faces.extend([[a, c, b], [b, c, d]]);
            }
        }
        let weights: Vec<[f32; 3]> = places.iter().map(|&at| self.weights(at)).collect();
        // Points follow the joints when the shape changes.
        let moved = |directions: &[Vec3]| {
            let of =
                |joint: u32| body.model.j_regressor.row(joint as usize).map(|(v, w)| w * directions[v]).sum::<Vec3>();
            let joints = self.joints.map(of);
            weights.iter().map(|weights| joints.iter().zip(weights).map(|(d, w)| w * *d).sum()).collect::<Vec<Vec3>>()
        };
        let mut template: Vec<Vec3> = places.iter().map(|at| at / body.scale).collect();
        model.shapedirs.clear();
        for (b, directions) in body.model.shapedirs.chunks(before as usize).enumerate() {
            let (beta, moved) = (body.mean_betas.get(b).copied().unwrap_or(0.0), moved(directions));
            template.iter_mut().zip(&moved).for_each(|(at, by)| *at -= beta * by);
            model.shapedirs.extend(directions.iter().chain(&moved));
        }
        model.v_template.extend(template);
        for weights in &weights {
            for (joint, &weight) in self.joints.iter().zip(weights).filter(|(_, w)| **w > 0.0) {
                model.weights.columns.push(*joint);
                model.weights.values.push(weight);
            }
            model.weights.offsets.push(model.weights.columns.len() as u32);
            model.posedirs.offsets.push(model.posedirs.columns.len() as u32);
        }
        model
    }
}
