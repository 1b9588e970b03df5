//! Helpers for tests of the command line.

use std::path::Path;
use std::process::{Command, Output, Stdio};

use occnerf::capture::Layout;
use serde_json::Value;
use synth::{SynthConfig, synthesise};

testkit::program!(xtask);

/// Settings of a training at a thousand steps a minute or more.
pub const QUICK: [&str; 8] = ["--preset", "fast", "--method", "hash-point", "--set", "samples=8", "--set", "patches=1"];

pub fn bytes(path: &Path) -> Vec<u8> {
    std::fs::read(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

pub fn json(path: &Path) -> Value {
    serde_json::from_slice(&bytes(path)).unwrap()
}

pub fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// The command with what the shell code before it sets.
pub fn limited(limits: &str, arguments: &[&str]) -> Output {
    let script = format!("{limits} exec \"$@\"");
    let mut command = Command::new("sh");
    command.args(["-c", &script, "sh", env!("CARGO_BIN_EXE_xtask")]).args(arguments);
    command.env_remove("SMPL_MODEL").stdin(Stdio::null()).output().unwrap()
}

/// Changes every frame of a capture's metadata.json.
pub fn rewritten(capture: &Path, change: impl FnMut(&mut Value)) {
    let path = capture.join("metadata.json");
    let mut metadata = json(&path);
    metadata.as_object_mut().unwrap().values_mut().for_each(change);
    std::fs::write(&path, metadata.to_string()).unwrap();
}

/// Writes a capture of the embedded person, of pictures `size` pixels a side.
pub fn capture(out: &Path, layout: Layout, size: u32, frames: usize) {
    let config = SynthConfig { size, frames, eval_cameras: 1, eval_every: 2, ..SynthConfig::default() };
    synthesise(None, None, &config, &|_| {}).unwrap().write(out, layout, &|_| {}).unwrap();
}
