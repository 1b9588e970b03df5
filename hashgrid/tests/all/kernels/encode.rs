//! The encoding against the test kit's reference encoding in f64.

use super::common::{encode, encode_rows, oracle, points, table};
use approx::assert_abs_diff_eq;
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
fn the_dense_index_and_the_hash_follow_their_definitions() {
    // At T = 9 in 3-D, 7 cells per axis (8³ corners) is the finest dense level.
    let grid = HashGrid::<3>::with_resolutions(&[7, 8], 1, 9).unwrap();
    assert_eq!(grid.level_range(0), 0..512);
    assert_eq!(grid.level_range(1), 512..1024);
    let table = table(&grid, 3);
    // Corner (0, 0, 1) has row 64 in the dense level, π_3 mod 2^9 in the hashed one.
    let dense = encode(&grid, &table, &[[0.0, 0.0, 1.0 / 7.0]])[0];
    let hashed = encode(&grid, &table, &[[0.0, 0.0, 1.0 / 8.0]])[1];
    assert_abs_diff_eq!(dense, table[64], epsilon = 1e-6);
    assert_eq!(hashed, table[512 + 805_459_861 % 512]);
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

#[test]
fn splitting_the_points_into_calls_changes_no_bit() {
    let grid = HashGrid::<4>::with_resolutions(&[3, 20, 50], 2, 10).unwrap();
    let table = table(&grid, 1);
    let points: Vec<[f32; 4]> =
        super::common::noise(4 * 40_000, 2).as_chunks::<4>().0.iter().map(|p| p.map(|x| 0.5 + 0.5 * x)).collect();
    let together = encode_rows(&grid, &table, &points);
    for size in [1, 7, 16, 17, 5000] {
        let apart: Vec<f32> = points.chunks(size).flat_map(|p| encode_rows(&grid, &table, p)).collect();
        assert!(apart == together, "in calls of {size}");
    }
}

#[test]
fn coordinates_outside_are_clamped_and_nan_is_zero() {
    let grid = HashGrid::<2>::with_resolutions(&[5, 100], 4, 7).unwrap();
    let table = table(&grid, 4);
    let at = |x, y| encode(&grid, &table, &[[x, y]]);
    assert_eq!(at(-1.0, 0.3), at(0.0, 0.3));
    assert_eq!(at(f32::NEG_INFINITY, 0.3), at(0.0, 0.3));
    assert_eq!(at(f32::NAN, 0.3), at(0.0, 0.3));
    assert_eq!(at(0.3, 1.5), at(0.3, 1.0));
    assert_eq!(at(0.3, f32::INFINITY), at(0.3, 1.0));
    assert_ne!(at(0.0, 0.3), at(1.0, 0.3));
}
