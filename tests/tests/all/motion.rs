//! From the posed world to the canonical pose, through the distance structure that training uses.

use crate::common;

use common::{body, placement, quantile, walking};
use glam::Vec3;
use smpl::{BodyModel, MotionClip, Posed, Shaped, SurfaceMotion, WeightVolume, WeightVolumeConfig};
use surface_query::{MeshDistance, vertex_normals};

const BETAS: [f32; 3] = [0.6, -0.4, 0.3];

fn posed() -> (Shaped, Posed) {
    let shaped = body().shaped(&BETAS);
    let posed = body().pose(&shaped, &walking(), placement());
    (shaped, posed)
}

fn to_canonical(motion: &SurfaceMotion, posed: &Posed, mesh: &MeshDistance, x: Vec3) -> Option<(Vec3, f32)> {
    let closest = mesh.closest_within(x, 0.2)?;
    let mapped = motion.map(body(), posed, x, closest.face, closest.barycentric, closest.signed_distance)?;
    Some((mapped.canonical, closest.signed_distance))
}

#[test]
fn posed_vertices_find_their_way_back_through_the_nearest_surface_point() {
    let (shaped, posed) = posed();
    let mesh = MeshDistance::new(&posed.vertices, &body().faces).unwrap();
    let motion = SurfaceMotion { margin: 0.06, falloff: 0.02 };
    let mut errors: Vec<f32> = (posed.vertices.iter().zip(&shaped.vertices))
        .map(|(&x, &rest)| to_canonical(&motion, &posed, &mesh, x).unwrap().0.distance(rest))
        .collect();
    let [median, most] = [0.5, 0.99].map(|share| quantile(&mut errors, share));
    println!("vertices: median {median}, 99 % {most}");
    // Skinning is inverted exactly where the nearest point is the vertex itself, which limbs
    // pressed into each other may prevent.
    assert!(median < 1e-5 && most < 5e-3, "median {median}, 99 % {most}");
}

#[test]
fn points_off_the_posed_surface_keep_their_distance_in_the_canonical_pose() {
    let (shaped, posed) = posed();
    let faces = &body().faces;
    let mesh = MeshDistance::new(&posed.vertices, faces).unwrap();
    let canonical = MeshDistance::new(&shaped.vertices, faces).unwrap();
    let motion = SurfaceMotion { margin: 0.06, falloff: 0.02 };
    let normals = vertex_normals(&posed.vertices, faces);
    for offset in [-0.02, 0.01, 0.03, 0.05] {
        let mut errors = Vec::new();
        for (&v, &n) in posed.vertices.iter().zip(&normals) {
            if let Some((x, d)) = to_canonical(&motion, &posed, &mesh, v + offset * n) {
                errors.push((canonical.closest(x).signed_distance - d).abs());
            }
        }
        assert!(errors.len() * 10 > posed.vertices.len() * 9, "{} alive at {offset}", errors.len());
        let [median, most] = [0.5, 0.9].map(|share| quantile(&mut errors, share));
        println!("{offset}: median {median}, 90 % {most}");
        assert!(median <= 5e-3, "{offset}: median {median}, 90 % {most}");
    }
}

/// Of the vertices in recorded poses: the 90th percentile of how far `map` takes them from where
/// they rest, in metres, and the share that it leaves out.
fn mapping_error(poses: &[Posed], rest: &[Vec3], map: impl Fn(&Posed) -> Vec<Option<Vec3>>) -> (f32, f32) {
    let mapped: Vec<Option<Vec3>> = poses.iter().flat_map(map).collect();
    let each = mapped.iter().zip(rest.iter().cycle());
    let mut errors: Vec<f32> = each.filter_map(|(x, rest)| Some(x.as_ref()?.distance(*rest))).collect();
    let dead = 1.0 - errors.len() as f32 / mapped.len() as f32;
    (quantile(&mut errors, 0.9), dead)
}

#[test]
fn recorded_poses_are_mapped_back_by_the_nearest_surface_point() {
    let Some(clips) = testkit::files::shared("mocap") else { return };
    let body = BodyModel::load(&clips.join("../body/open_body.npz")).unwrap();
    let shaped = body.shaped(&[]);
    for name in ["walk", "turn"] {
        let clip = MotionClip::load(&clips.join(format!("{name}.npz"))).unwrap();
        let pose = |frame: usize| {
            let (pose, placement) = clip.at(frame as f32 / clip.fps, body.num_joints());
            body.pose(&shaped, &pose, placement)
        };
        let poses: Vec<Posed> = (0..clip.num_frames()).step_by(40).map(pose).collect();
        let motion = SurfaceMotion { margin: 0.04, falloff: 0.02 };
        let (error, dead) = mapping_error(&poses, &shaped.vertices, |posed| {
            let mesh = MeshDistance::new(&posed.vertices, &body.faces).unwrap();
            let map = |&x: &Vec3| {
                let at = mesh.closest_within(x, 0.2)?;
                Some(motion.map(&body, posed, x, at.face, at.barycentric, at.signed_distance)?.canonical)
            };
            posed.vertices.iter().map(map).collect()
        });
        println!("{name}, surface: 90 % within {error} m, {dead} dead");
        assert!(error < 1e-5 && dead < 1e-3, "{name}, surface: {error} m, {dead} dead");
    }
}

#[test]
fn the_volume_has_holes_at_the_knees() {
    let shaped = body().shaped(&[]);
    let volume = WeightVolume::gaussian(body(), &shaped, &WeightVolumeConfig::default());
    let rest = body().pose(&shaped, &vec![Vec3::ZERO; body().num_joints()], smpl::Placement::default());
    for knee in [4, 5] {
        let f = volume.map(&rest.to_canonical(), rest.joints[knee], 0.0).map_or(0.0, |m| m.likelihood);
        assert!(f < 0.3, "{f}");
    }
}

#[test]
fn both_kinds_of_motion_agree_where_one_bone_rules() {
    let (shaped, posed) = posed();
    let volume = WeightVolume::gaussian(body(), &shaped, &WeightVolumeConfig::default());
    let mesh = MeshDistance::new(&posed.vertices, &body().faces).unwrap();
    let transforms = posed.to_canonical();
    let motion = SurfaceMotion { margin: 0.06, falloff: 0.02 };
    let mut errors = Vec::new();
    for (v, &x) in posed.vertices.iter().enumerate() {
        if body().weights.row(v).any(|(_, w)| w > 0.999) {
            let (surface, _) = to_canonical(&motion, &posed, &mesh, x).unwrap();
            let by_volume = volume.map(&transforms, x, 1e-3).unwrap().canonical;
            // The volume knows nothing of the pose blend shapes.
            errors.push((by_volume - posed.pose_offsets[v]).distance(surface));
        }
    }
    assert!(errors.len() > 300, "{}", errors.len());
    let [median, most] = [0.5, 0.8].map(|share| quantile(&mut errors, share));
    println!("{} vertices: median {median}, 80 % {most}", errors.len());
    assert!(median < 2e-3, "median {median}, 80 % {most}");
}
