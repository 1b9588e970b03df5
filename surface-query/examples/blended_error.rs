//! How far the paper's blended distance is from the exact one, by region of a body in T-pose: a
//! table of points spread evenly within 5 cm of the skin, and two pictures: the body coloured by
//! the mean error around it, front and back, and a slice through armpits and crotch.
//!
//! `blended_error [FOLDER] [BODY.npz]`: writes `blended_error.png` and `blended_slice.png` into
//! FOLDER (default `.`). Without BODY, the embedded body of `smpl`.

use std::path::{Path, PathBuf};

use glam::Vec3;
use image::{Rgb, RgbImage};
use smpl::BodyModel;
use surface_query::{MeshDistance, SurfaceQuery, SurfaceQueryConfig};

/// How far from the skin points are judged, metres.
const REACH: f32 = 0.05;
/// Points tried, before those too far away are left out.
const POINTS: u32 = 6_000_000;
/// An error shown in full red.
const FULL: f32 = 0.004;

/// Whether a point belongs to a region, given the joints.
type Holds = fn(Vec3, &[Vec3]) -> bool;

/// Regions by SMPL's joints, first match counts; lengths in metres.
const REGIONS: [(&str, Holds); 5] = [
    ("armpits: 9 cm about a point 8 cm below a shoulder", |x, joints| {
        [16, 17].iter().any(|&shoulder| x.distance(joints[shoulder] - Vec3::Y * 0.08) < 0.09)
    }),
    ("hands: more than 5 cm beyond a wrist", |x, joints| x.x > joints[20].x + 0.05 || x.x < joints[21].x - 0.05),
    ("between the legs: 7 cm about the middle, from the hips to 30 cm below", |x, joints| {
        let hips = (joints[1] + joints[2]) / 2.0;
        (x.x - hips.x).abs() < 0.07 && x.y < hips.y && x.y > hips.y - 0.3
    }),
    ("neck and ears: above the neck joint, up to 8 cm above the head joint, not in front of it", |x, joints| {
        x.y > joints[12].y && x.y < joints[15].y + 0.08 && x.z < joints[15].z + 0.02 && x.x.abs() < 0.15
    }),
    ("elsewhere", |_, _| true),
];

/// Errors of the points of one region.
#[derive(Default)]
struct Errors {
    absolute: Vec<f32>,
    wrong_sign: usize,
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let folder = PathBuf::from(arguments.next().unwrap_or(".".into()));
    let model = match arguments.next() {
        Some(path) => BodyModel::load(Path::new(&path))?,
        None => BodyModel::embedded(),
    };
    let body = model.shaped(&[]);
    let exact = MeshDistance::new(&body.vertices, &model.faces)?;
    let surface = SurfaceQuery::new(&body.vertices, &model.faces, &SurfaceQueryConfig::BODY)?;
    let mut neighbours = vec![0; surface.neighbours_per_query()];
    let mut blended = |x: Vec3| {
        surface.neighbours(x, &mut neighbours);
        surface.blend(x, &neighbours[..5]).signed_distance
    };

    let low = body.vertices.iter().copied().fold(Vec3::MAX, Vec3::min) - REACH;
    let high = body.vertices.iter().copied().fold(Vec3::MIN, Vec3::max) + REACH;
    let mut regions: [Errors; REGIONS.len()] = Default::default();
    // Mean error about each vertex: sum and weight.
    let mut about = vec![(0.0f32, 0.0f32); body.vertices.len()];
    for i in 1..=POINTS {
        // An additive recurrence that fills the box evenly (Roberts 2018).
        let share = |step: f64| (f64::from(i) * step).fract() as f32;
        let at = Vec3::new(share(0.819_172_513_4), share(0.671_043_606_7), share(0.549_700_477_9));
        let x = low + (high - low) * at;
        let Some(closest) = exact.closest(x, REACH) else {
            continue;
        };
        let d = blended(x);
        let error = (d - closest.signed_distance).abs();
        let region = REGIONS.iter().position(|(_, holds)| holds(x, &body.joints)).unwrap_or(0);
        regions[region].absolute.push(error);
        regions[region].wrong_sign += usize::from((d < 0.0) != (closest.signed_distance < 0.0));
        for (v, weight) in model.faces[closest.face as usize].into_iter().zip(closest.barycentric) {
            let (sum, total) = &mut about[v as usize];
            *sum += weight * error;
            *total += weight;
        }
    }

    println!("| region | points | mean | 95 % | max | wrong sign |\n| --- | ---: | ---: | ---: | ---: | ---: |");
    for ((name, _), mut errors) in REGIONS.into_iter().zip(regions) {
        let n = errors.absolute.len();
        if n == 0 {
            continue;
        }
        errors.absolute.sort_unstable_by(f32::total_cmp);
        let mean = errors.absolute.iter().map(|&e| f64::from(e)).sum::<f64>() / n as f64;
        let [p95, max] = [n * 95 / 100, n - 1].map(|at| errors.absolute[at] * 1e3);
        let wrong = errors.wrong_sign as f32 / n as f32 * 100.0;
        println!("| {name} | {n} | {:.2} mm | {p95:.2} mm | {max:.1} mm | {wrong:.2} % |", mean * 1e3);
    }

    let errors: Vec<f32> = about.into_iter().map(|(sum, total)| sum / total.max(1e-6)).collect();
    let path = folder.join("blended_error.png");
    portraits(&exact, &model.faces, &errors, low, high).save(&path)?;
    println!("{}: front and back, red from {} mm", path.display(), FULL * 1e3);
    let path = folder.join("blended_slice.png");
    slice(&exact, blended, body.joints[1].z, low, high).save(&path)?;
    println!(
        "{}: error in a slice, white 0 mm, red {} mm, black lines where a sign changes",
        path.display(),
        FULL * 5e3
    );
    Ok(())
}

/// White to red, in sixteen steps.
fn heat(error: f32) -> Vec3 {
    let t = (error / FULL * 16.0).round().clamp(0.0, 16.0) / 16.0;
    Vec3::new(1.0, 1.0 - 0.9 * t, 0.95 - 0.9 * t)
}

fn pixel(colour: Vec3) -> Rgb<u8> {
    Rgb(colour.to_array().map(|c| (c.clamp(0.0, 1.0) * 255.0) as u8))
}

/// Front and back side by side, parallel projection, by sphere tracing.
fn portraits(mesh: &MeshDistance, faces: &[[u32; 3]], errors: &[f32], low: Vec3, high: Vec3) -> RgbImage {
    let size = high - low;
    let width = 360;
    let height = (width as f32 * size.y / size.x) as u32;
    RgbImage::from_fn(2 * width, height, |column, row| {
        let side = if column < width { 1.0 } else { -1.0 };
        let across = side * (((column % width) as f32 + 0.5) / width as f32 - 0.5);
        let (middle, down) = ((low + high) / 2.0, (row as f32 + 0.5) / height as f32);
        let mut x = Vec3::new(middle.x + across * size.x, high.y - down * size.y, middle.z + side * size.z / 2.0);
        let mut travelled = 0.0;
        while travelled < size.z {
            let Some(closest) = mesh.closest(x, f32::INFINITY) else { break };
            if closest.signed_distance < 5e-4 {
                let corners = faces[closest.face as usize].into_iter().zip(closest.barycentric);
                let error = corners.map(|(v, weight)| weight * errors[v as usize]).sum();
                let normal = (x - closest.point).normalize_or(Vec3::Z * side);
                return pixel(heat(error) * (0.35 + 0.65 * (normal.z * side).max(0.0)));
            }
            x.z -= side * closest.signed_distance;
            travelled += closest.signed_distance;
        }
        Rgb([255; 3])
    })
}

/// The error at depth `z` within 10 cm of the skin, from the head to below the crotch; inside is
/// darker.
fn slice(mesh: &MeshDistance, mut blended: impl FnMut(Vec3) -> f32, z: f32, low: Vec3, high: Vec3) -> RgbImage {
    let (width, scale) = (480, (high.x - low.x) / 480.0);
    let height = (1.15 / scale) as u32;
    RgbImage::from_fn(width, height, |column, row| {
        let x = Vec3::new(low.x + (column as f32 + 0.5) * scale, high.y - (row as f32 + 0.5) * scale, z);
        let Some(closest) = mesh.closest(x, 2.0 * REACH) else {
            return Rgb([255; 3]);
        };
        let (d, b) = (closest.signed_distance, blended(x));
        if (d < 0.0) != (b < 0.0) {
            return Rgb([0; 3]);
        }
        pixel(heat((d - b).abs() / 5.0) * if d < 0.0 { 0.75 } else { 1.0 })
    })
}
