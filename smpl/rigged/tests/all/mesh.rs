//! Meshes from files.

use std::path::{Path, PathBuf};

use glam::Vec3;
use proptest::prelude::*;
use rigged::load_mesh;
use testkit::files::shared;

fn written(name: &str, text: impl AsRef<[u8]>) -> PathBuf {
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    std::fs::write(&path, text).unwrap();
    path
}

#[test]
fn obj_files_keep_their_order_and_split_polygons() {
    let text = "# a pyramid\no thing\nv 0 0 0 1 1 1\r\nv 1 0 0\nv 1 0 1\nvt 0 0\nvn 0 1 0\nusemtl x\n\
                f 1/1/1 2//1 3 4\nv 0 0 1 # late\nv 9e0 -1.5 \\\n 2\nf -1 -2 1\n";
    let mesh = load_mesh(&written("pyramid.obj", text)).unwrap();
    assert_eq!(mesh.vertices.len(), 5);
    assert_eq!(mesh.vertices[4], Vec3::new(9.0, -1.5, 2.0));
    assert_eq!(mesh.faces, [[0, 1, 2], [0, 2, 3], [4, 3, 0]]);
}

#[test]
fn errors_of_obj_files_name_the_line() {
    for (text, word) in [
        ("v 0 0\n", "line 1"),
        ("v 0 0 0\nv 0 nan 0\n", "line 2"),
        ("v 0 0 0\nv 0 1e39 0\n", "line 2"),
        ("v 0 zero 0\n", "\"zero\""),
        ("v 0 0 0\nf 1 1 2\n", "vertex 2 of 1"),
        ("v 0 0 0\nf 1 1 0\n", "line 2"),
        ("v 0 0 0\nf 1 1 -2\n", "line 2"),
        ("v 0 0 0\nf 1 1 -9223372036854775808\n", "line 2"),
        ("v 0 0 0\nf 1 1 9223372036854775807\n", "line 2"),
        ("v 0 0 0\nf 1 1\n", "2 corners"),
        ("v 0 0 0\n", "no faces"),
        ("", "no faces"),
    ] {
        let error = load_mesh(&written("wrong.obj", text)).unwrap_err().to_string();
        assert!(error.contains(word) && error.contains("wrong.obj"), "{text:?}: {error}");
    }
    let path = written("mesh.ply", "ply");
    assert!(load_mesh(&path).unwrap_err().to_string().contains("expected .obj"));
    assert!(load_mesh(Path::new("/no/such.obj")).is_err());
}

/// tobj renumbers vertices in the order of their first use, so corners are compared by position.
fn by_tobj(text: &str) -> Vec<Vec3> {
    let options = tobj::LoadOptions { triangulate: true, ..tobj::LoadOptions::default() };
    let (models, _) = tobj::load_obj_buf(&mut text.as_bytes(), &options, |_| Ok(Default::default())).unwrap();
    let corners = |model: tobj::Model| {
        let at: Vec<Vec3> = model.mesh.positions.chunks_exact(3).map(Vec3::from_slice).collect();
        model.mesh.indices.into_iter().map(move |i| at[i as usize])
    };
    models.into_iter().flat_map(corners).collect()
}

proptest! {
    #[test]
    fn triangles_of_obj_files_are_those_that_tobj_reads(
        vertices in prop::collection::vec((-8i8..8, -8i8..8, any::<i8>()), 3..12),
        polygons in prop::collection::vec(prop::collection::vec(any::<(prop::sample::Index, bool)>(), 3..6), 1..9),
    ) {
        let count = vertices.len();
        let mut text: String = vertices.iter().map(|(x, y, z)| format!("v {x} {y}.25 {z}e-2\nvn 0 1 0\n")).collect();
        for (number, polygon) in polygons.iter().enumerate() {
            text += "f";
            for (corner, from_end) in polygon {
                let index = corner.index(count);
                let index = if *from_end { index as i64 - count as i64 } else { index as i64 + 1 };
                text += &if number % 2 == 0 { format!(" {index}") } else { format!(" {index}//{index}") };
            }
            text += "\n";
        }
        let mesh = load_mesh(&written("tobj.obj", &text)).unwrap();
        let corners: Vec<Vec3> = mesh.faces.iter().flatten().map(|&v| mesh.vertices[v as usize]).collect();
        prop_assert_eq!(corners, by_tobj(&text));
    }
}

#[test]
fn meshes_come_from_characters_and_bodies_alike() {
    let Some(body) = shared("body/open_body.npz") else { return };
    let mesh = load_mesh(&body).unwrap();
    assert_eq!((mesh.vertices.len(), mesh.faces.len()), (6890, 13776));
    let text: String = (mesh.vertices.iter().map(|v| format!("v {} {} {}\n", v.x, v.y, v.z)))
        .chain(mesh.faces.iter().map(|f| format!("f {} {} {}\n", f[0] + 1, f[1] + 1, f[2] + 1)))
        .collect();
    assert_eq!(load_mesh(&written("body.obj", text)).unwrap(), mesh);
    let Some(character) = shared("character/makehuman_walk.glb") else { return };
    assert_eq!(load_mesh(&character).unwrap().faces.len(), 26756);
}

proptest! {
    /// The same mesh whatever the editor writes around the text.
    #[test]
    fn text_of_any_encoding_is_the_same_mesh(mark in 0usize..4, end in 0usize..3) {
        let text = "# größe\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n".replace('\n', ["\n", "\r\n", "\r"][end]);
        let units = |to: fn(u16) -> [u8; 2]| format!("\u{feff}{text}").encode_utf16().flat_map(to).collect::<Vec<u8>>();
        let bytes = match mark {
            0 => text.clone().into_bytes(),
            1 => format!("\u{feff}{text}").into_bytes(),
            2 => units(u16::to_le_bytes),
            _ => units(u16::to_be_bytes),
        };
        let path = std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join("encodings.obj");
        std::fs::write(&path, bytes).unwrap();
        let mesh = load_mesh(&path).unwrap();
        prop_assert_eq!((mesh.vertices[1], mesh.faces), (Vec3::X, vec![[0, 1, 2]]));
    }
}
