//! Encoding and gradients against references.
#![allow(clippy::unwrap_used, reason = "a failure here is a failed test")]

mod config;
mod kernels;
