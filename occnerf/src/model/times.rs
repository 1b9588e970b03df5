//! Where the time of a training step goes.

use std::ops::AddAssign;
use std::time::Instant;

/// Seconds of each stage of a step, summed over the threads that worked on it.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize)]
pub struct StepTimes {
    /// Drawing rays, decoding the picture where it is not kept, posing the prior, encoding its
    /// vertices.
    pub prepare: f64,
    /// Samples, their motion, their surface queries.
    pub trace: f64,
    /// Hash grid or frequencies, forward.
    pub encode: f64,
    /// Surface term and perceptron, forward.
    pub perceptron: f64,
    /// Compositing, losses, and both backward.
    pub losses: f64,
    /// Perceptron and surface term, backward.
    pub perceptron_backward: f64,
    /// Weight volume, and the encoding with respect to its coordinates.
    pub motion_backward: f64,
    /// Hash grid with respect to its table, and the vertices of the surface term.
    pub encode_backward: f64,
    /// Sums over groups, Adam.
    pub update: f64,
}

impl StepTimes {
    fn stages_mut(&mut self) -> [(&'static str, &mut f64); 9] {
        [
            ("prepare", &mut self.prepare),
            ("trace", &mut self.trace),
            ("encode", &mut self.encode),
            ("perceptron", &mut self.perceptron),
            ("losses", &mut self.losses),
            ("perceptron backward", &mut self.perceptron_backward),
            ("motion backward", &mut self.motion_backward),
            ("encode backward", &mut self.encode_backward),
            ("update", &mut self.update),
        ]
    }

    /// Every stage with its name, in the order of the step.
    pub fn stages(mut self) -> [(&'static str, f64); 9] {
        self.stages_mut().map(|(name, seconds)| (name, *seconds))
    }
}

impl AddAssign for StepTimes {
    fn add_assign(&mut self, other: Self) {
        self.stages_mut().into_iter().zip(other.stages()).for_each(|((_, sum), (_, seconds))| *sum += seconds);
    }
}

/// Measures one stage after another.
pub(crate) struct Stopwatch(Instant);

impl Stopwatch {
    pub fn start() -> Self {
        Self(Instant::now())
    }

    /// Adds the time since the last lap, or the start, to `stage`.
    pub fn lap(&mut self, stage: &mut f64) {
        let now = Instant::now();
        *stage += now.duration_since(self.0).as_secs_f64();
        self.0 = now;
    }
}
