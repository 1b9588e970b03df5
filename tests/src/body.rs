//! A mesh of realistic size for tests, benches and the example: the shared open body where it is at
//! hand.
#![allow(clippy::unwrap_used, reason = "a failure here is a failed test")]

use std::io::Read;

use crate::files::shared;
use crate::{TriMesh, mesh};
use glam::Vec3;

/// The open body, 6890 vertices in metres; `None`, with the reason printed, where the file is not
/// there.
///
/// # Panics
/// If it is misread.
#[must_use]
pub fn open_body() -> Option<TriMesh> {
    let path = shared("body/open_body.npz")?;
    let file = std::fs::File::open(&path).unwrap();
    let mut archive = zip::ZipArchive::new(file).unwrap();
    let mut rows = |name: &str| {
        let mut bytes = Vec::new();
        (archive.by_name(name).unwrap()).read_to_end(&mut bytes).unwrap();
        // Magic (6), version (2), header length (2), header; then little-endian data.
        let start = 10 + usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
        let by_columns = String::from_utf8_lossy(&bytes[..start]).contains("'fortran_order': True");
        let words: Vec<[u8; 4]> = bytes[start..].chunks_exact(4).map(|w| w.try_into().unwrap()).collect();
        let n = words.len() / 3;
        let (row, column) = if by_columns { (1, n) } else { (3, 1) };
        (0..n).map(|i| [0, 1, 2].map(|j| words[i * row + j * column])).collect::<Vec<_>>()
    };
    let mesh = TriMesh {
        vertices: (rows("v_template.npy").into_iter()).map(|v| Vec3::from(v.map(f32::from_le_bytes))).collect(),
        faces: (rows("f.npy").into_iter()).map(|f| f.map(u32::from_le_bytes)).collect(),
    };
    assert!(mesh.is_closed(), "{} was misread", path.display());
    Some(mesh)
}

/// The open body, or a bumpy ball of similar size and resolution.
pub fn body_or_ball() -> TriMesh {
    open_body().unwrap_or_else(|| mesh::icosphere(5).map(|p| p * (0.4 + 0.05 * (7.0 * p.x).sin() * (9.0 * p.y).cos())))
}

/// Splitmix64: the same on every machine.
pub struct Random(pub u64);

impl Random {
    /// Any number.
    pub fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// Below `end`; 0 for 0.
    pub fn below(&mut self, end: usize) -> usize {
        (self.bits() % end.max(1) as u64) as usize
    }

    /// Uniform in [0, 1).
    pub fn unit(&mut self) -> f32 {
        (self.bits() >> 40) as f32 / (1u64 << 24) as f32
    }

    /// Uniform in the cube ±`range`.
    pub fn vec3(&mut self, range: f32) -> Vec3 {
        Vec3::new(self.unit(), self.unit(), self.unit()) * (2.0 * range) - range
    }

    /// `n` points at most `distance` from random places of the surface.
    pub fn near_surface(&mut self, mesh: &TriMesh, n: usize, distance: f32) -> Vec<Vec3> {
        (0..n)
            .map(|_| {
                let face = mesh.faces[(self.unit() * mesh.faces.len() as f32) as usize];
                let [a, b, c] = face.map(|i| mesh.vertices[i as usize]);
                let (u, v) = (self.unit(), self.unit());
                let (u, v) = if u + v > 1.0 { (1.0 - u, 1.0 - v) } else { (u, v) };
                let offset = self.vec3(1.0).normalize_or(Vec3::X) * (distance * self.unit());
                a + (b - a) * u + (c - a) * v + offset
            })
            .collect()
    }
}
