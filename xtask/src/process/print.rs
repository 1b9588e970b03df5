//! Printing, which never stops work and escapes terminal control characters, and a sign of life of
//! what takes long.

use std::fmt::{Arguments, Write as _};
use std::io::{Error, ErrorKind, Write};
use std::sync::atomic::{AtomicI32, Ordering};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::thread::{Builder, scope};
use std::time::{Duration, Instant};

/// System's code of the last failed write to standard output; 0 for none.
static FAILED: AtomicI32 = AtomicI32::new(0);

/// Prints a line on standard output, as `println!` takes it.
#[macro_export]
macro_rules! say {
    ($($text:tt)*) => { $crate::process::out(format_args!($($text)*)) };
}

/// Prints a line on standard error.
#[macro_export]
macro_rules! note {
    ($($text:tt)*) => { $crate::process::err(format_args!($($text)*)) };
}

/// Prints a line on standard output.
pub fn out(text: Arguments<'_>) {
    if let Err(error) = line(&mut std::io::stdout().lock(), text)
        && error.kind() != ErrorKind::BrokenPipe
    {
        FAILED.store(error.raw_os_error().unwrap_or(0), Ordering::Relaxed);
    }
}

/// Error of the last failed write to standard output, but for a closed pipe, which wants no more.
pub fn failure() -> Option<Error> {
    Some(FAILED.load(Ordering::Relaxed)).filter(|code| *code != 0).map(Error::from_raw_os_error)
}

/// Prints a line on standard error.
pub fn err(text: Arguments<'_>) {
    // Results do not depend on a closed pipe or a full disk.
    let _ = line(&mut std::io::stderr().lock(), text);
}

fn line(to: &mut impl Write, text: Arguments<'_>) -> std::io::Result<()> {
    let mut text = shown(&text.to_string());
    text.push('\n');
    to.write_all(text.as_bytes()).and_then(|()| to.flush())
}

/// Text with control and bidirectional characters, except line breaks and tabs, as `\u{…}`.
pub fn shown(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        let turns = matches!(c, '\u{200e}' | '\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}');
        if turns || c.is_control() && c != '\n' && c != '\t' {
            let _ = write!(out, "{}", c.escape_unicode());
        } else {
            out.push(c);
        }
    }
    out
}

/// Silence before the first line, and between two.
const FIRST: Duration = Duration::from_secs(2);
const NEXT: Duration = Duration::from_secs(15);

/// Does `work`, naming it on standard error if it takes more than two seconds.
pub fn telling<T>(what: &str, work: impl FnOnce() -> T) -> T {
    let (end, ended) = channel::<()>();
    scope(|scope| {
        let watch = move || {
            let (begun, mut silence) = (Instant::now(), FIRST);
            while ended.recv_timeout(silence) == Err(RecvTimeoutError::Timeout) {
                note!("{what}: {:.0} s …", begun.elapsed().as_secs_f64());
                silence = NEXT;
            }
        };
        // Without a thread to spare, in silence.
        let _ = Builder::new().spawn_scoped(scope, watch);
        let made = work();
        drop(end);
        made
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_that_steers_a_terminal_is_left() {
        let hostile = "a\u{1b}[2J\u{1b}]0;title\u{7}b\r\u{9b}31m\u{202e}c\u{2066}\u{7f}\n\té 日";
        let text = shown(hostile);
        assert!(text.chars().all(|c| c == '\n' || c == '\t' || !c.is_control()), "{text:?}");
        assert!(text.starts_with("a\\u{1b}[2J") && text.ends_with("\n\té 日"), "{text:?}");
        assert!(!text.contains('\u{202e}') && !text.contains('\u{2066}'));
    }
}
