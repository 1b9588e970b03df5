//! The LPIPS network of `--lpips`.

use std::path::Path;

use anyhow::Result;
use occnerf::Lpips;

/// Loads the network.
pub fn load_lpips(path: Option<&Path>) -> Result<Option<Lpips>> {
    Ok(path.map(Lpips::load).transpose()?)
}

/// Its name in metrics.json.
pub fn network_name(lpips: Option<&Lpips>) -> Option<String> {
    lpips.map(|lpips| lpips.name().to_owned())
}
