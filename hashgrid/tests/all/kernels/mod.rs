//! Every kernel in every dimension, in one binary because compiling the kernels dominates.

mod common;
mod encode;
mod gradients;
