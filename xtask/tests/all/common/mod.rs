//! Helpers for tests of the command line.

use std::path::Path;

use occnerf::capture::Layout;
use synth::{SynthConfig, synthesise};

testkit::program!(xtask);

/// Writes a capture of the embedded person, of pictures `size` pixels a side.
pub fn capture(out: &Path, layout: Layout, size: u32, frames: usize) {
    let config = SynthConfig { size, frames, eval_cameras: 1, eval_every: 2, ..SynthConfig::default() };
    synthesise(None, None, &config, &|_| {}).unwrap().write(out, layout, &|_| {}).unwrap();
}
