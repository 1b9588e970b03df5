//! Fits the embedded body to joints (T, J, 3) of a `.npy` file: `fit_points JOINTS.npy coco17`.

use glam::Vec3;
use point_fit::{fit, joint_set, joint_sets};
use smpl::BodyModel;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let usage = || format!("usage: fit_points JOINTS.npy {}", joint_sets().join("|"));
    let mut arguments = std::env::args().skip(1);
    let (Some(path), Some(set)) = (arguments.next(), arguments.next()) else { return Err(usage().into()) };
    let body = BodyModel::embedded();
    let set = joint_set(&body, &set).ok_or_else(usage)?;
    let array = array_files::npz::read_npy(path.as_ref())?;
    if array.shape.len() != 3 || array.shape[1..] != [set.len(), 3] {
        return Err(format!("expected shape [frames, {}, 3], found {:?}", set.len(), array.shape).into());
    }
    // Without the points that the body does not have.
    let values = array.to_f64();
    let rows = values.chunks_exact(3).map(|p| Vec3::new(p[0] as f32, p[1] as f32, p[2] as f32));
    let seen: Vec<Vec3> = rows.zip(set.iter().cycle()).filter(|(_, anchor)| anchor.is_some()).map(|(p, _)| p).collect();
    let anchors: Vec<_> = set.into_iter().flatten().collect();
    let fitted = fit(&body, &anchors, &seen)?;
    println!("noise {:.1} mm, betas {:.2?}", 1e3 * fitted.noise, fitted.betas);
    for (i, frame) in fitted.frames.iter().enumerate() {
        let swapped = if frame.swapped { ", left and right exchanged" } else { "" };
        let off = frame.distance.map_or("no points".to_owned(), |d| format!("{:.1} mm off", 1e3 * d));
        println!("{i}: at {:.3}, {off}{swapped}", frame.translation);
    }
    Ok(())
}
