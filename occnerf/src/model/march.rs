//! The samples of a step's rays, evaluated front to back in runs, so that those behind an opaque surface need not be.

use glam::Vec3;
use volrender::{Composite, composite, composite_backward};

use crate::model::field::Group;
use crate::model::samples::{March, Samples, Tracer};
use crate::model::times::Stopwatch;

/// Live samples of a ray that are evaluated before it is asked whether it goes on: about as many as there are from one side of a
/// surface to the other. Where next to nothing may be left out more of them make larger batches, which read a table that is larger
/// than the cache faster.
pub(crate) fn run_length(min_transmittance: f32) -> usize {
    if min_transmittance < 1e-6 { 24 } else { 6 }
}

/// Runs of samples, each a few more of every ray that goes on.
#[derive(Default)]
pub(crate) struct Runs {
    /// Those of this step come first; the others are room for steps that need more.
    all: Vec<Run>,
    count: usize,
    marches: Vec<March>,
    weights: Vec<f32>,
    composites: Vec<Composite>,
}

/// The next samples of some rays.
#[derive(Default)]
struct Run {
    /// Which of the rays these are, in order.
    rays: Vec<usize>,
    group: Group,
}

impl Runs {
    /// Traces `rays`, `run` samples of each at a time, and has `evaluate` give every sample its density and colour, until all rays
    /// have ended or their transmittance is at most `min_transmittance`. With 0 all samples are one run.
    pub fn march(
        &mut self,
        tracer: &Tracer<'_>,
        rays: impl Iterator<Item = March>,
        min_transmittance: f32,
        run: usize,
        mut evaluate: impl FnMut(&mut Group),
    ) {
        self.count = 0;
        self.marches.clear();
        self.marches.extend(rays);
        let most = if min_transmittance > 0.0 { run } else { usize::MAX };
        loop {
            if self.count == self.all.len() {
                self.all.push(Run::default());
            }
            let Run { rays: going, group } = &mut self.all[self.count];
            going.clear();
            going.extend((0..self.marches.len()).filter(|&ray| self.marches[ray].goes_on(min_transmittance)));
            if going.is_empty() && self.count > 0 {
                return;
            }
            let mut watch = Stopwatch::start();
            group.samples.clear();
            for &ray in &*going {
                group.samples.trace_on(tracer, most, &mut self.marches[ray]);
            }
            watch.lap(&mut group.times.trace);
            evaluate(group);
            self.count += 1;
            if min_transmittance == 0.0 {
                return;
            }
            let mut watch = Stopwatch::start();
            composite_group(group, Vec3::ZERO, &mut self.weights, &mut self.composites);
            for (&ray, composite) in going.iter().zip(&self.composites) {
                self.marches[ray].pass(composite.opacity);
            }
            watch.lap(&mut group.times.losses);
        }
    }

    /// The groups of the runs, front to back.
    pub fn groups(&self) -> impl Iterator<Item = &Group> + Clone {
        self.all[..self.count].iter().map(|run| &run.group)
    }

    /// [`Runs::groups`], to be changed.
    pub fn groups_mut(&mut self) -> impl Iterator<Item = &mut Group> {
        self.all[..self.count].iter_mut().map(|run| &mut run.group)
    }
}

/// The samples of runs, ray by ray, and their gradients.
#[derive(Default)]
pub(crate) struct Along {
    /// First sample of each ray, and the end of the last.
    starts: Vec<usize>,
    /// How many rays of each run have had their turn.
    done: Vec<usize>,
    /// Run, and place in it, of each sample.
    places: Vec<(usize, usize)>,
    sigma: Vec<f32>,
    likelihood: Vec<f32>,
    delta: Vec<f32>,
    t: Vec<f32>,
    rgb: Vec<Vec3>,
    weights: Vec<f32>,
    d_sigma: Vec<f32>,
    d_rgb: Vec<Vec3>,
    d_likelihood: Vec<f32>,
}

impl Along {
    pub fn len(&self) -> usize {
        self.places.len()
    }

    /// Takes the samples from their runs.
    pub fn gather(&mut self, runs: &Runs) {
        self.starts.clear();
        self.starts.push(0);
        self.places.clear();
        let done = &mut self.done;
        done.clear();
        done.resize(runs.count, 0);
        for ray in 0..runs.marches.len() {
            for (r, run) in runs.all[..runs.count].iter().enumerate() {
                if run.rays.get(done[r]) != Some(&ray) {
                    break;
                }
                let samples = run.group.samples.starts[done[r]]..run.group.samples.starts[done[r] + 1];
                self.places.extend(samples.map(|s| (r, s)));
                done[r] += 1;
            }
            self.starts.push(self.places.len());
        }
        let places = &self.places;
        let group = |r: usize| &runs.all[r].group;
        let fill = |to: &mut Vec<f32>, from: &dyn Fn(&Group) -> &[f32]| {
            to.clear();
            to.extend(places.iter().map(|&(r, s)| from(group(r))[s]));
        };
        fill(&mut self.sigma, &|g| &g.sigma);
        fill(&mut self.likelihood, &|g| &g.samples.likelihood);
        fill(&mut self.delta, &|g| &g.samples.delta);
        fill(&mut self.t, &|g| &g.samples.t);
        self.rgb.clear();
        self.rgb.extend(places.iter().map(|&(r, s)| group(r).rgb[s]));
    }

    /// Composites every ray.
    pub fn composite(&mut self, background: Vec3, composites: &mut Vec<Composite>) {
        let Self { starts, sigma, likelihood, delta, t, rgb, weights, .. } = self;
        Rays { starts, sigma, likelihood, delta, t, rgb }.composite(background, weights, composites);
    }

    /// Backward of [`Along::composite`], into the runs' groups; `d_colors` of each ray.
    pub fn composite_backward(&mut self, background: Vec3, d_colors: impl Iterator<Item = Vec3>, runs: &mut Runs) {
        let n = self.places.len();
        self.d_sigma.resize(n, 0.0);
        self.d_rgb.resize(n, Vec3::ZERO);
        self.d_likelihood.resize(n, 0.0);
        for (ends, d_color) in self.starts.windows(2).zip(d_colors) {
            let range = ends[0]..ends[1];
            composite_backward(
                &self.sigma[range.clone()],
                &self.likelihood[range.clone()],
                &self.delta[range.clone()],
                &self.rgb[range.clone()],
                background,
                &self.weights[range.clone()],
                d_color,
                0.0,
                &mut self.d_sigma[range.clone()],
                &mut self.d_rgb[range.clone()],
                &mut self.d_likelihood[range],
            );
        }
        for group in runs.groups_mut() {
            let n = group.samples.len();
            group.d_sigma.resize(n, 0.0);
            group.d_rgb.resize(n, Vec3::ZERO);
            group.d_likelihood.resize(n, 0.0);
        }
        for (i, &(r, s)) in self.places.iter().enumerate() {
            let group = &mut runs.all[r].group;
            group.d_sigma[s] = self.d_sigma[i];
            group.d_rgb[s] = self.d_rgb[i];
            group.d_likelihood[s] = self.d_likelihood[i];
        }
    }

    /// The finest `k` neighbours of a ray's sample; none where samples have no neighbours.
    pub fn neighbours<'a>(&self, runs: &'a Runs, ray: usize, sample: usize, k: usize) -> &'a [u32] {
        let (r, s) = self.places[self.starts[ray] + sample];
        let samples = &runs.all[r].group.samples;
        let per_sample = samples.neighbours.len() / samples.len();
        if per_sample == 0 { &[] } else { &samples.neighbours[s * per_sample..][..k] }
    }
}

/// Composites every ray of a group.
pub(crate) fn composite_group(
    group: &Group,
    background: Vec3,
    weights: &mut Vec<f32>,
    composites: &mut Vec<Composite>,
) {
    let Samples { starts, likelihood, delta, t, .. } = &group.samples;
    Rays { starts, sigma: &group.sigma, likelihood, delta, t, rgb: &group.rgb }
        .composite(background, weights, composites);
}

/// The samples of rays, ray by ray, as far as compositing reads them.
struct Rays<'a> {
    /// First sample of each ray, and the end of the last.
    starts: &'a [usize],
    sigma: &'a [f32],
    likelihood: &'a [f32],
    delta: &'a [f32],
    t: &'a [f32],
    rgb: &'a [Vec3],
}

impl Rays<'_> {
    fn composite(&self, background: Vec3, weights: &mut Vec<f32>, composites: &mut Vec<Composite>) {
        weights.resize(self.t.len(), 0.0);
        composites.clear();
        for ends in self.starts.windows(2) {
            let range = ends[0]..ends[1];
            composites.push(composite(
                &self.sigma[range.clone()],
                &self.likelihood[range.clone()],
                &self.delta[range.clone()],
                &self.t[range.clone()],
                &self.rgb[range.clone()],
                background,
                &mut weights[range],
            ));
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::capture::{DemoConfig, demo};
    use crate::config::{Config, Method, Preset};
    use crate::model::parameters::Part;
    use crate::scene::prepared::Scene;
    use crate::train::trainer::Trainer;

    /// Some steps with all samples, to make the surface opaque, and one more as `config` has it: its report, the colours of its
    /// rays and the gradients.
    fn step(scene: &Scene, config: &Config) -> (crate::StepReport, Vec<glam::Vec3>, [Vec<f32>; 3]) {
        let mut trainer = Trainer::new(scene, Config { min_transmittance: 0.0, ..config.clone() }).unwrap();
        for _ in 0..60 {
            trainer.step().unwrap();
        }
        (trainer.config.min_transmittance, trainer.run) = (config.min_transmittance, 6);
        let report = trainer.step().unwrap();
        let colors = trainer.groups.iter().flat_map(|g| g.composites.iter().map(|c| c.color)).collect();
        let gradients = [Part::Field, Part::Table, Part::Pose].map(|part| trainer.parameters.gradient(part).to_vec());
        (report, colors, gradients)
    }

    /// One step of the volume motion, whose gradients pass through everything, and of the surface motion.
    #[test]
    fn what_lies_outside_the_prior_at_unknown_pixels_has_no_gradient() {
        let body = smpl::BodyModel::embedded();
        let capture = demo(&DemoConfig { size: 40, frames: 4, eval_cameras: 1, ..Default::default() }, &body).unwrap();
        for (preset, density_scale) in [(Preset::Fast, 25.0), (Preset::Paper, 25.0), (Preset::Paper, 4.0)] {
            let mut config = Config::preset(preset, Method::Occnerf);
            (config.patches, config.patch_size, config.samples, config.seed) = (4, 24, 48, 2);
            (config.loss.perceptual, config.min_transmittance) = (0.0, 0.0);
            config.encoding.log2_table_size = 12;
            // The smaller one has densities below β inside, which completeness pushes up.
            config.field.density_scale = density_scale;
            let scene = Scene::new(&capture, &body, &config).unwrap();
            let [all, few] = [true, false].map(|evaluates_all| {
                let mut trainer = Trainer::new(&scene, config.clone()).unwrap();
                trainer.evaluates_all = evaluates_all;
                let report = trainer.step().unwrap();
                let parts = [Part::Field, Part::Table, Part::Vertices, Part::Motion];
                (report, parts.map(|part| trainer.parameters.gradient(part).to_vec()), trainer.counts.counts().to_vec())
            });
            let (live, less) = (all.0.live_samples, few.0.live_samples);
            assert!(live > 1000 && 20 * less < 19 * live, "{preset:?}: {less} of {live} samples");
            assert!((all.0.loss - few.0.loss).abs() < 1e-6 * all.0.loss, "{} {}", all.0.loss, few.0.loss);
            assert_eq!(all.2, few.2);
            for (all, few) in all.1.iter().zip(&few.1).filter(|(all, _)| !all.is_empty()) {
                let difference = largest_difference(all, few);
                assert!(difference < 1e-5, "{preset:?}: {difference}");
            }
        }
    }

    fn largest_difference(a: &[f32], b: &[f32]) -> f32 {
        assert_eq!(a.len(), b.len());
        let largest = a.iter().map(|x| x.abs()).fold(0.0, f32::max);
        a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max) / largest
    }

    #[test]
    fn runs_change_nothing_and_samples_behind_an_opaque_surface_next_to_nothing() {
        let body = smpl::BodyModel::embedded();
        let capture = demo(&DemoConfig { size: 40, frames: 4, eval_cameras: 1, ..Default::default() }, &body).unwrap();
        let mut config = Config::preset(Preset::Fast, Method::Occnerf);
        (config.patches, config.patch_size, config.steps) = (2, 24, 100);
        config.field.density_scale *= 30.0;
        let scene = Scene::new(&capture, &body, &config).unwrap();
        let at = |min_transmittance| step(&scene, &Config { min_transmittance, ..config.clone() });
        let (all, all_colors, all_gradients) = at(0.0);
        // In many runs, until nothing at all shines through.
        let (same, same_colors, same_gradients) = at(f32::MIN_POSITIVE);
        assert!(same.live_samples <= all.live_samples && all.live_samples > 1000, "{}", same.live_samples);
        for (a, b) in all_colors.iter().zip(&same_colors) {
            assert!((*a - *b).abs().max_element() < 1e-6, "{a} {b}");
        }
        // Completeness is that of the samples that are evaluated.
        assert!((same.loss - all.loss).abs() < 1e-4 * all.loss, "{} {}", same.loss, all.loss);
        for (all, same) in all_gradients.iter().zip(&same_gradients) {
            let difference = largest_difference(all, same);
            assert!(difference < 1e-4, "{difference}");
        }
        let (less, less_colors, less_gradients) = at(1e-3);
        let share = less.live_samples as f64 / all.live_samples as f64;
        assert!(share < 0.9, "{share} of the samples");
        for (a, b) in all_colors.iter().zip(&less_colors) {
            assert!((*a - *b).abs().max_element() < 1.1e-3, "{a} {b}");
        }
        for (all, less) in all_gradients.iter().zip(&less_gradients) {
            let difference = largest_difference(all, less);
            assert!(difference < 0.02, "{difference}");
        }
    }
}
