//! `cargo lab`: the laboratory. It measures what the product's methods cost and are worth.
#![warn(clippy::print_stdout, clippy::print_stderr, reason = "printing must never stop work: see process::print")]

mod bench;
mod budget;
mod front;
mod methods;
mod obstacle;
mod probe;
mod report;
mod reproduce;
mod results;
mod scene;
mod sweep;
mod synth;

use anyhow::Result;
use clap::{Parser, Subcommand};
use xtask::process::EXIT_CODES;

/// Measures what the methods of OccNeRF cost and are worth.
#[derive(Parser)]
#[command(name = "cargo lab", bin_name = "cargo lab", version, after_help = EXIT_CODES)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// The paper's table on captures: every baseline and ablation, several seeds, one budget.
    Reproduce(Box<reproduce::ReproduceArguments>),
    /// Measures what every approximation costs and is worth, and where methods break.
    Bench(bench::BenchArguments),
    /// Splits the error of runs by its causes.
    Budget(budget::BudgetArguments),
    /// Puts runs and benches on one HTML page that needs no other file.
    Report(report::ReportArguments),
    /// Draws what the camera saw beside the person from unseen sides: README's picture.
    Front(front::FrontArguments),
    /// Writes an occluded capture of a synthetic person to disk, in a published dataset format.
    Synth(synth::SynthArguments),
    /// Runs one function of one crate on numpy arrays.
    Probe(probe::ProbeArguments),
}

fn run(arguments: Arguments) -> Result<()> {
    match arguments.command {
        Command::Reproduce(arguments) => reproduce::reproduce(&arguments),
        Command::Bench(arguments) => bench::bench(&arguments),
        Command::Budget(arguments) => budget::budget(&arguments),
        Command::Report(arguments) => report::report(&arguments),
        Command::Front(arguments) => front::front(&arguments),
        Command::Synth(arguments) => synth::synth(&arguments),
        Command::Probe(arguments) => probe::probe(&arguments),
    }
}

fn main() -> std::process::ExitCode {
    xtask::process::program(run)
}
