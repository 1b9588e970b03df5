//! The avatar as plain data, its validation, its skinning and its motions.

use glam::{Affine3A, Mat3, Mat3A, Quat, Vec2, Vec3, Vec3A};
use rayon::prelude::*;
use smpl::{Joint, MotionClip, SparseRows};
use volrender::Camera;

use crate::capture::Light;

/// Most joints of an avatar.
pub const MAX_JOINTS: usize = 256;
/// Longest side of an atlas in texels.
pub const MAX_ATLAS_SIDE: u32 = 4096;
/// Largest coordinate, in metres.
const MAX_LENGTH: f32 = 1e6;
/// Steepest light.
const MAX_SLOPE: f32 = 10.0;
/// Pose blend-shape terms of a joint other than the root: the entries of R − I.
pub(super) const TERMS_PER_JOINT: usize = 9;

/// A person as a textured, skinned surface of triangles, with motion clips.
///
/// Everything is in metres in a world that is right-handed and y up. The surface is in the
/// canonical pose (the T-pose, all rotations zero), facing +z. V vertices, F triangles, J joints, T
/// frames of a clip.
///
/// ```
/// use occnerf::capture::{LoadOptions, load_capture};
/// use occnerf::{Config, Method, Preset, Scene, bake, evaluate};
///
/// # fn main() -> Result<(), Box<dyn std::error::Error>> {
/// let body = smpl::BodyModel::embedded();
/// let options = LoadOptions { resize: Some(48), max_frames: Some(4), ..Default::default() };
/// let config = Config::preset(Preset::Fast, Method::Surface);
/// let scene = Scene::new(&load_capture("../xtask/demo".as_ref(), &body, &options)?, &body, &config)?;
/// let (avatar, report) = bake::fit(&scene)?;
/// assert!(avatar.num_joints() == 24 && report.errors[1] < report.errors[0]);
/// let light = scene.colors()?.light;
/// let mut renderer = bake::BakedRenderer::new(&avatar, scene.body.scale, light, visibility::Samples::Four);
/// let scores = evaluate(&scene, &mut renderer, &[&scene.eval[0]], None, |_, _| {})?;
/// assert!(scores.mask_iou > Some(0.7), "{scores:?}");
/// # Ok(())
/// # }
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct Avatar {
    /// Name of the scene, as the capture gives it.
    pub name: String,
    /// Identity of what it was made of, as the caller has it; may be empty.
    pub source: String,
    /// Canonical positions, (V); a vertex on a seam of the atlas has a copy per chart.
    pub vertices: Vec<Vec3>,
    /// Canonical unit normals, (V).
    pub normals: Vec<Vec3>,
    /// Texture coordinates, (V): u to the right and v downward, 0 to 1 over the atlas.
    pub uvs: Vec<Vec2>,
    /// Triangles, (F), counter-clockwise seen from outside.
    pub faces: Vec<[u32; 3]>,
    /// Joints of each vertex, (V); unused entries are repeated or 0.
    pub joints: Vec<[u16; 4]>,
    /// Their weights, (V): not negative, summing to 1.
    pub weights: Vec<[f32; 4]>,
    /// Pose blend shapes, (V, 9(J−1)), in the order of [`smpl::BodyModel::posedirs`]; empty rows
    /// for skinning alone. Formats without them leave them out.
    pub posedirs: SparseRows<Vec3>,
    /// Colours and confidence.
    pub atlas: Atlas,
    /// Light of the video: shading times the atlas's albedo is the video's colour. Formats without
    /// light leave it out.
    pub light: Light,
    /// The skeleton at rest, (J); parents come before their children, joint 0 is the only root.
    pub skeleton: Vec<Joint>,
    /// Shape coefficients of the body model that the surface came from; may be empty.
    pub betas: Vec<f32>,
    /// Motions; the first is the video's.
    pub clips: Vec<Clip>,
    /// The training camera of each frame of the first clip, (T), or none.
    pub cameras: Vec<Camera>,
}

/// The texture.
#[derive(Clone, Debug, PartialEq)]
pub struct Atlas {
    /// Texels a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// 8-bit sRGB, (H, W, 3), row-major from the top left.
    pub rgb: Vec<u8>,
    /// Observation confidence of each texel, (H, W): 0 unobserved, 255 full.
    pub confidence: Vec<u8>,
}

/// A named motion: axis-angle rotations (T·J) of each joint relative to its parent, and
/// translations (T) of the root.
///
/// The root joint is at its rest position + translation and rotates about itself
/// ([`smpl::Placement::Pelvis`]).
#[derive(Clone, Debug, PartialEq)]
pub struct Clip {
    /// Such as `video`; unique.
    pub name: String,
    /// Rotations, translations and rate.
    pub motion: MotionClip,
}

impl Avatar {
    /// V.
    #[must_use]
    pub fn num_vertices(&self) -> usize {
        self.vertices.len()
    }

    /// Colour values of the texels that triangles cover, and a height of each vertex.
    #[must_use]
    pub fn num_parameters(&self) -> usize {
        let corner = |v: u32| self.uvs[v as usize] * self.atlas.size();
        let area = |face: &[u32; 3]| {
            let [a, b, c] = face.map(corner);
            f64::from((b - a).perp_dot(c - a).abs()) / 2.0
        };
        3 * self.faces.iter().map(area).sum::<f64>() as usize + self.num_vertices()
    }

    /// J.
    #[must_use]
    pub fn num_joints(&self) -> usize {
        self.skeleton.len()
    }

    /// Canonical to world transform of each joint, (J), for rotations `pose` (J).
    ///
    /// # Panics
    /// If `pose` is not J long.
    #[must_use]
    pub fn bones(&self, pose: &[Vec3], translation: Vec3) -> Vec<Affine3A> {
        smpl::joint_transforms(&self.skeleton, pose, translation)
    }

    /// World positions and unit normals of the vertices, (V) each: pose blend shapes of rotations
    /// `pose` (J), then linear blend skinning by `bones` (J).
    ///
    /// # Panics
    /// Unless `bones` and `pose` are J long.
    #[must_use]
    pub fn skin(&self, bones: &[Affine3A], pose: &[Vec3]) -> (Vec<Vec3>, Vec<Vec3>) {
        assert_eq!((bones.len(), pose.len()), (self.num_joints(), self.num_joints()), "skin: bones, rotations");
        let features: Vec<f32> = (pose.iter().skip(1))
            .flat_map(|&turn| (smpl::rodrigues(turn) - Mat3::IDENTITY).transpose().to_cols_array())
            .collect();
        let skinned = |v: usize| {
            let bone = blend(bones, self.joints[v], self.weights[v]);
            let offset: Vec3 = self.posedirs.row(v).map(|(term, d)| features[term] * d).sum();
            let normal = self.normals[v];
            (bone.transform_point3(self.vertices[v] + offset), bone.transform_vector3(normal).normalize_or(normal))
        };
        (0..self.num_vertices()).into_par_iter().map(skinned).unzip()
    }

    /// Checks that the parts fit together.
    ///
    /// # Errors
    /// The first fault in the order of the fields: its part, expected and found.
    pub fn validate(&self) -> Result<(), String> {
        let (v, j) = (self.num_vertices(), self.num_joints());
        let each = [
            ("normals", self.normals.len()),
            ("uvs", self.uvs.len()),
            ("joints", self.joints.len()),
            ("weights", self.weights.len()),
            ("posedirs", self.posedirs.num_rows()),
        ];
        expect(v > 0, || "`vertices`: expected some, found none".to_owned())?;
        for (key, found) in each {
            expect(found == v, || format!("`{key}`: expected {v} rows, one a vertex, found {found}"))?;
        }
        vectors("vertices", &self.vertices, MAX_LENGTH)?;
        vectors("normals", &self.normals, 1.01)?;
        let inside = |uv: &Vec2| (0.0..=1.0).contains(&uv.x) && (0.0..=1.0).contains(&uv.y);
        all("uvs", &self.uvs, inside, "numbers from 0 to 1")?;
        let known = |face: &[u32; 3]| face.iter().all(|&i| (i as usize) < v);
        all("faces", &self.faces, known, &format!("vertices below {v}"))?;
        expect(!self.faces.is_empty(), || "`faces`: expected some, found none".to_owned())?;
        expect((1..=MAX_JOINTS).contains(&j), || format!("`skeleton`: expected 1 to {MAX_JOINTS} joints, found {j}"))?;
        all("joints", &self.joints, |row| row.iter().all(|&i| usize::from(i) < j), &format!("joints below {j}"))?;
        let sums = |row: &[f32; 4]| {
            row.iter().all(|w| (0.0..=1.001).contains(w)) && (row.iter().sum::<f32>() - 1.0).abs() <= 1e-3
        };
        all("weights", &self.weights, sums, "numbers of at least 0 that sum to 1")?;
        self.validate_posedirs(TERMS_PER_JOINT * (j - 1))?;
        self.atlas.validate()?;
        vectors("light", &[self.light.slope], MAX_SLOPE)?;
        self.validate_skeleton()?;
        all("betas", &self.betas, |beta| beta.abs() <= MAX_LENGTH, "finite numbers")?;
        self.validate_motion()
    }

    fn validate_posedirs(&self, terms: usize) -> Result<(), String> {
        let SparseRows { offsets, columns, values } = &self.posedirs;
        let parted = offsets.first() == Some(&0)
            && offsets.windows(2).all(|w| w[0] <= w[1])
            && offsets.last().is_some_and(|&end| end as usize == columns.len())
            && columns.len() == values.len();
        expect(parted, || "`posedirs`: expected row offsets that part the entries".to_owned())?;
        all("posedirs columns", columns, |&c| (c as usize) < terms, &format!("terms below {terms}"))?;
        vectors("posedirs", values, MAX_LENGTH)
    }

    fn validate_skeleton(&self) -> Result<(), String> {
        for (j, joint) in self.skeleton.iter().enumerate() {
            let placed = joint.parent.map_or(j == 0, |parent| usize::from(parent) < j);
            expect(placed, || {
                let expected = "none for joint 0 and a joint before it for all others";
                format!("`skeleton`: parent of joint {j}: expected {expected}, found {:?}", joint.parent)
            })?;
            let twice = self.skeleton[..j].iter().any(|other| other.name == joint.name);
            expect(!twice, || format!("`skeleton`: two joints are named {:?}", joint.name))?;
        }
        vectors("skeleton", &self.skeleton.iter().map(|joint| joint.rest).collect::<Vec<_>>(), MAX_LENGTH)
    }

    fn validate_motion(&self) -> Result<(), String> {
        let j = self.num_joints();
        for (c, Clip { name, motion }) in self.clips.iter().enumerate() {
            let twice = self.clips[..c].iter().any(|other| other.name == *name);
            expect(!twice, || format!("`clips`: two are named {name:?}"))?;
            expect(motion.num_joints == j, || {
                format!("clip {name:?}: expected {j} joints, found {}", motion.num_joints)
            })?;
            let (frames, turns) = (motion.num_frames(), motion.poses.len());
            expect(frames > 0 && frames.checked_mul(j) == Some(turns), || {
                format!("clip {name:?}: expected some frames of {j} rotations, found {frames} of {turns} in all")
            })?;
            let rate = motion.fps;
            expect(rate > 0.0 && rate <= 1e6, || format!("clip {name:?}: {rate} frames a second"))?;
            vectors(&format!("poses of {name:?}"), &motion.poses, 1e3)?;
            vectors(&format!("trans of {name:?}"), &motion.trans, MAX_LENGTH)?;
        }
        let frames = self.clips.first().map_or(0, |clip| clip.motion.num_frames());
        let cameras = self.cameras.len();
        expect(cameras == 0 || cameras == frames, || {
            format!("`cameras`: expected {frames}, one a frame of the first clip, or none; found {cameras}")
        })?;
        for (i, camera) in self.cameras.iter().enumerate() {
            let Camera { world_to_camera, width, height, .. } = *camera;
            Camera::new(camera.intrinsics(), world_to_camera, width, height)
                .map_err(|error| format!("camera {i}: {error}"))?;
        }
        Ok(())
    }
}

impl Atlas {
    /// Width and height.
    pub(super) fn size(&self) -> Vec2 {
        Vec2::new(self.width as f32, self.height as f32)
    }

    /// Halves the sides, by means of four texels, until none is longer than `longest`.
    pub fn shrink(&mut self, longest: u32) {
        while self.width.max(self.height) > longest.max(1) {
            let (width, height) = (self.width.div_ceil(2), self.height.div_ceil(2));
            let halved = |values: &[u8], channels: usize| -> Vec<u8> {
                let value = |x: u32, y: u32, c: usize| {
                    let (x, y) = (x.min(self.width - 1) as usize, y.min(self.height - 1) as usize);
                    u32::from(values[(y * self.width as usize + x) * channels + c])
                };
                let mean = |(y, x, c)| {
                    let four = [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(i, j)| value(2 * x + i, 2 * y + j, c));
                    ((four.iter().sum::<u32>() + 2) / 4) as u8
                };
                let row = |y| (0..width).flat_map(move |x| (0..channels).map(move |c| (y, x, c)));
                (0..height).flat_map(row).map(mean).collect()
            };
            let (rgb, confidence) = (halved(&self.rgb, 3), halved(&self.confidence, 1));
            *self = Self { width, height, rgb, confidence };
        }
    }

    fn validate(&self) -> Result<(), String> {
        let sides = 1..=MAX_ATLAS_SIDE;
        expect(sides.contains(&self.width) && sides.contains(&self.height), || {
            let (w, h) = (self.width, self.height);
            format!("`atlas`: expected sides of 1 to {MAX_ATLAS_SIDE} texels, found {w}×{h}")
        })?;
        let texels = self.width as usize * self.height as usize;
        for (key, expected, found) in
            [("rgb", 3 * texels, self.rgb.len()), ("confidence", texels, self.confidence.len())]
        {
            expect(found == expected, || format!("`atlas` {key}: expected {expected} bytes, found {found}"))?;
        }
        Ok(())
    }
}

/// Σ w_i · bones_i.
#[inline]
pub(super) fn blend(bones: &[Affine3A], joints: [u16; 4], weights: [f32; 4]) -> Affine3A {
    let mut sum = Affine3A { matrix3: Mat3A::ZERO, translation: Vec3A::ZERO };
    for (joint, weight) in joints.into_iter().zip(weights) {
        let bone = &bones[usize::from(joint)];
        sum.matrix3 += bone.matrix3 * weight;
        sum.translation += bone.translation * weight;
    }
    sum
}

fn expect(holds: bool, message: impl FnOnce() -> String) -> Result<(), String> {
    if holds { Ok(()) } else { Err(message()) }
}

/// Errors for the first entry that is not `valid`; NaN fails comparisons.
fn all<T: std::fmt::Debug>(key: &str, values: &[T], valid: impl Fn(&T) -> bool, expected: &str) -> Result<(), String> {
    match values.iter().position(|value| !valid(value)) {
        Some(at) => Err(format!("`{key}`: expected {expected}, found {:?} at {at}", values[at])),
        None => Ok(()),
    }
}

fn vectors(key: &str, values: &[Vec3], longest: f32) -> Result<(), String> {
    all(key, values, |v| v.length() <= longest, &format!("finite vectors no longer than {longest}"))
}

/// Rotation from the direction `up` of a capture's world to +y; the identity for a zero `up`.
#[must_use]
pub fn turn_upright(up: Vec3) -> Mat3 {
    up.try_normalize().map_or(Mat3::IDENTITY, |up| Mat3::from_quat(Quat::from_rotation_arc(up, Vec3::Y)))
}

/// The motion whose joint j of `skeleton` (J) has the canonical to world transform `frames[t][j]`
/// (T, J).
///
/// Bones that do not meet at their joints, as of a body that changes its size, keep their rotations
/// and the root's position.
///
/// # Panics
/// Unless every frame has J transforms.
#[must_use]
pub fn motion_of_bones(skeleton: &[Joint], frames: &[Vec<Affine3A>], fps: f32) -> MotionClip {
    let mut poses = Vec::with_capacity(frames.len() * skeleton.len());
    let mut trans = Vec::with_capacity(frames.len());
    for bones in frames {
        assert_eq!(bones.len(), skeleton.len(), "motion_of_bones: transforms of joints");
        let turns: Vec<Quat> = bones.iter().map(|bone| Quat::from_mat3a(&bone.matrix3).normalize()).collect();
        for (joint, &turn) in skeleton.iter().zip(&turns) {
            let parent = joint.parent.map_or(Quat::IDENTITY, |parent| turns[usize::from(parent)]);
            let local = parent.inverse() * turn;
            // Quaternion of the smaller angle.
            let shorter = if local.w < 0.0 { -local } else { local };
            poses.push(shorter.to_scaled_axis());
        }
        let moved = |(bone, joint): (&Affine3A, &Joint)| bone.transform_point3(joint.rest) - joint.rest;
        trans.push(bones.iter().zip(skeleton).next().map_or(Vec3::ZERO, moved));
    }
    MotionClip { poses, num_joints: skeleton.len(), trans, fps }
}
