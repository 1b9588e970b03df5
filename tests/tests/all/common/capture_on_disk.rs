//! A capture in HumanNeRF's prepared layout, written with pickles made here.

use std::path::Path;

use glam::Vec3;
use image::{Rgb, RgbImage};
use smpl::{BodyModel, SparseRows};

pub const SIZE: (u32, u32) = (24, 32);
pub const FRAMES: u32 = 3;

/// A box 1.7 high with a joint at either end.
pub fn body() -> BodyModel {
    let mesh = testkit::mesh::cuboid(Vec3::new(0.25, 0.85, 0.15));
    let ends = [[0u32, 1, 4, 5], [2, 3, 6, 7]];
    BodyModel {
        shapedirs: mesh.vertices.iter().map(|v| Vec3::Y * v.y * 0.1).collect(),
        posedirs: SparseRows::from_rows((0..8).map(|_| Vec::<(u32, Vec3)>::new())),
        weights: SparseRows::from_rows((0..8u32).map(|v| [(v >> 1 & 1, 1.0f32)])),
        j_regressor: SparseRows::from_rows(ends.map(|end| end.map(|v| (v, 0.25f32)))),
        parents: vec![None, Some(0)],
        v_template: mesh.vertices,
        faces: mesh.faces,
    }
}

/// Writes three frames. `image` and `mask` give the colour and the level of (frame, column, row).
pub fn write(
    dir: &Path,
    distortion: [f64; 5],
    image: impl Fn(u32, u32, u32) -> [u8; 3],
    mask: impl Fn(u32, u32, u32) -> u8,
) {
    for kind in ["images", "masks"] {
        std::fs::create_dir_all(dir.join(kind)).unwrap();
    }
    for i in 0..FRAMES {
        let save = |kind: &str, color: &dyn Fn(u32, u32) -> [u8; 3]| {
            let picture = RgbImage::from_fn(SIZE.0, SIZE.1, |x, y| Rgb(color(x, y)));
            picture.save(dir.join(kind).join(format!("frame_{i:06}.png"))).unwrap();
        };
        save("images", &|x, y| image(i, x, y));
        save("masks", &|x, y| [mask(i, x, y); 3]);
    }
    let joints: Vec<f64> = body().shaped(&[0.5]).joints.iter().flat_map(|j| j.to_array()).map(f64::from).collect();
    let names: Vec<String> = (0..FRAMES).map(|i| format!("frame_{i:06}")).collect();
    let every_frame = |record: Vec<u8>| dictionary(names.iter().map(|name| (name.as_str(), record.clone())));
    let camera = dictionary([
        ("intrinsics", array(&[3, 3], &[40.0, 0.0, 12.0, 0.0, 40.0, 16.0, 0.0, 0.0, 1.0])),
        // Looks along −z of the world from 3.5 in front of the body.
        (
            "extrinsics",
            array(&[4, 4], &[1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 3.5, 0.0, 0.0, 0.0, 1.0]),
        ),
        ("distortions", array(&[5], &distortion)),
    ]);
    let info = dictionary([
        ("Rh", array(&[3], &[0.0, 0.5, 0.0])),
        ("Th", array(&[3], &[0.05, 0.0, 0.0])),
        ("poses", array(&[6], &[0.0, 0.0, 0.0, 0.0, 0.25, 0.0])),
        ("betas", array(&[1], &[0.5])),
        ("tpose_joints", array(&[2, 3], &joints)),
    ]);
    let canonical = dictionary([("joints", array(&[2, 3], &joints)), ("avg_betas", array(&[1], &[0.5]))]);
    let files = [("cameras", every_frame(camera)), ("mesh_infos", every_frame(info)), ("canonical_joints", canonical)];
    for (name, root) in files {
        std::fs::write(dir.join(format!("{name}.pkl")), pickle(&root)).unwrap();
    }
}

/// Protocol 3 around an object.
fn pickle(root: &[u8]) -> Vec<u8> {
    [&[0x80, 3], root, b"."].concat()
}

fn text(words: &str) -> Vec<u8> {
    [b"X", (words.len() as u32).to_le_bytes().as_slice(), words.as_bytes()].concat()
}

fn dictionary<'a>(items: impl IntoIterator<Item = (&'a str, Vec<u8>)>) -> Vec<u8> {
    let items: Vec<u8> = items.into_iter().flat_map(|(key, value)| [text(key), value].concat()).collect();
    [b"}(", items.as_slice(), b"u"].concat()
}

/// numpy's `_reconstruct(ndarray, (0,), b'b')` with the state (1, shape, dtype('<f8'), False,
/// bytes).
fn array(shape: &[u32], values: &[f64]) -> Vec<u8> {
    let mut out = b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\0\x85C\x01b\x87R(K\x01(".to_vec();
    for n in shape {
        out.push(b'J');
        out.extend(n.to_le_bytes());
    }
    out.extend(b"tcnumpy\ndtype\n");
    out.extend(text("f8"));
    out.extend(b"K\0K\x01\x87R(K\x03");
    out.extend(text("<"));
    out.extend(b"NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\0tb\x89B");
    out.extend((values.len() as u32 * 8).to_le_bytes());
    out.extend(values.iter().flat_map(|v| v.to_le_bytes()));
    out.extend(b"tb");
    out
}
