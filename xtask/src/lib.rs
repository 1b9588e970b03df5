//! The command line of OccNeRF as a library, for programs that train, score and draw as it does.
#![warn(clippy::print_stdout, clippy::print_stderr, reason = "printing must never stop work: see process::print")]

pub mod auto;
mod avatar;
pub mod baked;
mod check;
mod commands;
pub mod eval;
mod export;
mod import;
pub mod list;
pub mod network;
pub mod optimise;
pub mod pictures;
pub mod place;
mod preview;
pub mod process;
mod render;
pub mod report;
pub mod run;
pub mod scale;
pub mod settings;
pub mod shard;
pub mod source;
pub mod table;
pub mod train;
mod video;
mod view;

pub use commands::Arguments;
