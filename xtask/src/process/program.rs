//! Entry point of a program.

use std::io::{ErrorKind, Write};
use std::process::ExitCode;
use std::thread::Builder;

use anyhow::Result;
use clap::Parser;

use super::{described, note, watch};

/// Exit codes, for the end of `--help`.
pub const EXIT_CODES: &str = "Exit codes:
  0        done
  1        something given is wrong
  2        the command line cannot be read
  3        a result cannot be written; what stood there before is whole
  4        another process has the folder
  128 + n  ended by signal n; a training saves the steps it has taken first";

/// Stack of the program's own thread, whatever the system's limit.
const STACK: usize = 8 << 20;

/// Parses the command line, runs `command`, and prints errors as one line.
pub fn program<A: Parser>(command: impl FnOnce(A) -> Result<()> + Send) -> ExitCode {
    std::thread::scope(|scope| match Builder::new().stack_size(STACK).spawn_scoped(scope, || run(command)) {
        // A panic has been printed.
        Ok(thread) => thread.join().unwrap_or(ExitCode::from(101)),
        Err(error) => {
            note!("error: a thread cannot be started: {error}");
            ExitCode::FAILURE
        }
    })
}

fn run<A: Parser>(command: impl FnOnce(A) -> Result<()>) -> ExitCode {
    let arguments = match A::try_parse() {
        Ok(arguments) => arguments,
        // Errors quote the arguments and are escaped; help is not.
        Err(error) if !error.use_stderr() => {
            let printed = error.print().and_then(|()| std::io::stdout().flush());
            let failed = printed.is_err_and(|error| error.kind() != ErrorKind::BrokenPipe);
            return ExitCode::from(if failed { 3 } else { 0 });
        }
        Err(error) => {
            note!("{}", error.to_string().trim_end());
            return ExitCode::from(2);
        }
    };
    if let Err(error) = watch() {
        note!("warning: signals end the program unsaved: {error}");
    }
    match command(arguments) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            let (text, code) = described(&error);
            note!("{text}");
            ExitCode::from(code)
        }
    }
}
