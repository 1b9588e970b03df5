//! One pose as a Wavefront OBJ with its material and picture.

use std::fmt::Write as _;
use std::path::Path;

use glam::{Vec2, Vec3};

use crate::Error;
use crate::bake::draw::{bilinear, color};
use crate::bake::{Atlas, Avatar, write_whole};

/// Writes `path` (`.obj`) and beside it the same name with `.mtl` and `.png`: the avatar's
/// surface with `vertices` (V) and `normals` (V) in their places, colours at the vertices
/// (`v x y z r g b`, sRGB from 0 to 1) and texture coordinates.
///
/// # Errors
/// [`Error::Bake`] for other numbers of vertices or normals; [`Error::Io`].
pub fn write_obj(avatar: &Avatar, vertices: &[Vec3], normals: &[Vec3], path: &Path) -> Result<(), Error> {
    let v = avatar.num_vertices();
    if vertices.len() != v || normals.len() != v {
        let found = (vertices.len(), normals.len());
        return Err(Error::Bake(format!("mesh: expected {v} vertices and normals, found {found:?}")));
    }
    let file_name = |extension: &str| {
        // OBJ statements are separated by white space.
        let name = path.with_extension(extension).file_name().unwrap_or_default().to_string_lossy().into_owned();
        name.chars().map(|c| if c.is_whitespace() || c.is_control() { '_' } else { c }).collect::<String>()
    };
    let (material, picture) = (file_name("mtl"), file_name("png"));
    if [&picture, &material].iter().any(|name| path.file_name().is_some_and(|own| own == name.as_str())) {
        let what = "is the name of its texture or material; a mesh is called .obj";
        return Err(Error::Bake(format!("{}: {what}", path.display())));
    }
    let mut text = format!("# metres, y up; colours of vertices in sRGB\nmtllib {material}\no person\nusemtl person\n");
    for (at, &uv) in vertices.iter().zip(&avatar.uvs) {
        let color = avatar.atlas.color(uv);
        let _ = writeln!(text, "v {:.6} {:.6} {:.6} {:.4} {:.4} {:.4}", at.x, at.y, at.z, color.x, color.y, color.z);
    }
    for uv in &avatar.uvs {
        // OBJ counts v upward.
        let _ = writeln!(text, "vt {:.6} {:.6}", uv.x, 1.0 - uv.y);
    }
    for n in normals {
        let _ = writeln!(text, "vn {:.4} {:.4} {:.4}", n.x, n.y, n.z);
    }
    for [a, b, c] in avatar.faces.iter().map(|face| face.map(|v| v + 1)) {
        let _ = writeln!(text, "f {a}/{a}/{a} {b}/{b}/{b} {c}/{c}/{c}");
    }
    let library = format!("newmtl person\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {picture}\n");
    write_whole(&path.with_file_name(picture), &avatar.atlas.to_png()?)?;
    write_whole(&path.with_file_name(material), library.as_bytes())?;
    write_whole(path, text.as_bytes())
}

impl Atlas {
    /// Bilinear lookup, sRGB in [0, 1].
    pub(super) fn color(&self, uv: Vec2) -> Vec3 {
        let texels = self.rgb.as_chunks().0;
        bilinear(self, uv * self.size(), |i| color(texels[i]).into()).into()
    }
}
