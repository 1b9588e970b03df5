//! Cameras as the visibility crate takes them.

use visibility::View;
use volrender::Camera;

/// The pinhole view that the visibility crate asks for.
pub(crate) fn pinhole(camera: &Camera) -> View {
    View {
        intrinsics: camera.intrinsics(),
        extrinsics: camera.world_to_camera,
        width: camera.width,
        height: camera.height,
    }
}
