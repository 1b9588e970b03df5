//! What a frame shows of the prior's vertices, and at which pixels of its mask that is somebody
//! else's.

use glam::Vec3;
use surface_query::vertex_normals;
use visibility::RayMesh;

use crate::Error;
use crate::capture::{Light, Pixels};
use crate::model::view::PosedView;
use crate::scene::labels::squared_distance;
use crate::scene::light::{Seen, albedo};
use crate::scene::pinhole::pinhole;

/// Pixels within a mask that may show what is beside the person, at most.
pub(crate) const MOST: usize = 4;
/// By how much more the colours of such pixels have to be wrong than those of the next farther
/// inside: bodies that do not quite fit make edges wrong too, but evenly so.
const STRANGE: f64 = 1.5;

/// What a frame shows of the vertices at pixels of the subject, by ray casting, and how many pixels
/// inside the mask that is, from 1.
pub(crate) fn seen(view: &PosedView, pixels: &Pixels, faces: &[[u32; 3]]) -> Result<Vec<(Seen, usize)>, Error> {
    let (camera, posed) = (&view.camera, &view.posed.vertices);
    let mesh = RayMesh::new(posed, faces)?;
    let usable: Vec<bool> = pixels.mask.iter().map(|&m| m > 0.5).collect();
    let visible = visibility::visible_vertices(&mesh, posed, &pinhole(camera), Some(&usable));
    let unusable: Vec<bool> = usable.iter().map(|usable| !usable).collect();
    let depth = squared_distance(&unusable, camera.width as usize);
    let normals = vertex_normals(posed, faces);
    let color = |v: usize| {
        let at = visible[v].then(|| camera.project(posed[v])).flatten()?;
        let pixel = at.y as usize * camera.width as usize + at.x as usize;
        let coverage = *pixels.mask.get(pixel)?;
        // Edge pixels are mixed with black in proportion to what the mask leaves free.
        let color = Vec3::from_slice(&pixels.image.pixels[3 * pixel..]) / coverage.max(0.5);
        Some(((v as u32, color, normals[v].normalize_or_zero()), (depth[pixel].sqrt() as usize).max(1)))
    };
    Ok((0..posed.len()).filter_map(color).collect())
}

/// What frames show more than so many pixels inside their masks.
pub(crate) fn deeper(frames: &[Vec<(Seen, usize)>], edge: usize) -> Vec<Vec<Seen>> {
    let deep = |frame: &Vec<(Seen, usize)>| frame.iter().filter(|seen| seen.1 > edge).map(|seen| seen.0).collect();
    frames.iter().map(deep).collect()
}

/// How many pixels at the edge of the masks show other colours of the vertices, under this light,
/// than what lies farther inside.
pub(crate) fn strange_edge(frames: &[Vec<(Seen, usize)>], light: Light, vertices: usize) -> usize {
    let inside = deeper(frames, MOST);
    let sums = albedo(inside.iter().flatten(), vertices, |normal| light.on(normal));
    let mut errors = [(0.0, 0u64); MOST + 2];
    for ((v, color, normal), depth) in frames.iter().flatten() {
        let (sum, squares) = sums[*v as usize];
        if squares > 0.0 {
            let error = &mut errors[(*depth).min(MOST + 1)];
            let squared = (sum / squares * light.on(*normal)).distance_squared(*color);
            *error = (error.0 + f64::from(squared), error.1 + 1);
        }
    }
    let means = errors.map(|(sum, count)| sum / count.max(1) as f64);
    (1..=MOST).take_while(|&depth| means[depth] > STRANGE * means[depth + 1]).last().unwrap_or(0)
}
