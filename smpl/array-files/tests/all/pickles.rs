//! Pickles, plain and joblib's: right values from good files, typed errors from bad ones, and what
//! must not cost memory.

use std::io::Write;

use allocation_counter::measure;
use array_files::pickle::{self, Value};
use array_files::{Data, Error, NdArray};

use crate::fixture;

fn array(shape: &[usize], data: Data) -> Value {
    Value::Array(NdArray { shape: shape.to_vec(), data })
}

fn text(s: &str) -> Value {
    Value::Str(s.to_owned())
}

/// The arrays that both scripts of the fixtures write.
fn arrays_are_as_written(name: &str, value: &Value) {
    let six = [0, 1, 2, 3, 4, 5];
    let objects = |items: Vec<Value>| Value::Objects { shape: vec![2], items };
    for (key, expected) in [
        ("f4", array(&[2, 3], Data::F32(six.map(|i| i as f32).to_vec()))),
        ("f8_columns", array(&[2, 3], Data::F64(six.map(f64::from).to_vec()))),
        ("i2_big", array(&[3], Data::I64(vec![1, -2, 300]))),
        ("u1", array(&[2], Data::I64(vec![0, 255]))),
        ("bool", array(&[2], Data::Bool(vec![true, false]))),
        ("scalar", array(&[], Data::F32(vec![0.5]))),
        ("zero_d", array(&[], Data::I64(vec![7]))),
        ("empty", array(&[0, 3], Data::F64(vec![]))),
        ("objects", objects(vec![Value::Dict(vec![(text("k"), Value::Int(1))]), Value::None])),
        ("strings", objects(vec![text("ab"), text("c")])),
    ] {
        assert_eq!(value.get(key), Some(&expected), "{name}, `{key}`");
    }
}

#[test]
fn every_protocol_gives_the_values_python_wrote() {
    for protocol in 0..6 {
        let path = fixture(&format!("values.protocol{protocol}.pkl"));
        let value = pickle::read(&path).unwrap_or_else(|e| panic!("protocol {protocol}: {e}"));
        let get = |key: &str| value.get(key).unwrap_or_else(|| panic!("{protocol}: no {key}"));
        let expect = |key: &str, expected: Value| {
            assert_eq!(get(key), &expected, "protocol {protocol}, `{key}`");
        };
        let ints = |list: &[i64]| list.iter().map(|&i| Value::Int(i)).collect::<Vec<_>>();
        expect("none", Value::None);
        expect("flags", Value::Tuple(vec![Value::Bool(true), Value::Bool(false)]));
        let numbers = [0, -1, 255, 256, 65535, 65536, -(1 << 31), 1 << 40, i64::MIN];
        expect("ints", Value::List(ints(&numbers)));
        let floats = [0.0, -2.5, 1e300].map(Value::Float);
        expect("floats", Value::List(floats.to_vec()));
        expect("text", text("ü \\ \n 漢 𝄞"));
        expect("bytes", Value::Bytes(b"\x00\xff'\n\\".to_vec()));
        expect("set", Value::Set(ints(&[3])));
        expect("frozen", Value::Set(ints(&[4])));
        let ordered = vec![(text("b"), Value::Int(1)), (text("a"), Value::Int(2))];
        expect("ordered", Value::Dict(ordered));
        expect("twice", Value::List(vec![Value::List(ints(&[1, 2])); 2]));
        arrays_are_as_written(&format!("protocol {protocol}"), &value);
        let Value::Array(NdArray { data: Data::F32(halves), .. }) = get("f2") else {
            panic!("f2: {:?}", get("f2"));
        };
        assert_eq!(halves[..2], [1.5, -0.25]);
        assert!((halves[2] - 6e-8).abs() < 3e-8, "subnormal half {}", halves[2]);
        let dense = get("sparse").to_dense("values", "sparse").unwrap().unwrap();
        assert_eq!(dense.shape, [2, 3]);
        assert_eq!(dense.data, Data::F64(vec![0.0, 2.0, 0.0, 1.0, 0.0, 3.0]));
    }
}

#[test]
fn pickles_cut_anywhere_are_errors_with_an_offset() {
    for protocol in 0..6 {
        let bytes = std::fs::read(fixture(&format!("values.protocol{protocol}.pkl"))).unwrap();
        for length in 0..bytes.len() {
            match pickle::parse("cut", &bytes[..length]) {
                Err(Error::Pickle { offset, .. }) => assert!(offset <= length),
                other => panic!("protocol {protocol}, {length} bytes: {other:?}"),
            }
        }
    }
}

#[test]
fn only_allowed_globals_are_understood() {
    for program in [
        &b"cos\nsystem\n(S'true'\ntR."[..],
        b"c__builtin__\neval\n(S'1'\ntR.",
        b"\x80\x04\x8c\x05posix\x8c\x06system\x93.",
        b"cnumpy\nload\n.",
        b"\x80\x04\x8c\x04a\n\x1b[\x8c\x01\r\x93.",
    ] {
        let message = pickle::parse("evil", program).unwrap_err().to_string();
        assert!(message.contains("not allowed"), "{message}");
        assert!(!message.contains(char::is_control), "{message:?}");
    }
}

#[test]
fn malicious_pickles_end_in_errors() {
    let mut deep = b"]".repeat(100_000);
    deep.extend(b"a".repeat(99_999));
    deep.push(b'.');
    // Each list holds the one before ten times over.
    let mut laughs = b"\x80\x02]q\x00K\x01a".to_vec();
    for level in 1..=30u8 {
        laughs.extend([b']', b'q', level, b'(']);
        laughs.extend([b'h', level - 1].repeat(10));
        laughs.push(b'e');
    }
    laughs.push(b'.');
    // One megabyte of data made into ten thousand arrays.
    let mut arrays = b"\x80\x02cnumpy\ndtype\nq\x00U\x02u1\x85Rq\x01B".to_vec();
    arrays.extend(1_000_000u32.to_le_bytes());
    arrays.extend(vec![0u8; 1_000_000]);
    arrays.extend(b"q\x02cnumpy.core.numeric\n_frombuffer\nq\x03J\x40\x42\x0f\x00\x85q\x04U\x01Cq\x05(");
    for _ in 0..10_000 {
        arrays.extend(b"h\x03(h\x02h\x01h\x04h\x05tR");
    }
    arrays.extend(b"l.");
    for (name, program) in [
        ("deep", deep.as_slice()),
        ("laughs", &laughs),
        ("arrays", &arrays),
        ("contains itself", b"]q\x00h\x00a."),
        ("dict of itself", b"}q\x00K\x01h\x00s."),
        ("huge length", b"\x8e\xff\xff\xff\xff\xff\xff\xff\xffx."),
        ("huge memo", b"Nr\xff\xff\xff\xffh\x01."),
        ("negative memo", b"Np-1\ng7\n."),
        ("pop of nothing", b"0."),
        ("tuple of nothing", b"\x87."),
        ("items without mark", b"]e."),
        ("pop across a mark", b"N(\x85."),
        ("odd items", b"}(K\x01u."),
        ("append to an int", b"K\x01K\x02a."),
        ("build on none", b"N}b."),
        ("wide integer", b"\x8a\x09\x00\x00\x00\x00\x00\x00\x00\x00\x01."),
        ("wide text integer", b"I99999999999999999999\n."),
        ("protocol 9", b"\x80\x09N."),
        ("persistent", b"P1\n."),
        ("shape", b"cnumpy.core.multiarray\n_reconstruct\n)R(K\x01(J\xff\xff\xff\x7fJ\xff\xff\xff\x7fJ\xff\xff\xff\x7ftcnumpy\ndtype\n(U\x02f8tRI00\nU\x00tb."),
        ("blank array", b"cnumpy.core.multiarray\n_reconstruct\n)R."),
        ("a class", b"cnumpy\nndarray\n."),
        ("empty", b""),
    ] {
        let start = std::time::Instant::now();
        match pickle::parse(name, program) {
            Err(Error::Pickle { file, .. }) => assert_eq!(file, name),
            other => panic!("{name}: {other:?}"),
        }
        assert!(start.elapsed().as_secs() < 10, "{name} took {:?}", start.elapsed());
    }
}

#[test]
fn every_compression_and_version_gives_the_values_python_wrote() {
    for name in ["plain", "protocol2", "zlib", "gzip", "bz2", "lzma", "xz", "old", "old_zlib"] {
        let value = pickle::read(&fixture(&format!("joblib.{name}.pkl"))).unwrap_or_else(|e| panic!("{name}: {e}"));
        let Value::Dict(people) = &value else { panic!("{name}: {}", value.type_name()) };
        assert_eq!(people[0].0, array(&[], Data::I64(vec![7])), "{name}: key");
        assert_eq!(value.get("after"), Some(&text("text")), "{name}");
        arrays_are_as_written(name, &people[0].1);
        assert_eq!(people[0].1.get("cube"), Some(&array(&[2, 3, 4], Data::I64((0..24).collect()))), "{name}");
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
    match outcome.unwrap() {
        Err(Error::Pickle { .. } | Error::Invalid { .. }) => (taken, true),
        Err(error) => panic!("{name}: {error}"),
        Ok(_) => (taken, false),
    }
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
        let (taken, refused) = run(name, bytes);
        assert!(refused, "{name}: accepted");
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
