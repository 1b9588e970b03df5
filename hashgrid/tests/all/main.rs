//! Encoding and gradients against references, in one binary because compiling the kernels
//! dominates.
#![allow(clippy::unwrap_used, reason = "a failure here is a failed test")]

mod common;
mod config;
mod encode;
mod gradients;
