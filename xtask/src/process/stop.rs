//! Termination signals: SIGINT, SIGTERM and SIGHUP.

use std::sync::atomic::{AtomicI32, AtomicUsize, Ordering};

/// Signal received under a guard; 0 for none.
static SIGNAL: AtomicI32 = AtomicI32::new(0);
/// Number of guards.
static GUARDS: AtomicUsize = AtomicUsize::new(0);

/// Defers the first signal; a second one, or one without a guard, ends the program at once. Files
/// stay whole, see [`occnerf::replace_file`].
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
    use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};

    let signals = match ignored() {
        Some(ignored) => [SIGHUP, SIGINT, SIGTERM].into_iter().filter(|s| ignored >> (s - 1) & 1 == 0).collect(),
        None => vec![SIGINT, SIGTERM],
    };
    let mut signals = signal_hook::iterator::Signals::new(signals)?;
    std::thread::spawn(move || {
        for signal in signals.forever() {
            if GUARDS.load(Ordering::SeqCst) == 0 || SIGNAL.swap(signal, Ordering::SeqCst) != 0 {
                std::process::exit(128 + signal);
            }
        }
    });
    Ok(())
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
