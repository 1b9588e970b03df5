//! Backward passes of what the model does forward.

pub(crate) mod correction;
pub(crate) mod field;
pub(crate) mod motion;
pub(crate) mod pose;
