//! Memory limit of concurrent decoding.

use std::sync::{Condvar, Mutex, PoisonError};

/// Weighted semaphore over bytes.
#[derive(Debug)]
pub(super) struct Gate {
    limit: u64,
    taken: Mutex<u64>,
    freed: Condvar,
}

impl Gate {
    /// Admits `limit` bytes in total.
    pub fn new(limit: u64) -> Self {
        Self { limit, taken: Mutex::new(0), freed: Condvar::new() }
    }

    /// Runs `work` once its bytes are admitted; work above the limit runs alone. `work` must not
    /// wait for other threads, which may be blocked here.
    pub fn pass<T>(&self, bytes: u64, work: impl FnOnce() -> T) -> T {
        let fits = |taken: &mut u64| *taken > 0 && taken.saturating_add(bytes) > self.limit;
        // The count stays valid when a decoder panics.
        let taken = self.taken.lock().unwrap_or_else(PoisonError::into_inner);
        let mut taken = self.freed.wait_while(taken, fits).unwrap_or_else(PoisonError::into_inner);
        *taken += bytes;
        drop(taken);
        let _leave = Leave { gate: self, bytes };
        work()
    }
}

/// Releases the bytes on drop, also on a panic.
struct Leave<'a> {
    gate: &'a Gate,
    bytes: u64,
}

impl Drop for Leave<'_> {
    fn drop(&mut self) {
        *self.gate.taken.lock().unwrap_or_else(PoisonError::into_inner) -= self.bytes;
        self.gate.freed.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicU64, Ordering};

    use super::*;

    #[test]
    fn no_more_is_inside_than_fits_and_everybody_gets_in() {
        let (gate, inside, most, done) = (Gate::new(10), AtomicU64::new(0), AtomicU64::new(0), AtomicU64::new(0));
        std::thread::scope(|scope| {
            for thread in 0..16u64 {
                let (gate, inside, most, done) = (&gate, &inside, &most, &done);
                scope.spawn(move || {
                    for round in 0..20 {
                        // 25 is more than the gate has: it goes in alone.
                        let bytes = [3, 4, 10, 25][((thread + round) % 4) as usize];
                        gate.pass(bytes, || {
                            let now = inside.fetch_add(bytes, Ordering::SeqCst) + bytes;
                            if bytes <= 10 {
                                most.fetch_max(now, Ordering::SeqCst);
                            } else {
                                assert_eq!(now, bytes);
                            }
                            std::thread::yield_now();
                            inside.fetch_sub(bytes, Ordering::SeqCst);
                            done.fetch_add(1, Ordering::SeqCst);
                        });
                    }
                });
            }
        });
        assert_eq!(done.into_inner(), 320);
        assert!((1..=10).contains(&most.into_inner()));
    }

    #[test]
    fn a_decoder_that_panics_leaves_the_gate() {
        let gate = Gate::new(1);
        let panicked = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| gate.pass(1, || panic!("broken"))));
        assert!(panicked.is_err());
        assert_eq!(gate.pass(1, || 7), 7);
    }
}
