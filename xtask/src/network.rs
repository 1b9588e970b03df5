//! The network of LPIPS, where `--lpips` names one.

use std::path::Path;

use anyhow::Result;
use occnerf::Lpips;

/// The network that `--lpips` names.
pub fn load_lpips(path: Option<&Path>) -> Result<Option<Lpips>> {
    Ok(path.map(Lpips::load).transpose()?)
}

/// Its name, as metrics.json has it.
pub fn network_name(lpips: Option<&Lpips>) -> Option<String> {
    lpips.map(|lpips| lpips.name().to_owned())
}
