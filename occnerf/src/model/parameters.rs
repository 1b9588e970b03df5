//! The learnable arrays, in the paper's groups.

use crate::config::Config;
use crate::model::field::Field;

/// A part of the parameters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Part {
    /// The perceptron F.
    Field,
    /// The hash table, or the parameters of a [`PointEncoder`](crate::PointEncoder).
    Table,
    /// Offsets of the vertices, V × 3; none where they are not learnt.
    Vertices,
    /// Log-weights of the motion volume.
    Motion,
}

/// Every part with its name in checkpoints.
pub(crate) const PARTS: [(Part, &str); 4] =
    [(Part::Field, "field"), (Part::Table, "table"), (Part::Vertices, "vertices"), (Part::Motion, "motion")];

/// An array for each part: values, or their gradients.
#[derive(Clone, Debug)]
pub(crate) struct Parameters(pub [Vec<f32>; 4]);

impl Parameters {
    /// The values that training starts from, for `vertices` vertices and `motion` log-weights.
    pub fn new(config: &Config, field: &Field, vertices: usize, motion: usize) -> Self {
        let moved = field.surface_term && config.rates.vertices > 0.0;
        let offsets = if moved { 3 * vertices } else { 0 };
        let table = field.encoder.initial_table(config.seed);
        Self([field.mlp.initial(config.seed), table, vec![0.0; offsets], vec![0.0; motion]])
    }

    pub fn get(&self, part: Part) -> &[f32] {
        &self.0[part as usize]
    }

    pub fn get_mut(&mut self, part: Part) -> &mut Vec<f32> {
        &mut self.0[part as usize]
    }

    /// Zeros of the same lengths.
    pub fn zeros(&self) -> Self {
        Self(self.0.each_ref().map(|values| vec![0.0; values.len()]))
    }
}
