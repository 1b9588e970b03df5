//! Output, exit codes, signals and locks.

mod ending;
mod lock;
mod memory;
mod print;
mod program;
mod stop;

pub use self::ending::{Ending, delivered, described, is_read_only, one_line, results_in, unwritten};
pub use self::lock::{Lock, still_held};
pub use self::memory::{check_memory, free_bytes, peak_rss_bytes};
pub use self::print::{err, out, telling};
pub use self::program::{EXIT_CODES, program};
pub use self::stop::{Guard, watch};
pub use crate::{note, say};
