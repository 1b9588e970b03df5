//! Files that joblib has compressed.

use std::io::Read;

use crate::Error;
use crate::npy::MAX_FILE_BYTES;

/// Dictionary of the LZMA decoders in KiB: that of `xz -9`, and as much again for the rest.
const LZMA_KIBIBYTES: u32 = 128 << 10;

/// Bytes that may come out of `packed` bytes: 256 times as many and 64 MiB, up to the largest file
/// that is read. Runs of zeros compress a thousandfold, arrays of measurements hardly at all.
pub(crate) fn unpacked_limit(packed: u64) -> u64 {
    packed.saturating_mul(256).saturating_add(64 << 20).min(MAX_FILE_BYTES)
}

/// The bytes themselves, or what they are compressed from: zlib, gzip, bzip2, LZMA or xz, told by
/// how they start. No pickle starts like any of these.
pub(super) fn unpacked(file: &str, bytes: Vec<u8>) -> Result<Vec<u8>, Error> {
    let source = bytes.as_slice();
    let malformed = |message: String| Error::Pickle { file: file.to_owned(), offset: 0, message };
    let lzma = |e: std::io::Error| malformed(format!("lzma: {e}"));
    let (name, mut reader): (&str, Box<dyn Read + '_>) = match source {
        // The two bytes of a zlib header are a multiple of 31.
        [0x78, flags, ..] if (0x7800 + u16::from(*flags)).is_multiple_of(31) => {
            ("zlib", Box::new(flate2::read::ZlibDecoder::new(source)))
        }
        [0x1f, 0x8b, ..] => ("gzip", Box::new(flate2::read::MultiGzDecoder::new(source))),
        [b'B', b'Z', b'h', ..] => ("bzip2", Box::new(bzip2::read::BzDecoder::new(source))),
        [0x5d, 0, 0, ..] => {
            let reader = lzma_rust2::LzmaReader::new_mem_limit(source, LZMA_KIBIBYTES, None);
            ("lzma", Box::new(reader.map_err(lzma)?))
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
    let mut out = Vec::new();
    (&mut reader).take(limit + 1).read_to_end(&mut out).map_err(|e| malformed(format!("{name}: {e}")))?;
    if out.len() as u64 > limit {
        let (file, key) = (file.to_owned(), name.to_owned());
        return Err(Error::TooLarge { file, key, claimed: out.len() as u128, limit });
    }
    Ok(out)
}
