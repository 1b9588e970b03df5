//! Backward passes of what the model does forward.

pub(crate) mod field;
pub(crate) mod motion;
