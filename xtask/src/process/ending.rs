//! Exit codes and one-line error messages.

use std::io;
use std::path::{Path, PathBuf};

use anyhow::Error;
use occnerf::capture::CaptureError;

use super::print::{failure, shown};

/// Longest message, characters; some quote a file.
const LONGEST: usize = 2000;

/// Errors with their own exit code; others exit with 1, a malformed command line with 2.
#[derive(Debug, thiserror::Error)]
pub enum Ending {
    /// A result cannot be written; the previous file is intact.
    #[error("{}: cannot be written: {source}", path.display())]
    Unwritten {
        /// The file.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// Another process works in the folder.
    #[error("{} is in use by another process: wait for its end, or take another folder", .0.display())]
    Busy(PathBuf),
    /// A signal came; the steps taken are saved.
    #[error("stopped by {}; {after}", name(*.signal))]
    Stopped {
        /// Its number.
        signal: i32,
        /// What is saved.
        after: String,
    },
}

impl Ending {
    fn code(&self) -> u8 {
        match self {
            Self::Unwritten { .. } => 3,
            Self::Busy(_) => 4,
            // Shell convention.
            Self::Stopped { signal, .. } => 128 + u8::try_from(*signal).unwrap_or(0) % 127,
        }
    }
}

/// Converts an I/O error of a result.
pub fn unwritten(path: &Path) -> impl FnOnce(io::Error) -> Error + '_ {
    move |source| Ending::Unwritten { path: path.to_owned(), source }.into()
}

/// Checks that all was printed, for commands whose result is their output.
///
/// # Errors
/// [`Ending::Unwritten`].
pub fn delivered() -> Result<(), Error> {
    failure().map_or(Ok(()), Err).map_err(unwritten(Path::new("standard output")))
}

/// Whether nothing can be written because that is forbidden.
pub fn is_read_only(error: &Error) -> bool {
    let forbidden = |source: &io::Error| {
        matches!(source.kind(), io::ErrorKind::PermissionDenied | io::ErrorKind::ReadOnlyFilesystem)
    };
    matches!(error.downcast_ref(), Some(Ending::Unwritten { source, .. }) if forbidden(source))
}

/// Converts library errors on files in `place`, where results go; others are returned as they are.
pub fn results_in(place: &Path) -> impl Fn(Error) -> Error + '_ {
    move |error| {
        let found = error.chain().find_map(file_and_reason).filter(|(path, _)| path.starts_with(place));
        match found {
            Some((path, reason)) => {
                // I/O errors cannot be cloned.
                let source = io::Error::new(reason.kind(), reason.to_string());
                Ending::Unwritten { path: path.to_owned(), source }.into()
            }
            None => error,
        }
    }
}

fn file_and_reason<'a>(cause: &'a (dyn std::error::Error + 'static)) -> Option<(&'a Path, &'a io::Error)> {
    fn of_array(error: &array_files::Error) -> Option<(&Path, &io::Error)> {
        let array_files::Error::Io { path, source } = error else { return None };
        Some((path, source))
    }
    fn of_capture(error: &CaptureError) -> Option<(&Path, &io::Error)> {
        match error {
            CaptureError::Io { path, source } => Some((path, source)),
            CaptureError::Array(error) => of_array(error),
            _ => None,
        }
    }
    match cause.downcast_ref::<occnerf::Error>() {
        Some(occnerf::Error::Io { path, source }) => Some((path, source)),
        Some(occnerf::Error::Data(error)) => of_capture(error),
        Some(occnerf::Error::Array(error)) => of_array(error),
        Some(_) => None,
        None => {
            let array = || cause.downcast_ref().and_then(of_array);
            cause.downcast_ref().and_then(of_capture).or_else(array)
        }
    }
}

fn name(signal: i32) -> String {
    match signal {
        1 => "SIGHUP".to_owned(),
        2 => "SIGINT".to_owned(),
        15 => "SIGTERM".to_owned(),
        other => format!("signal {other}"),
    }
}

/// Message and exit code of an error that ends the program.
pub fn described(error: &Error) -> (String, u8) {
    let ending = error.chain().find_map(|cause| cause.downcast_ref::<Ending>());
    let line = one_line(error);
    match ending {
        Some(Ending::Stopped { .. }) => (line, ending.map_or(1, Ending::code)),
        _ => (format!("error: {line}"), ending.map_or(1, Ending::code)),
    }
}

/// An error and its causes, without repetitions, on one line of limited length.
pub fn one_line(error: &Error) -> String {
    let mut text = String::new();
    for cause in error.chain() {
        let cause = cause.to_string();
        // Transparent errors quote their cause.
        if text.ends_with(&cause) {
            continue;
        }
        if !text.is_empty() {
            text.push_str(": ");
        }
        text.push_str(&cause);
    }
    let lines: Vec<&str> = text.lines().map(str::trim).filter(|line| !line.is_empty()).collect();
    cut(&shown(&lines.join(" ")))
}

/// Elides the middle of a long text.
fn cut(text: &str) -> String {
    let count = text.chars().count();
    if count <= LONGEST {
        return text.to_owned();
    }
    let start: String = text.chars().take(LONGEST / 2).collect();
    let end: String = text.chars().skip(count - LONGEST / 4).collect();
    format!("{start} … ({} characters left out) … {end}", count - LONGEST / 2 - LONGEST / 4)
}

#[cfg(test)]
mod tests {
    use anyhow::{Context, anyhow};

    use super::*;

    #[test]
    fn a_cause_is_said_once_on_one_line_without_escapes() {
        let gone = io::Error::from(io::ErrorKind::NotFound);
        let path = PathBuf::from("a\u{1b}[31m\nb.npz");
        let error = Error::from(array_files::Error::Io { path, source: gone }).context("the body");
        let (text, code) = described(&error);
        assert_eq!((text.as_str(), code), ("error: the body: a\\u{1b}[31m b.npz: entity not found", 1));
    }

    #[test]
    fn ends_have_codes_of_their_own_under_any_context() {
        let full = || io::Error::from_raw_os_error(28);
        let unwritten = Err::<(), _>(full()).map_err(unwritten(Path::new("x"))).context("saving").unwrap_err();
        assert_eq!(described(&unwritten).1, 3);
        assert_eq!(described(&Ending::Busy("x".into()).into()).1, 4);
        let (text, code) = described(&Ending::Stopped { signal: 15, after: "saved".to_owned() }.into());
        assert_eq!((text.as_str(), code), ("stopped by SIGTERM; saved", 143));
        assert_eq!(described(&anyhow!("x")).1, 1);
    }
}
