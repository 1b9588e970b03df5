//! Oracles, strategies and random tables.

use hashgrid::HashGrid;
use proptest::prelude::*;
use testkit::body::Random;

/// The oracle's features, of a table that is zero-padded to (L, 2^T, F).
pub fn oracle<const D: usize>(grid: &HashGrid<D>, table: &[f32], points: &[[f32; D]], log2: u32, f: usize) -> Vec<f64> {
    let points: Vec<f64> = points.iter().flatten().map(|&x| f64::from(x)).collect();
    let size = f << log2;
    let mut padded = vec![0.0; grid.resolutions().len() * size];
    for (l, to) in padded.chunks_exact_mut(size).enumerate() {
        let level = &table[grid.level_range(l)];
        to[..level.len()].copy_from_slice(level);
    }
    testkit::oracle::hash_encode(&points, D, grid.resolutions(), &padded, log2, f)
}

pub fn encode<const D: usize>(grid: &HashGrid<D>, table: &[f32], points: &[[f32; D]]) -> Vec<f32> {
    let mut features = vec![f32::NAN; points.len() * grid.num_features()];
    grid.encode(table, points, &mut features);
    features
}

/// [`encode`] in rows, (Q, L·F).
pub fn encode_rows<const D: usize>(grid: &HashGrid<D>, table: &[f32], points: &[[f32; D]]) -> Vec<f32> {
    let features = encode(grid, table, points);
    let mut rows = vec![f32::NAN; features.len()];
    grid.layout(points.len()).to_rows(&features, 0..points.len(), &mut rows, grid.num_features());
    rows
}

/// A random table in ±1: the values of `init_table` are below the tolerances.
pub fn table<const D: usize>(grid: &HashGrid<D>, seed: u64) -> Vec<f32> {
    grid.init_table(seed).iter().map(|x| x * 1e4).collect()
}

/// Coordinates mostly in [0, 1], sometimes at or beyond its ends, on cell faces or not finite.
pub fn coordinate() -> impl Strategy<Value = f32> {
    prop_oneof![
        12 => 0.0f32..=1.0,
        1 => Just(0.0),
        1 => Just(1.0),
        1 => (0u32..=16).prop_map(|i| i as f32 / 16.0),
        1 => -3.0f32..4.0,
        1 => prop::sample::select(vec![
            -0.0, f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e-42, 1.0 - f32::EPSILON / 2.0, f32::MAX,
        ]),
    ]
}

pub fn points<const D: usize>(count: std::ops::Range<usize>) -> impl Strategy<Value = Vec<[f32; D]>> {
    let point = prop::collection::vec(coordinate(), D).prop_map(|x| <[f32; D]>::try_from(x).expect("D coordinates"));
    prop::collection::vec(point, count)
}

/// Random numbers in ±1.
pub fn noise(n: usize, seed: u64) -> Vec<f32> {
    let mut random = Random(seed);
    (0..n).map(|_| 2.0 * random.unit() - 1.0).collect()
}

pub fn dot(a: &[f32], b: &[f32]) -> f64 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(&a, &b)| f64::from(a) * f64::from(b)).sum()
}
