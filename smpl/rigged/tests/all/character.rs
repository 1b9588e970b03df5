//! Rigged characters: the shared ones where they are there, and small ones made here, right and
//! wrong.

use base64::Engine;
use glam::{Affine3A, Vec3};
use proptest::prelude::*;
use rigged::{Character, Mesh, load_mesh};
use testkit::files::{arm, glb, shared};

fn read(json: &str, binary: &[u8]) -> Result<Character, smpl::Error> {
    Character::from_bytes("made.glb", &glb(json, binary))
}

fn close(a: Vec3, b: Vec3) {
    assert!(a.distance(b) < 1e-5, "{a} is not {b}");
}

#[test]
fn a_small_character_moves_as_worked_out_by_hand() {
    let (json, binary) = arm();
    let arm = read(&json, &binary).unwrap();
    assert_eq!((arm.num_joints(), arm.joint_names.join(" ")), (2, "root tip".to_owned()));
    assert_eq!(arm.faces, [[0, 1, 2], [2, 1, 3]]);
    assert_eq!(arm.rest().vertices, arm.vertices);
    assert_eq!((arm.animations[0].name.as_str(), arm.animations[0].duration), ("bend", 3.0));
    // A quarter turn about (0, 1, 0) takes (0, 2, 0) to (−1, 1, 0); vertex 3 is halfway between (1,
    // 2, 0) and (−1, 2, 0).
    let bent = arm.pose(0, 3.0);
    close(bent.vertices[0], Vec3::ZERO);
    close(bent.vertices[2], Vec3::new(-1.0, 1.0, 0.0));
    close(bent.vertices[3], Vec3::new(0.0, 2.0, 0.0));
    close(bent.bones[1].transform_point3(Vec3::Y), Vec3::Y);
    // Halfway in time is an eighth of a turn: slerp, not lerp. A quarter of the way, a sixteenth.
    let turned = |seconds: f32| arm.pose(0, seconds).bones[1].matrix3.x_axis.y;
    assert!((turned(2.0) - (std::f32::consts::FRAC_PI_4).sin()).abs() < 1e-6);
    assert!((turned(1.5) - (std::f32::consts::FRAC_PI_8).sin()).abs() < 1e-6);
    // Held outside the keys.
    assert_eq!(arm.pose(0, 99.0), bent);
    assert_eq!(arm.pose(0, -1.0).vertices, arm.vertices);
    assert_eq!(arm.pose(0, f32::NAN).vertices, arm.vertices);
    // The cubic spline with flat tangents is the smooth step.
    let x = |seconds: f32| arm.pose(1, seconds).bones[1].transform_point3(Vec3::Y).x;
    assert!((x(1.5) - 2.0 * 0.15625).abs() < 1e-6 && (x(2.0) - 1.0).abs() < 1e-6 && x(3.0) == 2.0);
    // A step holds until the next key.
    assert_eq!(arm.pose(2, 2.999).vertices, arm.vertices);
    close(arm.pose(2, 3.0).vertices[2], Vec3::new(-1.0, 1.0, 0.0));
}

#[test]
fn buffers_may_stand_in_the_document_but_not_outside_the_folder() {
    let (json, binary) = arm();
    let data = base64::engine::general_purpose::STANDARD.encode(&binary);
    let with = |uri: &str| json.replace(r#""byteLength":380"#, &format!(r#""byteLength":380,"uri":"{uri}""#));
    let inline = with(&format!("data:application/octet-stream;base64,{data}"));
    assert_eq!(Character::from_bytes("a", inline.as_bytes()).unwrap(), read(&json, &binary).unwrap());
    for uri in ["../secret.bin", "%2e%2e/a.bin", "/etc/passwd", "a/../../b.bin"] {
        let refused = Character::from_bytes("a", with(uri).as_bytes()).unwrap_err().to_string();
        assert!(refused.contains("beside it"), "{uri}: {refused}");
    }
    for uri in ["data:,plain", "data:a;base64,***"] {
        assert!(Character::from_bytes("a", with(uri).as_bytes()).is_err(), "{uri}");
    }
    let folder = std::path::Path::new(env!("CARGO_TARGET_TMPDIR"));
    for (name, uri) in [("arm.bin", "arm.bin"), ("mein körper.bin", "mein%20k%C3%B6rper.bin")] {
        std::fs::write(folder.join(name), &binary).unwrap();
        std::fs::write(folder.join("arm.gltf"), with(uri)).unwrap();
        assert_eq!(load_mesh(&folder.join("arm.gltf")).unwrap().faces.len(), 2);
    }
}

#[test]
fn meshes_without_a_skin_follow_their_node() {
    let (json, binary) = arm();
    let json = json.replace(r#""mesh":0,"skin":0"#, r#""mesh":0,"translation":[0,0,5],"scale":[2,2,2]"#);
    let plain = read(&json, &binary).unwrap();
    assert_eq!(plain.num_joints(), 1);
    close(plain.rest().vertices[3], Vec3::new(2.0, 4.0, 5.0));
}

/// Six times the volume of a mesh, positive where faces are counter-clockwise seen from outside.
fn volume(mesh: &Mesh) -> f32 {
    mesh.faces
        .iter()
        .map(|f| {
            let [a, b, c] = f.map(|i| mesh.vertices[i as usize]);
            a.dot(b.cross(c))
        })
        .sum()
}

proptest! {
    /// Whatever mirrors a node, or a joint, the inside stays inside.
    #[test]
    fn mirrored_nodes_keep_their_outside(signs in prop::array::uniform3(any::<bool>()), parent in any::<bool>(), skinned in any::<bool>()) {
        let scale = signs.map(|s| if s { "-1.5" } else { "1.5" }).join(",");
        let (mut a, mut b) = (format!(r#""scale":[{scale}],"#), String::new());
        if parent {
            std::mem::swap(&mut a, &mut b);
        }
        let skin = if skinned { r#""skin":0,"# } else { "" };
        let json = format!(
            r#"{{"asset":{{"version":"2.0"}},"scene":0,"scenes":[{{"nodes":[0]}}],
"nodes":[{{{b}"children":[1]}},{{{a}{skin}"mesh":0}}],"skins":[{{"joints":[1]}}],
"meshes":[{{"primitives":[{{"attributes":{{"POSITION":0,"JOINTS_0":2,"WEIGHTS_0":3}},"indices":1}}]}}],
"accessors":[{{"bufferView":0,"componentType":5126,"count":4,"type":"VEC3"}},
{{"bufferView":1,"componentType":5121,"count":12,"type":"SCALAR"}},
{{"componentType":5121,"count":4,"type":"VEC4"}},{{"bufferView":2,"componentType":5126,"count":4,"type":"VEC4"}}],
"bufferViews":[{{"buffer":0,"byteLength":48}},{{"buffer":0,"byteOffset":48,"byteLength":12}},{{"buffer":0,"byteOffset":60,"byteLength":64}}],
"buffers":[{{"byteLength":124}}]}}"#
        );
        let corners = [0.0f32, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
        let mut binary: Vec<u8> = corners.iter().flat_map(|v| v.to_le_bytes()).collect();
        binary.extend([0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3]);
        binary.extend([1.0f32, 0.0, 0.0, 0.0].repeat(4).iter().flat_map(|v| v.to_le_bytes()));
        let path = std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join("mirrored.glb");
        std::fs::write(&path, glb(&json, &binary)).unwrap();
        let mesh = load_mesh(&path).unwrap();
        prop_assert!((volume(&mesh) - 1.5f32.powi(3)).abs() < 1e-4, "{}", volume(&mesh));
    }
}

#[test]
fn legal_but_rare_documents_are_read() {
    let (json, binary) = arm();
    let plain = read(&json, &binary).unwrap();
    assert!(plain.ignored.is_empty());
    // A channel for an extension, without a node.
    let channel = r#""channels":[{"sampler":0,"target":{"path":"pointer"}},"#;
    let pointer = json.replacen(r#""channels":["#, channel, 1);
    assert_eq!(read(&pointer, &binary).unwrap(), plain);
    // Zeros where there is no view.
    let zeros = json.replacen(r#""bufferView":0,"componentType""#, r#""componentType""#, 1);
    assert!(read(&zeros, &binary).unwrap().vertices.iter().all(|v| *v == Vec3::ZERO));
    // Positions in bytes.
    let bytes = json.replacen(r#""bufferView":0,"componentType":5126"#, r#""bufferView":6,"componentType":5121"#, 1);
    let bytes =
        bytes.replacen(r#""byteOffset":352,"byteLength":16"#, r#""byteOffset":352,"byteLength":16,"byteStride":4"#, 1);
    refused(&bytes, &binary, &["wrong type"]);
    let quantized = bytes.replacen(r#""scene":0"#, r#""scene":0,"extensionsRequired":["KHR_mesh_quantization"]"#, 1);
    assert_eq!(read(&quantized, &binary).unwrap().vertices[3], Vec3::new(0.0, 1.0, 0.0));
    // A morph target at half of its weight: the target adds the positions themselves.
    let morph = json.replacen(r#""indices":7"#, r#""indices":7,"targets":[{"POSITION":0}]"#, 1);
    let by_mesh = morph.replacen(r#""meshes":[{"#, r#""meshes":[{"weights":[0.5],"#, 1);
    let by_node = by_mesh.replacen(r#"{"mesh":0,"#, r#"{"mesh":0,"weights":[1.0],"#, 1);
    for (json, times) in [(&morph, 1.0), (&by_mesh, 1.5), (&by_node, 2.0)] {
        let vertices = read(json, &binary).unwrap().vertices;
        assert!(vertices.iter().zip(&plain.vertices).all(|(a, b)| *a == *b * times), "{times}");
    }
    // A strip and a fan of four corners, without indices.
    let order = |mode: usize| json.replacen(r#""indices":7"#, &format!(r#""mode":{mode}"#), 1);
    assert_eq!(read(&order(5), &binary).unwrap().faces, [[0, 1, 2], [2, 1, 3]]);
    assert_eq!(read(&order(6), &binary).unwrap().faces, [[0, 1, 2], [0, 2, 3]]);
    // Compressed by Draco without being said to be required, beside the plain accessors or instead
    // of them.
    let draco = r#""extensions":{"KHR_draco_mesh_compression":{"bufferView":0}},"attributes":"#;
    let both = json.replacen(r#""attributes":"#, draco, 1);
    assert_eq!(read(&both, &binary).unwrap(), plain);
    let alone = both.replacen(r#""bufferView":0,"componentType""#, r#""componentType""#, 1);
    refused(&alone, &binary, &["mesh 0", "KHR_draco_mesh_compression", "not read"]);
    // Texts as editors write them.
    let data = base64::engine::general_purpose::STANDARD.encode(&binary);
    let text = json.replace(r#""byteLength":380"#, &format!(r#""byteLength":380,"uri":"data:a;base64,{data}""#));
    let utf16: Vec<u8> = "\u{feff}".chars().chain(text.chars()).flat_map(|c| (c as u16).to_le_bytes()).collect();
    for bytes in [
        text.clone().into_bytes(),
        format!("\u{feff}{text}").into_bytes(),
        text.replace('\n', "\r").into_bytes(),
        utf16,
    ] {
        assert_eq!(Character::from_bytes("a", &bytes).unwrap(), plain);
    }
    let used = json.replacen(r#""scene":0"#, r#""scene":0,"extensionsUsed":["EXT_mesh_gpu_instancing"]"#, 1);
    assert!(read(&used, &binary).unwrap().ignored[0].contains("EXT_mesh_gpu_instancing"));
}

/// Views as npm's meshoptimizer 1.0.1 (`encodeGltfBuffer`; `encodeFilterExp` of 15 bits,
/// `encodeFilterQuat` of 16) writes those of positions, rotations and indices.
#[test]
fn compressed_views_hold_what_was_compressed() {
    let (json, binary) = arm();
    let plain = read(&json, &binary).unwrap();
    let positions = "a000013f000000403f2000012800000000010c0000004000012800000000000001280000000000000000000000000000000000\
        000000000000000000f2000000f2000000f2";
    let rotations = "a001100000000130000000fe0000000001100000000000000000000000000000000000000000000000000000000000000000\
        0000ff7f";
    let triangles = "e1f010007687566778a9866589689801690000";
    for extension in ["EXT_meshopt_compression", "KHR_meshopt_compression"] {
        let (mut json, mut bytes) = (json.clone(), binary.clone());
        for (view, length, stride, count, mode, hex) in [
            (0, 48, 12, 4, r#"ATTRIBUTES","filter":"EXPONENTIAL"#, positions),
            (248, 16, 8, 2, r#"ATTRIBUTES","filter":"QUATERNION"#, rotations),
            (368, 12, 2, 6, "TRIANGLES", triangles),
        ] {
            let compressed: Vec<u8> =
                (0..hex.len() / 2).map(|i| u8::from_str_radix(&hex[2 * i..2 * i + 2], 16).unwrap()).collect();
            let old = json.find(&format!(r#"{{"buffer":0,"byteOffset":{view},"#)).unwrap();
            let end = old + json[old..].find('}').unwrap() + 1;
            let new = format!(
                r#"{{"buffer":1,"byteLength":{length},"extensions":{{"{extension}":{{"buffer":0,"byteOffset":{},
                "byteLength":{},"byteStride":{stride},"count":{count},"mode":"{mode}"}}}}}}"#,
                bytes.len(),
                compressed.len()
            );
            json.replace_range(old..end, &new);
            bytes.extend(compressed);
        }
        // Rotations are normalised integers now.
        let json = json.replacen(
            r#"{"bufferView":4,"componentType":5126"#,
            r#"{"bufferView":4,"componentType":5122,"normalized":true"#,
            1,
        );
        let all = bytes.len();
        let buffers = format!(
            r#""byteLength":{all}}},{{"byteLength":400,"extensions":{{"{extension}":{{"fallback":true}}}}}}],
            "extensionsRequired":["{extension}"]}}"#
        );
        let json = json.replace(r#""byteLength":380}]}"#, &buffers);
        let read = read(&json, &bytes).unwrap();
        assert_eq!((&read.vertices, &read.faces), (&plain.vertices, &plain.faces));
        for i in 0..5 {
            let at = 1.0 + 0.5 * i as f32;
            let close = |(a, b): (&Vec3, &Vec3)| a.distance(*b) < 1e-4;
            assert!(read.pose(0, at).vertices.iter().zip(&plain.pose(0, at).vertices).all(close));
        }
        let wrong = |from: &str, to: &str, words: &[&str]| {
            assert!(json.contains(from));
            refused(&json.replacen(from, to, 1), &bytes, words);
        };
        wrong(r#""count":6,"mode""#, r#""count":9,"mode""#, &["buffer view 7", "meshopt", "TRIANGLES"]);
        wrong(r#""mode":"TRIANGLES""#, r#""mode":"STRIPS""#, &["buffer view 7", "meshopt", "STRIPS"]);
        wrong(r#""byteLength":19"#, r#""byteLength":18"#, &["buffer view 7", "meshopt"]);
        wrong(r#""byteLength":19"#, r#""byteLength":20"#, &["buffer view 7", "leave"]);
        wrong(r#""byteLength":48"#, r#""byteLength":4800000000"#, &["buffer view 0", "limit"]);
    }
}

#[test]
fn textures_are_placed_and_what_is_not_read_is_named() {
    let (json, binary) = arm();
    let material = r#""materials":[{"pbrMetallicRoughness":{"baseColorFactor":[1,0.5,1,0.8],"baseColorTexture":{"index":0,
"extensions":{"KHR_texture_transform":{"offset":[0.5,0.25],"rotation":1.5707964,"scale":[2,3]}}}},"alphaMode":"MASK"},
{"pbrMetallicRoughness":{"baseColorTexture":{"index":1}},"alphaMode":"MASK","alphaCutoff":0.25},
{"pbrMetallicRoughness":{"baseColorTexture":{"index":2}},"alphaMode":"BLEND"}],
"textures":[{"source":0},{"source":0},{"source":1}],
"images":[{"uri":"data:image/png;base64,AAAA"},{"uri":"data:image/jpeg;base64,BBBB"}],"meshes""#;
    let json = json.replacen(r#""meshes""#, material, 1);
    // Coordinates of the texture: the first two weights of vertices, (2,0), (1,0), (0,1),
    // (0.5,0.5).
    let json = json.replacen(r#""WEIGHTS_0":1"#, r#""WEIGHTS_0":1,"TEXCOORD_0":8,"COLOR_0":1"#, 1);
    // Three more primitives: without coordinates, with the first image again, with another.
    let more = |material: usize, uvs: &str| {
        format!(
            r#"{{"attributes":{{"POSITION":0,"WEIGHTS_0":1,"JOINTS_0":6{uvs}}},"indices":7,"material":{material}}}"#
        )
    };
    let uvs = r#","TEXCOORD_0":8"#;
    let more = [more(0, ""), more(1, uvs), more(2, uvs)].join(",");
    let json = json.replacen(r#""indices":7}"#, &format!(r#""indices":7,"material":0}},{more}"#), 1);
    let accessors = json.find(r#""accessors":["#).unwrap();
    let end = json[accessors..].find("],\n").unwrap() + accessors;
    let json = format!(
        "{},{}{}",
        &json[..end],
        r#"{"bufferView":8,"componentType":5126,"count":4,"type":"VEC2"}"#,
        &json[end..]
    );
    let json = json.replacen(
        r#"{"buffer":0,"byteOffset":368,"byteLength":12}"#,
        r#"{"buffer":0,"byteOffset":368,"byteLength":12},{"buffer":0,"byteOffset":48,"byteLength":64,"byteStride":16}"#,
        1,
    );
    let read = read(&json, &binary).unwrap();
    for (uv, [u, v]) in read.uvs.iter().zip([[2.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.5, 0.5]]) {
        // A quarter turn takes (u, v) to (v, −u).
        let expected = glam::Vec2::new(3.0 * v + 0.5, -2.0 * u + 0.25);
        assert!(uv.distance(expected) < 1e-5, "{uv} {expected}");
    }
    assert!(read.ignored.len() == 1 && read.ignored[0].contains("alphaMode BLEND"), "{:?}", read.ignored);
    let images: Vec<&[u8]> = read.textures.iter().map(|texture| texture.bytes.as_slice()).collect();
    assert_eq!((images, read.uvs.len()), (vec![&[0; 3][..], &[4, 16, 65]], 16));
    assert_eq!(read.texture_of, [[Some(0); 4], [None; 4], [Some(0); 4], [Some(1); 4]].concat());
    // Colours of vertices are the weights, (2,0,0), (1,0,0), (0,1,0), (½,½,0), and never more than
    // 1.
    let colours = [[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.5, 0.0], [0.5, 0.25, 0.0]].map(Vec3::from);
    let tints = [colours, [Vec3::new(1.0, 0.5, 1.0); 4], [Vec3::ONE; 4], [Vec3::ONE; 4]].concat();
    assert_eq!(read.tints, tints);
    // The first primitive's colours have no alpha.
    assert_eq!(read.cutoffs, [[2.0; 4], [0.625; 4], [0.25; 4], [0.5; 4]].concat());
}

/// Fails unless reading gives an error that names every one of `words`.
fn refused(json: &str, binary: &[u8], words: &[&str]) {
    let error = read(json, binary).map(|_| ()).unwrap_err().to_string();
    for word in words.iter().chain(&["made.glb"]) {
        assert!(error.contains(word), "should name {word:?}: {error}");
    }
}

#[test]
fn errors_name_the_fault_of_a_document() {
    let (json, binary) = arm();
    let swap = |from: &str, to: &str| {
        assert!(json.contains(from), "{from}");
        json.replacen(from, to, 1)
    };
    refused(&swap(r#"{"translation":[0,1,0]"#, r#"{"translation":[0,1,0],"children":[0]"#), &binary, &["cycle"]);
    refused(&swap(r#"{"children":[1]"#, r#"{"children":[1,1]"#), &binary, &["node 1", "two parents"]);
    refused(&swap(r#"{"translation":[0,1,0]"#, r#"{"translation":[0,1e39,0]"#), &binary, &["node 1", "not finite"]);
    let huge = r#""bufferView":0,"componentType":5126,"count":4294967295"#;
    refused(&swap(r#""bufferView":0,"componentType":5126,"count":4"#, huge), &binary, &["accessor 0", "4294967295"]);
    let most = r#""bufferView":0,"componentType":5126,"count":18446744073709551615"#;
    refused(&swap(r#""bufferView":0,"componentType":5126,"count":4"#, most), &binary, &["accessor 0"]);
    let no_view = r#""componentType":5126,"count":4294967295"#;
    refused(&swap(r#""bufferView":0,"componentType":5126,"count":4"#, no_view), &binary, &["accessor 0", "limit"]);
    let required = |name: &str| swap(r#""scene":0"#, &format!(r#""scene":0,"extensionsRequired":["{name}"]"#));
    for name in ["KHR_draco_mesh_compression", "KHR_texture_basisu", "EXT_texture_webp", "EXT_mesh_gpu_instancing"] {
        refused(&required(name), &binary, &["extensionsRequired", name]);
    }
    refused(&swap(r#""byteOffset":368,"byteLength":12"#, r#""byteOffset":368,"byteLength":13"#), &binary, &["view 7"]);
    refused(&swap(r#""byteLength":380"#, r#""byteLength":381"#), &binary, &["buffer 0", "381"]);
    refused(&swap(r#""input":3"#, r#""input":33"#), &binary, &["animation 0", "index 33 of 8"]);
    refused(&swap(r#""channels":[{"sampler":0"#, r#""channels":[{"sampler":9"#), &binary, &["animation 0", "index 9"]);
    refused(&swap(r#""joints":[0,1]"#, r#""joints":[0]"#), &binary, &["mesh 0", "joint 1 of 1"]);
    refused(&swap(r#""joints":[0,1]"#, r#""joints":[0,1,1]"#), &binary, &["skin 0", "2 inverse bind matrices for 3"]);
    refused(&swap(r#""indices":7"#, r#""indices":7,"mode":0"#), &binary, &["no triangles"]);
    refused(&swap(r#"[{"nodes":[0,2]}]"#, "[{}]"), &binary, &["no triangles"]);
    refused(&swap(r#""WEIGHTS_0":1,"#, ""), &binary, &["JOINTS_0", "without weights"]);
    refused(&swap(r#""type":"VEC3","min""#, r#""type":"VEC2","min""#), &binary, &["POSITION"]);
    let poke = |at: usize, bytes: &[u8]| {
        let mut binary = binary.clone();
        binary[at..at + bytes.len()].copy_from_slice(bytes);
        binary
    };
    refused(&json, &poke(368, &4u16.to_le_bytes()), &["index 4 of 4"]);
    refused(&json, &poke(112, &f32::NAN.to_le_bytes()), &["skin 0", "not finite"]);
    refused(&json, &poke(0, &f32::INFINITY.to_le_bytes()), &["POSITION", "not finite"]);
    refused(&json, &poke(0, &1e30f32.to_le_bytes()), &["POSITION", "1000000"]);
    refused(&json, &poke(48, &(-1.0f32).to_le_bytes()), &["set 0", "-1"]);
    refused(&json, &poke(240, &3.0f32.to_le_bytes()), &["animation 0", "times"]);
}

#[test]
fn one_small_accessor_used_often_does_not_fill_the_memory() {
    // 40 000 nodes show one mesh of 32 000 vertices: 1.3 · 10⁹ vertices from 400 kB.
    let count = 32_000;
    let binary = vec![0u8; 12 * count];
    let nodes = vec![r#"{"mesh":0}"#; 40_000].join(",");
    let json = format!(
        r#"{{"asset":{{"version":"2.0"}},"nodes":[{nodes}],"meshes":[{{"primitives":[{{"attributes":{{"POSITION":0}}}}]}}],
"accessors":[{{"bufferView":0,"componentType":5126,"count":{count},"type":"VEC3","min":[0,0,0],"max":[0,0,0]}}],
"bufferViews":[{{"buffer":0,"byteLength":{n}}}],"buffers":[{{"byteLength":{n}}}]}}"#,
        n = binary.len()
    );
    let json = json.replace("32000,\"type\"", "31998,\"type\"");
    // What is named is the sum, which is over the limit, not the accessor, which is not.
    let error = read(&json, &binary).map(|_| ()).unwrap_err().to_string();
    let numbers = error.split(' ').filter_map(|word| word.parse::<u64>().ok()).collect::<Vec<_>>();
    assert!(numbers.iter().any(|n| *n > 1 << 28) && numbers.contains(&(1 << 28)), "{error}");
}

#[test]
fn every_truncation_is_an_error() {
    let (json, binary) = arm();
    let whole = glb(&json, &binary);
    for n in 0..whole.len() {
        assert!(Character::from_bytes("cut", &whole[..n]).is_err(), "{n} of {} bytes", whole.len());
    }
    // What stands behind the end is no part of the container.
    assert!(Character::from_bytes("made.glb", &[&whole[..], b"\n"].concat()).is_ok());
}

/// A shared character, at bind and in motion.
fn shared_character(name: &str) -> Option<Character> {
    let character = Character::load(&shared(&format!("character/{name}"))?).unwrap();
    for v in 0..character.vertices.len() {
        let sum: f32 = character.weights.row(v).map(|(_, w)| w).sum();
        assert!((sum - 1.0).abs() < 1e-5, "weights of vertex {v} sum to {sum}");
    }
    let texture = &character.textures[0];
    let size = image::load_from_memory(&texture.bytes).unwrap();
    assert!(size.width() >= 256);
    assert_eq!(character.uvs.len(), character.vertices.len());
    // Joints where the inverse bind matrices say give back the file's vertices.
    let identity = vec![Affine3A::IDENTITY; character.num_joints()];
    let skinned = character.skin(&identity);
    assert!(skinned.iter().zip(&character.vertices).all(|(a, b)| a.distance(*b) < 1e-5));
    Some(character)
}

#[test]
fn the_makehuman_character_stands_at_bind_and_walks_on_the_floor() {
    let Some(character) = shared_character("makehuman_walk.glb") else { return };
    assert_eq!((character.vertices.len(), character.faces.len(), character.num_joints()), (14517, 26756, 31));
    let rest = character.rest();
    let off = rest.vertices.iter().zip(&character.vertices).map(|(a, b)| a.distance(*b)).fold(0.0, f32::max);
    assert!(off < 1e-4, "rest and bind differ by {off} m");
    let walk = &character.animations[0];
    assert_eq!(walk.name, "cmu_131_01_walk");
    assert!((walk.duration - 248.0 / 30.0).abs() < 1e-3, "{}", walk.duration);
    let (mut lowest, mut highest, mut moved) = (f32::INFINITY, f32::NEG_INFINITY, 0.0f32);
    for i in 0..100 {
        let posed = character.pose(0, i as f32 * walk.duration / 99.0);
        let feet = posed.vertices.iter().map(|v| v.y).fold(f32::INFINITY, f32::min);
        (lowest, highest) = (lowest.min(feet), highest.max(feet));
        moved = moved.max(posed.vertices[0].distance(rest.vertices[0]));
    }
    println!("lowest vertex between {lowest} and {highest} m, {moved} m walked");
    assert!(lowest > -0.05 && highest < 0.08, "feet between {lowest} and {highest}");
    assert!(moved > 0.5, "it does not walk");
    // Parents are the nearest ancestors that are joints.
    let (names, parents) = (&character.joint_names, character.joint_parents());
    let above = |name: &str| {
        let joint = names.iter().position(|n| n == name).unwrap();
        parents[joint].map(|p| names[p].as_str())
    };
    assert_eq!((above("Hips"), above("LeftForeArm")), (None, Some("LeftArm")));
    assert_eq!(above("RightUpLeg"), Some("RHipJoint"));
    assert_eq!(parents.iter().filter(|p| p.is_none()).count(), 1);
}

#[test]
fn the_cesium_man_stands_upright_and_moves() {
    let Some(character) = shared_character("CesiumMan.glb") else { return };
    assert_eq!((character.vertices.len(), character.num_joints()), (3273, 19));
    let posed = character.pose(0, 0.5);
    let y = |f: fn(f32, f32) -> f32, start| posed.vertices.iter().map(|v| v.y).fold(start, f);
    let (low, high) = (y(f32::min, f32::INFINITY), y(f32::max, f32::NEG_INFINITY));
    assert!((1.3..1.8).contains(&(high - low)), "height {}", high - low);
    assert!(low.abs() < 0.05, "feet at {low}");
    assert!((character.animations[0].duration - 2.0).abs() < 0.01);
    let later = character.pose(0, 1.0).vertices;
    let moved = posed.vertices.iter().zip(&later).map(|(a, b)| a.distance(*b));
    assert!(moved.fold(0.0, f32::max) > 0.1);
}

/// A few bytes of text asked for gigabytes.
#[test]
fn one_file_named_many_times_is_refused_before_it_fills_the_memory() {
    let folder = std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join("named-often");
    std::fs::create_dir_all(&folder).unwrap();
    let size = 32 << 20;
    // Sparse: it takes no room on the disk.
    std::fs::File::create(folder.join("big.bin")).unwrap().set_len(size).unwrap();
    let buffers = vec![format!(r#"{{"byteLength":{size},"uri":"big.bin"}}"#); 400].join(",");
    let path = folder.join("often.gltf");
    std::fs::write(&path, format!(r#"{{"asset":{{"version":"2.0"}},"buffers":[{buffers}]}}"#)).unwrap();
    let message = Character::load(&path).unwrap_err().to_string();
    assert!(message.contains("buffer 16") && message.contains("more than the limit"), "{message}");
}
