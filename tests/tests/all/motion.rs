//! From the posed world to the canonical pose, through the distance structure that training uses.

use crate::common;

use common::{body, placement, quantile, walking};
use glam::Vec3;
use smpl::{Posed, Shaped, SurfaceMotion};
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
