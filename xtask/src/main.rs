//! `cargo xtask`: train, evaluate and render people from occluded videos.

mod bench;
mod capacity;
mod check;
mod compare;
mod convert;
mod eval;
mod import;
mod obstacle;
mod pictures;
mod probe;
mod render;
mod report;
mod reproduce;
mod run;
mod settings;
mod source;
mod synth;
mod table;
mod train;

use clap::{Parser, Subcommand};

/// Turns a video of a moving person, partly hidden behind objects, into a 3-D person that renders from any side.
#[derive(Parser)]
#[command(name = "cargo xtask", bin_name = "cargo xtask", version)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Trains on a scene, scores the result on unseen views, and draws it.
    Train(train::TrainArguments),
    /// Scores a run, prints a table and writes its metrics.json.
    Eval(eval::EvalArguments),
    /// Draws a run's person: its movement, from all around, or in the rest pose.
    Render(render::RenderArguments),
    /// The paper's table on captures: every baseline and ablation, several seeds, one budget.
    Reproduce(reproduce::ReproduceArguments),
    /// Makes a capture of a video from what a body estimator and a segmenter wrote.
    Import(import::ImportArguments),
    /// Tells whether a capture's body lies on its person: a picture, a table, and the mistakes that are likely.
    Check(check::CheckArguments),
    /// Writes an occluded capture of a synthetic person to disk, in a published dataset format.
    Synth(synth::SynthArguments),
    /// Runs one function of one crate on numpy arrays.
    Probe(probe::ProbeArguments),
    /// Measures what every approximation costs and is worth, and where methods break.
    Bench(bench::BenchArguments),
    /// Puts runs and benches on one HTML page that needs no other file.
    Report(report::ReportArguments),
    /// Converts a body model, .npz or .pkl, to .safetensors.
    Convert(convert::ConvertArguments),
}

fn main() -> std::process::ExitCode {
    let outcome = match Arguments::parse().command {
        Command::Train(arguments) => train::train(&arguments),
        Command::Eval(arguments) => eval::eval(&arguments),
        Command::Render(arguments) => render::render(&arguments),
        Command::Reproduce(arguments) => reproduce::reproduce(&arguments),
        Command::Import(arguments) => import::import(&arguments),
        Command::Check(arguments) => check::check(&arguments),
        Command::Synth(arguments) => synth::synth(&arguments),
        Command::Probe(arguments) => probe::probe(&arguments),
        Command::Bench(arguments) => bench::bench(&arguments),
        Command::Report(arguments) => report::report(&arguments),
        Command::Convert(arguments) => convert::convert(&arguments),
    };
    match outcome {
        Ok(()) => std::process::ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            std::process::ExitCode::FAILURE
        }
    }
}
