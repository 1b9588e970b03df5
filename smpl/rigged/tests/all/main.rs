//! Characters and meshes from files, right and wrong.
#![allow(clippy::unwrap_used, reason = "a failure here is a failed test")]

mod character;
mod mesh;
