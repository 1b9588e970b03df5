//! Level of detail of avatars.

use std::collections::HashMap;

use glam::{Vec2, Vec3};
use occnerf::bake::{Atlas, Avatar};
use occnerf::capture::Light;
use proptest::prelude::*;
use smpl::{BoneNames, SparseRows, skeleton};
use testkit::mesh::{TriMesh, open_grid, torus};
use testkit::strategy;

/// The mesh with four charts seen along ±z, cut at x = 0 too: vertices on seams have a copy a
/// chart.
fn charted(mesh: &TriMesh) -> Avatar {
    let mut copies = HashMap::new();
    let (mut vertices, mut uvs, mut faces) = (Vec::new(), Vec::new(), Vec::new());
    for face in &mesh.faces {
        let [a, b, c] = face.map(|v| mesh.vertices[v as usize]);
        let (front, left) = ((b - a).cross(c - a).z > 0.0, a.x + b.x + c.x < 0.0);
        faces.push(face.map(|v| {
            *copies.entry((v, front, left)).or_insert_with(|| {
                let at = mesh.vertices[v as usize];
                vertices.push(at);
                // Mirrored behind, so that all charts are wound alike.
                let flat = Vec2::new(if front { at.x } else { -at.x }, -at.y) / 8.0 + 0.25;
                uvs.push(flat + Vec2::new(if front { 0.0 } else { 0.5 }, if left { 0.0 } else { 0.5 }));
                vertices.len() as u32 - 1
            })
        }));
    }
    let n = vertices.len();
    Avatar {
        name: String::new(),
        source: String::new(),
        normals: vertices.iter().map(|v: &Vec3| v.normalize_or(Vec3::Z)).collect(),
        vertices,
        uvs,
        faces,
        joints: vec![[0; 4]; n],
        weights: vec![[1.0, 0.0, 0.0, 0.0]; n],
        posedirs: SparseRows::from_rows(vec![Vec::<(u32, Vec3)>::new(); n]),
        atlas: Atlas { width: 1, height: 1, rgb: vec![0; 3], confidence: vec![255] },
        light: Light::default(),
        skeleton: skeleton(BoneNames::Smpl, &[None], &[Vec3::ZERO]),
        betas: Vec::new(),
        clips: Vec::new(),
        cameras: Vec::new(),
    }
}

/// The surface without its seams.
fn welded(avatar: &Avatar) -> TriMesh {
    let mut known = HashMap::new();
    let mut vertices = Vec::new();
    let of: Vec<u32> = (avatar.vertices.iter())
        .map(|v| {
            *known.entry(v.to_array().map(f32::to_bits)).or_insert_with(|| {
                vertices.push(*v);
                vertices.len() as u32 - 1
            })
        })
        .collect();
    TriMesh { vertices, faces: avatar.faces.iter().map(|face| face.map(|v| of[v as usize])).collect() }
}

/// Area of each triangle in the atlas; negative where it lies on its back.
fn areas(avatar: &Avatar) -> Vec<f32> {
    let area = |face: &[u32; 3]| {
        let [a, b, c] = face.map(|v| avatar.uvs[v as usize]);
        (b - a).perp_dot(c - a)
    };
    avatar.faces.iter().map(area).collect()
}

fn chart(uv: Vec2) -> (bool, bool) {
    (uv.x > 0.5, uv.y > 0.5)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn a_closed_surface_stays_closed_and_no_triangle_turns_over(
        mesh in strategy::bumpy_sphere(),
        share in 0.15f32..0.9,
    ) {
        let whole = charted(&mesh);
        let most = (share * mesh.faces.len() as f32) as usize;
        let [one, two] = [(), ()].map(|()| {
            let mut avatar = whole.clone();
            avatar.simplify(most).unwrap();
            avatar
        });
        prop_assert!(one == two);
        one.validate().unwrap();
        prop_assert!(one.faces.len() <= most, "{} of {most}", one.faces.len());
        let less = welded(&one);
        prop_assert!(less.is_closed());
        // An icosahedron, of 20 triangles, fills .61 of the ball about it.
        let filled = less.volume() / mesh.volume();
        prop_assert!((0.6..1.1).contains(&filled), "{filled}");
        // What is kept is as it was, and no triangle spans two charts.
        for (at, uv) in one.vertices.iter().zip(&one.uvs) {
            prop_assert!(whole.vertices.iter().zip(&whole.uvs).any(|both| both == (at, uv)));
        }
        for face in &one.faces {
            let [a, b, c] = face.map(|v| chart(one.uvs[v as usize]));
            prop_assert!(a == b && b == c);
        }
        prop_assert!(areas(&whole).iter().all(|a| *a < 0.0) && areas(&one).iter().all(|a| *a < 0.0));
    }
}

#[test]
fn as_few_are_left_as_seams_topology_and_borders_allow() {
    for (name, mesh) in [("torus", torus(1.0, 0.4, 24, 12)), ("sheet", open_grid(12))] {
        let whole = charted(&mesh);
        let mut avatar = whole.clone();
        avatar.simplify(0).unwrap();
        avatar.validate().unwrap();
        let (few, many) = (avatar.faces.len(), whole.faces.len());
        assert!(few > 0 && few * 5 < many, "{name}: {few} of {many}");
        let less = welded(&avatar);
        assert_eq!(less.is_closed(), mesh.is_closed(), "{name}");
        // Euler characteristic.
        let edges = |mesh: &TriMesh| {
            let sides = mesh.faces.iter().flat_map(|&[a, b, c]| [(a, b), (b, c), (c, a)]);
            let mut all: Vec<_> = sides.map(|(a, b)| (a.min(b), a.max(b))).collect();
            all.sort_unstable();
            all.dedup();
            all.len() as i64
        };
        let euler = |m: &TriMesh| m.vertices.len() as i64 - edges(m) + m.faces.len() as i64;
        assert_eq!(euler(&less), euler(&welded(&whole)), "{name}");
        let mut same = whole.clone();
        same.simplify(many).unwrap();
        assert_eq!(same.faces, whole.faces);
    }
    let mut bad = charted(&open_grid(3));
    bad.faces[0][0] = 99;
    assert!(bad.simplify(1).unwrap_err().to_string().contains("faces"));
}
