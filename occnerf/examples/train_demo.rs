//! Trains a person for a hundred steps on a small demo capture and draws them from a side that no
//! training frame shows: on the left the truth, on the right the model.
//!
//! Usage: `train_demo [OUT.png]`.

use std::error::Error;
use std::path::PathBuf;

use glam::Vec3;
use occnerf::capture::{DemoConfig, Image, demo};
use occnerf::{Config, FieldRenderer, Method, PreparedFrame, Preset, Renderer, Scene, Trainer, evaluate};

const STEPS: u64 = 100;
/// Dark clothes and empty space differ on it.
const GREY: f32 = 0.35;

fn main() -> Result<(), Box<dyn Error>> {
    let out = std::env::args_os().nth(1).map_or_else(|| PathBuf::from("train_demo.png"), PathBuf::from);
    let body = smpl::BodyModel::embedded();
    let capture = demo(&DemoConfig { size: 96, frames: 20, eval_cameras: 2, ..DemoConfig::default() }, &body)?;
    let mut config = Config::preset(Preset::Fast, Method::Occnerf);
    config.steps = STEPS;
    let scene = Scene::new(&capture, &body, &config)?;
    let mut trainer = Trainer::new(&scene, config)?;
    println!("{} parameters, {} frames", trainer.model().num_parameters(), scene.train.len());
    for _ in 0..STEPS {
        let report = trainer.step()?;
        if report.step % 20 == 0 {
            println!("step {:4}  loss {:.3}  {:.1} dB in training", report.step, report.loss, report.psnr);
        }
    }

    let view = &scene.eval[0];
    let mut renderer = FieldRenderer::new(trainer.model())?;
    let scores = evaluate(&scene, &mut renderer, &[view], |_, _| {})?;
    if let Some(psnr) = scores.psnr_mask {
        println!("{} {}: {psnr:.1} dB over the subject", view.camera_name, view.name);
    }
    let rendering = renderer.render(&view.view, Vec3::splat(GREY))?;
    side_by_side(&truth(view)?, &rendering.image).save_png(&out)?;
    println!("{}", out.display());
    Ok(())
}

/// The frame over grey.
fn truth(frame: &PreparedFrame) -> Result<Image, occnerf::Error> {
    let shown = frame.pixels()?;
    let each = shown.image.pixels.chunks_exact(3).zip(&shown.mask);
    let pixels = each.flat_map(|(p, m)| p.iter().map(move |c| c + (1.0 - m) * GREY)).collect();
    Ok(Image { width: frame.view.camera.width, height: frame.view.camera.height, pixels })
}

fn side_by_side(left: &Image, right: &Image) -> Image {
    let row = 3 * left.width as usize;
    let rows = left.pixels.chunks_exact(row).zip(right.pixels.chunks_exact(row));
    let pixels = rows.flat_map(|(l, r)| l.iter().chain(r).copied()).collect();
    Image { width: 2 * left.width, height: left.height, pixels }
}
