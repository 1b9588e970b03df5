//! What other programs are given: read back, compared with the avatar, and refused where it cannot
//! be.

use std::path::PathBuf;
use std::sync::OnceLock;

use crate::skinned;
use glam::{Mat3, Quat, Vec2, Vec3};
use occnerf::bake::export::{GlbOptions, Splats, fit_motion, splats, write_amass, write_obj};
use occnerf::bake::{Avatar, fit};
use occnerf::capture::Light;
use occnerf::{Config, Method, Preset, Scene};
use rigged::Character;
use smpl::{MotionClip, SparseRows};
use synth::{DemoConfig, demo};

fn avatar() -> &'static Avatar {
    static AVATAR: OnceLock<Avatar> = OnceLock::new();
    AVATAR.get_or_init(|| {
        let body = smpl::BodyModel::embedded();
        let capture = demo(&DemoConfig { size: 96, frames: 4, eval_cameras: 1, ..Default::default() }, &body).unwrap();
        let scene = Scene::new(&capture, &body, &Config::preset(Preset::Fast, Method::Surface)).unwrap();
        let light = Light { slope: Vec3::new(0.5, 0.25, -0.125) };
        Avatar { light, ..fit(&scene).unwrap().0 }
    })
}

/// The avatar as glTF has it, without pose blend shapes.
fn bare() -> Avatar {
    let rows = vec![Vec::<(u32, Vec3)>::new(); avatar().num_vertices()];
    Avatar { posedirs: SparseRows::from_rows(rows), ..avatar().clone() }
}

fn adapted(avatar: &Avatar, motion: &MotionClip) -> Result<MotionClip, occnerf::Error> {
    fit_motion(motion, avatar.num_joints(), avatar.skeleton[0].rest)
}

fn place(name: &str) -> PathBuf {
    let directory = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("export");
    std::fs::create_dir_all(&directory).unwrap();
    directory.join(name)
}

fn worst(a: &[Vec3], b: &[Vec3]) -> f32 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(a, b)| a.distance(*b)).fold(0.0, f32::max)
}

/// The atlas, interpolated.
fn albedo(avatar: &Avatar, uv: Vec2) -> Vec3 {
    let [width, height] = [avatar.atlas.width, avatar.atlas.height].map(|side| side as usize);
    let at = (uv * Vec2::new(width as f32, height as f32) - 0.5).max(Vec2::ZERO);
    let texel = |x: usize, y: usize| {
        let first = 3 * (y.min(height - 1) * width + x.min(width - 1));
        Vec3::from([0, 1, 2].map(|c| f32::from(avatar.atlas.rgb[first + c]) / 255.0))
    };
    let (x, y, share) = (at.x as usize, at.y as usize, at.fract());
    let row = |y: usize| texel(x, y).lerp(texel(x + 1, y), share.x);
    row(y).lerp(row(y + 1), share.y)
}

#[test]
fn a_glb_reads_back_and_moves_as_the_avatar_does() {
    let avatar = avatar();
    let path = place("person.glb");
    let bytes = avatar.to_glb_with(&GlbOptions::default()).unwrap();
    let length = u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
    let text = std::str::from_utf8(&bytes[20..20 + length]).unwrap();
    assert!(text.contains(r#""extras":{"light":[0.5,0.25,-0.125]}"#), "{text}");
    std::fs::write(&path, bytes).unwrap();
    let character = Character::load(&path).unwrap();
    assert_eq!(character.vertices, avatar.vertices);
    assert_eq!(character.faces, avatar.faces);
    assert_eq!(character.uvs, avatar.uvs);
    let names: Vec<&str> = avatar.skeleton.iter().map(|joint| joint.name.as_str()).collect();
    assert_eq!(character.joint_names, names);
    assert!(names.contains(&"left_knee"));
    let parents: Vec<Option<usize>> = avatar.skeleton.iter().map(|joint| joint.parent.map(usize::from)).collect();
    assert_eq!(character.joint_parents(), parents);
    assert!(worst(&character.rest().vertices, &avatar.vertices) < 1e-5);
    let motion = &avatar.clips[0].motion;
    assert_eq!(character.animations[0].name, "video");
    for seconds in [0.0, 1.0 / motion.fps, 1.5 / motion.fps, motion.duration(), 99.0] {
        let (found, expected) = (character.pose(0, seconds).vertices, skinned(&bare(), seconds).0);
        assert!(worst(&found, &expected) < 2e-4, "at {seconds} s: {} m", worst(&found, &expected));
    }
    let texture = image::load_from_memory(&character.textures[0].bytes).unwrap().into_rgb8();
    assert_eq!(texture.into_raw(), avatar.atlas.rgb);
}

#[test]
fn level_arms_change_the_rest_and_not_the_motion() {
    let (avatar, level) = (bare(), bare().with_level_arms().unwrap());
    level.validate().unwrap();
    let rest = |name: &str| level.skeleton.iter().find(|joint| joint.name == name).unwrap().rest;
    for (shoulder, wrist) in [("left_shoulder", "left_wrist"), ("right_shoulder", "right_wrist")] {
        let arm = (rest(wrist) - rest(shoulder)).normalize_or_zero();
        assert!(arm.x.abs() > 1.0 - 1e-6 && (rest(wrist).x > 0.0) == (wrist == "left_wrist"), "{arm}");
    }
    let seconds = 1.0 / avatar.clips[0].motion.fps;
    // Vertices between two bones keep to the pose in which they were skinned first.
    let (found, expected) = (skinned(&level, seconds).0, skinned(&avatar, seconds).0);
    let mean = found.iter().zip(&expected).map(|(a, b)| a.distance(*b)).sum::<f32>() / found.len() as f32;
    assert!(mean < 3e-3, "{mean}");
    let mut nameless = avatar;
    nameless.skeleton[18].name = "tentacle".to_owned();
    assert!(nameless.with_level_arms().unwrap_err().to_string().contains("leftLowerArm"));
}

#[test]
fn an_obj_holds_the_pose_the_colours_and_the_atlas() {
    let avatar = avatar();
    let (vertices, normals) = skinned(avatar, 0.05);
    let path = place("a person.obj");
    write_obj(avatar, &vertices, &normals, &path).unwrap();
    let (models, materials) = tobj::load_obj(&path, &tobj::GPU_LOAD_OPTIONS).unwrap();
    let mesh = &models[0].mesh;
    assert_eq!(mesh.indices.len(), 3 * avatar.faces.len());
    assert_eq!(mesh.vertex_color.len(), mesh.positions.len());
    for (corner, &index) in mesh.indices.iter().enumerate().step_by(97) {
        let (found, expected) = (index as usize, avatar.faces.as_flattened()[corner] as usize);
        let read = |values: &[f32]| Vec3::from_slice(&values[3 * found..]);
        assert!(read(&mesh.positions).distance(vertices[expected]) < 1e-5);
        assert!(read(&mesh.normals).distance(normals[expected]) < 1e-3);
        let uv = Vec2::from_slice(&mesh.texcoords[2 * found..]);
        assert!(uv.distance(Vec2::new(avatar.uvs[expected].x, 1.0 - avatar.uvs[expected].y)) < 1e-5);
        let (color, near) = (read(&mesh.vertex_color), albedo(avatar, avatar.uvs[expected]));
        assert!(color.distance(near) < 1e-3, "{color} {near}");
    }
    let picture = materials.unwrap()[0].diffuse_texture.clone().unwrap();
    let picture = image::open(place(&picture)).unwrap().into_rgb8();
    assert_eq!(picture.into_raw(), avatar.atlas.rgb);
    assert!(write_obj(avatar, &vertices[1..], &normals, &path).is_err());
}

#[test]
fn motion_goes_out_and_comes_back_standing() {
    let avatar = avatar();
    let path = place("motion.npz");
    write_amass(avatar, 0, &path).unwrap();
    let clip = MotionClip::load(&path).unwrap();
    assert_eq!((clip.num_frames(), clip.num_joints, clip.fps), (4, 24, 30.0));
    // As AMASS has it, z is up.
    let up = Quat::from_scaled_axis(clip.poses[0]) * Vec3::Y;
    assert!(up.z > 0.8, "{up}");
    let back = adapted(avatar, &clip).unwrap();
    let motion = &avatar.clips[0].motion;
    for frame in 0..4 {
        let vertices = |m: &MotionClip| {
            let pose = &m.poses[24 * frame..24 * (frame + 1)];
            avatar.skin(&avatar.bones(pose, m.trans[frame]), pose).0
        };
        assert!(worst(&vertices(&back), &vertices(motion)) < 1e-4);
    }
    let mut npz = array_files::npz::Npz::open(&path).unwrap();
    assert_eq!(npz.f32("betas", &[None]).unwrap().1, avatar.betas);
    assert!(npz.keys().iter().any(|key| key == "gender"));
    assert!(write_amass(avatar, 7, &path).is_err());
}

#[test]
fn a_motion_of_another_skeleton_is_refused_and_smpl_h_is_taken() {
    let avatar = avatar();
    let clip = |joints: usize| MotionClip {
        poses: vec![Vec3::X * 0.1; 2 * joints],
        num_joints: joints,
        trans: vec![Vec3::Y; 2],
        fps: 60.0,
    };
    let error = adapted(avatar, &clip(31)).unwrap_err().to_string();
    assert!(error.contains("skeleton") && error.contains("24") && error.contains("31"), "{error}");
    let fitted = adapted(avatar, &clip(52)).unwrap();
    assert_eq!((fitted.num_joints, fitted.poses.len(), fitted.fps), (24, 48, 60.0));
    assert_eq!(fitted.poses[23], Vec3::ZERO);
}

/// What a viewer of splats draws (Zwicker et al. 2001; the order and the 0.3 pixels of Kerbl et al.
/// 2023): colour and opacity along `forward` from far away, one pixel `scale` metres wide.
fn drawn(splats: &Splats, to_view: Mat3, middle: Vec3, scale: f32, side: usize) -> Vec<(Vec3, f32)> {
    let mut order: Vec<usize> = (0..splats.centres.len()).collect();
    let depth = |i: usize| (to_view * splats.centres[i]).z;
    order.sort_by(|&a, &b| depth(a).total_cmp(&depth(b)));
    let mut pixels = vec![(Vec3::ZERO, 0.0f32); side * side];
    for i in order {
        let at = (to_view * (splats.centres[i] - middle)) / scale + side as f32 / 2.0;
        let axes = to_view * Mat3::from_quat(splats.rotations[i]) * Mat3::from_diagonal(splats.scales[i] / scale);
        let covariance = axes * axes.transpose();
        let (a, b, c) = (covariance.x_axis.x + 0.3, covariance.x_axis.y, covariance.y_axis.y + 0.3);
        let determinant = a * c - b * b;
        let reach = 3.0 * a.max(c).sqrt();
        let range = |x: f32| (x - reach).max(0.0) as usize..((x + reach).max(0.0) as usize + 1).min(side);
        for (y, x) in range(at.y).flat_map(|y| range(at.x).map(move |x| (y, x))) {
            let (dx, dy) = (x as f32 + 0.5 - at.x, y as f32 + 0.5 - at.y);
            let power = -0.5 * (c * dx * dx - 2.0 * b * dx * dy + a * dy * dy) / determinant;
            let alpha = (0.99 * power.exp()).min(0.99);
            let pixel = &mut pixels[y * side + x];
            if alpha > 1.0 / 255.0 {
                pixel.0 += (1.0 - pixel.1) * alpha * splats.colors[i];
                pixel.1 += (1.0 - pixel.1) * alpha;
            }
        }
    }
    pixels
}

/// The avatar in colours that change little across a splat, under even light.
fn even() -> Avatar {
    let mut avatar = Avatar { light: Light::default(), ..avatar().clone() };
    let (width, height) = (avatar.atlas.width as usize, avatar.atlas.height as usize);
    for face in &avatar.faces {
        let corners = face.map(|v| avatar.vertices[v as usize]);
        let [a, b, c] = face.map(|v| avatar.uvs[v as usize] * Vec2::new(width as f32, height as f32));
        let (low, high) = (a.min(b).min(c) - 1.5, a.max(b).max(c) + 1.5);
        let range = |low: f32, high: f32, most: usize| low.max(0.0) as usize..(high as usize + 1).min(most);
        let area = (b - a).perp_dot(c - a).min(-1e-6);
        let columns = range(low.x, high.x, width);
        for (y, x) in range(low.y, high.y, height).flat_map(|y| columns.clone().map(move |x| (y, x))) {
            let at = Vec2::new(x as f32 + 0.5, y as f32 + 0.5) - a;
            let u = (at.perp_dot(c - a) / area).clamp(0.0, 1.0);
            let v = ((b - a).perp_dot(at) / area).clamp(0.0, 1.0 - u);
            let place = corners[0] * (1.0 - u - v) + corners[1] * u + corners[2] * v;
            let tone = place.to_array().map(|x| (127.0 + 40.0 * (6.0 * x).sin()) as u8);
            avatar.atlas.rgb[3 * (y * width + x)..][..3].copy_from_slice(&tone);
        }
    }
    avatar
}

#[test]
fn splats_cover_the_surface_without_holes_and_show_its_colours() {
    let avatar = &even();
    let vertices = skinned(avatar, 0.0).0;
    let splats = splats(avatar, &vertices, 0.009).unwrap();
    assert!(splats.centres.len() > 20_000, "{}", splats.centres.len());
    let mesh = visibility::RayMesh::new(&vertices, &avatar.faces).unwrap();
    let middle = vertices.iter().sum::<Vec3>() / vertices.len() as f32;
    for (scale, side) in [(0.008, 240), (0.002, 200)] {
        for turn in [0.0f32, 1.1, 2.9, 4.4] {
            // Right, down, forward.
            let flip = Mat3::from_diagonal(Vec3::new(1.0, -1.0, -1.0));
            let to_view = flip * Mat3::from_rotation_y(-turn);
            let found = drawn(&splats, to_view, middle, scale, side);
            let expected = |i: usize| {
                let at = Vec3::new((i % side) as f32 + 0.5, (i / side) as f32 + 0.5, 0.0) - side as f32 / 2.0;
                let origin = to_view.transpose() * Vec3::new(at.x * scale, at.y * scale, -5.0) + middle;
                let hit = mesh.first_hit(origin, to_view.transpose() * Vec3::Z)?;
                let face = avatar.faces[hit.face as usize];
                let uv: Vec2 = (0..3).map(|c| hit.barycentric[c] * avatar.uvs[face[c] as usize]).sum();
                Some(albedo(avatar, uv))
            };
            let hits: Vec<Option<Vec3>> = (0..side * side).map(expected).collect();
            let inside = |i: usize| {
                let around = [i, i - 1, i + 1, i - side, i + side];
                around.iter().all(|&j| hits[j].is_some())
            };
            let core: Vec<usize> = (side + 1..side * (side - 1) - 1).filter(|&i| inside(i)).collect();
            let least = core.iter().map(|&i| found[i].1).fold(1.0, f32::min);
            assert!(least > 0.95, "turn {turn}, {scale} m a pixel: {least}");
            let error: f32 = core.iter().map(|&i| (found[i].0 - hits[i].unwrap()).length_squared() / 3.0).sum();
            let psnr = -10.0 * (error / core.len() as f32).log10();
            assert!(core.len() > 2000 && psnr > 25.0, "turn {turn}, {scale} m a pixel: {psnr} dB");
        }
    }
}

#[test]
fn splats_are_as_bright_as_the_light_makes_the_surface() {
    let mut lit = even();
    lit.light.slope = Vec3::new(0.0, 0.0, -0.5);
    let [plain, shaded] = [&even(), &lit].map(|avatar| splats(avatar, &avatar.vertices, 0.05).unwrap());
    let normal = |i: usize| plain.rotations[i] * Vec3::Z;
    for i in (0..plain.centres.len()).step_by(31) {
        let along = normal(i).z;
        let brightness = 1.0 - 0.5 * along + 0.25 * (along * along - 1.0 / 3.0);
        let expected = (brightness * plain.colors[i]).min(Vec3::ONE);
        assert!(shaded.colors[i].distance(expected) < 1e-4, "{i}: {} {expected}", shaded.colors[i]);
    }
}

#[test]
fn a_splat_file_has_the_fields_that_viewers_read() {
    let avatar = avatar();
    let splats = splats(avatar, &avatar.vertices, 0.05).unwrap();
    let path = place("person.ply");
    splats.write(&path).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    let end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let header = std::str::from_utf8(&bytes[..end]).unwrap();
    let fields: Vec<&str> = header.lines().filter_map(|line| line.strip_prefix("property float ")).collect();
    let expected = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3";
    assert_eq!(fields.join(" "), expected);
    let n = splats.centres.len();
    assert!(header.contains("binary_little_endian") && header.contains(&format!("element vertex {n}\n")));
    assert_eq!(bytes.len(), end + 56 * n);
    for i in (0..n).step_by(101) {
        let row: Vec<f32> =
            bytes[end + 56 * i..][..56].chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect();
        assert!(row.iter().all(|x| x.is_finite()));
        // Upside down and backward against ours.
        let at = splats.centres[i];
        assert!(Vec3::new(row[0], row[1], row[2]).distance(Vec3::new(at.x, -at.y, -at.z)) < 1e-6);
        let color = 0.5 + 0.282_094_79 * Vec3::new(row[3], row[4], row[5]);
        assert!(color.distance(splats.colors[i]) < 1e-5);
        assert!((1.0 / (1.0 + (-row[6]).exp()) - 0.99).abs() < 1e-4);
        assert!(row[7..10].iter().all(|scale| scale.exp() > 1e-7));
        let turn = Quat::from_xyzw(row[11], row[12], row[13], row[10]);
        assert!((turn.length() - 1.0).abs() < 1e-5);
        let normal = turn * Vec3::Z;
        let ours = splats.rotations[i] * Vec3::Z;
        assert!(normal.distance(Vec3::new(ours.x, -ours.y, -ours.z)) < 1e-4);
    }
}

#[test]
fn splats_of_impossible_surfaces_are_refused_or_left_out() {
    let avatar = avatar();
    for patch in [0.0, -1.0, f32::NAN, 1e-9] {
        assert!(splats(avatar, &avatar.vertices, patch).is_err(), "{patch}");
    }
    assert!(splats(avatar, &avatar.vertices[1..], 0.01).is_err());
    let odd: Vec<Vec3> = (avatar.vertices.iter().enumerate())
        .map(|(i, &v)| match i % 7 {
            0 => Vec3::NAN,
            1 => Vec3::INFINITY,
            2 => Vec3::ZERO,
            _ => v,
        })
        .collect();
    let kept = splats(avatar, &odd, 0.5).unwrap();
    assert!(kept.centres.iter().chain(&kept.scales).all(|v| v.is_finite()));
}
