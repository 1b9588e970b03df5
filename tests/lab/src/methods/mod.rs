//! The methods under comparison: the product's, and those that the laboratory adds as encoders of
//! points ([`PointEncoder`]).

mod frequency;
mod neighbours;
mod neural_body;
mod self_nerf;

use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use occnerf::{Config, Lpips, MotionKind, PointEncoder, Preset, RateConfig, Scene, Trainer};
use serde::{Deserialize, Serialize};

use frequency::Frequencies;
use neighbours::Neighbours;
use neural_body::NeuralBody;
use self_nerf::SelfNerf;
use xtask::eval::{Drawn, score_run, unscored};
use xtask::process::say;
use xtask::run::{Metrics, RunConfig};
use xtask::source::Source;
use xtask::train::unless_finished;

/// Which model is trained; all share data, sampler, renderer, budget and the losses but
/// completeness.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Method {
    /// The product's prior in mean colours.
    Prior,
    /// The product's surface without a field.
    Surface,
    /// Frequencies of x̂ and a wider perceptron (after Weng et al. 2022).
    Humannerf,
    /// The product's hash encoding of x̂.
    HashPoint,
    /// Codes on the vertices beside frequencies of x̂ (after Peng et al. 2021).
    NeuralBody,
    /// Encodings of the nearest vertices, blended (the order of Peng et al. 2022).
    SelfNerf,
    /// The product's own.
    Occnerf,
    /// The product's choice for a scene.
    Auto,
}

impl Method {
    /// The name in tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::Humannerf => "humannerf",
            Self::NeuralBody => "neural-body",
            Self::SelfNerf => "self-nerf",
            Self::Auto => "auto",
            Self::Prior | Self::Surface | Self::HashPoint | Self::Occnerf => self.base().name(),
        }
    }

    /// Whether it trains a field; what does not depends on no seed.
    pub fn has_field(self) -> bool {
        !matches!(self, Self::Prior | Self::Surface)
    }

    /// Whether `cargo xtask train` has it.
    pub fn is_product(self) -> bool {
        matches!(self, Self::Prior | Self::Surface | Self::HashPoint | Self::Occnerf | Self::Auto)
    }

    /// The product's method whose settings it has; only the encoding differs.
    fn base(self) -> occnerf::Method {
        match self {
            Self::Prior => occnerf::Method::Prior,
            Self::Surface => occnerf::Method::Surface,
            Self::Occnerf | Self::Auto => occnerf::Method::Occnerf,
            _ => occnerf::Method::HashPoint,
        }
    }

    /// The defaults of a preset.
    pub fn preset(self, preset: Preset) -> Config {
        let mut config = Config::preset(preset, self.base());
        if matches!(self, Self::Humannerf | Self::NeuralBody) {
            // Without a hash grid the perceptron has to hold the whole person, or half of it.
            (config.field.width, config.field.depth) = match (preset, self) {
                (Preset::Paper, Self::Humannerf) => (256, 8),
                (Preset::Paper, _) => (256, 4),
                (Preset::Fast | Preset::Balanced, _) => (128, 4),
            };
            if preset != Preset::Paper {
                // The higher rate was chosen for a small F behind a hash grid.
                config.rates.field = 2e-3;
            }
        }
        config
    }

    /// The encoder of a method of the laboratory.
    fn encoder(self, scene: &Scene, config: &Config) -> Result<Option<Arc<dyn PointEncoder>>> {
        let learns_motion = config.motion.kind == MotionKind::Volume;
        let neighbours = || -> Result<Neighbours> {
            ensure!(!learns_motion, "{}: expected motion.kind = surface", self.name());
            Neighbours::new(&scene.body, config)
        };
        Ok(match self {
            Self::Prior | Self::Surface | Self::HashPoint | Self::Occnerf | Self::Auto => None,
            Self::Humannerf => Some(Arc::new(Frequencies)),
            Self::NeuralBody => Some(Arc::new(NeuralBody::new(neighbours()?))),
            Self::SelfNerf => Some(Arc::new(SelfNerf::new(neighbours()?, &scene.body, config)?)),
        })
    }

    /// A trainer at step 0.
    ///
    /// # Errors
    /// Those of [`Trainer::new`]; a motion that the method cannot learn.
    pub fn trainer(self, scene: &Scene, config: Config) -> Result<Trainer<'_>> {
        let encoder = self.encoder(scene, &config)?;
        let trainer = Trainer::new(scene, config)?;
        Ok(match encoder {
            Some(encoder) => trainer.with_encoder(encoder),
            None => trainer,
        })
    }

    /// The scores under `directory` of the run `name`: those it has if it finished earlier with the
    /// same settings; else it is trained. Runs of the laboratory's encoders have no checkpoints: an
    /// interrupted one starts again.
    pub fn run_unless_finished(
        self,
        directory: &Path,
        name: &str,
        run: &RunConfig,
        source: &Source,
        lpips: Option<&Lpips>,
        interval: Duration,
    ) -> Result<Metrics> {
        if self.is_product() {
            return xtask::train::run_unless_finished(directory, name, run, source, lpips, interval);
        }
        unless_finished(directory, directory, run, lpips, |_| {
            say!("{name}: training");
            run.write(directory)?;
            let scene = source.scene(&run.train)?;
            let start = Instant::now();
            let mut trainer = self.trainer(&scene, run.train.clone())?;
            trainer.load_perceptual()?;
            for _ in 0..run.train.steps {
                trainer.step().with_context(|| name.to_owned())?;
            }
            let perceptual = trainer.perceptual();
            let model = trainer.into_model();
            let drawn = Drawn::Field { model: &model, perceptual };
            let mut metrics = unscored(run, &drawn, start.elapsed().as_secs_f64());
            metrics.method = self.name().to_owned();
            score_run(directory, run, &scene, &drawn, lpips, metrics)
        })
    }
}

/// Multiplies every learning rate.
pub fn scale_rates(rates: &mut RateConfig, by: f32) {
    for rate in [&mut rates.field, &mut rates.vertices, &mut rates.table, &mut rates.motion] {
        *rate *= by;
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a failure here is a failed test")]
mod tests {
    use super::*;
    use glam::Vec3;
    use occnerf::{FieldRenderer, Renderer};
    use synth::{DemoConfig, demo};
    use volrender::RandomStream;

    const OURS: [Method; 3] = [Method::Humannerf, Method::NeuralBody, Method::SelfNerf];

    fn tiny(method: Method) -> Config {
        let mut config = method.preset(Preset::Fast);
        (config.patches, config.patch_size, config.samples) = (2, 12, 24);
        (config.field.width, config.field.depth) = (24, 2);
        (config.encoding.levels, config.encoding.log2_table_size, config.encoding.n_max) = (3, 10, 20);
        config
    }

    fn scene(config: &Config) -> Scene {
        let body = smpl::BodyModel::embedded();
        let capture = demo(&DemoConfig { size: 32, frames: 3, eval_cameras: 1, ..Default::default() }, &body).unwrap();
        Scene::new(&capture, &body, config).unwrap()
    }

    #[test]
    fn every_preset_of_every_method_is_valid() {
        for method in [&OURS[..], &[Method::Prior, Method::HashPoint, Method::Occnerf]].concat() {
            for preset in [Preset::Fast, Preset::Balanced, Preset::Paper] {
                method.preset(preset).validate().unwrap();
            }
        }
    }

    /// Along random directions of the parameters, and of the points where the motion is learnt.
    #[test]
    fn gradients_of_parameters_and_points_agree_with_central_differences() {
        for method in OURS {
            let config = tiny(method);
            let scene = scene(&config);
            let encoder = method.encoder(&scene, &config).unwrap().unwrap();
            let mut random = RandomStream::new(&[3, method as u64]);
            let vertices = &scene.body.canonical.vertices;
            let mut place = || vertices[random.below(vertices.len())] + 0.01 * Vec3::splat(random.uniform() + 0.1);
            let points: Vec<[f32; 3]> = (0..40).map(|_| place().to_array()).collect();
            let mut normal = |n: usize| (0..n).map(|_| random.normal()).collect::<Vec<f32>>();
            let parameters = normal(encoder.initial(1).len());
            let cotangent = normal(points.len() * encoder.num_features());
            let value = |parameters: &[f32], points: &[[f32; 3]]| -> f64 {
                let mut features = vec![0.0; cotangent.len()];
                encoder.encode(parameters, points, &mut features);
                features.iter().zip(&cotangent).map(|(x, c)| f64::from(*x) * f64::from(*c)).sum()
            };
            let mut d_parameters = vec![0.0; parameters.len()];
            encoder.encode_backward(&points, &cotangent, &mut d_parameters);
            let mut d_points = vec![[0.0; 3]; points.len()];
            encoder.encode_backward_points(&points, &cotangent, &mut d_points);
            for _ in 0..6 {
                let (u, u_points) = (normal(parameters.len()), normal(3 * points.len()));
                // Features are linear in the parameters: any step will do.
                let moved = |h: f32| parameters.iter().zip(&u).map(|(p, u)| p + h * u).collect::<Vec<f32>>();
                let numeric = (value(&moved(0.5), &points) - value(&moved(-0.5), &points)) / 1.0;
                let analytic: f64 = d_parameters.iter().zip(&u).map(|(d, u)| f64::from(d * u)).sum();
                assert!((numeric - analytic).abs() < 1e-3 * (1.0 + analytic.abs()), "{method:?}: {numeric} {analytic}");
                if method != Method::Humannerf {
                    continue;
                }
                // The highest band has a period of 12 mm.
                let h = 2e-5;
                let at = |h: f32| {
                    let mut moved = points.clone();
                    moved.as_flattened_mut().iter_mut().zip(&u_points).for_each(|(x, u)| *x += h * u);
                    value(&parameters, &moved)
                };
                let numeric = (at(h) - at(-h)) / f64::from(2.0 * h);
                let analytic: f64 =
                    d_points.as_flattened().iter().zip(&u_points).map(|(d, u)| f64::from(*d) * f64::from(*u)).sum();
                let size = (d_points.as_flattened().iter().map(|d| f64::from(d * d)).sum::<f64>()).sqrt();
                assert!((numeric - analytic).abs() < 0.02 * size, "{method:?}: {numeric} {analytic} {size}");
            }
        }
    }

    #[test]
    fn training_gives_the_same_bits_on_any_threads_and_draws() {
        for method in OURS {
            let config = tiny(method);
            let scene = scene(&config);
            let train = || {
                let mut trainer = method.trainer(&scene, config.clone()).unwrap();
                let losses: Vec<u64> = (0..6).map(|_| trainer.step().unwrap().loss.to_bits()).collect();
                let mut renderer = FieldRenderer::new(trainer.model()).unwrap();
                let picture = renderer.render(&scene.eval[0].view, Vec3::ONE).unwrap();
                assert!(picture.image.pixels.iter().all(|x| x.is_finite()));
                (losses, picture.image.pixels)
            };
            let [one, two] =
                [1, 2].map(|n| rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap().install(train));
            assert!(one == two, "{method:?}");
        }
    }

    #[test]
    fn only_frequencies_can_be_moved_by_a_learnt_volume() {
        for method in OURS {
            let mut config = tiny(method);
            (config.motion.kind, config.motion.shell_interval) = (MotionKind::Volume, 0);
            (config.field.prior_colors, config.motion.resolution) = (false, 16);
            let scene = scene(&config);
            assert_eq!(method.trainer(&scene, config).is_ok(), method == Method::Humannerf);
        }
    }
}
