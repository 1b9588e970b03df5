//! Helpers for tests of the command line.

use std::path::Path;

use occnerf::capture::Layout;
use synth::{SynthConfig, synthesise};

testkit::program!(xtask);

/// Settings of a training at a thousand steps a minute or more.
pub const QUICK: [&str; 8] = ["--preset", "fast", "--method", "hash-point", "--set", "samples=8", "--set", "patches=1"];

/// Writes a capture of the embedded person, of pictures `size` pixels a side.
pub fn capture(out: &Path, layout: Layout, size: u32, frames: usize) {
    let config = SynthConfig { size, frames, eval_cameras: 1, eval_every: 2, ..SynthConfig::default() };
    synthesise(None, None, &config, &|_| {}).unwrap().write(out, layout, &|_| {}).unwrap();
}
