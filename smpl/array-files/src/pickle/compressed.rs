//! Files compressed by joblib.

use std::io::Read;

use crate::Error;
use crate::file::{read_limited, unpacked_limit};

/// `bytes` unpacked if they start as zlib or gzip do; else themselves. No pickle starts like any
/// compressed file.
pub(super) fn unpacked(file: &str, bytes: Vec<u8>) -> Result<Vec<u8>, Error> {
    let source = bytes.as_slice();
    let malformed = |message: String| Error::Pickle { file: file.to_owned(), offset: 0, message };
    let (name, reader): (&str, Box<dyn Read + '_>) = match source {
        // The two bytes of a zlib header are a multiple of 31.
        [0x78, flags, ..] if (0x7800 + u16::from(*flags)).is_multiple_of(31) => {
            ("zlib", Box::new(flate2::read::ZlibDecoder::new(source)))
        }
        [0x1f, 0x8b, ..] => ("gzip", Box::new(flate2::read::MultiGzDecoder::new(source))),
        [b'B', b'Z', b'h', ..]
        | [0x5d, 0, 0, ..]
        | [0xfd, b'7', b'z', b'X', b'Z', 0, ..]
        | [4, 0x22, 0x4d, 0x18, ..] => {
            let expected = "expected zlib, gzip or none (joblib.dump's `compress`)";
            return Err(malformed(format!("is compressed by bzip2, LZMA, xz or LZ4, {expected}")));
        }
        _ => return Ok(bytes),
    };
    let limit = unpacked_limit(bytes.len() as u64);
    let out = read_limited(reader, 0, limit).map_err(|e| malformed(format!("{name}: {e}")))?;
    out.ok_or_else(|| Error::too_large(file, name, u128::from(limit) + 1, limit))
}
