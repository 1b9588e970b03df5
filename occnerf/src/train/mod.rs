//! Training: a model, an optimiser and a batch, stepped from rays to gradients.

pub(crate) mod adam;
pub(crate) mod backward;
pub(crate) mod batch;
pub(crate) mod loss;
pub(crate) mod photometric;
#[cfg(test)]
mod plain;
pub(crate) mod step;
pub(crate) mod trainer;
