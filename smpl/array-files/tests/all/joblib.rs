//! What joblib writes: arrays behind their descriptions, compressed or not; and what must not cost
//! memory.

use crate::common;

use std::io::Write;

use allocation_counter::measure;
use array_files::pickle::{self, Value};
use array_files::{Data, Error, NdArray};
use common::fixture;

fn array(shape: &[usize], data: Data) -> Value {
    Value::Array(NdArray { shape: shape.to_vec(), data })
}

#[test]
fn every_compression_and_version_gives_the_values_python_wrote() {
    for name in ["plain", "protocol2", "zlib", "gzip", "bz2", "lzma", "xz", "old", "old_zlib"] {
        let value = pickle::read(&fixture(&format!("joblib.{name}.pkl"))).unwrap_or_else(|e| panic!("{name}: {e}"));
        let Value::Dict(people) = &value else { panic!("{name}: {}", value.type_name()) };
        assert_eq!(people[0].0, array(&[], Data::I64(vec![7])), "{name}: key");
        assert_eq!(value.get("after"), Some(&Value::Str("text".to_owned())), "{name}");
        let person = &people[0].1;
        let expect = |key: &str, expected: Value| assert_eq!(person.get(key), Some(&expected), "{name}, `{key}`");
        let six = [0, 1, 2, 3, 4, 5];
        expect("f4", array(&[2, 3], Data::F32(six.map(|i| i as f32).to_vec())));
        expect("f8_columns", array(&[2, 3], Data::F64(six.map(f64::from).to_vec())));
        expect("u1", array(&[2], Data::I64(vec![0, 255])));
        expect("i2_big", array(&[3], Data::I64(vec![1, -2, 300])));
        expect("bool", array(&[2], Data::Bool(vec![true, false])));
        expect("empty", array(&[0, 3], Data::F64(vec![])));
        expect("zero_d", array(&[], Data::I64(vec![7])));
        expect("scalar", array(&[], Data::F32(vec![0.5])));
        expect("cube", array(&[2, 3, 4], Data::I64((0..24).collect())));
        let one = Value::Dict(vec![(Value::Str("k".to_owned()), Value::Int(1))]);
        expect("objects", Value::Objects { shape: vec![2], items: vec![one, Value::None] });
        let texts = ["ab", "c"].map(|text| Value::Str(text.to_owned()));
        expect("strings", Value::Objects { shape: vec![2], items: texts.to_vec() });
    }
}

#[test]
fn files_cut_anywhere_are_errors() {
    for name in ["plain", "zlib", "gzip", "bz2", "lzma", "xz", "old"] {
        let bytes = std::fs::read(fixture(&format!("joblib.{name}.pkl"))).unwrap();
        for length in 0..bytes.len() {
            // What ends a compressed stream may be missing: everything is there by then.
            let ends = bytes.len() - length <= 40;
            match pickle::from_bytes("cut", bytes[..length].to_vec()) {
                Err(error) => assert!(error.to_string().starts_with("cut: "), "{name}: {error}"),
                Ok(_) => assert!(ends && name != "plain" && name != "old", "{name}, {length} bytes"),
            }
        }
    }
}

#[test]
fn a_wrapper_that_is_wrong_is_named() {
    let whole = std::fs::read(fixture("joblib.plain.pkl")).unwrap();
    let replaced = |from: &[u8], to: &[u8]| {
        let at = whole.windows(from.len()).position(|w| w == from).unwrap();
        [&whole[..at], to, &whole[at + from.len()..]].concat()
    };
    for (from, to, words) in [
        (&b"NumpyArrayWrapper"[..], &b"NumpyArrayWreaker"[..], "not allowed"),
        (b"\x05order", b"\x05ardor", "`order`"),
        (b"\x05shape", b"\x05sheep", "`shape`"),
        (b"\x8c\x01C\x94", b"\x8c\x01Z\x94", "\"Z\""),
    ] {
        let error = pickle::from_bytes("wrong", replaced(from, to)).unwrap_err().to_string();
        assert!(error.contains(words), "{words}: {error}");
    }
    let lz4 = pickle::from_bytes("x", b"\x04\x22\x4d\x18....".to_vec()).unwrap_err().to_string();
    assert!(lz4.contains("LZ4"), "{lz4}");
}

/// The most memory that a program took, and whether it was refused.
fn run(name: &str, program: Vec<u8>) -> (u64, bool) {
    let mut outcome = None;
    let taken = measure(|| outcome = Some(pickle::from_bytes(name, program))).bytes_max;
    match outcome {
        Some(Err(Error::Pickle { .. } | Error::Invalid { .. })) => (taken, true),
        Some(Ok(_)) => (taken, false),
        other => panic!("{name}: {:?}", other.map(|value| value.map(|v| v.type_name()))),
    }
}

/// The most memory that a program took that has to be refused.
fn refused(name: &str, program: Vec<u8>) -> u64 {
    let (taken, refused) = run(name, program);
    assert!(refused, "{name}: accepted");
    taken
}

#[test]
fn short_opcodes_take_no_more_memory_than_is_said() {
    const LENGTH: usize = 24 << 20;
    let of = |opcodes: &[u8]| [opcodes.repeat(LENGTH / opcodes.len()), b".".to_vec()].concat();
    for (name, program) in [
        ("None", of(b"N")),
        ("empty tuples", of(b")")),
        ("empty lists", of(b"]")),
        ("empty dictionaries", of(b"}")),
        ("marks", of(b"(")),
        ("duplicates", [b"N".to_vec(), of(b"2")].concat()),
        ("memo references", [b"]q\x00".to_vec(), of(b"h\x00")].concat()),
        ("memo entries", [b"N".to_vec(), of(b"\x94")].concat()),
        ("booleans", of(b"\x88")),
        ("small numbers", of(b"K\x01")),
        ("short strings", of(b"U\x00")),
        ("references in a list", [b"](".to_vec(), b"N".repeat(1000), b"q\x00".to_vec(), of(b"h\x00")].concat()),
        ("appended", [b"]N2".to_vec(), of(b"2a")].concat()),
    ] {
        let taken = run(name, program).0;
        let limit = (8 * LENGTH + (128 << 20)) as u64;
        // The input is within the measure, too: it was made before.
        assert!(taken <= limit, "{name} took {taken} bytes, more than {limit}");
    }
}

#[test]
fn compressed_bombs_are_refused_before_they_fill_the_memory() {
    let zeros = vec![0u8; 1 << 20];
    let mut zlib = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::best());
    let mut gzip = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::best());
    let mut bz2 = bzip2::write::BzEncoder::new(Vec::new(), bzip2::Compression::best());
    for _ in 0..400 {
        zlib.write_all(&zeros).unwrap();
        gzip.write_all(&zeros).unwrap();
        bz2.write_all(&zeros).unwrap();
    }
    for (name, bytes) in
        [("zlib", zlib.finish().unwrap()), ("gzip", gzip.finish().unwrap()), ("bz2", bz2.finish().unwrap())]
    {
        // A vector that grows is there twice while it moves to twice the room.
        let limit = (bytes.len() as u64 * 256 + (64 << 20)) * 3 + (8 << 20);
        let taken = refused(name, bytes);
        assert!(taken <= limit, "{name} took {taken} bytes, more than {limit}");
    }
}

#[test]
fn an_array_used_twice_is_there_twice() {
    // [a, a] of one array, by the memo.
    let mut program = b"\x80\x02]cnumpy.core.numeric\n_frombuffer\n(U\x02\x01\x02cnumpy\ndtype\nU\x02u1\x85RK\x02\x85U\x01CtRq\x00ah\x00a.".to_vec();
    let value = pickle::from_bytes("twice", program.clone()).unwrap();
    let one = array(&[2], Data::I64(vec![1, 2]));
    assert_eq!(value, Value::List(vec![one.clone(), one]));
    program.truncate(program.len() - 1);
    assert!(pickle::from_bytes("twice", program).is_err());
}
