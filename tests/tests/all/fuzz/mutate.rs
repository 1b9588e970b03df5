//! Damage that keeps the form: files are taken apart, harmed within, and put together again with
//! right sizes and sums.

use std::io::{Cursor, Read, Write};

use testkit::body::Random;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipArchive, ZipWriter};

fn of<'a, T>(random: &mut Random, items: &'a [T]) -> &'a T {
    &items[random.below(items.len())]
}

/// How a file is put together.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Form {
    /// Bytes.
    Plain,
    /// A zip archive, with the sums of its files.
    Zip,
    /// Chunks with lengths and sums.
    Png,
    /// JSON and a binary chunk with their lengths.
    Glb,
    /// The length of a JSON header, the header, data.
    Safetensors,
}

/// Words that mean something to some reader, thrown in anywhere.
const WORDS: &str = "{ } [ ] [[[[[[[[[[[[[[[[ \" : , null true -1 1e308 1e-320 NaN Infinity -0 4294967295 \
    18446744073709551615 99999999999999999999 0.1 \\u0000 \\ ' ]q\0 }q\0 ( t. u s R b 0 h\0 ../";
/// Opcodes of pickles and lines of meshes.
const OPCODES: [&[u8]; 6] =
    [b"\x80\x04", b"\x80\x02", b"\x95\xff\xff\xff\xff\0\0\0\0", b"\x8a\xff", b"f -1 0 9", b"\nv nan 1 2\n"];
/// Powers of two at which, or just below which, sums and products go wrong.
const POWERS: [u32; 10] = [0, 1, 7, 8, 15, 16, 31, 32, 62, 63];
const NUMBERS: &str = "0 -1 1 2 255 65536 2147483648 4294967296 1e308 -1e30 1e-300 0.5 nan 1e999 \
    18446744073709551616 -9223372036854775809";

fn word<'a>(random: &mut Random, words: &'a str) -> &'a [u8] {
    let words: Vec<&str> = words.split(' ').collect();
    of(random, &words).as_bytes()
}

/// An integer at which sums and products go wrong.
fn whole(random: &mut Random) -> u64 {
    (1u64 << of(random, &POWERS)).wrapping_sub(random.below(3) as u64)
}

/// One of the seeds, harmed in one to four places.
pub fn damaged(random: &mut Random, form: Form, seeds: &[Vec<u8>]) -> Vec<u8> {
    let seed = of(random, seeds).clone();
    let other = of(random, seeds).clone();
    // Now and then the frame itself.
    if form == Form::Plain || random.below(4) == 0 {
        return harm(random, seed, &other);
    }
    match form {
        Form::Plain => seed,
        Form::Zip => zip(random, &seed),
        Form::Png => png(random, &seed),
        Form::Glb => glb(random, &seed),
        Form::Safetensors => safetensors(random, &seed),
    }
}

fn harm(random: &mut Random, mut bytes: Vec<u8>, other: &[u8]) -> Vec<u8> {
    let most = bytes.len().max(1 << 20);
    for _ in 0..=random.below(4) {
        let at = random.below(bytes.len() + 1);
        let end = (at + 1 + random.below(32)).min(bytes.len());
        match random.below(13) {
            0 => bytes.truncate(at),
            1 if at < bytes.len() => bytes[at] ^= 1 << random.below(8),
            2 if at < bytes.len() => bytes[at] = random.bits() as u8,
            3 => {
                let word = if random.below(8) == 0 { *of(random, &OPCODES) } else { word(random, WORDS) };
                drop(bytes.splice(at..at, word.iter().copied()));
            }
            4 => drop(bytes.drain(at..end.max(at))),
            5 => {
                // Again and again.
                let part = bytes[at..end.max(at)].to_vec();
                let times = 1 << random.below(8);
                drop(bytes.splice(at..at, part.repeat(times)));
            }
            6 => {
                let value = whole(random).to_le_bytes();
                overwrite(&mut bytes, at, &value[..*of(random, &[1, 2, 4, 8])]);
            }
            7 => {
                let value = whole(random).to_be_bytes();
                overwrite(&mut bytes, at, &value[8 - *of(random, &[1, 2, 4, 8])..]);
            }
            8 => {
                let value = *of(random, &[f32::NAN, f32::INFINITY, 1e30, -1e38, 1e-40, 0.0, -0.0]);
                overwrite(&mut bytes, at & !3, &value.to_le_bytes());
            }
            9 => {
                let from = random.below(other.len() + 1);
                let to = (from + random.below(64)).min(other.len());
                drop(bytes.splice(at..at, other[from..to].iter().copied()));
            }
            _ => number(random, &mut bytes, at),
        }
        bytes.truncate(most);
    }
    bytes
}

fn overwrite(bytes: &mut [u8], at: usize, by: &[u8]) {
    for (old, new) in bytes.iter_mut().skip(at).zip(by) {
        *old = *new;
    }
}

/// Replaces the next number in the text, if one follows.
fn number(random: &mut Random, bytes: &mut Vec<u8>, at: usize) {
    let digit = |b: &u8| b.is_ascii_digit() || *b == b'.';
    let Some(start) = bytes[at..].iter().take(200).position(|b| b.is_ascii_digit()).map(|i| at + i) else { return };
    let end = start + bytes[start..].iter().take_while(|b| digit(b)).count();
    drop(bytes.splice(start..end, word(random, NUMBERS).iter().copied()));
}

fn zip(random: &mut Random, seed: &[u8]) -> Vec<u8> {
    let mut archive = ZipArchive::new(Cursor::new(seed)).unwrap();
    let chosen = random.below(archive.len());
    let mut out = ZipWriter::new(Cursor::new(Vec::new()));
    let mut previous = Vec::new();
    for i in 0..archive.len() {
        let mut entry = archive.by_index(i).unwrap();
        let name = entry.name().unwrap().into_owned();
        let mut bytes = Vec::new();
        entry.read_to_end(&mut bytes).unwrap();
        if i == chosen {
            bytes = match random.below(12) {
                0 => continue,
                1 => std::mem::take(&mut previous),
                _ => harm(random, bytes, &previous),
            };
        }
        let method = if random.below(2) == 0 { CompressionMethod::Stored } else { CompressionMethod::Deflated };
        out.start_file(name, SimpleFileOptions::default().compression_method(method)).unwrap();
        out.write_all(&bytes).unwrap();
        previous = bytes;
    }
    out.finish().unwrap().into_inner()
}

fn png(random: &mut Random, seed: &[u8]) -> Vec<u8> {
    let mut out = seed[..8].to_vec();
    let (mut at, chunks) = (8, seed.len());
    let chosen = random.below(4);
    for index in 0.. {
        if at + 12 > chunks {
            break;
        }
        let length = u32::from_be_bytes(seed[at..at + 4].try_into().unwrap()) as usize;
        let mut content = seed[at + 8..at + 8 + length].to_vec();
        if index == chosen {
            content = harm(random, content, b"");
        }
        let mut body = seed[at + 4..at + 8].to_vec();
        body.extend(&content);
        out.extend((content.len() as u32).to_be_bytes());
        out.extend(&body);
        out.extend(crc32(&body).to_be_bytes());
        at += 12 + length;
    }
    out
}

fn crc32(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(!0u32, |crc, byte| {
        (0..8).fold(crc ^ u32::from(*byte), |c, _| if c & 1 == 1 { c >> 1 ^ 0xEDB8_8320 } else { c >> 1 })
    })
}

fn glb(random: &mut Random, seed: &[u8]) -> Vec<u8> {
    let length = u32::from_le_bytes(seed[12..16].try_into().unwrap()) as usize;
    let (mut json, mut binary) = (seed[20..20 + length].to_vec(), seed[28 + length..].to_vec());
    if random.below(4) == 0 {
        binary = harm(random, binary, &[]);
    } else {
        json = harm(random, json, &binary);
    }
    testkit::files::glb(&json, &binary)
}

fn safetensors(random: &mut Random, seed: &[u8]) -> Vec<u8> {
    let length = u64::from_le_bytes(seed[..8].try_into().unwrap()) as usize;
    let (mut header, mut data) = (seed[8..8 + length].to_vec(), seed[8 + length..].to_vec());
    if random.below(4) == 0 {
        data = harm(random, data, &[]);
    } else {
        header = harm(random, header, &[]);
    }
    let mut out = (header.len() as u64).to_le_bytes().to_vec();
    out.extend(header);
    out.extend(data);
    out
}
