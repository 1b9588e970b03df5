//! What the person does, and what the body tracker makes of it.

use std::f32::consts::TAU;

use glam::{Quat, Vec3};
use smpl::Placement;

use super::landmarks::joint;
use volrender::RandomStream;

/// Turns of the person during the video: every side comes to face the camera, and some twice.
const TURNS: f32 = 1.15;
/// Two steps take this many frames at 100 frames a video.
const STRIDE: f32 = 26.0;
/// Harmonics of the tracker's error over the length of the video.
const HARMONICS: usize = 6;

/// Rotations of all joints, global rotation, and translation.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Pose {
    /// Axis-angle relative to the parent, (J); joint 0 is zero.
    pub joints: Vec<Vec3>,
    pub rotation: Quat,
    pub translation: Vec3,
}

impl Pose {
    pub fn placement(&self) -> Placement {
        Placement::Origin { rotation: self.rotation.to_scaled_axis(), translation: self.translation }
    }
}

/// Walking on the spot while turning, at frame `frame` of `frames`. The translation is 0.
///
/// The T-pose's left arm points along +x: turning about −z lowers it, about −x then swings it
/// forward; a knee bends about +x, a left elbow about −y. `pressed` (0 to 1) brings the arms to the
/// trunk and the thighs together.
pub(crate) fn walk(frame: usize, frames: usize, pressed: f32) -> Pose {
    let time = frame as f32 / frames as f32;
    let phase = TAU * time * 100.0 / STRIDE;
    let x = Quat::from_rotation_x;
    let mut local = [Quat::IDENTITY; joint::COUNT];

    for (sign, hip, knee, ankle, shoulder, elbow) in [
        (1.0, joint::LEFT_HIP, joint::LEFT_KNEE, joint::LEFT_ANKLE, joint::LEFT_SHOULDER, joint::LEFT_ELBOW),
        (-1.0, joint::RIGHT_HIP, joint::RIGHT_KNEE, joint::RIGHT_ANKLE, joint::RIGHT_SHOULDER, joint::RIGHT_ELBOW),
    ] {
        let leg = if sign > 0.0 { phase } else { phase + TAU / 2.0 };
        let swing = leg.sin();
        // The knee bends while the leg comes forward.
        let lift = (leg + 0.9).cos().max(0.0);
        local[hip] = x(-0.10 - 0.40 * swing) * Quat::from_rotation_z(sign * (0.05 - 0.09 * pressed));
        local[knee] = x(0.12 + 0.75 * lift * lift);
        local[ankle] = x(0.02 - 0.18 * lift * swing);
        // Arms swing against the legs; each is raised once during the video.
        let raise = 0.55 * (TAU * time + if sign > 0.0 { 0.3 } else { 2.6 }).sin().max(0.0).powi(2) * (1.0 - pressed);
        local[shoulder] = x(0.42 * swing - 0.5 * raise) * Quat::from_rotation_z(-sign * (1.18 + 0.3 * pressed - raise));
        local[elbow] = Quat::from_rotation_y(-sign * (0.40 - 0.25 * swing + 0.7 * raise));
    }
    for (i, j) in joint::SPINE.into_iter().enumerate() {
        let twist = Quat::from_rotation_y(0.05 * (phase + 0.2 * i as f32).sin());
        let bend = Quat::from_rotation_z(0.025 * (phase + 1.0).cos());
        local[j] = twist * bend * x(0.02 + 0.015 * (2.0 * phase).sin());
    }
    local[joint::NECK] = Quat::from_rotation_y(0.22 * (TAU * 2.0 * time).sin());
    local[joint::HEAD] = x(0.10 * (TAU * 3.0 * time).sin()) * Quat::from_rotation_y(-0.08 * phase.sin());

    let mut joints: Vec<Vec3> = local.iter().map(|q| q.to_scaled_axis()).collect();
    joints[joint::PELVIS] = Vec3::ZERO;
    let rotation = Quat::from_rotation_y(TAU * (TURNS * time - 0.05)) * x(0.03 * (2.0 * phase).cos());
    Pose { joints, rotation, translation: Vec3::ZERO }
}

/// A smooth 3-vector of time with the given root mean square length over the video, (T). Periodic
/// in twice the video's length, so that its ends are free.
pub(crate) fn wander(stream: &mut RandomStream, frames: usize, rms: f32) -> Vec<Vec3> {
    let mut waves = Vec::new();
    for harmonic in 1..=HARMONICS {
        let amplitude = Vec3::from_array([(); 3].map(|()| stream.normal()));
        let phase = Vec3::from_array([(); 3].map(|()| TAU * stream.uniform()));
        waves.push((harmonic as f32, amplitude, phase));
    }
    let mut path: Vec<Vec3> = (0..frames)
        .map(|frame| {
            let angle = 0.5 * TAU * frame as f32 / frames as f32;
            waves
                .iter()
                .map(|(harmonic, amplitude, phase)| *amplitude * (phase + Vec3::splat(harmonic * angle)).map(f32::sin))
                .sum()
        })
        .collect();
    let mean_square: f32 = path.iter().map(|p| p.length_squared()).sum::<f32>() / frames as f32;
    if mean_square > 0.0 {
        let scale = rms / mean_square.sqrt();
        path.iter_mut().for_each(|p| *p *= scale);
    }
    path
}

/// Errors of the tracker.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TrackerError {
    pub seed: u64,
    /// Root mean square angle between true and tracked *global* orientation of each bone, radians.
    pub rotation: f32,
    /// Root mean square distance between true and tracked position of the pelvis.
    pub translation: f32,
}

/// What a tracker would report for `poses`: the errors of bones are independent of each other and
/// smooth in time. `pelvis` is the pelvis joint at rest, about which the global error turns.
pub(crate) fn track(poses: &[Pose], parents: &[Option<usize>], pelvis: Vec3, error: TrackerError) -> Vec<Pose> {
    let joints = parents.len();
    let noise: Vec<Vec<Vec3>> = (0..joints as u64)
        .map(|j| wander(&mut RandomStream::new(&[error.seed, 0x706f_7365, j]), poses.len(), error.rotation))
        .collect();
    let mut stream = RandomStream::new(&[error.seed, 0x7472_616e]);
    let drift = wander(&mut stream, poses.len(), error.translation);
    poses
        .iter()
        .enumerate()
        .map(|(frame, pose)| {
            let mut truth: Vec<Quat> = Vec::with_capacity(joints);
            let mut tracked: Vec<Quat> = Vec::with_capacity(joints);
            let mut relative = vec![Vec3::ZERO; joints];
            for (j, parent) in parents.iter().enumerate() {
                let local = Quat::from_scaled_axis(pose.joints[j]);
                let above = parent.map_or(pose.rotation, |p| truth[p] * local);
                truth.push(above);
                tracked.push((Quat::from_scaled_axis(noise[j][frame]) * above).normalize());
                if let Some(p) = parent {
                    relative[j] = (tracked[*p].inverse() * tracked[j]).to_scaled_axis();
                }
            }
            let rotation = tracked.first().copied().unwrap_or(pose.rotation);
            // Keep the pelvis where it is, but for the drift.
            let kept = pose.rotation * pelvis - rotation * pelvis;
            Pose { joints: relative, rotation, translation: pose.translation + kept + drift[frame] }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tracked_bones_are_off_by_the_stated_angle_in_the_world() {
        let frames = 60;
        let parents: Vec<Option<usize>> = (0..joint::COUNT).map(|j| j.checked_sub(1)).collect();
        let truth: Vec<Pose> = (0..frames).map(|f| walk(f, frames, 0.0)).collect();
        let pelvis = Vec3::new(0.0, 0.9, 0.1);
        let error = TrackerError { seed: 4, rotation: 0.03, translation: 0.01 };
        let tracked = track(&truth, &parents, pelvis, error);
        let global = |pose: &Pose| {
            let mut at = pose.rotation;
            let mut all = vec![at];
            for axis in &pose.joints[1..] {
                at *= Quat::from_scaled_axis(*axis);
                all.push(at);
            }
            all
        };
        let mut square = [0.0; joint::COUNT];
        let mut moved = 0.0;
        for (a, b) in truth.iter().zip(&tracked) {
            for (j, (p, q)) in global(a).iter().zip(global(b)).enumerate() {
                square[j] += p.angle_between(q).powi(2) / frames as f32;
            }
            let at = |pose: &Pose| pose.rotation * pelvis + pose.translation;
            moved += at(a).distance_squared(at(b)) / frames as f32;
        }
        for (j, s) in square.iter().enumerate() {
            assert!((s.sqrt() - 0.03).abs() < 2e-3, "joint {j}: {}", s.sqrt());
        }
        assert!((f32::sqrt(moved) - 0.01).abs() < 1e-4);
    }
}
