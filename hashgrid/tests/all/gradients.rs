//! The backward passes against finite differences, and as adjoints of the forward pass.

use crate::common::{dot, encode, noise, points, table};
use approx::abs_diff_eq;
use hashgrid::HashGrid;
use proptest::prelude::*;
use testkit::gradient::{Tolerance, assert_gradient};

/// Finest of nested levels: a point off its faces is off those of the coarser levels.
const FINEST: u32 = 64;
const NESTED: [u32; 4] = [2, 8, 16, FINEST];

/// Points at least a fifth of the finest cell away from every face.
fn off_faces<const D: usize>(count: usize) -> impl Strategy<Value = Vec<[f32; D]>> {
    let coordinate = (0..FINEST, 0.2f32..0.8).prop_map(|(cell, f)| (cell as f32 + f) / FINEST as f32);
    let point = prop::collection::vec(coordinate, D).prop_map(|x| <[f32; D]>::try_from(x).expect("D coordinates"));
    prop::collection::vec(point, count)
}

/// Within a cell the encoding is linear in each coordinate: a large step has no truncation error,
/// and the tolerance is the rounding of L·F features of magnitude ≤ 1 over twice the step.
fn check_points<const D: usize>(points: &[[f32; D]], log2: u32, features: usize, seed: u64) {
    let grid = HashGrid::<D>::with_resolutions(&NESTED, features, log2).expect("a grid");
    let table = table(&grid, seed);
    let d_features = noise(points.len() * grid.num_features(), seed ^ 1);
    let mut d_points = vec![[0.0; D]; points.len()];
    grid.encode_backward_points(&table, points, &d_features, &mut d_points);

    let step = 0.15 / FINEST as f32;
    let tolerance = Tolerance {
        abs: 8.0 * f64::from(f32::EPSILON) * (grid.num_features() as f64).sqrt() / f64::from(step),
        rel: 1e-4,
    };
    assert_gradient("encode in x", points.as_flattened(), d_points.as_flattened(), step, tolerance, |x| {
        dot(&encode(&grid, &table, x.as_chunks::<D>().0), &d_features)
    });
}

fn check_table<const D: usize>(points: &[[f32; D]], features: usize, seed: u64) {
    let grid = HashGrid::<D>::with_resolutions(&[1, 2, 30], features, 5).expect("a grid");
    let table = table(&grid, seed);
    let d_features = noise(points.len() * grid.num_features(), seed ^ 1);
    let mut d_table = vec![0.0; grid.num_parameters()];
    grid.encode_backward(points, &d_features, &mut d_table);
    // Linear in the table: any step is exact.
    let tolerance = Tolerance { abs: 2e-6 * points.len() as f64, rel: 1e-4 };
    assert_gradient("encode in the table", &table, &d_table, 1.0, tolerance, |table| {
        dot(&encode(&grid, table, points), &d_features)
    });
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn the_gradient_of_the_points_equals_finite_differences(
        two in off_faces::<2>(5), three in off_faces::<3>(5), four in off_faces::<4>(20), features in 1usize..12, seed: u64,
    ) {
        check_points(&two, 8, features, seed);
        check_points(&three, 10, features, seed);
        check_points(&four, 12, features, seed);
    }

    #[test]
    fn the_gradient_of_the_table_equals_finite_differences(
        two in points::<2>(1..20), three in points::<3>(1..20), four in points::<4>(1..20), features in 1usize..12, seed: u64,
    ) {
        check_table(&two, features, seed);
        check_table(&three, features, seed);
        check_table(&four, features, seed);
    }

    #[test]
    fn backward_passes_add_to_their_outputs(points in points::<3>(1..30), seed: u64) {
        let grid = HashGrid::<3>::with_resolutions(&[4, 40], 2, 8).unwrap();
        let values = table(&grid, seed);
        let d_features = noise(points.len() * grid.num_features(), seed);
        let (mut once, mut onto) = (vec![0.0; grid.num_parameters()], vec![5.0; grid.num_parameters()]);
        grid.encode_backward(&points, &d_features, &mut once);
        grid.encode_backward(&points, &d_features, &mut onto);
        for (once, onto) in once.iter().zip(&onto) {
            prop_assert!(abs_diff_eq!(once + 5.0, onto, epsilon = 1e-4));
        }
        let (mut once, mut onto) = (vec![[0.0; 3]; points.len()], vec![[5.0; 3]; points.len()]);
        grid.encode_backward_points(&values, &points, &d_features, &mut once);
        grid.encode_backward_points(&values, &points, &d_features, &mut onto);
        for (once, onto) in once.as_flattened().iter().zip(onto.as_flattened()) {
            prop_assert!(abs_diff_eq!(once + 5.0, onto, epsilon = 1e-4), "{once} {onto}");
        }
    }
}

#[test]
fn clamped_coordinates_get_no_gradient() {
    let grid = HashGrid::<2>::with_resolutions(&[4, 50], 2, 8).unwrap();
    let table = table(&grid, 9);
    let points = [[-0.1, 0.3], [1.1, 0.3], [f32::NAN, 0.3], [0.0, 0.3], [1.0, 0.3]];
    let mut d_points = [[0.0; 2]; 5];
    grid.encode_backward_points(&table, &points, &[1.0; 5 * 4], &mut d_points);
    for clamped in &d_points[..3] {
        assert_eq!(clamped[0], 0.0);
        assert_ne!(clamped[1], 0.0);
    }
    // 0 and 1 themselves have the slope of their cell.
    for end in &d_points[3..] {
        assert_ne!(end[0], 0.0);
    }
}

#[test]
fn splitting_the_points_into_parts_changes_no_bit() {
    let grid = HashGrid::<4>::with_resolutions(&[2, 5, 9, 33, 100], 3, 10).unwrap();
    let table = table(&grid, 2);
    let points: Vec<[f32; 4]> = noise(4 * 40_000, 5).as_chunks::<4>().0.iter().map(|p| p.map(f32::abs)).collect();
    let d_features = noise(points.len() * grid.num_features(), 6);
    let run = |points: &[[f32; 4]], d_features: &[f32]| {
        let (mut d_points, mut features) = (vec![[0.0; 4]; points.len()], vec![0.0; d_features.len()]);
        grid.encode_backward_points(&table, points, d_features, &mut d_points);
        grid.encode(&table, points, &mut features);
        (d_points, features)
    };
    let whole = run(&points, &d_features);
    let mut d_whole = vec![0.0; table.len()];
    grid.encode_backward(&points, &d_features, &mut d_whole);
    for size in [17, 5000] {
        let (layout, width) = (grid.layout(points.len()), grid.num_features());
        // The (L, count, F) features of `count` points.
        let cut = |all: &[f32], first: usize, count: usize| {
            let (mut rows, mut part) = (vec![0.0; count * width], vec![0.0; count * width]);
            layout.to_rows(all, first..first + count, &mut rows, width);
            grid.layout(count).from_rows(&rows, width, 0..count, &mut part);
            part
        };
        let parts: Vec<Vec<f32>> =
            (0..points.len()).step_by(size).map(|i| cut(&d_features, i, size.min(points.len() - i))).collect();
        for (part, (points, d_features)) in points.chunks(size).zip(&parts).enumerate() {
            let (first, count) = (part * size, points.len());
            let (d_points, features) = run(points, d_features);
            assert!(d_points == whole.0[first..][..count] && features == cut(&whole.1, first, count), "{size}");
        }
        let mut d_table = vec![0.0; table.len()];
        grid.encode_backward_parts(points.chunks(size).zip(parts.iter().map(Vec::as_slice)), &mut d_table);
        assert!(d_table == d_whole, "in parts of {size}");
    }
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    let grid = HashGrid::<4>::with_resolutions(&[2, 5, 9, 33, 100], 2, 10).unwrap();
    let points: Vec<[f32; 4]> = noise(4 * 20_000, 5).as_chunks::<4>().0.iter().map(|p| p.map(f32::abs)).collect();
    let d_features = noise(points.len() * grid.num_features(), 6);
    let on = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let mut d_table = vec![0.0; grid.num_parameters()];
        pool.install(|| grid.encode_backward(&points, &d_features, &mut d_table));
        d_table
    };
    let one = on(1);
    assert!(one.iter().any(|d| *d != 0.0));
    for threads in [2, 3, 8] {
        assert!(on(threads) == one, "{threads} threads");
    }
}
