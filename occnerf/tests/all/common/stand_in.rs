//! A stand-in for a baked person: the posed prior in mean vertex colours, a few texels a face.

use glam::{Affine3A, Vec2, Vec3};
use occnerf::bake::{Atlas, Avatar, Clip, motion_of_bones, turn_upright};
use occnerf::capture::Light;
use occnerf::{PriorColors, Scene, upright};
use volrender::Camera;

/// Texels a side of the square that a face's colours stand in.
const CELL: usize = 8;

/// The prior of a prepared scene as an avatar.
pub fn stand_in(scene: &Scene, colors: &PriorColors) -> Avatar {
    let body = &scene.body;
    let metres = 1.0 / body.scale;
    let up = upright(body, scene.train.iter().map(|frame| &*frame.view));
    let world = Affine3A::from_mat3(turn_upright(up) * metres);
    let model = &body.model;
    let rest: Vec<Vec3> = body.canonical.joints.iter().map(|&joint| joint * metres).collect();
    let skeleton = smpl::skeleton(smpl::BoneNames::Smpl, &model.parents, &rest);
    let frames: Vec<Vec<Affine3A>> = scene
        .train
        .iter()
        .map(|frame| {
            let to_avatar = |bone: &Affine3A| world * *bone * Affine3A::from_scale(Vec3::splat(body.scale));
            frame.view.posed.bones.iter().map(to_avatar).collect()
        })
        .collect();
    let cameras = scene
        .train
        .iter()
        .map(|frame| {
            let mut camera = frame.view.camera;
            let there = world.inverse();
            let mut placed = camera.world_to_camera * there;
            // Back to a rotation, and to depths in metres.
            placed.matrix3 *= metres;
            placed.translation *= metres;
            camera.world_to_camera = placed;
            camera
        })
        .collect::<Vec<Camera>>();

    let corners = model.faces.len() * 3;
    let columns = (model.faces.len() as f32).sqrt().ceil() as usize;
    let rows = model.faces.len().div_ceil(columns);
    let (width, height) = (columns * CELL, rows * CELL);
    let mut atlas = Atlas {
        width: width as u32,
        height: height as u32,
        rgb: vec![255; 3 * width * height],
        confidence: vec![0; width * height],
    };
    let (mut uvs, mut vertices, mut joints, mut weights) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    // Corners of the triangle in its cell, in texels, away from the neighbours.
    let places = [Vec2::new(1.5, 1.5), Vec2::new(6.5, 1.5), Vec2::new(1.5, 6.5)];
    for (f, face) in model.faces.iter().enumerate() {
        let (x0, y0) = (f % columns * CELL, f / columns * CELL);
        let color = face.map(|v| colors.colors[v as usize]);
        let seen = face.iter().filter(|&&v| colors.seen[v as usize]).count();
        for (y, x) in (0..CELL).flat_map(|y| (0..CELL).map(move |x| (y, x))) {
            let at = Vec2::new(x as f32 + 0.5, y as f32 + 0.5) - 1.5;
            let (b, c) = (at.x / 5.0, at.y / 5.0);
            let mixed = (color[0] * (1.0 - b - c) + color[1] * b + color[2] * c).clamp(Vec3::ZERO, Vec3::ONE);
            let texel = (y0 + y) * width + x0 + x;
            let bytes = (mixed * 255.0).round().to_array().map(|c| c as u8);
            atlas.rgb[3 * texel..3 * texel + 3].copy_from_slice(&bytes);
            atlas.confidence[texel] = [0, 85, 170, 255][seen];
        }
        for (corner, &v) in face.iter().enumerate() {
            let place = Vec2::new(x0 as f32, y0 as f32) + places[corner];
            uvs.push(place / Vec2::new(width as f32, height as f32));
            vertices.push(body.canonical.vertices[v as usize] * metres);
            let mut row: Vec<(usize, f32)> = model.weights.row(v as usize).collect();
            row.sort_by(|a, b| b.1.total_cmp(&a.1));
            row.truncate(4);
            let sum: f32 = row.iter().map(|entry| entry.1).sum();
            let entry = |i: usize| row.get(i).copied().unwrap_or((0, 0.0));
            joints.push(std::array::from_fn(|i| entry(i).0 as u16));
            weights.push(std::array::from_fn(|i| entry(i).1 / sum));
        }
    }
    let mut sums = vec![Vec3::ZERO; body.canonical.vertices.len()];
    for face in &model.faces {
        let [a, b, c] = face.map(|v| body.canonical.vertices[v as usize]);
        face.iter().for_each(|&v| sums[v as usize] += (b - a).cross(c - a));
    }
    let smooth = model.faces.iter().flatten().map(|&v| sums[v as usize].normalize_or(Vec3::Y)).collect();
    // Pose blend shapes are in the unit of the body model already.
    let posedirs = smpl::SparseRows::from_rows(
        (model.faces.iter().flatten())
            .map(|&v| model.posedirs.row(v as usize).map(|(term, d)| (term as u32, d)).collect::<Vec<_>>()),
    );
    let motion = motion_of_bones(&skeleton, &frames, 30.0);
    Avatar {
        name: scene.name.clone(),
        source: String::new(),
        vertices,
        normals: smooth,
        uvs,
        faces: (0..corners as u32).collect::<Vec<_>>().chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect(),
        joints,
        weights,
        posedirs,
        atlas,
        light: Light::default(),
        skeleton,
        betas: body.mean_betas.clone(),
        clips: vec![Clip { name: "video".to_owned(), motion }],
        cameras,
    }
}
