//! numpy's files: correct values from good files, typed errors from bad ones.

use std::path::Path;

use array_files::npz::{self, Npz, read_npy};
use array_files::pickle::{self, Value};
use array_files::{Data, Error, NdArray};
use proptest::prelude::*;
use testkit::files::{Directory, npy_of};

use crate::fixture;

#[test]
fn npz_arrays_are_read_with_shape_and_type() {
    let mut npz = Npz::open(&fixture("numpy.npz")).unwrap();
    assert_eq!(npz.keys()[0], "f4");
    let (shape, values) = npz.f32("f4", &[None, Some(3)]).unwrap();
    assert_eq!((shape.as_slice(), values.as_slice()), (&[2, 3][..], &[0.0, 1.0, 2.0, 3.0, 4.0, 5.0][..]));
    assert_eq!(npz.f32("f8_columns", &[Some(2), None]).unwrap().1, [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]);
    assert_eq!(npz.i64("i2_big", &[None]).unwrap().1, [1, -2, 300]);
    assert_eq!(npz.i64("bool", &[Some(2)]).unwrap().1, [1, 0]);
    assert_eq!(npz.f32("scalar", &[]).unwrap().1, [0.25]);
    assert!(npz.f32("empty", &[None, Some(3)]).unwrap().1.is_empty());
}

#[test]
fn npz_errors_name_file_key_and_shapes() {
    let mut npz = Npz::open(&fixture("numpy.npz")).unwrap();
    let e = npz.f32("f4", &[Some(6890), None]).unwrap_err().to_string();
    for part in ["numpy.npz", "`f4`", "[2, 3]", "[6890, _]"] {
        assert!(e.contains(part), "{e:?} lacks {part:?}");
    }
    let refused = |error: Error, expected: &str| {
        let error = error.to_string();
        assert!(error.contains(expected), "{error}");
    };
    refused(npz.f32("nothing", &[]).unwrap_err(), "`nothing`: missing, the file holds f4, ");
    refused(npz.f32("nan", &[None]).unwrap_err(), "`nan`: not finite at flat index 1");
    refused(npz.f32("huge", &[None]).unwrap_err(), "`huge`: not finite at flat index 0");
    refused(npz.i64("f4", &[None, None]).unwrap_err(), "`f4`: floats, expected integers");
    refused(npz.array("text").unwrap_err(), "`text`: element type ");
    assert_eq!(npz.value("text").unwrap().items(), Some(&[Value::Str("ab".to_owned())][..]));
    assert!(matches!(Npz::open(Path::new("/no/such.npz")), Err(Error::Io { .. })));
}

#[test]
fn texts_are_read_in_the_order_of_rows_or_not_at_all() {
    let read = |order: &str| {
        let header = format!("{{'descr': '|S1', 'fortran_order': {order}, 'shape': (2, 2), }}\n");
        pickle::from_bytes("names.npy", npy_of(&header, b"abcd"))
    };
    let texts = ["a", "b", "c", "d"].map(|text| Value::Str(text.to_owned()));
    assert_eq!(read("False").unwrap().items(), Some(&texts[..]));
    let error = read("True").unwrap_err().to_string();
    assert!(error.contains("names.npy") && error.contains("column-major array of text"), "{error}");
}

#[test]
fn headers_that_claim_too_much_are_refused_before_memory_is_taken() {
    let dir = Directory::new("npy-claims");
    for (descr, shape, large) in [
        ("<f4", "(4611686018427387904, 4)", true),
        ("<f4", "(18446744073709551615, 18446744073709551615, 18446744073709551615)", true),
        ("<f4", "(1000000000,)", true),
        // 200 MB of bytes in the file, 1.6 GB once they are 64-bit integers.
        ("|u1", "(200000000,)", true),
        ("<f4", "(99999999999999999999999,)", false),
        ("<f4", "(-1,)", false),
        // Below the limit, but not there.
        ("<f4", "(100000000,)", false),
        ("<f4", "(0, 4611686018427387904)", false),
    ] {
        let header = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}");
        dir.write("claim.npy", npy_of(&header, &[0; 8]));
        let error = read_npy(&dir.file("claim.npy")).expect_err(shape);
        match error {
            Error::Invalid { .. } => {
                assert!(large && error.to_string().contains("more than the limit"), "{shape}: {error}")
            }
            Error::Npy { .. } => assert!(!large, "{shape}: {error}"),
            _ => panic!("{shape}: {error}"),
        }
    }
}

#[test]
fn malformed_npy_headers_are_errors() {
    let dir = Directory::new("npy-headers");
    for header in [
        "",
        "{",
        "{}",
        "{'descr': '<f4'}",
        "{'descr': '<f4', 'fortran_order': False}",
        "{'descr': '<f4', 'fortran_order': Maybe, 'shape': (2,)}",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (2}",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (2,), 'more': 1}",
        "{'descr': [('a', '<f4')], 'fortran_order': False, 'shape': (2,)}",
        "{'descr': 'é', 'fortran_order': False, 'shape': (2,)}",
        "{'descr': '<f', 'fortran_order': False, 'shape': (2,)}",
        "{'descr': '', 'fortran_order': False, 'shape': (2,)}",
        "{'descr': '<c8', 'fortran_order': False, 'shape': (1,)}",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (1,)}",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (3,)}",
    ] {
        dir.write("header.npy", npy_of(header, &[0; 8]));
        let error = read_npy(&dir.file("header.npy")).expect_err(header);
        assert!(matches!(error, Error::Npy { .. } | Error::Invalid { .. }), "{header}: {error}");
    }
}

#[test]
fn archives_cut_anywhere_are_errors() {
    let bytes = std::fs::read(fixture("numpy.npz")).unwrap();
    for length in 0..bytes.len() {
        let read = Npz::from_bytes("cut", bytes[..length].to_vec()).and_then(|mut npz| {
            let keys = npz.keys().to_vec();
            keys.iter().try_for_each(|key| npz.array(key).map(drop))
        });
        assert!(read.is_err(), "{length} of {} bytes were accepted", bytes.len());
    }
}

#[test]
fn a_changed_byte_of_data_fails_the_checksum() {
    let bytes = std::fs::read(fixture("numpy.npz")).unwrap();
    let mut npz = Npz::from_bytes("good", bytes.clone()).unwrap();
    let good = npz.array("f4").unwrap();
    for at in 0..bytes.len() {
        let mut bad = bytes.clone();
        bad[at] ^= 0x10;
        let read = Npz::from_bytes("bad", bad).and_then(|mut npz| npz.array("f4"));
        if let Ok(array) = read {
            assert_eq!(array, good, "byte {at}");
        }
    }
}

fn any_array() -> impl Strategy<Value = NdArray> {
    (prop::collection::vec(0usize..5, 0..4), 0..4, any::<u64>()).prop_map(|(shape, kind, seed)| {
        let bits = (0..shape.iter().product::<usize>() as u64).map(|i| (seed ^ i).wrapping_mul(0x9E37_79B9_7F4A_7C15));
        let data = match kind {
            0 => Data::F64(bits.map(|b| b as i64 as f64 / 3.0).collect()),
            1 => Data::F32(bits.map(|b| b as i32 as f32 / 3.0).collect()),
            2 => Data::I64(bits.map(|b| b as i64).collect()),
            _ => Data::Bool(bits.map(|b| b & 1 == 1).collect()),
        };
        NdArray { shape, data }
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn written_arrays_are_read_back_with_type_shape_and_bits(arrays in prop::collection::vec(any_array(), 0..4)) {
        let dir = Directory::new("npz-written");
        let file = dir.file("written.npz");
        let names = ["a", "b_1", "ü", "last"];
        let named: Vec<_> = names.into_iter().zip(arrays).collect();
        npz::write(&file, &named).unwrap();
        let mut read = Npz::open(&file).unwrap();
        prop_assert_eq!(read.keys().len(), named.len());
        for (key, array) in &named {
            prop_assert_eq!(&read.array(key).unwrap(), array);
        }
    }
}

#[test]
fn arrays_that_cannot_be_written_are_errors() {
    let array = |shape| NdArray { shape, data: Data::I64(vec![1, 2, 3]) };
    let dir = Directory::new("npz-unwritten");
    let file = dir.file("unwritten.npz");
    let error = npz::write(&file, &[("x", array(vec![2, 2]))]).unwrap_err();
    assert!(matches!(&error, Error::Invalid { key, .. } if key == "x"), "{error}");
    let error = npz::write(&file, &[("x", array(vec![3])), ("x", array(vec![3]))]).unwrap_err();
    assert!(matches!(&error, Error::Npy { key, .. } if key == "x"), "{error}");
    let error = npz::write(Path::new("/no/such/place.npz"), &[("x", array(vec![3]))]).unwrap_err();
    assert!(matches!(error, Error::Io { .. }), "{error}");
}
