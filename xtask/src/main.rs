//! `cargo xtask`: train, evaluate and render people from occluded videos.
#![warn(clippy::print_stdout, clippy::print_stderr, reason = "printing must never stop work: see process::print")]

mod avatar;
mod baked;
mod bench;
mod budget;
mod capacity;
mod check;
mod convert;
mod eval;
mod export;
mod film;
mod font;
mod front;
mod html;
mod import;
mod list;
mod network;
mod obstacle;
mod optimise;
mod pictures;
mod preview;
mod probe;
mod process;
mod render;
mod report;
mod reproduce;
mod results;
mod run;
mod scale;
mod settings;
mod shard;
mod source;
mod synth;
mod table;
mod train;
mod video;
mod view;

use clap::{Parser, Subcommand};

use crate::process::note;

/// Turns a video of a moving person, partly hidden behind objects, into a 3-D person that renders
/// from any side.
#[derive(Parser)]
#[command(name = "cargo xtask", bin_name = "cargo xtask", version, after_help = EXIT_CODES)]
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
    /// Draws what the camera saw beside the person from unseen sides: README's picture.
    Front(front::FrontArguments),
    /// Writes a run's person in a form that other programs open: skinned avatar, splats, mesh,
    /// motion.
    Export(export::ExportArguments),
    /// Writes a run's person as one HTML page, to turn around and play.
    View(view::ViewArguments),
    /// The paper's table on captures: every baseline and ablation, several seeds, one budget.
    Reproduce(reproduce::ReproduceArguments),
    /// Makes a capture of a video from what a body estimator and a segmenter wrote.
    Import(import::ImportArguments),
    /// Tells whether a capture's body lies on its person: a picture, a table, and the mistakes that
    /// are likely.
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

const EXIT_CODES: &str = "Exit codes:
  0        done
  1        something given is wrong
  2        the command line cannot be read
  3        a result cannot be written; what stood there before is whole
  4        another process has the folder
  128 + n  ended by signal n, with everything saved";

fn main() -> std::process::ExitCode {
    let command = match Arguments::try_parse() {
        Ok(arguments) => arguments.command,
        // Help is ours; an error quotes what was given.
        Err(error) if !error.use_stderr() => {
            let _ = error.print();
            return std::process::ExitCode::SUCCESS;
        }
        Err(error) => {
            note!("{}", error.to_string().trim_end());
            return std::process::ExitCode::from(2);
        }
    };
    if let Err(error) = process::watch() {
        note!("warning: signals end the program unsaved: {error}");
    }
    let outcome = match command {
        Command::Train(arguments) if arguments.list.is_some() => list::train_list(&arguments),
        Command::Train(arguments) => train::train(&arguments),
        Command::Eval(arguments) => eval::eval(&arguments),
        Command::Render(arguments) => render::render(&arguments),
        Command::Front(arguments) => front::front(&arguments),
        Command::Export(arguments) => export::export(&arguments),
        Command::View(arguments) => view::view(&arguments),
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
            let (text, code) = process::described(&error);
            note!("{text}");
            std::process::ExitCode::from(code)
        }
    }
}
