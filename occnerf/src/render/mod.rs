//! Pictures of a trained person, or of the prior.

pub(crate) mod field;
pub(crate) mod picture;
