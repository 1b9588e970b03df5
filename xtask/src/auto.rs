//! `--method auto`: the surface, or a field on top of it where one pays.
//!
//! Both are fitted without every tenth frame and compared on those, by parts of the body. A field that
//! does not predict unseen frames better than the surface is not trained.

use anyhow::Result;
use glam::Vec3;
use occnerf::bake::{fit, skeleton};
use occnerf::{Config, Label, Method, PreparedFrame, Scene, Trainer, pinhole};
use visibility::{RasterOptions, Rasterizer};

use crate::eval::{Drawn, Split};
use crate::process::say;
use crate::run::Verdict;
use crate::settings::HOLD_OUT;
use crate::source::Source;
use crate::table::aligned;

/// Steps of the trial field.
const TRIAL: u64 = 200;
/// Least gain of a field, dB over the known pixels of the frames held out.
const WORTH: f64 = 0.3;

/// Parts of the body by joint, and pixels of the mask beside it.
const PARTS: [(&str, &[&str]); 7] = [
    ("head", &["head", "neck"]),
    ("arms", &["collar", "shoulder", "elbow"]),
    ("hands", &["wrist", "hand"]),
    ("legs", &["hip", "knee"]),
    ("feet", &["ankle", "foot"]),
    ("trunk", &[""]),
    ("beside the body", &[]),
];
const BESIDE: usize = PARTS.len() - 1;

/// Compares the surface with a field of a few steps on frames held out from both, and says so.
pub fn weigh(source: &Source, config: &Config) -> Result<Verdict> {
    let steps = TRIAL.min(config.steps);
    let config = Config { method: Method::Occnerf, steps, held_out: HOLD_OUT, ..config.clone() };
    say!("auto: a field of {steps} steps against the surface, on every {HOLD_OUT}th frame");
    let scene = source.scene(&config)?;
    let parts = scene.eval.iter().map(|frame| parts(&scene, frame)).collect::<Result<Vec<_>>>()?;
    let (avatar, _) = fit(&scene)?;
    let light = scene.colors()?.light;
    let surface = Trial::of(&Drawn::Avatar { body: &scene.body, light, avatar: &avatar }, &scene, &parts)?;
    let mut trainer = Trainer::new(&scene, config)?;
    trainer.load_perceptual()?;
    for _ in 0..steps {
        trainer.step()?;
    }
    let perceptual = trainer.perceptual();
    let model = trainer.into_model();
    let field = Trial::of(&Drawn::Field { model: &model, perceptual }, &scene, &parts)?;
    let verdict = between(&surface, &field, [avatar.num_parameters(), model.num_parameters()]);
    say!("{}\n{}", aligned(&verdict.parts, 1), verdict.why);
    Ok(verdict)
}

fn between(surface: &Trial, field: &Trial, parameters: [usize; 2]) -> Verdict {
    let all = surface.pixels.iter().sum::<usize>().max(1);
    let mut rows = vec![["part", "pixels", "surface", "field", "gain"].map(str::to_owned).to_vec()];
    for (part, (name, _)) in PARTS.iter().enumerate().filter(|(part, _)| surface.pixels[*part] > 0) {
        let share = 100.0 * surface.pixels[part] as f64 / all as f64;
        let [a, b] = [surface, field].map(|trial| decibels(trial.errors[part], trial.pixels[part]));
        let gain = format!("{:+.2}", b - a);
        rows.push(vec![(*name).to_owned(), format!("{share:.0} %"), format!("{a:.2}"), format!("{b:.2}"), gain]);
    }
    let [a, b] = [surface, field].map(|trial| decibels(trial.errors.iter().sum(), all));
    let gain = b - a;
    let field_pays = gain >= WORTH;
    let more = (parameters[1] as f64 - parameters[0] as f64) / 1e6;
    let slower = 1e3 * (field.seconds - surface.seconds);
    let why = format!(
        "{gain:+.2} dB for {more:+.2} million parameters and {slower:+.0} ms a picture, expected at least {WORTH} dB: {}",
        if field_pays { "the field is trained" } else { "the surface is enough" }
    );
    Verdict { field: field_pays, parts: rows, why }
}

fn decibels(error: f64, pixels: usize) -> f64 {
    -10.0 * (error / pixels.max(1) as f64).max(1e-10).log10()
}

/// Squared error and known pixels of each part, over the frames held out.
#[derive(Default)]
struct Trial {
    errors: [f64; PARTS.len()],
    pixels: [usize; PARTS.len()],
    /// Of a picture.
    seconds: f64,
}

impl Trial {
    fn of(drawn: &Drawn<'_>, scene: &Scene, parts: &[Vec<usize>]) -> Result<Self> {
        let (mut trial, mut of_frame, mut unread) = (Self::default(), parts.iter(), Ok(()));
        let scores = drawn.score(scene, Split::NovelView, None, |frame, rendering| {
            let Some(parts) = of_frame.next() else { return };
            match frame.pixels() {
                Ok(truth) => {
                    let colours = truth.image.pixels.chunks_exact(3).zip(rendering.image.pixels.chunks_exact(3));
                    let labels = frame.labels.iter().zip(parts);
                    for ((a, b), (_, &part)) in colours.zip(labels).filter(|(_, (label, _))| *label == Label::Subject) {
                        let squared: f32 = a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum();
                        trial.errors[part] += f64::from(squared) / 3.0;
                        trial.pixels[part] += 1;
                    }
                }
                Err(error) => unread = Err(error),
            }
        })?;
        unread?;
        trial.seconds = scores.render_seconds_per_frame;
        Ok(trial)
    }
}

/// The part of the body at each pixel of a frame, (H · W).
fn parts(scene: &Scene, frame: &PreparedFrame) -> Result<Vec<usize>> {
    let model = &scene.body.model;
    let names = skeleton(&model.parents, &vec![Vec3::ZERO; model.parents.len()]);
    let part =
        |joint: usize| PARTS.iter().position(|(_, words)| words.iter().any(|word| names[joint].name.contains(word)));
    let heaviest = |v: u32| model.weights.heaviest(v as usize).unwrap_or(0);
    let (view, options) = (pinhole(&frame.view.camera), RasterOptions::default());
    let drawn = Rasterizer::default().faces(&frame.view.posed.vertices, &model.faces, &view, &options)?;
    let at = |fragment: Option<visibility::Fragment>| {
        fragment.and_then(|fragment| part(heaviest(model.faces[fragment.face as usize][0]))).unwrap_or(BESIDE)
    };
    Ok(drawn.into_iter().map(at).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_field_is_trained_only_where_it_gains() {
        let trial = |error: f64| {
            let mut trial = Trial { seconds: error, ..Trial::default() };
            (trial.pixels[0], trial.pixels[BESIDE]) = (300, 100);
            (trial.errors[0], trial.errors[BESIDE]) = (3.0 * error, error);
            trial
        };
        let better = between(&trial(1.0), &trial(0.9), [200_000, 1_200_000]);
        assert!(better.field && better.why.contains("+0.46 dB for +1.00 million"), "{}", better.why);
        assert_eq!(better.parts[1], ["head", "75 %", "20.00", "20.46", "+0.46"]);
        assert_eq!(better.parts[2][0], "beside the body");
        let alike = between(&trial(1.0), &trial(0.95), [200_000, 1_200_000]);
        assert!(!alike.field && alike.why.ends_with("the surface is enough"), "{}", alike.why);
    }
}
