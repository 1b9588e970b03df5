//! Undistortion of pictures.

use glam::Vec2;
use volrender::{Camera, Distortion};

/// Undistorts `source` (H, W, channels) of `camera` with `distortion`: bilinear, 0 beyond the
/// border and where the distortion model folds back.
pub(super) fn undistort(source: Vec<f32>, channels: usize, camera: &Camera, distortion: &Distortion) -> Vec<f32> {
    if distortion.is_identity() {
        return source;
    }
    let (width, height) = (camera.width as usize, camera.height as usize);
    let fold = distortion.fold_radius();
    let mut out = vec![0.0; source.len()];
    for row in 0..height {
        for column in 0..width {
            let ideal = Vec2::new(column as f32 + 0.5, row as f32 + 0.5);
            if ((ideal - camera.centre) / camera.focal).length() >= fold {
                continue;
            }
            let at = camera.distort_pixel(distortion, ideal) - Vec2::splat(0.5);
            let reach = Vec2::new(width as f32, height as f32);
            if !(at.cmpgt(Vec2::NEG_ONE).all() && at.cmplt(reach).all()) {
                continue;
            }
            let corner = at.floor();
            let fraction = at - corner;
            for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
                let (x, y) = (corner.x as i64 + dx, corner.y as i64 + dy);
                if x < 0 || y < 0 || x >= width as i64 || y >= height as i64 {
                    continue;
                }
                let weight = if dx == 1 { fraction.x } else { 1.0 - fraction.x }
                    * if dy == 1 { fraction.y } else { 1.0 - fraction.y };
                let from = (y as usize * width + x as usize) * channels;
                let to = (row * width + column) * channels;
                for c in 0..channels {
                    out[to + c] += weight * source[from + c];
                }
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use glam::{Affine3A, Mat3, Vec3};

    use super::*;

    fn camera() -> Camera {
        let k = Mat3::from_cols(Vec3::X * 60.0, Vec3::Y * 60.0, Vec3::new(32.0, 24.0, 1.0));
        Camera::new(k, Affine3A::IDENTITY, 64, 48).unwrap()
    }

    #[test]
    fn nothing_is_shown_twice() {
        // r − 0.8 r³ turns at r = 0.645; the corner of the picture is at 0.667.
        let distortion = Distortion::from_opencv([-0.8, 0.0, 0.0, 0.0, 0.0]);
        let out = undistort(vec![1.0; 64 * 48], 1, &camera(), &distortion);
        assert_eq!((out[0], out[24 * 64]), (0.0, 1.0));
    }

    #[test]
    fn what_the_lens_never_saw_is_empty() {
        // Pincushion: ideal corners lie outside the photograph.
        let distortion = Distortion::from_opencv([0.5, 0.0, 0.0, 0.0, 0.0]);
        let (image, mask) = (vec![1.0; 64 * 48 * 3], vec![1.0; 64 * 48]);
        let (image, mask) = (undistort(image, 3, &camera(), &distortion), undistort(mask, 1, &camera(), &distortion));
        assert_eq!((mask[0], &image[..3]), (0.0, &[0.0; 3][..]));
        assert!((mask[24 * 64 + 32] - 1.0).abs() < 1e-6);
    }
}
