//! Restart of a field that has become empty: without density it has no gradient.

use serde::{Deserialize, Serialize};

/// Steps between two tests.
const WINDOW: u64 = 32;
/// A field is lost if fewer than one in `LOST` rays at the subject meets it.
const LOST: u64 = 10;
/// Each restart takes the learning rates down by this factor.
const SLOWER: f32 = 0.1;
/// Restarts at most.
const MOST: u32 = 3;

/// Rays of the current window, and restarts so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Restarts {
    /// Restarts so far.
    pub count: u32,
    /// Steps that had been taken at the last one.
    pub begun: u64,
    /// Rays at the subject's known pixels in this window, and those that met it: an opacity above a
    /// half.
    pub rays: u64,
    pub met: u64,
}

impl Restarts {
    /// Counts a ray at the subject.
    pub fn note(&mut self, opacity: f32) {
        self.rays += 1;
        self.met += u64::from(opacity > 0.5);
    }

    /// Whether training restarts, tested after each step; `steps` are taken.
    pub fn due(&mut self, steps: u64) -> bool {
        if !steps.is_multiple_of(WINDOW) {
            return false;
        }
        let lost = self.met * LOST < self.rays && self.count < MOST;
        (self.rays, self.met) = (0, 0);
        if lost {
            self.count += 1;
            self.begun = steps;
        }
        lost
    }

    /// Factor on the learning rates.
    pub fn rates(&self) -> f32 {
        SLOWER.powi(self.count as i32)
    }

    /// Checks the state of a checkpoint after `steps`.
    pub fn check(&self, steps: u64) -> Result<(), String> {
        let possible = self.count <= MOST && self.begun <= steps && self.met <= self.rays && self.rays <= 1 << 40;
        if possible { Ok(()) } else { Err(format!("{self:?} is not possible after {steps} steps")) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_window_without_the_subject_or_one_that_met_it_changes_nothing() {
        let mut restarts = Restarts::default();
        assert!(!restarts.due(WINDOW));
        (0..100).for_each(|i| restarts.note(if i < 10 { 0.9 } else { 0.0 }));
        assert!(!restarts.due(2 * WINDOW) && restarts == Restarts::default() && restarts.rates() == 1.0);
        (0..100).for_each(|i| restarts.note(if i < 9 { 0.9 } else { f32::NAN }));
        assert!(!restarts.due(2 * WINDOW + 1));
        assert!(restarts.due(3 * WINDOW) && restarts.begun == 3 * WINDOW && restarts.rates() == SLOWER);
        for window in 4..20 {
            restarts.note(0.0);
            assert_eq!(restarts.due(window * WINDOW), window <= 5);
        }
        assert!(restarts.check(5 * WINDOW).is_ok() && restarts.check(0).is_err());
    }
}
