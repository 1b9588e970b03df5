//! The encoding against the test kit's reference encoding in f64.

use crate::common::{encode_rows, oracle, points, table};
use hashgrid::HashGrid;
use proptest::prelude::*;

/// Each weight is a product of D factors rounded once, each sum has 2^D ≤ 16 terms of magnitude ≤
/// 1.
const TOLERANCE: f64 = 20.0 * f32::EPSILON as f64;

fn compare<const D: usize>(
    points: &[[f32; D]],
    resolutions: &[u32],
    log2: u32,
    features: usize,
    seed: u64,
) -> Result<(), TestCaseError> {
    let grid = HashGrid::<D>::with_resolutions(resolutions, features, log2).unwrap();
    let table = table(&grid, seed);
    let expected = oracle(&grid, &table, points, log2, features);
    for (i, (got, expected)) in encode_rows(&grid, &table, points).iter().zip(&expected).enumerate() {
        prop_assert!(
            (f64::from(*got) - expected).abs() <= TOLERANCE,
            "feature {} of point {:?}: {got}, expected {expected}",
            i % grid.num_features(),
            points[i / grid.num_features()]
        );
    }
    Ok(())
}

fn resolutions() -> impl Strategy<Value = Vec<u32>> {
    let resolution = prop_oneof![1u32..40, 1u32..3000, Just(1 << 16), Just(1 << 24)];
    prop::collection::vec(resolution, 1..6)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn the_encoding_equals_the_reference_in_every_dimension(
        resolutions in resolutions(), two in points::<2>(0..40), three in points::<3>(0..40), four in points::<4>(0..40),
        log2 in 0u32..14, features in 1usize..20, seed: u64,
    ) {
        compare(&two, &resolutions, log2, features, seed)?;
        compare(&three, &resolutions, log2, features, seed)?;
        compare(&four, &resolutions, log2, features, seed)?;
    }
}

#[test]
fn empty_batches_write_nothing() {
    let grid = HashGrid::<2>::with_resolutions(&[5], 1, 7).unwrap();
    let mut table = table(&grid, 4);
    grid.encode(&table, &[], &mut []);
    grid.encode_backward_points(&table, &[], &[], &mut []);
    let before = table.clone();
    grid.encode_backward(&[], &[], &mut table);
    assert_eq!(before, table);
}

#[test]
#[should_panic(expected = "table has 3 numbers, expected num_parameters() = 36")]
fn a_table_of_the_wrong_length_panics() {
    let grid = HashGrid::<2>::with_resolutions(&[5], 1, 7).unwrap();
    grid.encode(&[0.0; 3], &[[0.0; 2]], &mut [0.0]);
}
