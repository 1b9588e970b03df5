//! Files of `torch.save`: views of every kind, in both forms, and what is wrong with others.

use std::io::Cursor;

use allocation_counter::measure;
use array_files::torch::{TorchFile, is_torch};
use array_files::{Data, Error, NdArray};
use testkit::files::{Tensor, torch};

fn read(bytes: Vec<u8>, name: &str) -> Result<NdArray, Error> {
    assert!(is_torch(&bytes));
    let mut file = TorchFile::open("f.pt", Cursor::new(bytes))?;
    let tensor = file.tensor(name, file.root().get(name).unwrap())?.unwrap();
    file.read(name, &tensor)
}

#[test]
fn views_are_written_out_row_by_row() {
    let floats: Vec<u8> = (0..8).flat_map(|i| (i as f32).to_le_bytes()).collect();
    let halves: Vec<u8> = [0x3c00u16, 0xc000].into_iter().flat_map(u16::to_le_bytes).collect();
    let brains: Vec<u8> = [0x3f80u16, 0xc000].into_iter().flat_map(u16::to_le_bytes).collect();
    let longs: Vec<u8> = [-3i64, 1 << 40].into_iter().flat_map(i64::to_le_bytes).collect();
    let storages = [(floats, 4), (halves, 2), (brains, 2), (longs, 8), (vec![0, 1], 1)];
    let cases: [(Tensor<'_>, Data); 9] = [
        (("rows", "FloatStorage", 0, 1, vec![2, 3], vec![3, 1]), Data::F32(vec![1., 2., 3., 4., 5., 6.])),
        (("columns", "FloatStorage", 0, 0, vec![2, 3], vec![1, 2]), Data::F32(vec![0., 2., 4., 1., 3., 5.])),
        (("expanded", "FloatStorage", 0, 5, vec![2, 2], vec![0, 1]), Data::F32(vec![5., 6., 5., 6.])),
        (("gaps", "FloatStorage", 0, 1, vec![2, 2], vec![4, 2]), Data::F32(vec![1., 3., 5., 7.])),
        (("scalar", "FloatStorage", 0, 7, vec![], vec![]), Data::F32(vec![7.])),
        (("none", "FloatStorage", 0, 0, vec![0, 3], vec![3, 1]), Data::F32(vec![])),
        (("half", "HalfStorage", 1, 0, vec![2], vec![1]), Data::F32(vec![1., -2.])),
        (("brain", "BFloat16Storage", 2, 0, vec![2, 1], vec![1, 999]), Data::F32(vec![1., -2.])),
        (("long", "LongStorage", 3, 0, vec![2], vec![1]), Data::I64(vec![-3, 1 << 40])),
    ];
    let tensors: Vec<Tensor<'_>> = cases.iter().map(|(saved, _)| saved.clone()).collect();
    for bytes in [false, true].map(|legacy| torch(&tensors, &storages, legacy)) {
        for ((name, _, _, _, shape, _), data) in &cases {
            let array = read(bytes.clone(), name).unwrap_or_else(|e| panic!("{name}: {e}"));
            assert_eq!(array.data, *data, "{name}");
            assert_eq!(array.shape, shape.iter().map(|&n| n as usize).collect::<Vec<_>>(), "{name}");
        }
    }
}

#[test]
fn tensors_that_leave_their_storage_or_repeat_it_without_end_are_refused() {
    let storages = [(vec![0u8; 32], 4)];
    for (shape, strides, offset, words) in [
        (vec![9], vec![1], 0, "32 bytes"),
        (vec![2], vec![7], 1, "32 bytes"),
        (vec![2, 2], vec![1], 0, "strides"),
        (vec![1 << 30], vec![0], 0, "limit"),
        (vec![u32::MAX / 2; 5], vec![0; 5], 0, "limit"),
    ] {
        let saved: [Tensor<'_>; 1] = [("t", "FloatStorage", 0, offset, shape, strides)];
        for bytes in [false, true].map(|legacy| torch(&saved, &storages, legacy)) {
            let mut error = String::new();
            let taken = measure(|| error = read(bytes, "t").unwrap_err().to_string()).bytes_max;
            assert!(error.contains("`t`") && error.contains(words), "{error}");
            assert!(taken < 1 << 21, "{taken} bytes");
        }
    }
    let missing: [Tensor<'_>; 1] = [("t", "FloatStorage", 5, 0, vec![1], vec![1])];
    assert!(read(torch(&missing, &storages, false), "t").unwrap_err().to_string().contains("\"5\""));
}
