//! Backward passes of the model.

pub(crate) mod field;
pub(crate) mod motion;
