//! Files compressed by joblib.

use std::io::Read;

use crate::Error;
use crate::file::{read_limited, unpacked_limit};

/// Memory limit of the LZMA decoders in KiB: twice the dictionary of `xz -9`.
const LZMA_KIBIBYTES: u32 = 128 << 10;

/// `bytes` unpacked if they start as zlib, gzip, bzip2, LZMA or xz do; else themselves. No pickle
/// starts like any of these.
pub(super) fn unpacked(file: &str, bytes: Vec<u8>) -> Result<Vec<u8>, Error> {
    let source = bytes.as_slice();
    let malformed = |message: String| Error::Pickle { file: file.to_owned(), offset: 0, message };
    let (name, reader): (&str, Box<dyn Read + '_>) = match source {
        // The two bytes of a zlib header are a multiple of 31.
        [0x78, flags, ..] if (0x7800 + u16::from(*flags)).is_multiple_of(31) => {
            ("zlib", Box::new(flate2::read::ZlibDecoder::new(source)))
        }
        [0x1f, 0x8b, ..] => ("gzip", Box::new(flate2::read::MultiGzDecoder::new(source))),
        [b'B', b'Z', b'h', ..] => ("bzip2", Box::new(bzip2::read::BzDecoder::new(source))),
        [0x5d, 0, 0, ..] => {
            let reader = lzma_rust2::LzmaReader::new_mem_limit(source, LZMA_KIBIBYTES, None);
            ("lzma", Box::new(reader.map_err(|e| malformed(format!("lzma: {e}")))?))
        }
        [0xfd, b'7', b'z', b'X', b'Z', 0, ..] => {
            ("xz", Box::new(lzma_rust2::XzReader::new_mem_limit(source, true, LZMA_KIBIBYTES)))
        }
        [4, 0x22, 0x4d, 0x18, ..] => {
            let expected = "expected zlib, gzip, bz2, lzma or none";
            return Err(malformed(format!("is compressed by LZ4, {expected} (joblib.dump's `compress`)")));
        }
        _ => return Ok(bytes),
    };
    let limit = unpacked_limit(bytes.len() as u64);
    let out = read_limited(reader, 0, limit).map_err(|e| malformed(format!("{name}: {e}")))?;
    out.ok_or_else(|| Error::too_large(file, name, u128::from(limit) + 1, limit))
}
