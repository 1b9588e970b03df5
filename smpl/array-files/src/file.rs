//! Whole files, up to a limit.

use std::fs::File;
use std::io::{self, ErrorKind, Read};
use std::path::Path;

use crate::Error;

/// Largest file that is read, in bytes: 2 GiB.
pub(crate) const MAX_FILE_BYTES: u64 = 1 << 31;
/// Most bytes that are read of what is no plain file: 256 MiB.
const MAX_PIPED_BYTES: u64 = 1 << 28;

/// Reads a file of at most `limit` bytes; a device or a pipe, whose reported length means nothing, of
/// at most 256 MiB too.
///
/// ```
/// # let path = std::env::temp_dir().join("array-files-bounded.txt");
/// std::fs::write(&path, "four")?;
/// assert_eq!(array_files::read_bounded(&path, 4)?, b"four");
/// let error = array_files::read_bounded(&path, 3).unwrap_err();
/// assert_eq!(error.to_string(), "more than 3 bytes, the most that is read of such a file");
/// # std::fs::remove_file(&path)?;
/// # Ok::<(), std::io::Error>(())
/// ```
///
/// # Errors
/// Those of the system; [`ErrorKind::FileTooLarge`] beyond the limit; [`ErrorKind::OutOfMemory`].
pub fn read_bounded(path: &Path, limit: u64) -> io::Result<Vec<u8>> {
    let file = File::open(path)?;
    let found = file.metadata()?;
    let limit = if found.is_file() { limit } else { limit.min(MAX_PIPED_BYTES) };
    let read = if found.len() > limit { None } else { read_limited(file, found.len() as usize, limit)? };
    read.ok_or_else(|| {
        let what = format!("more than {limit} bytes, the most that is read of such a file");
        io::Error::new(ErrorKind::FileTooLarge, what)
    })
}

/// Reads an array file: at most 2 GiB by [`read_bounded`].
///
/// # Errors
/// [`Error::Io`]; [`Error::Invalid`] for a web page.
pub fn read_file(path: &Path) -> Result<Vec<u8>, Error> {
    let bytes = read_bounded(path, MAX_FILE_BYTES).map_err(Error::io(path))?;
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
pub(crate) fn read_limited(reader: impl Read, expected: usize, limit: u64) -> io::Result<Option<Vec<u8>>> {
    let mut bytes = Vec::new();
    bytes.try_reserve_exact(expected)?;
    reader.take(limit + 1).read_to_end(&mut bytes)?;
    Ok(Some(bytes).filter(|bytes| bytes.len() as u64 <= limit))
}

/// Bytes that `packed` compressed bytes may expand to: 256 times as many and 64 MiB, at most
/// [`MAX_FILE_BYTES`]. Measurements compress little; runs of zeros do a thousandfold.
pub(crate) fn unpacked_limit(packed: u64) -> u64 {
    packed.saturating_mul(256).saturating_add(64 << 20).min(MAX_FILE_BYTES)
}
