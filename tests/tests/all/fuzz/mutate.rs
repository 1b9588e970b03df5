//! Damage that keeps the form: files are taken apart, harmed within, and put together again with
//! right sizes and sums.

use std::io::{Cursor, Read, Write};

use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipArchive, ZipWriter};

/// SplitMix64: the same damage on every machine.
pub struct Random(pub u64);

impl Random {
    pub fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    pub fn below(&mut self, end: usize) -> usize {
        (self.next() % end.max(1) as u64) as usize
    }

    fn of<'a, T>(&mut self, items: &'a [T]) -> &'a T {
        &items[self.below(items.len())]
    }
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
const WORDS: [&[u8]; 40] = [
    b"{",
    b"}",
    b"[",
    b"]",
    b"[[[[[[[[[[[[[[[[",
    b"\"",
    b":",
    b",",
    b"null",
    b"true",
    b"-1",
    b"1e308",
    b"1e-320",
    b"NaN",
    b"Infinity",
    b"-0",
    b"4294967295",
    b"18446744073709551615",
    b"99999999999999999999",
    b"0.1",
    b"\\u0000",
    b"\\",
    b"'",
    b"\x80\x04",
    b"\x80\x02",
    b"]q\x00",
    b"}q\x00",
    b"(",
    b"t.",
    b"u",
    b"s",
    b"R",
    b"b",
    b"0",
    b"\x95\xff\xff\xff\xff\0\0\0\0",
    b"\x8a\xff",
    b"h\x00",
    b"f -1 0 9",
    b"\nv nan 1 2\n",
    b"../",
];
/// Integers at which sums and products go wrong.
const WHOLE: [u64; 14] = [
    0,
    1,
    2,
    0x7f,
    0xff,
    0x7fff,
    0xffff,
    0x7fff_ffff,
    0x8000_0000,
    0xffff_ffff,
    1 << 40,
    1 << 62,
    i64::MAX as u64,
    u64::MAX,
];
const NUMBERS: [&str; 16] = [
    "0",
    "-1",
    "1",
    "2",
    "255",
    "65536",
    "2147483648",
    "4294967296",
    "1e308",
    "-1e30",
    "1e-300",
    "0.5",
    "nan",
    "1e999",
    "18446744073709551616",
    "-9223372036854775809",
];

/// One of the seeds, harmed in one to four places.
pub fn damaged(random: &mut Random, form: Form, seeds: &[Vec<u8>]) -> Vec<u8> {
    let seed = random.of(seeds).clone();
    let other = random.of(seeds).clone();
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
            2 if at < bytes.len() => bytes[at] = random.next() as u8,
            3 => drop(bytes.splice(at..at, random.of(&WORDS).iter().copied())),
            4 => drop(bytes.drain(at..end.max(at))),
            5 => {
                // Again and again.
                let part = bytes[at..end.max(at)].to_vec();
                let times = 1 << random.below(8);
                drop(bytes.splice(at..at, part.repeat(times)));
            }
            6 => {
                let value = random.of(&WHOLE).to_le_bytes();
                overwrite(&mut bytes, at, &value[..*random.of(&[1, 2, 4, 8])]);
            }
            7 => {
                let value = random.of(&WHOLE).to_be_bytes();
                overwrite(&mut bytes, at, &value[8 - *random.of(&[1, 2, 4, 8])..]);
            }
            8 => {
                let value = *random.of(&[f32::NAN, f32::INFINITY, 1e30, -1e38, 1e-40, 0.0, -0.0]);
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
    drop(bytes.splice(start..end, random.of(&NUMBERS).bytes()));
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
