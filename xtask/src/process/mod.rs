//! Output, exit codes, signals and locks.

mod ending;
mod lock;
mod print;
mod program;
mod stop;

pub use self::ending::{Ending, described, one_line, results_in, unwritten};
pub use self::lock::Lock;
pub use self::print::{err, out};
pub use self::program::{EXIT_CODES, program};
pub use self::stop::{Guard, watch};
pub use crate::{note, say};
