//! Every kernel in every dimension; one binary, because compiling them takes longest.

mod common;
mod encode;
mod gradients;
