//! Motion capture in Biovision's hierarchy format, and its motion on another skeleton.

use std::fmt::Write as _;
use std::io::Write as _;
use std::path::Path;

use array_files::{decode_text, read_file, replace_file};
use glam::{DQuat, DVec3, EulerRot, Mat3, Quat, Vec3};

use super::MotionClip;
use super::skeleton::{BODY, FACE, HANDS, Joint, ROLES, joint_transforms, roles};
use crate::Error;

/// Most joints.
const MAX_JOINTS: usize = 1024;
/// Most rotations, frames times joints.
const MAX_ROTATIONS: usize = 1 << 24;
/// Largest number accepted.
const MAX_VALUE: f64 = 1e6;
/// Units of length by metres: metres, centimetres, millimetres, and that of CMU's skeletons.
const UNITS: [(f64, &str); 4] =
    [(1.0, "metres"), (0.01, "centimetres"), (1e-3, "millimetres"), (0.0254 / 0.45, "1/0.45 inches")];
/// Height by which the unit is told, in metres.
const HEIGHT: f64 = 1.7;
/// Centimetres a metre.
const CENTIMETRES: f32 = 100.0;

/// A skeleton and its motion, in metres.
///
/// ```
/// use glam::Vec3;
/// use smpl::{BodyModel, BoneNames, Bvh, MotionClip, skeleton};
///
/// let body = BodyModel::embedded();
/// let skeleton = skeleton(BoneNames::Mixamo, &body.parents, &body.shaped(&[]).joints);
/// let mut poses = vec![Vec3::ZERO; 24];
/// poses[4].x = 1.0;
/// let motion = MotionClip { poses, num_joints: 24, trans: vec![Vec3::Y], fps: 30.0 };
///
/// let path = std::env::temp_dir().join("knee.bvh");
/// Bvh { skeleton: skeleton.clone(), motion, unit: "centimetres" }.save(&path)?;
/// let knee = Bvh::load(&path)?.onto(&skeleton).unwrap();
/// assert!((knee.poses[4].x - 1.0).abs() < 1e-5 && knee.trans[0].distance(Vec3::Y) < 1e-5);
/// # std::fs::remove_file(&path).unwrap();
/// # Ok::<(), smpl::Error>(())
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct Bvh {
    /// Joints, in the order of the file. The root of a file rests at the origin.
    pub skeleton: Vec<Joint>,
    /// Rotations of the joints and translations of the root.
    pub motion: MotionClip,
    /// Name of the file's unit of length, told by the height of the skeleton.
    pub unit: &'static str,
}

impl Bvh {
    /// Reads a `.bvh` with one root. Channels may stand in any order, which is that in which the
    /// rotations are multiplied. Positions of the root are absolute; without them it stays at its
    /// `OFFSET`. Positions of other joints are passed over: bones keep their lengths.
    ///
    /// # Errors
    /// [`Error::Io`]; [`Error::Invalid`] with the line, for broken hierarchies, numbers that are
    /// none, not finite or beyond 10⁶, more or fewer values than frames times channels, more than
    /// 1024 joints or 2²⁴ rotations, and a skeleton without extent.
    pub fn load(path: &Path) -> Result<Self, Error> {
        let text = decode_text(&read_file(path)?);
        Parser { file: path.display().to_string(), words: words(&text), line: 1 }.parse()
    }

    /// Writes the motion, in centimetres: rotations Z X Y in degrees, positions of the root, which
    /// rests at the origin. Names lose their white space.
    ///
    /// # Errors
    /// [`Error::Invalid`] for a skeleton whose joints do not come after their parents, or of
    /// another number of joints than the motion's; [`Error::Io`].
    pub fn save(&self, path: &Path) -> Result<(), Error> {
        let (file, j) = (path.display().to_string(), self.skeleton.len());
        let ordered = |(at, joint): (usize, &Joint)| joint.parent.map_or(at == 0, |parent| usize::from(parent) < at);
        if j == 0 || !self.skeleton.iter().enumerate().all(ordered) || self.motion.num_joints != j {
            let message = format!("expected {} joints, each after its parent, found {j}", self.motion.num_joints);
            return Err(Error::invalid(&file, "skeleton", message));
        }
        let mut text = "HIERARCHY\n".to_owned();
        let mut order = Vec::with_capacity(j);
        self.write_joints(&mut text, &mut order);
        let frames = self.motion.num_frames();
        let _ = writeln!(text, "MOTION\nFrames: {frames}\nFrame Time: {:.9}", 1.0 / f64::from(self.motion.fps));
        let replaced = replace_file(path, |to| {
            to.write_all(text.as_bytes())?;
            for (pose, trans) in self.motion.poses.chunks_exact(j).zip(&self.motion.trans) {
                let at = (self.skeleton[0].rest + trans) * CENTIMETRES;
                write!(to, "{:.5} {:.5} {:.5}", at.x, at.y, at.z)?;
                for &joint in &order {
                    let (z, x, y) = DQuat::from_scaled_axis(pose[joint].as_dvec3()).to_euler(EulerRot::ZXY);
                    write!(to, " {:.6} {:.6} {:.6}", z.to_degrees(), x.to_degrees(), y.to_degrees())?;
                }
                writeln!(to)?;
            }
            Ok(())
        });
        replaced.map_err(|source| Error::Io { path: path.to_owned(), source })
    }

    /// The hierarchy, depth first; `order` takes the joints as they are written.
    fn write_joints(&self, text: &mut String, order: &mut Vec<usize>) {
        let children = |joint: usize| {
            let child = move |j: &usize| self.skeleton[*j].parent.map(usize::from) == Some(joint);
            (0..self.skeleton.len()).rev().filter(child)
        };
        // Joints to open, and braces to close.
        let mut todo = vec![Some(0)];
        let mut depth = 0;
        while let Some(next) = todo.pop() {
            let Some(joint) = next else {
                depth -= 1;
                let _ = writeln!(text, "{:1$}}}", "", 2 * depth);
                continue;
            };
            let Joint { name, parent, rest } = &self.skeleton[joint];
            let bone = parent.map_or(Vec3::ZERO, |parent| *rest - self.skeleton[usize::from(parent)].rest);
            let name: String = name.split_whitespace().collect::<Vec<_>>().join("_");
            let (kind, place) = if joint == 0 { ("ROOT", "6 Xposition Yposition Zposition") } else { ("JOINT", "3") };
            let (pad, bone) = (" ".repeat(2 * depth), bone * CENTIMETRES);
            let _ = writeln!(text, "{pad}{kind} {name}\n{pad}{{");
            let _ = writeln!(text, "{pad}  OFFSET {:.5} {:.5} {:.5}", bone.x, bone.y, bone.z);
            let _ = writeln!(text, "{pad}  CHANNELS {place} Zrotation Xrotation Yrotation");
            if children(joint).next().is_none() {
                // Half as long as the bone before it.
                let end = 0.5 * bone;
                let _ = writeln!(text, "{pad}  End Site\n{pad}  {{");
                let _ = writeln!(text, "{pad}    OFFSET {:.5} {:.5} {:.5}\n{pad}  }}", end.x, end.y, end.z);
            }
            order.push(joint);
            depth += 1;
            todo.push(None);
            todo.extend(children(joint).map(Some));
        }
    }
}

fn words(text: &str) -> impl Iterator<Item = (usize, &str)> {
    text.lines().enumerate().flat_map(|(line, text)| text.split_whitespace().map(move |word| (line + 1, word)))
}

#[derive(Clone, Copy)]
enum Channel {
    Position(usize),
    Rotation(DVec3),
}

struct Parser<'a, I: Iterator<Item = (usize, &'a str)>> {
    file: String,
    words: I,
    /// Line of the last word.
    line: usize,
}

impl<'a, I: Iterator<Item = (usize, &'a str)>> Parser<'a, I> {
    fn parse(mut self) -> Result<Bvh, Error> {
        self.expect("HIERARCHY")?;
        let (mut skeleton, channels, offset, extent) = self.hierarchy()?;
        let by_height = |unit: &&(f64, &str)| (extent * unit.0 / HEIGHT).ln().abs();
        let &(scale, unit) = UNITS.iter().min_by(|a, b| by_height(a).total_cmp(&by_height(b))).unwrap_or(&UNITS[0]);
        skeleton.iter_mut().for_each(|joint| joint.rest *= scale as f32);
        self.expect("Frames:")?;
        let frames = self.word()?;
        let frames: usize = frames.parse().map_err(|_| self.unexpected("a number of frames", frames))?;
        if frames == 0 || frames.checked_mul(skeleton.len()).is_none_or(|n| n > MAX_ROTATIONS) {
            let most = MAX_ROTATIONS / skeleton.len();
            return Err(self.fault(format!("{frames} frames of {} joints, expected 1 to {most}", skeleton.len())));
        }
        self.expect("Frame")?;
        self.expect("Time:")?;
        let seconds = self.number()?;
        if !(1e-6..=1e3).contains(&seconds) {
            return Err(self.fault(format!("{seconds} s a frame, expected 0.000001 to 1000")));
        }
        let (mut poses, mut trans) = (Vec::new(), Vec::new());
        for frame in 0..frames {
            let mut turns = vec![DQuat::IDENTITY; skeleton.len()];
            let mut at = offset;
            for &(joint, channel) in &channels {
                let value = self.next().ok_or_else(|| self.fault(format!("ends in frame {frame} of {frames}")))?;
                let value = self.to_number(value)?;
                match channel {
                    Channel::Position(axis) if joint == 0 => at[axis] = value,
                    Channel::Position(_) => {}
                    Channel::Rotation(axis) => turns[joint] *= DQuat::from_axis_angle(axis, value.to_radians()),
                }
            }
            trans.push((scale * at).as_vec3());
            poses.extend(turns.into_iter().map(|turn| shorter(turn.as_quat()).to_scaled_axis()));
        }
        if let Some(word) = self.next() {
            return Err(self.unexpected(&format!("the end after {frames} frames"), word));
        }
        let motion = MotionClip { poses, num_joints: skeleton.len(), trans, fps: (1.0 / seconds) as f32 };
        Ok(Bvh { skeleton, motion, unit })
    }

    /// Joints at rest in the file's unit, channels of a frame with their joints, the root's offset,
    /// and the extent, end sites included; up to and with `MOTION`.
    #[allow(clippy::type_complexity, reason = "a tuple of named parts, used once")]
    fn hierarchy(&mut self) -> Result<(Vec<Joint>, Vec<(usize, Channel)>, DVec3, f64), Error> {
        let (mut skeleton, mut channels): (Vec<Joint>, Vec<(usize, Channel)>) = (Vec::new(), Vec::new());
        let mut offset = DVec3::ZERO;
        let (mut low, mut high) = (Vec3::ZERO, Vec3::ZERO);
        // Open joints, `None` for an end site.
        let mut open: Vec<Option<usize>> = Vec::new();
        loop {
            let word = self.word()?;
            match (word.to_ascii_uppercase().as_str(), open.last().copied()) {
                ("MOTION", None) if !skeleton.is_empty() => break,
                (kind @ ("ROOT" | "JOINT"), parent) => {
                    let parent = match (kind, parent) {
                        ("ROOT", None) if skeleton.is_empty() => None,
                        ("JOINT", Some(Some(parent))) => Some(parent as u16),
                        _ => return Err(self.unexpected("one ROOT, and each JOINT in it or in another", word)),
                    };
                    if skeleton.len() == MAX_JOINTS {
                        return Err(self.fault(format!("more than {MAX_JOINTS} joints")));
                    }
                    let name = self.name()?;
                    let rest = self.offset()?;
                    let rest = if parent.is_none() { std::mem::replace(&mut offset, rest) } else { rest }.as_vec3();
                    let rest = parent.map_or(Vec3::ZERO, |parent: u16| skeleton[usize::from(parent)].rest + rest);
                    (low, high) = (low.min(rest), high.max(rest));
                    open.push(Some(skeleton.len()));
                    skeleton.push(Joint { name, parent, rest });
                }
                ("END", Some(Some(parent))) => {
                    self.name()?;
                    let end = skeleton[parent].rest + self.offset()?.as_vec3();
                    (low, high) = (low.min(end), high.max(end));
                    open.push(None);
                }
                ("CHANNELS", Some(Some(joint))) => {
                    if channels.last().is_some_and(|last| last.0 == joint) {
                        return Err(self.fault("a second CHANNELS of a joint"));
                    }
                    let count = self.word()?;
                    let known: Option<usize> = count.parse().ok().filter(|count| *count <= 6);
                    for _ in 0..known.ok_or_else(|| self.unexpected("0 to 6 channels", count))? {
                        channels.push((joint, self.channel()?));
                    }
                }
                ("}", Some(_)) => drop(open.pop()),
                _ => return Err(self.unexpected("JOINT, End Site, CHANNELS or a brace in its place", word)),
            }
        }
        let extent = f64::from((high - low).max_element());
        if extent <= 0.0 {
            return Err(self.fault("all bones have zero length"));
        }
        if channels.is_empty() {
            return Err(self.fault("no CHANNELS"));
        }
        Ok((skeleton, channels, offset, extent))
    }

    /// Words up to an opening brace.
    fn name(&mut self) -> Result<String, Error> {
        let mut name = String::new();
        loop {
            match self.word()? {
                "{" if !name.is_empty() => return Ok(name),
                "{" | "}" => return Err(self.fault("expected a name")),
                word if name.len() + word.len() > 256 => return Err(self.fault("a name of more than 256 letters")),
                word => name = if name.is_empty() { word.to_owned() } else { format!("{name} {word}") },
            }
        }
    }

    fn offset(&mut self) -> Result<DVec3, Error> {
        self.expect("OFFSET")?;
        Ok(DVec3::new(self.number()?, self.number()?, self.number()?))
    }

    fn channel(&mut self) -> Result<Channel, Error> {
        let word = self.word()?;
        let axis = word.bytes().next().map_or(3, |first| usize::from(first.to_ascii_lowercase().wrapping_sub(b'x')));
        match (axis, word.get(1..).unwrap_or_default().to_ascii_lowercase().as_str()) {
            (0..3, "position") => Ok(Channel::Position(axis)),
            (0..3, "rotation") => Ok(Channel::Rotation(DVec3::AXES[axis])),
            _ => Err(self.unexpected("a channel such as Xposition or Zrotation", word)),
        }
    }

    fn next(&mut self) -> Option<&'a str> {
        let (line, word) = self.words.next()?;
        self.line = line;
        Some(word)
    }

    fn word(&mut self) -> Result<&'a str, Error> {
        self.next().ok_or_else(|| self.fault("the file ends here"))
    }

    fn number(&mut self) -> Result<f64, Error> {
        let word = self.word()?;
        self.to_number(word)
    }

    fn to_number(&self, word: &str) -> Result<f64, Error> {
        let number = word.parse().ok().filter(|x: &f64| x.abs() <= MAX_VALUE);
        number.ok_or_else(|| self.unexpected("a number of at most 1000000", word))
    }

    fn expect(&mut self, expected: &str) -> Result<(), Error> {
        let word = self.word()?;
        if word.eq_ignore_ascii_case(expected) { Ok(()) } else { Err(self.unexpected(expected, word)) }
    }

    fn unexpected(&self, expected: &str, found: &str) -> Error {
        let found: String = found.chars().take(40).collect();
        self.fault(format!("expected {expected}, found {found:?}"))
    }

    fn fault(&self, message: impl ToString) -> Error {
        Error::invalid(&self.file, &format!("line {}", self.line), message)
    }
}

/// The quaternion of the same rotation with the smaller angle.
fn shorter(turn: Quat) -> Quat {
    if turn.w < 0.0 { -turn } else { turn }
}

/// Joints that both skeletons must have.
const NEEDED: [(usize, &str); 9] = [
    (0, "hips"),
    (1, "left upper leg"),
    (2, "right upper leg"),
    (4, "left lower leg"),
    (5, "right lower leg"),
    (16, "left upper arm"),
    (17, "right upper arm"),
    (18, "left forearm"),
    (19, "right forearm"),
];
/// Limbs whose directions at rest are aligned, with the joint at their end; of feet, only
/// the heading is aligned.
const LIMBS: [(usize, usize); 10] =
    [(1, 4), (2, 5), (4, 7), (5, 8), (16, 18), (17, 19), (18, 20), (19, 21), (7, 10), (8, 11)];
/// Shortest bone of a limb, relative to a leg.
const SHORTEST: f32 = 1e-3;

/// A skeleton by roles.
struct Roles<'a> {
    skeleton: &'a [Joint],
    /// Joint of each role.
    joints: [Option<usize>; ROLES],
}

impl<'a> Roles<'a> {
    fn new(skeleton: &'a [Joint]) -> Result<Self, String> {
        let names: Vec<&str> = skeleton.iter().map(|joint| joint.name.as_str()).collect();
        let mut joints = [None; ROLES];
        for (joint, role) in roles(&names).into_iter().enumerate() {
            if let Some(role) = role {
                joints[role] = Some(joint);
            }
        }
        let missing: Vec<&str> = NEEDED.iter().filter(|(s, _)| joints[*s].is_none()).map(|(_, name)| *name).collect();
        if !missing.is_empty() {
            return Err(format!("no joint by name for {}", missing.join(", ")));
        }
        Ok(Self { skeleton, joints })
    }

    fn at(&self, role: usize) -> Option<Vec3> {
        self.joints[role].map(|joint| self.skeleton[joint].rest)
    }

    /// From the joint of role `from` to that of `to`.
    fn bone(&self, from: usize, to: usize) -> Option<Vec3> {
        Some(self.at(to)? - self.at(from)?)
    }

    /// Mean length of the legs: to the ankles, or to the knees.
    fn leg(&self, to_ankles: bool) -> f32 {
        let length = |(from, to)| self.bone(from, to).map_or(0.0, Vec3::length);
        0.5 * LIMBS[..if to_ankles { 4 } else { 2 }].iter().copied().map(length).sum::<f32>()
    }

    /// Rotation from the axes of the rest pose, upright along an axis of the file, to +y up and +z
    /// ahead.
    fn to_front(&self) -> Option<Quat> {
        let across = self.bone(2, 1)? + self.bone(17, 16)?;
        let up = self.bone(1, 16)? + self.bone(2, 17)?;
        let nearest = |v: Vec3| {
            let axes = Vec3::AXES.into_iter().filter(|axis| v.dot(*axis).abs() > 0.0);
            axes.max_by(|a, b| v.dot(*a).abs().total_cmp(&v.dot(*b).abs())).map(|axis| axis * v.dot(axis).signum())
        };
        let up = nearest(up)?;
        let left = nearest(across.reject_from(up))?;
        Some(Quat::from_mat3(&Mat3::from_cols(left, up, left.cross(up)).transpose()))
    }
}

impl Bvh {
    /// The motion for the skeleton `to`, which rests y up facing +z. Joints correspond by the names
    /// of SMPL, Mixamo, CMU, VRM, Unreal, MakeHuman and Biped rigs; they take the orientation of
    /// their counterparts, corrected by the directions of the limbs at rest; all others follow
    /// their parents. Translations are scaled by the lengths of the legs. A skeleton of the same
    /// names takes the rotations and translations as they are. The world's axes stay.
    ///
    /// # Errors
    /// What one of the skeletons lacks: hips, upper or lower arms or legs, or their lengths.
    pub fn onto(&self, to: &[Joint]) -> Result<MotionClip, String> {
        let (from, j, motion) = (&self.skeleton, self.skeleton.len(), &self.motion);
        let root = to.first().map_or(Vec3::ZERO, |joint| joint.rest);
        if from.iter().map(|joint| &joint.name).eq(to.iter().map(|joint| &joint.name)) {
            let trans = motion.trans.iter().map(|t| from[0].rest + *t - root).collect();
            return Ok(MotionClip { trans, ..motion.clone() });
        }
        let (from, to) = (Roles::new(from)?, Roles::new(to).map_err(|fault| format!("the target has {fault}"))?);
        let turn = from.to_front().ok_or("the rest pose has no height or no width")?;
        let to_ankles = [7, 8].iter().all(|&ankle| from.joints[ankle].is_some() && to.joints[ankle].is_some());
        let (source_leg, leg) = (from.leg(to_ankles), to.leg(to_ankles));
        // From the target's rest to the source's.
        let mut aligned = [turn.inverse(); ROLES];
        for (role, end) in LIMBS {
            let (Some(source), Some(own)) = (from.bone(role, end), to.bone(role, end)) else { continue };
            let is_foot = matches!(role, 7 | 8);
            if !is_foot && (source.length() <= SHORTEST * source_leg || own.length() <= SHORTEST * leg) {
                let name = NEEDED.iter().find(|needed| needed.0 == role).map_or("limb", |needed| needed.1);
                return Err(format!("the {name} has zero length"));
            }
            let direction = |v: Vec3| if is_foot { v.with_y(0.0) } else { v }.try_normalize();
            if let (Some(source), Some(own)) = (direction(turn * source), direction(own)) {
                aligned[role] = turn.inverse() * Quat::from_rotation_arc(own, source);
            }
        }
        // Hands and fingers go with the forearms.
        for role in (20..FACE).chain(HANDS..ROLES) {
            let is_right = match role {
                ..BODY => role == 21,
                BODY..FACE => role >= BODY + 15,
                _ => role > HANDS,
            };
            aligned[role] = aligned[18 + usize::from(is_right)];
        }
        let mut source_of = vec![None; to.skeleton.len()];
        for (role, joint) in to.joints.iter().enumerate() {
            // Of fewer spinal joints the one before.
            let lower = [role, role.wrapping_sub(3), role.wrapping_sub(6)];
            let tried = if matches!(role, 6 | 9) { &lower[..role / 3] } else { &lower[..1] };
            let found = tried.iter().find_map(|&r| from.joints[r].map(|source| (source, aligned[role])));
            if let Some(joint) = joint {
                source_of[*joint] = found;
            }
        }
        let (Some(source_hips), Some(hips)) = (from.joints[0], to.joints[0]) else { return Err("no hips".to_owned()) };
        let scale = leg / source_leg;
        let (mut poses, mut trans) = (Vec::new(), Vec::with_capacity(motion.num_frames()));
        for (pose, &translation) in motion.poses.chunks_exact(j).zip(&motion.trans) {
            let bones = joint_transforms(from.skeleton, pose, translation);
            let turned = |joint: usize| Quat::from_mat3a(&bones[joint].matrix3);
            let start = turned(source_hips) * aligned[0];
            let mut turns: Vec<Quat> = Vec::with_capacity(to.skeleton.len());
            for (joint, source) in to.skeleton.iter().zip(&source_of) {
                let above = joint.parent.map(|parent| turns[usize::from(parent)]);
                let own = source.map_or(above.unwrap_or(start), |(source, aligned)| turned(source) * aligned);
                poses.push(shorter((above.unwrap_or_default().inverse() * own).normalize()).to_scaled_axis());
                turns.push(own.normalize());
            }
            let place = scale * bones[source_hips].transform_point3(from.skeleton[source_hips].rest);
            // What the joints above the hips leave of the way to them.
            let (mut below, mut arm) = (hips, Vec3::ZERO);
            while let Some(parent) = to.skeleton[below].parent.map(usize::from) {
                arm += turns[parent] * (to.skeleton[below].rest - to.skeleton[parent].rest);
                below = parent;
            }
            trans.push(place - arm - root);
        }
        Ok(MotionClip { poses, num_joints: to.skeleton.len(), trans, fps: motion.fps })
    }
}
