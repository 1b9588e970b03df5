//! Triangle meshes from files.

use std::path::Path;

use array_files::{decode_text, read_file};
use glam::Vec3;
use smpl::{BodyModel, Error};

use crate::character::Character;

/// Largest coordinate of a mesh, in its own unit: a kilometre in millimetres.
pub(crate) const MAX_COORDINATE: f32 = 1e6;

/// A triangle mesh, from [`load_mesh`].
#[derive(Clone, Debug, PartialEq)]
pub struct Mesh {
    /// Positions, (V), in the file's order.
    pub vertices: Vec<Vec3>,
    /// Triangles, (F).
    pub faces: Vec<[u32; 3]>,
}

/// Reads a mesh by its extension: Wavefront `.obj`; all triangle meshes of the scene of a `.glb` or
/// `.gltf`, at rest, in world space; the template of a body model (see [`BodyModel::load`]).
///
/// Of an OBJ file the statements `v` and `f` are read; polygons become fans. Vertices keep the
/// file's order, so that vertex indices agree with other programs.
///
/// ```
/// let path = std::env::temp_dir().join("rigged_load_mesh_example.obj");
/// std::fs::write(&path, "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n").unwrap();
/// let mesh = rigged::load_mesh(&path).unwrap();
/// assert_eq!(mesh.faces, [[0, 1, 2], [0, 2, 3]]);
/// ```
///
/// # Errors
/// Any [`Error`]; those about an OBJ file name the line.
pub fn load_mesh(path: &Path) -> Result<Mesh, Error> {
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or("").to_ascii_lowercase();
    match extension.as_str() {
        "obj" => parse_obj(&path.display().to_string(), &read_file(path)?),
        "glb" | "gltf" | "vrm" => {
            let character = Character::load(path)?;
            let mesh = Mesh { vertices: character.rest().vertices, faces: character.faces };
            match mesh.vertices.iter().find(|v| v.is_nan() || v.abs().max_element() > MAX_COORDINATE) {
                Some(far) => {
                    let message = format!("{far}, expected coordinates of at most {MAX_COORDINATE}");
                    Err(Error::invalid(&path.display().to_string(), "vertices", message))
                }
                None => Ok(mesh),
            }
        }
        "npz" | "pkl" | "safetensors" => {
            let body = BodyModel::load(path)?;
            Ok(Mesh { vertices: body.v_template, faces: body.faces })
        }
        _ => {
            let kinds = ".obj, .glb, .gltf, .vrm, .npz, .pkl or .safetensors";
            let message = format!("unknown kind of file (expected {kinds})");
            Err(Error::invalid(&path.display().to_string(), "", message))
        }
    }
}

fn parse_obj(file: &str, bytes: &[u8]) -> Result<Mesh, Error> {
    let text = decode_text(bytes);
    let mut mesh = Mesh { vertices: Vec::new(), faces: Vec::new() };
    let mut polygon: Vec<u32> = Vec::new();
    // Line of each triangle: an index may refer to a vertex that follows, so it is checked last.
    let mut lines: Vec<usize> = Vec::new();
    let mut joined = String::new();
    for (number, line) in text.lines().enumerate().map(|(i, line)| (i + 1, line)) {
        let invalid = |message: String| Error::invalid(file, &format!("line {number}"), message);
        let statement = line.split('#').next().unwrap_or("").trim();
        if let Some(start) = statement.strip_suffix('\\') {
            joined.push_str(start);
            joined.push(' ');
            continue;
        }
        joined.push_str(statement);
        let statement = std::mem::take(&mut joined);
        let mut words = statement.split_ascii_whitespace();
        match words.next() {
            Some("v") => {
                let mut position = [0.0f32; 3];
                for value in &mut position {
                    let word = words.next().ok_or_else(|| invalid("fewer than three coordinates".to_owned()))?;
                    *value = word.parse().map_err(|_| invalid(format!("{word:?} is not a number")))?;
                    if !value.is_finite() {
                        return Err(invalid(format!("{word:?} is not finite")));
                    }
                    if value.abs() > MAX_COORDINATE {
                        return Err(invalid(format!("{word:?}: expected at most {MAX_COORDINATE}")));
                    }
                }
                mesh.vertices.push(position.into());
            }
            Some("f") => {
                polygon.clear();
                for word in words {
                    let index: i64 = (word.split('/').next().and_then(|w| w.parse().ok()))
                        .ok_or_else(|| invalid(format!("{word:?} is not a vertex")))?;
                    // From 1, or from the end of the vertices so far.
                    let from_zero = if index < 0 { mesh.vertices.len() as i64 + index } else { index - 1 };
                    let vertex = u32::try_from(from_zero).map_err(|_| invalid(format!("{word:?} is not a vertex")))?;
                    polygon.push(vertex);
                }
                if polygon.len() < 3 {
                    return Err(invalid(format!("a face with {} corners", polygon.len())));
                }
                for pair in polygon[1..].windows(2) {
                    mesh.faces.push([polygon[0], pair[0], pair[1]]);
                    lines.push(number);
                }
            }
            _ => {}
        }
    }
    let count = mesh.vertices.len();
    for (face, line) in mesh.faces.iter().zip(lines) {
        if let Some(&bad) = face.iter().find(|&&v| v as usize >= count) {
            let message = format!("vertex {} of {count}", u64::from(bad) + 1);
            return Err(Error::invalid(file, &format!("line {line}"), message));
        }
    }
    if mesh.faces.is_empty() {
        return Err(Error::invalid(file, "faces", "no faces"));
    }
    Ok(mesh)
}
