//! The crate as its users see it.
#![allow(clippy::unwrap_used, reason = "a failure here is a failed test")]

mod allocations;
mod avatar;
mod checkpoint;
mod common;
mod config;
mod evaluation;
mod export;
#[path = "../../lpips/tests/lpips/formula.rs"]
#[allow(dead_code, reason = "the crate lpips uses all of it")]
mod formula;
mod held_out;
mod import;
mod labels;
mod odd_frames;
mod on_demand;
mod perceptual;
mod person;
mod readme;
#[path = "common/stand_in.rs"]
mod stand_in;
