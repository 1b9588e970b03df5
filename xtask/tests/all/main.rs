//! The command line as its users see it.
#![allow(clippy::unwrap_used, reason = "a failure here is a failed test")]

mod cli;
mod common;
#[cfg(target_os = "linux")]
mod death;
#[cfg(target_os = "linux")]
mod derived;
mod export;
#[cfg(target_os = "linux")]
mod faults;
mod import;
mod list;
mod own_video;
mod surface;
