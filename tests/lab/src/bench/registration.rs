//! `bench registration`: what registration makes of priors that are wrong on purpose, against the
//! bodies that the demo was filmed with.

use std::path::PathBuf;
use std::time::Instant;

use anyhow::{Context, Result};
use clap::Args;
use glam::Quat;
use occnerf::capture::{Capture, Mended, Registered};
use occnerf::{Config, Method, PreparedFrame, Preset, PriorColors, PriorRenderer, Scene, evaluate, register};
use smpl::BodyModel;
use synth::{DemoConfig, Perturbation, demo};

use crate::results::{self, Section};
use xtask::process::say;
use xtask::run::{use_threads, write};
use xtask::table;

#[derive(Args)]
pub struct RegistrationArguments {
    /// Where to write
    #[arg(long, default_value = "runs/bench-registration")]
    out: PathBuf,
    /// Pixels a side of the demo's pictures
    #[arg(long, default_value_t = DemoConfig::default().size)]
    side: u32,
    /// Rounds [default: those of `fast`]
    #[arg(long)]
    rounds: Option<usize>,
    /// Only these priors, comma separated [default: all]
    #[arg(long, value_delimiter = ',')]
    priors: Vec<String>,
    /// Threads [default: all cores]
    #[arg(long)]
    threads: Option<usize>,
    /// Make what is found a section of tests/lab/RESULTS.md
    #[arg(long)]
    publish: bool,
}

/// What is wrong beside what the demo's prior has wrong anyway; the first has nothing wrong at all.
const PRIORS: [(&str, Perturbation); 10] = {
    let none = Perturbation::NONE;
    [
        ("right", none),
        ("demo", none),
        ("pose 3°", Perturbation { pose_degrees: 3.0, ..none }),
        ("pose 5°", Perturbation { pose_degrees: 5.0, ..none }),
        ("shape 1 σ", Perturbation { shape: 1.0, ..none }),
        ("place 3 cm", Perturbation { translation: 0.03, ..none }),
        ("depth 3 %", Perturbation { depth_percent: 3.0, ..none }),
        ("limbs 5 %", Perturbation { limbs_percent: 5.0, ..none }),
        ("masks ± 2 px", Perturbation { ragged_pixels: 2.0, ..none }),
        ("real", Perturbation::REAL),
    ]
};

/// psnr_mask of unseen views of the body as it is, in the mean colours that frames show of it under
/// the light of the video.
fn psnr(registered: Registered, model: &BodyModel) -> Result<f64> {
    let mut config = Config::preset(Preset::Fast, Method::Prior);
    config.registration.rounds = 0;
    let scene = Scene::prepare(registered, model, &config)?;
    let colors = PriorColors::measure(&scene)?;
    let frames: Vec<&PreparedFrame> = scene.eval.iter().collect();
    let scores = evaluate(&scene, &mut PriorRenderer::new(&scene.body, &colors), &frames, None, |_, _| {})?;
    scores.psnr_mask.context("no unseen view shows the person")
}

/// Runs the bench.
pub fn registration(arguments: &RegistrationArguments) -> Result<()> {
    use_threads(arguments.threads)?;
    let known = PRIORS.map(|(name, _)| name).join(", ");
    let asked = |name: &str| arguments.priors.is_empty() || arguments.priors.iter().any(|p| p.trim() == name);
    let unknown = arguments.priors.iter().find(|p| PRIORS.iter().all(|(name, _)| *name != p.trim()));
    anyhow::ensure!(unknown.is_none(), "--priors {}: there are {known}", unknown.map_or("", String::as_str));
    let rounds = arguments.rounds.unwrap_or(Config::preset(Preset::Fast, Method::Occnerf).registration.rounds);
    let given = DemoConfig { size: arguments.side, ..DemoConfig::default() };
    let exact = DemoConfig { pose_noise_degrees: 0.0, translation_noise: 0.0, beta_noise: 0.0, ..given };
    let body = BodyModel::embedded();
    let truth = demo(&exact, &body)?;
    let header = [
        "prior",
        "° shown",
        "after",
        "° hidden",
        "after",
        "mm shown",
        "after",
        "mm hidden",
        "after",
        "px shown",
        "after",
        "dB",
        "after",
        "of what the truth gains",
        "seconds",
    ];
    let mut lines = vec![header.map(str::to_owned).to_vec()];
    // Registration also finds clothes, which the true bodies lack.
    let best_with = |masks: &Perturbation| -> Result<f64> {
        let mut best = truth.clone();
        masks.apply(&mut best, &body)?;
        psnr(register(Mended::from(best), &body, rounds)?, &body)
    };
    let exact = best_with(&Perturbation::NONE)?;
    for (index, (name, wrong)) in PRIORS.iter().enumerate().filter(|(_, (name, _))| asked(name)) {
        let (mut capture, mut model) = (if index == 0 { truth.clone() } else { demo(&given, &body)? }, body.clone());
        wrong.apply(&mut capture, &model)?;
        wrong.spoil_body(&mut model);
        let before = Error::measure((&truth, &body), (&capture, &model))?;
        let given_psnr = psnr(capture.clone().into(), &model)?;
        let start = Instant::now();
        let registered = register(Mended::from(capture), &model, rounds)?;
        let seconds = start.elapsed().as_secs_f64();
        let after = Error::measure((&truth, &body), (&registered.capture, &model))?;
        let mut line = vec![(*name).to_owned()];
        for (before, after) in before.rows().into_iter().zip(after.rows()) {
            line.extend([format!("{before:.2}"), format!("{after:.2}")]);
        }
        let found_psnr = psnr(registered, &model)?;
        let Perturbation { ragged_pixels, mask_pixels, .. } = *wrong;
        let masks = Perturbation { ragged_pixels, mask_pixels, ..Perturbation::NONE };
        let best = if masks == Perturbation::NONE { exact } else { best_with(&masks)? };
        let gained = (found_psnr - given_psnr) / (best - given_psnr);
        let gained = if best - given_psnr > 0.1 { format!("{:.0} %", 100.0 * gained) } else { "–".to_owned() };
        line.extend([format!("{given_psnr:.2}"), format!("{found_psnr:.2}"), gained, format!("{seconds:.1}")]);
        say!("{}", line.join(" | "));
        lines.push(line);
    }
    let side = arguments.side;
    let text = format!(
        "Root mean square errors of the demo's joints in all {} frames of {side} × {side} pixels, against the bodies that it \
         was filmed with, before and after {} rounds: turns of bones in the world, places in the world, places in the \
         picture. A joint is shown where the pixel that it falls on shows the person, hidden where it does not. dB: \
         psnr_mask of unseen views of the body in the mean colours that frames show of its vertices, {exact:.2} \
         with the true bodies, registered too, which finds their clothes; what the truth gains is with masks as wrong. \
         `demo` is the prior as the demo gives it; what is below comes on top of that.\n\n{}",
        truth.train.len(),
        rounds,
        table::aligned(&lines, 1)
    );
    std::fs::create_dir_all(&arguments.out)?;
    write(&arguments.out.join("registration.md"), &text)?;
    say!("\n{text}");
    if arguments.publish {
        let title = "What registration recovers";
        results::publish(&Section { name: "registration", title, body: &text, charts: &[] })?;
    }
    Ok(())
}

/// Squared errors of joints that frames show, and of those that they hide.
#[derive(Default)]
struct Error {
    shown: Sums,
    hidden: Sums,
}

#[derive(Default)]
struct Sums {
    count: f64,
    /// Radians.
    turn: f64,
    /// Metres.
    place: f64,
    /// Pixels.
    pixels: f64,
}

impl Error {
    /// Compares two captures of the same frames.
    fn measure(truth: (&Capture, &BodyModel), found: (&Capture, &BodyModel)) -> Result<Self> {
        let mut error = Self::default();
        for (a, b) in truth.0.train.iter().zip(&found.0.train) {
            let posed = |frame: &occnerf::capture::Frame, body: &BodyModel| {
                body.pose(&body.shaped(&frame.betas), &frame.pose, frame.placement)
            };
            let (x, y) = (posed(a, truth.1), posed(b, found.1));
            let pixels = a.pixels()?;
            for (j, (from, to)) in x.joints.iter().zip(&y.joints).enumerate() {
                let (Some(p), Some(q)) = (a.camera.project(*from), a.camera.project(*to)) else { continue };
                let (p, q) = (p.truncate(), q.truncate());
                let within = p.x >= 0.0 && p.y >= 0.0 && p.x < a.camera.width as f32 && p.y < a.camera.height as f32;
                let shown = within && pixels.mask[p.y as usize * a.camera.width as usize + p.x as usize] > 0.5;
                let turn = Quat::from_mat3a(&(y.bones[j].matrix3 * x.bones[j].matrix3.inverse()));
                let sums = if shown { &mut error.shown } else { &mut error.hidden };
                sums.count += 1.0;
                sums.turn += f64::from(turn.normalize().to_scaled_axis().length_squared());
                sums.place += f64::from(from.distance_squared(*to));
                sums.pixels += f64::from(p.distance_squared(q));
            }
        }
        Ok(error)
    }

    /// Degrees of joints shown and hidden, millimetres of joints shown and hidden, pixels.
    fn rows(&self) -> [f64; 5] {
        let root = |sums: &Sums, pick: fn(&Sums) -> f64| (pick(sums) / sums.count.max(1.0)).sqrt();
        let [turn, place]: [fn(&Sums) -> f64; 2] = [|s| s.turn, |s| 1e6 * s.place];
        [
            root(&self.shown, turn).to_degrees(),
            root(&self.hidden, turn).to_degrees(),
            root(&self.shown, place),
            root(&self.hidden, place),
            root(&self.shown, |s| s.pixels),
        ]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_are_those_that_were_made_and_none_of_what_is_right() {
        let body = BodyModel::embedded();
        let none =
            DemoConfig { pose_noise_degrees: 0.0, translation_noise: 0.0, beta_noise: 0.0, ..Default::default() };
        let truth = demo(&DemoConfig { size: 48, frames: 12, eval_cameras: 1, ..none }, &body).unwrap();
        let zero = Error::measure((&truth, &body), (&truth, &body)).unwrap();
        assert!(zero.rows().iter().all(|e| *e < 0.05), "{:?}", zero.rows());
        assert!(zero.shown.count > 50.0 && zero.hidden.count > 20.0);
        let mut moved = truth.clone();
        Perturbation { translation: 0.03, ..Perturbation::NONE }.apply(&mut moved, &body).unwrap();
        let [turn, _, shown, hidden, _] = Error::measure((&truth, &body), (&moved, &body)).unwrap().rows();
        assert!(turn < 0.05 && (15.0..50.0).contains(&shown) && (15.0..50.0).contains(&hidden), "{shown} {hidden}");
    }
}
