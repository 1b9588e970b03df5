//! `--method auto`: the surface, with a skirt or a field where they pay.
//!
//! Each is fitted without every tenth frame and compared on those, by parts of the body. What does
//! not predict unseen frames better than less is left out.

use anyhow::Result;
use glam::Vec3;
use occnerf::bake::{fit, skirted};
use occnerf::{Config, Label, Method, PreparedFrame, Scene, Trainer, pinhole};
use smpl::{BoneNames, skeleton};
use visibility::{RasterOptions, Rasterizer};

use crate::eval::{Drawn, Split};
use crate::process::say;
use crate::run::Verdict;
use crate::settings::HOLD_OUT;
use crate::source::Source;
use crate::table::aligned;

/// Steps of the trial field.
const TRIAL: u64 = 200;
/// Least gain of an addition, dB over the known pixels of the frames held out.
const WORTH: f64 = 0.3;
/// Names of the additions.
const SKIRT: &str = "a skirt";
const FIELD: &str = "a field";

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

/// Compares the surface with a skirted one, if the masks show a skirt, and with a field of a few
/// steps, on frames held out from all, and says so. A skirt that pays becomes part of the source's
/// body.
pub fn weigh(source: &mut Source, config: &Config) -> Result<Verdict> {
    let steps = TRIAL.min(config.steps);
    let config = Config { method: Method::Occnerf, steps, held_out: HOLD_OUT, ..config.clone() };
    say!("auto: a field of {steps} steps against the surface, on every {HOLD_OUT}th frame");
    let mut scene = source.scene(&config)?;
    let parts = scene.eval.iter().map(|frame| parts(&scene, frame)).collect::<Result<Vec<_>>>()?;
    let mut trials = vec![Trial::of_surface("surface", &scene, &parts)?];
    if let Some(model) = skirted(&scene)? {
        let dressed = source.with_body(model);
        let wider = dressed.scene(&config)?;
        trials.push(Trial::of_surface(SKIRT, &wider, &parts)?);
        if trials[1].pays_over(&trials[0]) {
            (*source, scene) = (dressed, wider);
        }
    }
    let mut trainer = Trainer::new(&scene, config)?;
    trainer.load_perceptual()?;
    for _ in 0..steps {
        trainer.step()?;
    }
    let perceptual = trainer.perceptual();
    let model = trainer.into_model();
    let drawn = Drawn::Field { model: &model, perceptual };
    trials.push(Trial::of(FIELD, &drawn, model.num_parameters(), &scene, &parts)?);
    let verdict = between(&trials);
    say!("{}\n{}", aligned(&verdict.parts, 1), verdict.why);
    Ok(verdict)
}

/// What is worth its cost of `trials`: a surface, then perhaps one with a skirt, then a field over
/// the better of them.
fn between(trials: &[Trial]) -> Verdict {
    let surface = &trials[0];
    let all = surface.pixels.iter().sum::<usize>().max(1);
    let names = trials.iter().map(|trial| trial.name);
    let mut rows = vec![["part", "pixels"].into_iter().chain(names).map(str::to_owned).collect::<Vec<_>>()];
    for (part, (name, _)) in PARTS.iter().enumerate().filter(|(part, _)| surface.pixels[*part] > 0) {
        let share = 100.0 * surface.pixels[part] as f64 / all as f64;
        let scores = trials.iter().map(|trial| format!("{:.2}", decibels(trial.errors[part], trial.pixels[part])));
        rows.push([(*name).to_owned(), format!("{share:.0} %")].into_iter().chain(scores).collect());
    }
    let (mut best, mut taken, mut why) = (surface, Vec::new(), Vec::new());
    for trial in &trials[1..] {
        let more = (trial.parameters as f64 - best.parameters as f64) / 1e6;
        let (gain, slower) = (trial.decibels() - best.decibels(), 1e3 * (trial.seconds - best.seconds));
        let pays = trial.pays_over(best);
        let verdict = if pays { "it pays" } else { "left out" };
        why.push(format!(
            "{}: {gain:+.2} dB for {more:+.2} million parameters and {slower:+.0} ms a picture, expected at least \
             {WORTH} dB: {verdict}",
            trial.name
        ));
        if pays {
            best = trial;
            taken.push(trial.name);
        }
    }
    Verdict { skirt: taken.contains(&SKIRT), field: taken.contains(&FIELD), parts: rows, why: why.join("; ") }
}

fn decibels(error: f64, pixels: usize) -> f64 {
    -10.0 * (error / pixels.max(1) as f64).max(1e-10).log10()
}

/// Squared error and known pixels of each part, over the frames held out.
#[derive(Default)]
struct Trial {
    name: &'static str,
    parameters: usize,
    errors: [f64; PARTS.len()],
    pixels: [usize; PARTS.len()],
    /// Of a picture.
    seconds: f64,
}

impl Trial {
    fn decibels(&self) -> f64 {
        decibels(self.errors.iter().sum(), self.pixels.iter().sum())
    }

    fn pays_over(&self, other: &Self) -> bool {
        self.decibels() - other.decibels() >= WORTH
    }

    fn of_surface(name: &'static str, scene: &Scene, parts: &[Vec<usize>]) -> Result<Self> {
        let (avatar, _) = fit(scene)?;
        let drawn = Drawn::Avatar { body: &scene.body, light: scene.colors()?.light, avatar: &avatar };
        Self::of(name, &drawn, avatar.num_parameters(), scene, parts)
    }

    fn of(
        name: &'static str,
        drawn: &Drawn<'_>,
        parameters: usize,
        scene: &Scene,
        parts: &[Vec<usize>],
    ) -> Result<Self> {
        let mut trial = Self { name, parameters, ..Self::default() };
        let (mut of_frame, mut unread) = (parts.iter(), Ok(()));
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
    let names = skeleton(BoneNames::Smpl, &model.parents, &vec![Vec3::ZERO; model.parents.len()]);
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
    fn what_is_added_pays_on_frames_held_out() {
        let trial = |name: &'static str, error: f64, parameters: usize| {
            let mut trial = Trial { name, parameters, seconds: error, ..Trial::default() };
            (trial.pixels[0], trial.pixels[BESIDE]) = (300, 100);
            (trial.errors[0], trial.errors[BESIDE]) = (3.0 * error, error);
            trial
        };
        let [surface, skirt] = [trial("surface", 1.0, 200_000), trial(SKIRT, 0.8, 210_000)];
        let better = between(&[surface, skirt, trial(FIELD, 0.7, 1_200_000)]);
        assert!(better.field && better.skirt && better.why.contains("+0.58 dB for +0.99 million"), "{}", better.why);
        assert_eq!(better.parts[1], ["head", "75 %", "20.00", "20.97", "21.55"]);
        assert_eq!(better.parts[2][0], "beside the body");
        let alike = between(&[trial("surface", 1.0, 200_000), trial(FIELD, 0.95, 1_200_000)]);
        assert!(!alike.field && alike.why.ends_with("left out"), "{}", alike.why);
    }
}
