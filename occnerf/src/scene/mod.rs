//! A capture made ready: normalised lengths, the prior registered, posed bodies, labelled pixels,
//! colours of the prior and the light on it.

pub(crate) mod colors;
pub(crate) mod hands;
pub(crate) mod labels;
pub(crate) mod masks;
pub(crate) mod prepared;
pub(crate) mod registration;
pub(crate) mod reliability;
pub(crate) mod seen;
