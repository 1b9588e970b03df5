//! The commands.

use anyhow::Result;
use clap::{Parser, Subcommand};

use crate::process::{EXIT_CODES, delivered};
use crate::run::use_threads;
use crate::{check, eval, export, import, list, render, train, view};

/// Turns a video of a moving person, partly hidden behind objects, into a 3-D person that renders
/// from any side.
#[derive(Parser)]
#[command(name = "cargo xtask", bin_name = "cargo xtask", version, after_help = EXIT_CODES)]
pub struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Trains on a scene, scores the result on unseen views, and draws it.
    Train(Box<train::TrainArguments>),
    /// Scores a run, prints a table and writes its metrics.json.
    Eval(eval::EvalArguments),
    /// Draws a run's person: its movement, from all around, or in the rest pose.
    Render(render::RenderArguments),
    /// Writes a run's person in a form that other programs open: skinned avatar, splats, mesh,
    /// motion.
    Export(export::ExportArguments),
    /// Writes a run's person as one HTML page, to turn around and play.
    View(view::ViewArguments),
    /// Makes a capture of a video from the results of a body estimator and a segmenter.
    Import(import::ImportArguments),
    /// Checks that a capture's body lies on its person: a picture, a table, and likely mistakes.
    Check(check::CheckArguments),
}

impl Arguments {
    /// Runs the command.
    pub fn run(self) -> Result<()> {
        let threads = match &self.command {
            Command::Train(arguments) => arguments.threads,
            Command::Eval(arguments) => arguments.threads,
            Command::Render(arguments) => arguments.threads,
            _ => None,
        };
        use_threads(threads)?;
        match self.command {
            Command::Train(arguments) if arguments.list.is_some() => list::train_list(&arguments),
            Command::Train(arguments) => train::train(&arguments),
            // The results of these are what they print.
            Command::Eval(arguments) => eval::eval(&arguments).and_then(|()| delivered()),
            Command::Check(arguments) => check::check(&arguments).and_then(|()| delivered()),
            Command::Render(arguments) => render::render(&arguments),
            Command::Export(arguments) => export::export(&arguments),
            Command::View(arguments) => view::view(&arguments),
            Command::Import(arguments) => import::import(&arguments),
        }
    }
}
