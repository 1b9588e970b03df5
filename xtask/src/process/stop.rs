//! Signals that ask the program to end: Ctrl-C, SIGTERM, and SIGHUP of a closed terminal.

use std::sync::atomic::{AtomicI32, AtomicUsize, Ordering};

/// The signal that came while something was guarded; 0 for none.
static SIGNAL: AtomicI32 = AtomicI32::new(0);
/// Guards that live.
static GUARDS: AtomicUsize = AtomicUsize::new(0);

/// Work that is asked to end rather than ended: while a guard lives, the first signal is only
/// remembered, and a second ends the program at once. Without a guard any signal does, and no file
/// is left half written by that: see [`occnerf::replace_file`].
#[must_use]
pub struct Guard(());

impl Guard {
    /// Guards what follows.
    pub fn begin() -> Self {
        GUARDS.fetch_add(1, Ordering::SeqCst);
        Self(())
    }

    /// The signal that came, if one did.
    pub fn signal(&self) -> Option<i32> {
        Some(SIGNAL.load(Ordering::SeqCst)).filter(|&signal| signal != 0)
    }
}

impl Drop for Guard {
    fn drop(&mut self) {
        GUARDS.fetch_sub(1, Ordering::SeqCst);
    }
}

/// Listens from now on. What the program was started to ignore (SIGHUP under `nohup`, SIGINT in the
/// background of a script) stays ignored, as far as the system tells.
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

/// Elsewhere the system's own way holds.
#[cfg(not(unix))]
pub fn watch() -> std::io::Result<()> {
    Ok(())
}

/// The signals that this process ignores, the first in the lowest bit; `None` where the system does
/// not tell.
#[cfg(unix)]
fn ignored() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"))?;
    u64::from_str_radix(mask.trim(), 16).ok()
}
