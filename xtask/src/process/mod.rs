//! The program among others: what it prints, how it ends, what stops it, and what it has to itself.

mod ending;
mod lock;
mod print;
mod stop;

pub use self::ending::{Ending, described, one_line, results_in, unwritten};
pub use self::lock::Lock;
pub use self::print::{err, out};
pub(crate) use self::print::{note, say};
pub use self::stop::{Guard, watch};
