//! What a trained person is, and how a ray meets it.

pub(crate) mod body;
pub(crate) mod colors;
pub(crate) mod encoder;
pub(crate) mod extent;
pub(crate) mod field;
pub(crate) mod march;
pub(crate) mod perceptron;
pub(crate) mod person;
pub(crate) mod samples;
pub(crate) mod saved;
pub(crate) mod subdivide;
pub(crate) mod trained;
pub(crate) mod view;
