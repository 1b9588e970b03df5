//! Gradients and moments of every part of the parameters.

use rayon::prelude::*;

use crate::config::RateConfig;
use crate::model::parameters::{Arrays, Parameters};
use crate::train::adam::Adam;

/// Gradients, and an Adam instance for each part.
#[derive(Clone, Debug)]
pub(crate) struct Optimiser {
    pub gradients: Arrays,
    pub moments: [Adam; 4],
}

impl Optimiser {
    /// An optimiser that has taken no step.
    pub fn new(parameters: &Parameters) -> Self {
        let lengths = parameters.values.0.each_ref().map(Vec::len);
        Self { gradients: parameters.values.zeros(), moments: lengths.map(Adam::new) }
    }

    pub fn clear_gradients(&mut self) {
        let all = self.gradients.0.iter_mut();
        all.for_each(|g| g.par_chunks_mut(1 << 16).for_each(|chunk| chunk.fill(0.0)));
    }

    /// One Adam step of every part at its rate times `decay`; returns how many gradients were not
    /// finite.
    pub fn step(&mut self, parameters: &mut Parameters, rates: &RateConfig, decay: f32) -> usize {
        let each = [rates.field, rates.table, rates.vertices, rates.motion];
        let parts = parameters.values.0.iter_mut().zip(&self.gradients.0).zip(&mut self.moments);
        parts.zip(each).map(|(((v, g), adam), rate)| adam.step(rate * decay, rates.beta_2, v, g)).sum()
    }
}
