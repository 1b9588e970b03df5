//! Memory that the process takes, and may take.

use anyhow::{Result, ensure};
use array_files::read_bounded;

/// Largest file that is read, bytes.
const MOST: u64 = 1 << 20;

/// A number of a file under /proc, where there is one.
fn number(path: &str, key: &str) -> Option<u64> {
    let text = read_bounded(path.as_ref(), MOST).ok()?;
    let text = String::from_utf8_lossy(&text);
    let line = text.lines().find_map(|line| line.strip_prefix(key))?;
    line.split_whitespace().next()?.parse().ok()
}

/// Peak resident set of this process; 0 where unknown.
pub fn peak_rss_bytes() -> u64 {
    number("/proc/self/status", "VmHWM:").map_or(0, |kib| kib << 10)
}

/// Free memory of the machine, where the system says.
pub fn free_bytes() -> Option<u64> {
    number("/proc/meminfo", "MemAvailable:").map(|kib| kib << 10)
}

/// Address space of the program itself: code, stacks and what the allocator reserves, bytes.
const PROGRAM: u64 = 192 << 20;

/// Checks that the process's address space has room for that much memory in all. An allocation
/// beyond its limit aborts.
///
/// # Errors
/// If the limit is lower.
pub fn check_memory(bytes: u64) -> Result<()> {
    let need = (PROGRAM + bytes) >> 20;
    let limit = number("/proc/self/limits", "Max address space").map_or(u64::MAX, |limit| limit >> 20);
    ensure!(
        need <= limit,
        "memory: about {need} MiB are needed, the process is limited to {limit} (ulimit -v); raise that, or load \
         less (--memory, --resize, --max-frames)"
    );
    Ok(())
}
