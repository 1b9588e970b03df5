//! A capture made ready: normalised lengths, posed bodies, labelled pixels, colours of the prior.

pub(crate) mod colors;
pub(crate) mod labels;
pub(crate) mod prepared;
