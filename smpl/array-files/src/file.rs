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
/// [`Error::Io`]; [`Error::Invalid`] for a larger file and for a web page.
pub fn read_file(path: &Path) -> Result<Vec<u8>, Error> {
    let file = std::fs::File::open(path).map_err(Error::io(path))?;
    let length = file.metadata().map_err(Error::io(path))?.len();
    let too_large = |claimed: u64| Error::too_large(&path.display().to_string(), "", claimed.into(), MAX_FILE_BYTES);
    if length > MAX_FILE_BYTES {
        return Err(too_large(length));
    }
    let bytes = read_limited(file, length as usize, MAX_FILE_BYTES).map_err(Error::io(path))?;
    let bytes = bytes.ok_or_else(|| too_large(MAX_FILE_BYTES + 1))?;
    let start = decode_text(&bytes[..bytes.len().min(256)]).trim_start().to_ascii_lowercase();
    if start.starts_with("<!doctype html") || start.starts_with("<html") {
        let message = "a web page (HTML), as sites send it in place of a file that needs a login";
        return Err(Error::invalid(&path.display().to_string(), "", message.to_owned()));
    }
    Ok(bytes)
}

/// The text of a file as editors on any system write it: UTF-8, with a byte-order mark or without, or
/// UTF-16 with one; line ends of `\r\n` and `\r` become `\n`. What is not valid becomes U+FFFD.
///
/// ```
/// use array_files::decode_text;
/// assert_eq!(decode_text(b"\xef\xbb\xbfv 0 0 0\r\nv 1 0 0\r"), "v 0 0 0\nv 1 0 0\n");
/// assert_eq!(decode_text(b"\xff\xfe{\0}\0"), "{}");
/// ```
pub fn decode_text(bytes: &[u8]) -> String {
    let utf16 = |bytes: &[u8], from: fn([u8; 2]) -> u16| {
        let units: Vec<u16> = bytes.chunks(2).map(|pair| from([pair[0], *pair.get(1).unwrap_or(&0)])).collect();
        String::from_utf16_lossy(&units)
    };
    let text = match bytes {
        [0xEF, 0xBB, 0xBF, rest @ ..] => String::from_utf8_lossy(rest).into_owned(),
        [0xFF, 0xFE, rest @ ..] => utf16(rest, u16::from_le_bytes),
        [0xFE, 0xFF, rest @ ..] => utf16(rest, u16::from_be_bytes),
        _ => String::from_utf8_lossy(bytes).into_owned(),
    };
    if text.contains('\r') { text.replace("\r\n", "\n").replace('\r', "\n") } else { text }
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
