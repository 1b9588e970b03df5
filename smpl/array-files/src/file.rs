//! Whole files, up to a limit.

use std::io::Read;
use std::path::Path;

use crate::Error;

/// Largest file that is read, in bytes: 2 GiB.
pub(crate) const MAX_FILE_BYTES: u64 = 1 << 31;

/// Reads a whole file of at most 2 GiB. Devices and pipes, which report no length, are read up to
/// that limit.
///
/// # Errors
/// [`Error::Io`]; [`Error::TooLarge`].
pub fn read_file(path: &Path) -> Result<Vec<u8>, Error> {
    let file = std::fs::File::open(path).map_err(Error::io(path))?;
    let length = file.metadata().map_err(Error::io(path))?.len();
    let too_large = |claimed: u64| Error::too_large(&path.display().to_string(), "", claimed.into(), MAX_FILE_BYTES);
    if length > MAX_FILE_BYTES {
        return Err(too_large(length));
    }
    let bytes = read_limited(file, length as usize, MAX_FILE_BYTES).map_err(Error::io(path))?;
    bytes.ok_or_else(|| too_large(MAX_FILE_BYTES + 1))
}

/// Everything from `reader`, or `None` if it is more than `limit` bytes; `expected` bytes are
/// reserved.
pub(crate) fn read_limited(reader: impl Read, expected: usize, limit: u64) -> std::io::Result<Option<Vec<u8>>> {
    let mut bytes = Vec::new();
    bytes.reserve_exact(expected);
    reader.take(limit + 1).read_to_end(&mut bytes)?;
    Ok(Some(bytes).filter(|bytes| bytes.len() as u64 <= limit))
}

/// Bytes that `packed` compressed bytes may expand to: 256 times as many and 64 MiB, at most
/// [`MAX_FILE_BYTES`]. Measurements hardly compress; runs of zeros do a thousandfold.
pub(crate) fn unpacked_limit(packed: u64) -> u64 {
    packed.saturating_mul(256).saturating_add(64 << 20).min(MAX_FILE_BYTES)
}
