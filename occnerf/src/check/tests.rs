//! Every mistake made on good captures, and none found in them.

use std::sync::OnceLock;

use glam::{Affine3A, Mat3, Quat, Vec3};
use smpl::{BodyModel, BoneNames, Placement};

use super::*;
use crate::capture::{ImportOptions, LoadOptions, import, load_capture};
use synth::{DemoConfig, demo};
use testkit::files::{Directory, shared};

fn small_demo(body: &BodyModel, seed: u64) -> Capture {
    let config = DemoConfig { size: 128, frames: 60, eval_cameras: 1, seed, ..DemoConfig::default() };
    demo(&config, body).unwrap()
}

/// Good captures, each with its body: the demo, the shared ones, and imports of each estimator's
/// files.
fn good() -> &'static [(String, Capture, BodyModel)] {
    static GOOD: OnceLock<Vec<(String, Capture, BodyModel)>> = OnceLock::new();
    GOOD.get_or_init(|| {
        let body = BodyModel::embedded();
        let mut found: Vec<(String, Capture, BodyModel)> =
            (0..2).map(|seed| (format!("demo {seed}"), small_demo(&body, seed), body.clone())).collect();
        if let Some(dir) = shared("captures") {
            let body = BodyModel::load(&dir.join("../body/open_body.npz")).unwrap();
            for name in ["zju_demo", "humannerf_demo", "ocmotion_like/mild", "ocmotion_like/severe"] {
                let options = LoadOptions { eval_stride: 20, ..LoadOptions::default() };
                let capture = load_capture(&dir.join(name), &body, &options).unwrap();
                found.push((name.to_owned(), capture, body.clone()));
            }
        }
        if let Some(dir) = shared("estimators") {
            let out = Directory::new("check-import");
            for (fit, masks) in [
                ("wham/wham_output.pkl", Some("sam2")),
                ("phalp/demo_clip.pkl", None),
                ("gvhmr/hmr4d_results.pt", Some("matanyone")),
                ("prompthmr/results.pkl", None),
                ("romp/video_results.npz", Some("sam2")),
                ("easymocap", Some("sam2_per_object")),
            ] {
                let to = out.path().join(fit.split('/').next().unwrap());
                let masks = masks.map(|masks| dir.join(masks));
                let (frames, file) = (dir.join("frames"), dir.join(fit));
                import(&ImportOptions { frames, fit: file, masks, ..ImportOptions::default() }, &to).unwrap();
                let body = BodyModel::load(&to.join("body.safetensors")).unwrap();
                let capture = load_capture(&to, &body, &LoadOptions::default()).unwrap();
                found.push((fit.to_owned(), capture, body));
            }
        }
        found
    })
}

/// Makes a mistake.
fn made(mistake: Mistake, capture: &Capture, body: &BodyModel) -> Capture {
    let mut wrong = capture.clone();
    let count = capture.train.len();
    for (i, frame) in wrong.train.iter_mut().enumerate() {
        let camera = &mut frame.camera;
        match mistake {
            Mistake::CameraToWorld => camera.world_to_camera = camera.world_to_camera.inverse(),
            Mistake::CameraYUp => {
                let flip = Affine3A::from_mat3(Mat3::from_diagonal(Vec3::new(1.0, -1.0, -1.0)));
                camera.world_to_camera = flip * camera.world_to_camera;
            }
            // The root turned about the camera's x axis, as a fit for another axis up would have
            // it.
            Mistake::BodyUp(degrees) => {
                let axis = camera.world_to_camera.inverse().transform_vector3(Vec3::X);
                let turn = Quat::from_axis_angle(axis, (degrees as f32).to_radians());
                let shaped = body.shaped(&frame.betas);
                let pelvis = body.pose(&shaped, &frame.pose, frame.placement).joints[0];
                match &mut frame.placement {
                    Placement::Pelvis { .. } => {
                        frame.pose[0] = (turn * Quat::from_scaled_axis(frame.pose[0])).to_scaled_axis();
                    }
                    Placement::Origin { rotation, translation } => {
                        *rotation = (turn * Quat::from_scaled_axis(*rotation)).to_scaled_axis();
                        *translation = pelvis - Quat::from_scaled_axis(*rotation) * shaped.joints[0];
                    }
                }
            }
            Mistake::Unit(factor) => {
                camera.world_to_camera.translation *= factor;
                let (Placement::Pelvis { translation } | Placement::Origin { translation, .. }) = &mut frame.placement;
                *translation *= factor;
            }
            Mistake::Degrees => frame.pose.iter_mut().for_each(|axis| *axis *= 180.0 / std::f32::consts::PI),
            Mistake::Radians => frame.pose.iter_mut().for_each(|axis| *axis *= std::f32::consts::PI / 180.0),
            Mistake::Focal(factor) => camera.focal *= factor,
            Mistake::Scaled(factor) => {
                camera.focal *= factor;
                camera.centre *= factor;
            }
            Mistake::PrincipalPoint => camera.centre = glam::Vec2::ZERO,
            Mistake::Mirrored => frame.source.edit(|pixels| {
                let width = pixels.image.width as usize;
                pixels.mask.chunks_exact_mut(width).for_each(<[f32]>::reverse);
                pixels.image.pixels.chunks_exact_mut(3 * width).for_each(|row| {
                    row.reverse();
                    row.chunks_exact_mut(3).for_each(<[f32]>::reverse);
                });
                pixels.occluder.iter_mut().for_each(|o| o.chunks_exact_mut(width).for_each(<[bool]>::reverse));
            }),
            Mistake::MaskInverted => {
                frame.source.edit(|pixels| pixels.mask.iter_mut().for_each(|m| *m = 1.0 - *m));
            }
            Mistake::FrameShift(by) => {
                let other = (i as i32 - by).clamp(0, count as i32 - 1) as usize;
                frame.source = capture.train[other].source.clone();
            }
            // Another person's motion, one and a half steps aside.
            Mistake::WrongPerson => {
                let other = &capture.train[(i + count / 3) % count];
                (frame.pose, frame.placement) = (other.pose.clone(), other.placement);
                let aside = Affine3A::from_translation(Vec3::X * 0.9);
                frame.camera.world_to_camera = aside * other.camera.world_to_camera;
            }
            _ => panic!("{mistake:?}"),
        }
    }
    wrong
}

/// What is made wrong: the whole capture, or one frame in this many, from the third on.
#[derive(Clone, Copy, Debug)]
enum Wrong {
    All(Mistake),
    /// The fit in place of the pictures.
    MirroredFit,
    Frames(Fault, usize),
}

const WRONGS: [Wrong; 34] = [
    Wrong::All(Mistake::CameraToWorld),
    Wrong::All(Mistake::CameraYUp),
    Wrong::All(Mistake::BodyUp(180)),
    Wrong::All(Mistake::BodyUp(90)),
    Wrong::All(Mistake::BodyUp(-90)),
    Wrong::All(Mistake::Unit(1000.0)),
    Wrong::All(Mistake::Unit(100.0)),
    Wrong::All(Mistake::Degrees),
    Wrong::All(Mistake::Radians),
    Wrong::All(Mistake::Focal(1.3)),
    Wrong::All(Mistake::Focal(0.7)),
    Wrong::All(Mistake::Focal(2.0)),
    Wrong::All(Mistake::Focal(0.5)),
    Wrong::All(Mistake::Focal(8.0)),
    Wrong::All(Mistake::Scaled(0.5)),
    Wrong::All(Mistake::Scaled(2.0)),
    Wrong::All(Mistake::PrincipalPoint),
    Wrong::All(Mistake::Mirrored),
    Wrong::MirroredFit,
    Wrong::All(Mistake::MaskInverted),
    Wrong::All(Mistake::FrameShift(1)),
    Wrong::All(Mistake::FrameShift(-1)),
    Wrong::All(Mistake::FrameShift(2)),
    Wrong::All(Mistake::WrongPerson),
    Wrong::Frames(Fault::Limb(Limb::LeftArm), 5),
    Wrong::Frames(Fault::Limb(Limb::LeftLeg), 5),
    Wrong::Frames(Fault::Limb(Limb::RightLeg), 1),
    Wrong::Frames(Fault::Limb(Limb::RightArm), 5),
    Wrong::Frames(Fault::Background, 5),
    Wrong::Frames(Fault::Background, 1),
    Wrong::Frames(Fault::EmptyMask, 5),
    Wrong::Frames(Fault::Overlap, 10),
    Wrong::Frames(Fault::PlaceJump, 10),
    Wrong::Frames(Fault::PoseJump, 10),
];

impl Wrong {
    fn is_in(self, frame: usize) -> bool {
        matches!(self, Self::Frames(_, every) if frame % every == 2 % every)
    }

    fn made(self, capture: &Capture, body: &BodyModel) -> Capture {
        let mut wrong = capture.clone();
        match self {
            Self::All(mistake) => return made(mistake, capture, body),
            Self::MirroredFit => wrong.train.iter_mut().for_each(|frame| mirror(frame, body)),
            Self::Frames(fault, _) => {
                let frames = wrong.train.iter_mut().enumerate().filter(|(i, _)| self.is_in(*i));
                frames.for_each(|(_, frame)| corrupt(fault, frame, body));
            }
        }
        wrong
    }

    /// Whether it is found, named as what it is, and the advised value within a twentieth.
    fn judged(self, found: &Check) -> [bool; 3] {
        let expected = match self {
            Self::All(mistake) => mistake,
            Self::MirroredFit => Mistake::Mirrored,
            Self::Frames(fault, _) => {
                let named = |fault: Fault, here: bool| {
                    let frames = found.frames.iter().enumerate().filter(|(i, _)| self.is_in(*i) == here);
                    frames.filter(|(_, frame)| frame.faults.contains(&fault)).count()
                };
                let any = |i: usize| !found.frames[i].faults.is_empty();
                let found_any = (0..found.frames.len()).any(|i| self.is_in(i) && any(i));
                let others = Limb::ALL.map(Fault::Limb).into_iter().chain([Fault::Background]);
                let most = others.filter(|other| *other != fault).map(|other| named(other, true)).max();
                let right = named(fault, true) > 0 && most.is_none_or(|most| named(fault, true) >= most);
                // A jump ends in the frame after.
                let is_near = |i: usize| self.is_in(i) || i > 0 && self.is_in(i - 1);
                let alarm = (0..found.frames.len()).any(|i| !is_near(i) && any(i));
                return [found_any, right, right && found.mistakes.is_empty() && !alarm];
            }
        };
        let Some(first) = found.mistakes.first() else { return [false; 3] };
        let close = |a: f32, b: f32| (a / b - 1.0).abs() < 0.05;
        let advice = match (*first, expected) {
            (Mistake::Focal(a), Mistake::Focal(b)) | (Mistake::Scaled(a), Mistake::Scaled(b)) => close(a, b),
            (first, expected) => first == expected,
        };
        [true, std::mem::discriminant(first) == std::mem::discriminant(&expected), advice]
    }
}

/// Mirrors a frame's body, left to right as its camera sees it.
fn mirror(frame: &mut Frame, body: &BodyModel) {
    let names = BoneNames::Smpl.of_body(body.num_joints());
    let twin = |name: &String| match name.strip_prefix("left_") {
        Some(rest) => format!("right_{rest}"),
        None => name.strip_prefix("right_").map_or(name.clone(), |rest| format!("left_{rest}")),
    };
    let pose = std::mem::take(&mut frame.pose);
    let shaped = body.shaped(&frame.betas);
    let pelvis = body.pose(&shaped, &pose, frame.placement).joints[0];
    let flip = |axis: Vec3| Vec3::new(axis.x, -axis.y, -axis.z);
    frame.pose =
        names.iter().map(|name| flip(pose[names.iter().position(|other| *other == twin(name)).unwrap()])).collect();
    let aside = Mat3::from_diagonal(Vec3::new(-1.0, 1.0, 1.0));
    let camera = frame.camera.world_to_camera;
    let turned = |axis: Vec3| {
        let (camera, turn) = (Mat3::from(camera.matrix3), Mat3::from_quat(Quat::from_scaled_axis(axis)));
        Quat::from_mat3(&(camera.transpose() * aside * camera * turn * aside)).to_scaled_axis()
    };
    let to = camera.inverse().transform_point3(aside * camera.transform_point3(pelvis));
    match &mut frame.placement {
        Placement::Pelvis { translation } => {
            frame.pose[0] = turned(pose[0]);
            *translation += to - pelvis;
        }
        Placement::Origin { rotation, translation } => {
            *rotation = turned(*rotation);
            *translation = to - Quat::from_scaled_axis(*rotation) * shaped.joints[0];
        }
    }
}

/// Makes a fault of a frame.
fn corrupt(fault: Fault, frame: &mut Frame, body: &BodyModel) {
    match fault {
        Fault::Limb(limb) => {
            let (joint, bend) = match limb {
                Limb::LeftArm => (16, Vec3::Z * 1.2),
                Limb::RightArm => (17, Vec3::Z * -1.2),
                Limb::LeftLeg => (1, Vec3::X * -1.2),
                Limb::RightLeg => (2, Vec3::X * -1.2),
            };
            frame.pose[joint] += bend;
        }
        Fault::Background => {
            let posed = body.pose(&body.shaped(&frame.betas), &frame.pose, frame.placement);
            let camera = frame.camera;
            let scale = metre(&camera, &posed.joints);
            let at = camera.project(posed.joints[0]).unwrap().truncate() + Vec2::X * 0.35 * scale;
            frame.source.edit(move |pixels| {
                for (i, level) in pixels.mask.iter_mut().enumerate() {
                    let (x, y) = (i % camera.width as usize, i / camera.width as usize);
                    if at.distance(Vec2::new(x as f32, y as f32)) < 0.2 * scale {
                        *level = 1.0;
                    }
                }
            });
        }
        Fault::EmptyMask => frame.source.edit(|pixels| pixels.mask.fill(0.0)),
        Fault::Overlap | Fault::PlaceJump => frame.camera.world_to_camera.translation.x += 1.5,
        Fault::PoseJump => frame.pose.iter_mut().skip(1).for_each(|axis| *axis += Vec3::splat(0.9)),
    }
}

#[test]
fn good_captures_raise_no_alarm() {
    let mut alarms = Vec::new();
    for (name, capture, body) in good() {
        let whole = check(capture, body).unwrap();
        let faults =
            |check: &Check| check.frames.iter().filter(|f| f.faults.iter().any(|f| *f != Fault::EmptyMask)).count();
        if !whole.mistakes.is_empty() || faults(&whole) > 0 {
            alarms.push(format!("{name}: {:?}, {} faults", whole.mistakes, faults(&whole)));
        }
        for frames in capture.train.chunks_exact(20) {
            let window = Capture { train: frames.to_vec(), ..capture.clone() };
            let mistakes = likely(&window, body, small_views(&window).unwrap()).unwrap();
            if !mistakes.is_empty() {
                alarms.push(format!("{name} from {}: {mistakes:?}", window.train[0].name));
            }
        }
    }
    assert!(alarms.is_empty(), "{alarms:#?}");
}

/// A row of the table: a mistake; numbers of trials, of those found, named, and with the right
/// advice; other findings.
fn row(wrong: Wrong, captures: &[&(String, Capture, BodyModel)]) -> ([usize; 4], String) {
    let (mut counts, mut others) = ([captures.len(), 0, 0, 0], Vec::new());
    for (name, capture, body) in captures {
        let window = Capture { train: capture.train[..capture.train.len().min(30)].to_vec(), ..capture.clone() };
        let found = check(&wrong.made(&window, body), body).unwrap();
        let judged = wrong.judged(&found);
        (0..3).for_each(|i| counts[1 + i] += usize::from(judged[i]));
        if judged != [true; 3] {
            let faults: Vec<&Fault> = found.frames.iter().flat_map(|frame| &frame.faults).collect();
            others.push(format!("{name}: {:?} {faults:?}", found.mistakes));
        }
    }
    let [trials, found, named, advice] = counts;
    (
        counts,
        format!(
            "{wrong:?}: {trials} trials, {found} found, {named} named, {advice} right advice; {}",
            others.join("; ")
        ),
    )
}

/// Each mistake on a sixth of the captures.
#[test]
fn each_mistake_is_found() {
    let every = good().len().min(6);
    let (mut all, mut missed) = ([0; 4], Vec::new());
    for (i, wrong) in WRONGS.into_iter().enumerate() {
        let captures: Vec<_> = good().iter().skip(i % every).step_by(every).collect();
        let (counts, line) = row(wrong, &captures);
        println!("{line}");
        (0..4).for_each(|i| all[i] += counts[i]);
        if counts[2] + 1 + counts[0] / 10 < counts[0] {
            missed.push(line);
        }
    }
    println!("trials, found, named, right advice: {all:?}");
    assert!(all[2] * 100 >= 95 * all[0] && all[3] * 100 >= 95 * all[0] && missed.is_empty(), "{all:?} {missed:#?}");
}

/// No usual mistake makes noise of masks.
#[test]
fn masks_of_noise_are_said_to_fit_nothing() {
    let body = BodyModel::embedded();
    let mut capture = small_demo(&body, 4);
    for (i, frame) in capture.train.iter_mut().enumerate() {
        let noise = move |n: usize| f32::from(((n + 7919 * i) as u32).wrapping_mul(0x9e37_79b1) < 1 << 31);
        frame.source.edit(move |pixels| pixels.mask.iter_mut().enumerate().for_each(|(n, level)| *level = noise(n)));
    }
    assert_eq!(likely(&capture, &body, small_views(&capture).unwrap()).unwrap(), [Mistake::NoFit]);
}

#[test]
fn a_silhouette_is_where_rays_hit_also_around_a_camera_within_the_body() {
    let body = BodyModel::embedded();
    let capture = small_demo(&body, 3);
    for frame in capture.train.iter().step_by(20) {
        let posed = body.pose(&body.shaped(&frame.betas), &frame.pose, frame.placement);
        let mesh = RayMesh::new(&posed.vertices, &body.faces).unwrap();
        let mut within = frame.camera;
        within.world_to_camera.translation -= within.world_to_camera.transform_point3a(posed.joints[0].into());
        for camera in [frame.camera, within] {
            let covered = silhouette(&posed.vertices, &body.faces, &camera).unwrap();
            let wrong = covered.iter().enumerate().filter(|(i, covered)| {
                let (x, y) = (*i as u32 % camera.width, *i as u32 / camera.width);
                let ray = camera.ray(x as f32 + 0.5, y as f32 + 0.5);
                mesh.first_hit(ray.origin, ray.direction).is_some() != **covered
            });
            // Rounding at the outline.
            assert!(covered.iter().filter(|c| **c).count() > 500 && wrong.count() <= 3);
        }
    }
}

#[test]
fn jumps_empty_masks_and_frames_that_do_not_fit_are_marked() {
    let body = BodyModel::embedded();
    let mut capture = small_demo(&body, 1);
    capture.train[10].source.edit(|pixels| pixels.mask.fill(0.0));
    capture.train[20].camera.world_to_camera.translation.x += 1.5;
    capture.train[30].pose.iter_mut().skip(1).for_each(|axis| *axis += Vec3::splat(0.9));
    let found = check(&capture, &body).unwrap();
    let faults = |i: usize| &found.frames[i].faults;
    assert_eq!(faults(10), &[Fault::EmptyMask]);
    assert!(faults(20).contains(&Fault::Overlap) && faults(20).contains(&Fault::PlaceJump), "{:?}", faults(20));
    assert!(faults(21).contains(&Fault::PlaceJump));
    assert!(faults(30).contains(&Fault::PoseJump) && faults(31).contains(&Fault::PoseJump), "{:?}", faults(30));
    assert!(faults(40).is_empty() && found.mistakes.is_empty());
}

#[test]
fn limbs_elsewhere_and_background_in_masks_are_named() {
    let (mut lines, mut sums) = (Vec::new(), [[0; 4]; 5]);
    for (name, capture, body) in good() {
        let window = Capture { train: capture.train.iter().step_by(4).take(12).cloned().collect(), ..capture.clone() };
        let parts = faults::parts(body);
        let faults = |capture: &Capture| -> Vec<Vec<Fault>> {
            let small = small_views(capture).unwrap();
            small.iter().map(|view| one(&capture.train[view.index], view, body, &parts).unwrap().faults).collect()
        };
        for kind in 0..5 {
            let mut wrong = window.clone();
            let expected = Limb::ALL.get(kind).map_or(Fault::Background, |limb| Fault::Limb(*limb));
            wrong.train.iter_mut().for_each(|frame| corrupt(expected, frame, body));
            let found = faults(&wrong);
            let counts = [
                found.iter().filter(|f| f.contains(&expected)).count(),
                found.iter().flatten().filter(|f| matches!(f, Fault::Limb(_)) && **f != expected).count(),
                found.iter().flatten().filter(|f| **f == Fault::Background && **f != expected).count(),
                found.len(),
            ];
            lines.push(format!("{name} {expected:?}: {counts:?}"));
            (0..4).for_each(|i| sums[kind][i] += counts[i]);
        }
    }
    let [right, other, background, _] = [0, 1, 2, 3].map(|i| sums[..4].iter().map(|counts| counts[i]).sum::<usize>());
    let found = right + other + background;
    println!("limbs: {right} of {found} named, {other} taken for another, {background} for background");
    assert!(found > 15 * good().len() && 4 * right >= 3 * found && 10 * other < found, "{lines:#?}");
    let [right, limb, _, all] = sums[4];
    println!("background: {right} of {all} named, {limb} taken for a limb");
    assert!(100 * (right + limb) >= 95 * all && 3 * right >= 2 * all, "{lines:#?}");
}
