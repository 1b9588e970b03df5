//! Termination signals: SIGINT, SIGTERM and SIGHUP.

use std::sync::atomic::{AtomicI32, AtomicUsize, Ordering};

/// Signal received under a guard; 0 for none.
static SIGNAL: AtomicI32 = AtomicI32::new(0);
/// Number of guards.
static GUARDS: AtomicUsize = AtomicUsize::new(0);

/// Defers the first signal; a second one, or one without a guard, ends the program at once. Files
/// stay whole, see [`array_files::replace_file`].
#[must_use]
pub struct Guard(());

impl Guard {
    /// Starts deferring signals.
    pub fn begin() -> Self {
        GUARDS.fetch_add(1, Ordering::SeqCst);
        Self(())
    }

    /// The deferred signal.
    pub fn signal(&self) -> Option<i32> {
        Some(SIGNAL.load(Ordering::SeqCst)).filter(|&signal| signal != 0)
    }
}

impl Drop for Guard {
    fn drop(&mut self) {
        GUARDS.fetch_sub(1, Ordering::SeqCst);
    }
}

/// Starts listening. Signals ignored at start (SIGHUP under `nohup`, SIGINT in the background of a
/// script) stay ignored.
#[cfg(unix)]
pub fn watch() -> std::io::Result<()> {
    use std::thread::{Builder, sleep};
    use std::time::Duration;

    use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};

    use super::ending::Ending;
    use crate::note;

    let signals = match ignored() {
        Some(ignored) => [SIGHUP, SIGINT, SIGTERM].into_iter().filter(|s| ignored >> (s - 1) & 1 == 0).collect(),
        None => vec![SIGINT, SIGTERM],
    };
    let mut signals = signal_hook::iterator::Signals::new(signals)?;
    let listen = move || {
        for signal in signals.forever() {
            let guarded = GUARDS.load(Ordering::SeqCst) != 0;
            if guarded && SIGNAL.swap(signal, Ordering::SeqCst) == 0 {
                continue;
            }
            let made = if guarded { "what was saved before stays" } else { "the result had not been made" };
            let after = format!("{made}, and every file is whole");
            // Standard error may be blocked.
            let said = Builder::new().spawn(move || note!("{}", Ending::Stopped { signal, after }));
            let waits = |_: &u32| said.as_ref().is_ok_and(|said| !said.is_finished());
            (0..50).take_while(waits).for_each(|_| sleep(Duration::from_millis(10)));
            std::process::exit(128 + signal);
        }
    };
    Builder::new().spawn(listen).map(drop)
}

/// No handling on other systems.
#[cfg(not(unix))]
pub fn watch() -> std::io::Result<()> {
    Ok(())
}

/// Mask of ignored signals, the first in the lowest bit; `None` where unknown.
#[cfg(unix)]
fn ignored() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"))?;
    u64::from_str_radix(mask.trim(), 16).ok()
}
