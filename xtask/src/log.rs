//! The log of a run, as far as its checkpoint goes.

use std::path::Path;

use anyhow::{Context, Result};

use crate::run::LOG;

/// Seconds of training that the first `steps` steps of the run in `directory` took, as far as its log knows.
pub fn logged_seconds(directory: &Path, steps: u64) -> Result<f64> {
    Ok(earlier_log(&directory.join(LOG), steps)?.seconds)
}

/// What an earlier sitting logged.
pub struct EarlierLog {
    pub text: String,
    pub seconds: f64,
    pub steps: u64,
}

/// The log up to the checkpoint; lines of steps that the checkpoint does not hold are dropped.
pub fn earlier_log(path: &Path, steps: u64) -> Result<EarlierLog> {
    let mut log = EarlierLog { text: String::new(), seconds: 0.0, steps };
    if steps == 0 || !path.exists() {
        return Ok(log);
    }
    for line in std::fs::read_to_string(path).with_context(|| path.display().to_string())?.lines() {
        let Ok(value) = serde_json::from_str::<serde_json::Value>(line) else { continue };
        if value["step"].as_u64().is_some_and(|s| s <= steps) {
            log.text.push_str(line);
            log.text.push('\n');
            log.seconds = value["seconds"].as_f64().unwrap_or(log.seconds);
        }
    }
    Ok(log)
}
