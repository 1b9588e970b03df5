//! Helpers for tests of the command line.

testkit::program!(lab);

/// Writes a capture that is made in no time, in a format of `synth`.
pub fn tiny(out: &std::path::Path, format: &str) {
    let size = ["--size", "32", "--frames", "4", "--eval-cameras", "1"];
    done(&[&["synth", "--out", text(out), "--format", format], &size[..]].concat());
}
