//! The paper's running counts against exact visibility on a real training: trains for some steps,
//! then compares how often each vertex was near a termination point with the number of training
//! frames that show it, by ray casting. Prints Spearman's rank correlation of the two as training
//! goes on and draws the body in both orders, red the least seen vertex and green the most: exact
//! from four sides above, counted below.
//!
//! Usage: `visibility_counts [OUT.png] [STEPS] [CAPTURE BODY]`; without a capture a small demo.

use std::error::Error;
use std::path::Path;

use glam::{Affine3A, Mat3, Vec3};
use occnerf::capture::{DemoConfig, Image, LoadOptions, demo, load_capture};
use occnerf::{Config, Method, PosedView, Preset, PriorRenderer, Renderer, Scene, Trainer, VertexColors};
use smpl::BodyModel;
use testkit::statistics::{ranks, spearman};
use volrender::Camera;

const SIZE: u32 = 240;

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let out = arguments.first().map_or("visibility_counts.png", String::as_str);
    let steps = arguments.get(1).map_or(Ok(200), |s| s.parse())?;
    let (capture, body) = if let [_, _, capture, body] = &arguments[..] {
        let body = BodyModel::load(Path::new(body))?;
        (load_capture(Path::new(capture), &body, &LoadOptions::default())?, body)
    } else {
        let body = BodyModel::embedded();
        (demo(&DemoConfig { size: 96, frames: 30, eval_cameras: 1, ..DemoConfig::default() }, &body)?, body)
    };
    let config = Config { steps, ..Config::preset(Preset::Fast, Method::Occnerf) };
    let scene = Scene::new(&capture, &body, &config)?;
    let start = std::time::Instant::now();
    let exact = scene.vertex_frequencies()?;
    println!("{} frames of {} vertices cast in {:.0?}", scene.train.len(), exact.len(), start.elapsed());
    let mut trainer = Trainer::new(&scene, config)?;
    for step in 1..=steps {
        trainer.step()?;
        if step == steps || (step % 50 == 0 && (step / 50).is_power_of_two()) {
            let counts = trainer.model().visibility_counts();
            let never = counts.iter().zip(&exact).filter(|(c, e)| **c > 0 && **e == 0).count();
            let missed = counts.iter().zip(&exact).filter(|(c, e)| **c == 0 && **e > 0).count();
            let agreement = spearman(&exact, counts);
            println!(
                "step {step}: Spearman {agreement:.3}; counted but never seen {never}, seen but never counted {missed}"
            );
        }
    }
    let rows: Result<Vec<Image>, Box<dyn Error>> = [&exact[..], trainer.model().visibility_counts()]
        .into_iter()
        .map(|counts| turnaround(&scene, counts))
        .collect();
    let rows = rows?;
    let pixels = rows.iter().flat_map(|row| row.pixels.iter().copied()).collect();
    Image { width: 4 * SIZE, height: 2 * SIZE, pixels }.save_png(Path::new(out))?;
    println!("{out}");
    Ok(())
}

/// The body at rest in the colours of its counts' ranks, from four sides.
fn turnaround(scene: &Scene, counts: &[u64]) -> Result<Image, Box<dyn Error>> {
    let share = |rank: f64| (rank / counts.len() as f64) as f32;
    let colour = |share: f32| Vec3::new((2.0 - 2.0 * share).min(1.0), (1.7 * share).min(0.85), 0.15);
    let colors = ranks(counts).into_iter().map(|r| colour(share(r))).collect();
    let colors = VertexColors { colors, seen: vec![true; counts.len()] };
    let mut renderer = PriorRenderer::new(&scene.body, &colors);
    let body = scene.body.rest();
    let middle = body.joints.iter().sum::<Vec3>() / body.joints.len() as f32;
    let (focal, centre) = (SIZE as f32 * 1.15, SIZE as f32 / 2.0);
    let intrinsics = Mat3::from_cols(Vec3::X * focal, Vec3::Y * focal, Vec3::new(centre, centre, 1.0));
    let mut pixels = vec![1.0; (3 * 4 * SIZE * SIZE) as usize];
    for side in 0..4u8 {
        let angle = f32::from(side) * std::f32::consts::FRAC_PI_2;
        let eye = middle + 2.6 * Vec3::new(angle.sin(), 0.1, angle.cos());
        let forward = (middle - eye).normalize_or(Vec3::Z);
        let right = forward.cross(Vec3::Y).normalize_or(Vec3::X);
        let rotation = Mat3::from_cols(right, forward.cross(right), forward).transpose();
        let extrinsics = Affine3A::from_mat3_translation(rotation, rotation * -eye);
        let camera = Camera::new(intrinsics, extrinsics, SIZE, SIZE)?;
        let picture = renderer.render(&PosedView::new(&camera, body.clone()), Vec3::ONE)?.image.pixels;
        for (y, row) in picture.chunks_exact(3 * SIZE as usize).enumerate() {
            pixels[3 * SIZE as usize * (4 * y + usize::from(side))..][..row.len()].copy_from_slice(row);
        }
    }
    Ok(Image { width: 4 * SIZE, height: SIZE, pixels })
}
