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
    /// Every stage with its name, in the order of the step.
    pub fn stages(&self) -> [(&'static str, f64); 9] {
        [
            ("prepare", self.prepare),
            ("trace", self.trace),
            ("encode", self.encode),
            ("perceptron", self.perceptron),
            ("losses", self.losses),
            ("perceptron backward", self.perceptron_backward),
            ("motion backward", self.motion_backward),
            ("encode backward", self.encode_backward),
            ("update", self.update),
        ]
    }
}

impl AddAssign for StepTimes {
    fn add_assign(&mut self, other: Self) {
        self.prepare += other.prepare;
        self.trace += other.trace;
        self.encode += other.encode;
        self.perceptron += other.perceptron;
        self.losses += other.losses;
        self.perceptron_backward += other.perceptron_backward;
        self.motion_backward += other.motion_backward;
        self.encode_backward += other.encode_backward;
        self.update += other.update;
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
