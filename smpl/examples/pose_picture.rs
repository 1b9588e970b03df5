//! Draws a body in poses and shapes: `pose_picture [OUT.png [BODY.npz]]`.

use glam::{Mat3, Vec2, Vec3};
use image::{GrayImage, Luma, imageops};
use smpl::{BodyModel, Placement};

/// Width and height of a view, pixels, before it is halved, and pixels per metre.
const VIEW: [u32; 2] = [480, 640];
const SCALE: f32 = 330.0;
/// Axis-angle rotations of SMPL's joints.
const WALK: &[(usize, [f32; 3])] =
    &[(1, [-0.5, 0.0, 0.0]), (2, [0.4, 0.0, 0.0]), (5, [0.7, 0.0, 0.0]), (16, [0.3, 0.0, -1.2]), (17, [0.0, 0.0, 1.2])];
const SIT: &[(usize, [f32; 3])] = &[
    (1, [-1.5, 0.1, 0.0]),
    (2, [-1.5, -0.1, 0.0]),
    (4, [1.6, 0.0, 0.0]),
    (5, [1.6, 0.0, 0.0]),
    (18, [0.0, -1.8, 0.0]),
];

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let out = arguments.next().unwrap_or("poses.png".into());
    let body = arguments.next().map_or_else(|| Ok(BodyModel::embedded()), |path| BodyModel::load(path.as_ref()))?;
    let views: [(_, &[f32], f32); 5] = [
        (&[][..], &[], 0.0),
        (WALK, &[], 0.7),
        (SIT, &[], 0.9),
        (WALK, &[0.0, 2.0], 0.0),
        (WALK, &[1.0, -1.5, -2.0], 0.0),
    ];
    let mut sheet = GrayImage::from_pixel(VIEW[0] * views.len() as u32, VIEW[1], Luma([245]));
    for (column, (rotations, betas, turn)) in views.into_iter().enumerate() {
        let mut pose = vec![Vec3::ZERO; body.num_joints()];
        rotations.iter().for_each(|&(joint, rotation)| pose[joint] = rotation.into());
        let posed = body.pose(&body.shaped(betas), &pose, Placement::default());
        let view: Vec<Vec3> = posed.vertices.iter().map(|&v| Mat3::from_rotation_y(turn) * v).collect();
        let centre = Vec2::new((column as f32 + 0.5) * VIEW[0] as f32, 0.38 * VIEW[1] as f32);
        let mut depth = vec![f32::NEG_INFINITY; (sheet.width() * sheet.height()) as usize];
        for corners in body.faces.iter().map(|face| face.map(|v| view[v as usize])) {
            let normal = (corners[1] - corners[0]).cross(corners[2] - corners[0]).normalize_or_zero();
            let shade = 45.0 + 190.0 * normal.dot(Vec3::new(0.4, 0.5, 0.8).normalize_or_zero()).max(0.0);
            let [a, b, c] = corners.map(|v| centre + SCALE * Vec2::new(v.x, -v.y));
            let (low, high) = (a.min(b).min(c), a.max(b).max(c));
            for (x, y) in
                (low.x as u32..=high.x as u32).flat_map(|x| (low.y as u32..=high.y as u32).map(move |y| (x, y)))
            {
                let p = Vec2::new(x as f32, y as f32) + 0.5;
                let inside = [(a, b), (b, c), (c, a)].iter().all(|(a, b)| (*b - *a).perp_dot(p - *a) <= 0.0);
                let z = &mut depth[(y.min(VIEW[1] - 1) * sheet.width() + x.min(sheet.width() - 1)) as usize];
                if inside && corners[0].z > *z && x < sheet.width() && y < VIEW[1] {
                    *z = corners[0].z;
                    sheet.put_pixel(x, y, Luma([shade as u8]));
                }
            }
        }
    }
    imageops::resize(&sheet, sheet.width() / 2, sheet.height() / 2, imageops::FilterType::Triangle).save(out)?;
    Ok(())
}
