//! Draws a body in poses and shapes: `pose_picture [OUT.png [BODY.npz]]`.

use glam::{Mat3, Vec2, Vec3};
use image::{GrayImage, Luma, imageops};
use smpl::{BodyModel, Placement};

/// Side of a view and pixels per metre, before the picture is halved.
const SIDE: u32 = 480;
const SCALE: f32 = 280.0;
/// Joints of SMPL and their axis-angle rotations.
type Pose = &'static [(usize, Vec3)];
const WALK: Pose = &[(1, Vec3::new(-0.5, 0.0, 0.0)), (5, Vec3::X), (16, Vec3::new(0.3, 0.0, -1.2)), (17, Vec3::Z)];
const SIT: Pose = &[(1, Vec3::new(-1.5, 0.1, 0.0)), (2, Vec3::new(-1.5, 0.0, 0.0)), (4, Vec3::X), (5, Vec3::X)];

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let out = arguments.next().unwrap_or("poses.png".into());
    let body = arguments.next().map_or_else(|| Ok(BodyModel::embedded()), |path| BodyModel::load(path.as_ref()))?;
    let (heavy, slim): (&[f32], &[f32]) = (&[0.0, 2.0], &[1.0, -1.5, -2.0]);
    let views = [(&[][..], &[][..], 0.0), (WALK, &[], 0.7), (SIT, &[], 0.9), (WALK, heavy, 0.0), (WALK, slim, 0.0)];
    let mut sheet = GrayImage::from_pixel(SIDE * views.len() as u32, SIDE, Luma([245]));
    for (column, (rotations, betas, turn)) in views.into_iter().enumerate() {
        let mut pose = vec![Vec3::ZERO; body.num_joints()];
        rotations.iter().for_each(|&(joint, rotation)| pose[joint] = rotation);
        let posed = body.pose(&body.shaped(betas), &pose, Placement::default());
        let view: Vec<Vec3> = posed.vertices.iter().map(|&v| Mat3::from_rotation_y(turn) * v).collect();
        let centre = SIDE as f32 * Vec2::new(column as f32 + 0.5, 0.34);
        let mut depth = vec![f32::NEG_INFINITY; (sheet.width() * SIDE) as usize];
        for corners in body.faces.iter().map(|face| face.map(|v| view[v as usize])) {
            let normal = (corners[1] - corners[0]).cross(corners[2] - corners[0]).normalize_or_zero();
            let shade = 45.0 + 190.0 * normal.dot(Vec3::new(0.39, 0.49, 0.78)).max(0.0);
            let [a, b, c] = corners.map(|v| centre + SCALE * Vec2::new(v.x, -v.y));
            let (low, high) = (a.min(b).min(c).as_uvec2(), a.max(b).max(c).as_uvec2());
            for (x, y) in (low.x..=high.x).flat_map(|x| (low.y..=high.y.min(SIDE - 1)).map(move |y| (x, y))) {
                let p = Vec2::new(x as f32, y as f32) + 0.5;
                let inside = [(a, b), (b, c), (c, a)].iter().all(|(a, b)| (b - a).perp_dot(p - a) <= 0.0);
                let nearest = &mut depth[(y * sheet.width() + x.min(sheet.width() - 1)) as usize];
                if inside && x < sheet.width() && corners[0].z > *nearest {
                    *nearest = corners[0].z;
                    sheet.put_pixel(x, y, Luma([shade as u8]));
                }
            }
        }
    }
    imageops::resize(&sheet, sheet.width() / 2, SIDE / 2, imageops::FilterType::Triangle).save(out)?;
    Ok(())
}
