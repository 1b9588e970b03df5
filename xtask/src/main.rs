//! `cargo xtask`: train, evaluate and render people from occluded videos.

fn main() -> std::process::ExitCode {
    xtask::process::program(xtask::Arguments::run)
}
