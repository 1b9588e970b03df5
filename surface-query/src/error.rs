use glam::Vec3;

/// Why a mesh or a configuration is refused.
///
/// ```
/// let refused = surface_query::MeshDistance::new(&[glam::Vec3::ZERO], &[[0, 0, 1]]).unwrap_err();
/// assert_eq!(refused.to_string(), "face 0 has vertex index 1, but there are only 1 vertices");
/// ```
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{0}")]
pub struct Error(pub(crate) String);

/// Checks what every structure of this crate relies on.
pub(crate) fn check_mesh(vertices: &[Vec3], faces: &[[u32; 3]]) -> Result<(), Error> {
    let count = vertices.len();
    let most = count.max(faces.len());
    if most > 1 << 31 {
        return Err(Error(format!("{most} elements, at most 2^31 are supported")));
    }
    if let Some(vertex) = vertices.iter().position(|v| !v.is_finite()) {
        return Err(Error(format!("vertex {vertex} is not finite")));
    }
    for (face, corners) in faces.iter().enumerate() {
        if let Some(vertex) = corners.iter().find(|&&v| v as usize >= count) {
            let message = format!("face {face} has vertex index {vertex}, but there are only {count} vertices");
            return Err(Error(message));
        }
    }
    Ok(())
}
