//! The learnable arrays and their optimisers, in the paper's groups.

use rayon::prelude::*;

use crate::config::{Config, RateConfig};
use crate::model::field::Field;
use crate::train::adam::Adam;

/// A parameter group.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Part {
    /// The perceptron F.
    Field,
    /// The hash table.
    Table,
    /// Offsets of the vertices, V × 3.
    Vertices,
    /// Log-weights of the motion volume.
    Motion,
    /// Corrections of the poses.
    Pose,
}

/// Every group with its name in checkpoints.
pub(crate) const PARTS: [(Part, &str); 5] = [
    (Part::Field, "field"),
    (Part::Table, "table"),
    (Part::Vertices, "vertices"),
    (Part::Motion, "motion"),
    (Part::Pose, "pose"),
];

/// Values, gradients and moments of every group.
#[derive(Clone, Debug)]
pub(crate) struct Parameters {
    values: [Vec<f32>; 5],
    gradients: [Vec<f32>; 5],
    pub optimisers: [Adam; 5],
    /// Rows of the table that pruning has left, if it took any; the others are zero.
    pub kept_rows: Option<Vec<bool>>,
}

impl Parameters {
    pub fn new(config: &Config, field: &Field, vertices: usize, motion: usize, pose: usize) -> Self {
        let vertices = if field.surface_term { 3 * vertices } else { 0 };
        let values = [
            field.mlp.initial(config.seed),
            field.encoder.initial_table(config.seed),
            vec![0.0; vertices],
            vec![0.0; motion],
            vec![0.0; pose],
        ];
        let gradients = values.clone().map(|v| vec![0.0; v.len()]);
        let optimisers = [0, 1, 2, 3, 4].map(|part: usize| Adam::new(values[part].len()));
        Self { values, gradients, optimisers, kept_rows: None }
    }

    pub fn get(&self, part: Part) -> &[f32] {
        &self.values[part as usize]
    }

    /// Numbers of a group that carry something.
    pub fn count(&self, part: Part) -> usize {
        let all = self.get(part).len();
        match &self.kept_rows {
            Some(kept) if part == Part::Table => all / kept.len().max(1) * kept.iter().filter(|kept| **kept).count(),
            _ => all,
        }
    }

    pub fn get_mut(&mut self, part: Part) -> &mut Vec<f32> {
        &mut self.values[part as usize]
    }

    pub fn gradient(&mut self, part: Part) -> &mut [f32] {
        &mut self.gradients[part as usize]
    }

    /// Values of one group and the gradient of another.
    pub fn value_and_gradient(&mut self, value: Part, gradient: Part) -> (&[f32], &mut [f32]) {
        (&self.values[value as usize], &mut self.gradients[gradient as usize])
    }

    pub fn clear_gradients(&mut self) {
        self.gradients.iter_mut().for_each(|g| g.par_chunks_mut(1 << 16).for_each(|chunk| chunk.fill(0.0)));
    }

    /// One Adam step of every group at its rate times `decay`; returns how many gradients were not finite.
    pub fn step(&mut self, rates: &RateConfig, decay: f32) -> usize {
        self.kept_rows = None;
        let each = [rates.field, rates.table, rates.vertices, rates.motion, rates.pose];
        let groups = self.values.iter_mut().zip(&self.gradients).zip(&mut self.optimisers);
        groups.zip(each).map(|(((v, g), adam), rate)| adam.step(rate * decay, rates.beta_2, v, g)).sum()
    }
}
