//! Pruning: rows of the hash table that training never moved.

use serde::{Deserialize, Serialize};

use crate::model::parameters::Part;
use crate::model::trained::Model;

/// Rows of the hash table before and after pruning.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Pruned {
    /// Rows of the hash table before.
    pub rows: u64,
    /// Rows that no training ray and no vertex ever touched.
    pub dropped: u64,
    /// Learnable numbers left, of the whole model.
    pub parameters: u64,
}

impl Model {
    /// Empties the rows of the hash table that training never moved: they are no longer counted and
    /// no longer stored in a checkpoint. What a training ray can meet stays the same to the bit;
    /// elsewhere a feature changes by the 1e-4 that such a row was filled with at the start.
    pub fn prune(&mut self) -> Pruned {
        let features = self.config.encoding.features.max(1);
        let initial = self.field.encoder.initial_table(self.config.seed);
        let table = self.parameters.get_mut(Part::Table);
        let mut kept = Vec::with_capacity(table.len() / features);
        for (row, first) in table.chunks_exact_mut(features).zip(initial.chunks_exact(features)) {
            // A zero row was pruned earlier.
            kept.push(row.iter().zip(first).any(|(v, first)| *v != 0.0 && v != first));
            if kept.last() == Some(&false) {
                row.fill(0.0);
            }
        }
        let (rows, dropped) = (kept.len() as u64, kept.iter().filter(|kept| !**kept).count() as u64);
        self.parameters.kept_rows = (dropped > 0).then_some(kept);
        Pruned { rows, dropped, parameters: self.num_parameters() as u64 }
    }
}
