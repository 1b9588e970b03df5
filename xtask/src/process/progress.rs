//! A sign of life of what takes long.

use std::sync::mpsc::{RecvTimeoutError, channel};
use std::thread::{Builder, scope};
use std::time::{Duration, Instant};

use crate::note;

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
