//! The laboratory's commands.
#![allow(clippy::unwrap_used, reason = "a failure here is a failed test")]

mod bench;
mod common;
mod parts;
mod probe;
mod reproduce;
mod synth;
