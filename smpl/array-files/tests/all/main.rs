//! Readers against written files, damage and limits.
#![allow(clippy::unwrap_used, reason = "a failure here is a failed test")]

mod arrays;
mod common;
mod joblib;
mod pickles;
mod torch;
