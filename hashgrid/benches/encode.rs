//! Encoding with the paper's sizes (D 4, L 16, F 2, T 2^19), forward and backward, against the
//! definition. Uniform points share few corners; points near a surface share more, as in a trained
//! scene. `cargo bench -p hashgrid`: times are per call of [`POINTS`] points; items/s are points.

use divan::counter::ItemsCount;
use divan::{Bencher, black_box};
use hashgrid::{HashGrid, HashGridConfig};
use rayon::prelude::*;
use testkit::body::Random;

const POINTS: usize = 1 << 16;
/// Points per parallel task.
const TASK: usize = 16_384;
const CONFIG: HashGridConfig = HashGridConfig { levels: 16, features: 2, log2_table_size: 19, n_min: 16, n_max: 2048 };

fn main() {
    let _ = rayon::ThreadPoolBuilder::new().num_threads(2).build_global();
    divan::main();
}

struct Case {
    grid: HashGrid<4>,
    table: Vec<f32>,
    points: Vec<[f32; 4]>,
    d_features: Vec<f32>,
}

#[derive(Clone, Copy, Debug)]
enum Points {
    Uniform,
    Surface,
}

fn case(kind: Points) -> Case {
    let grid = HashGrid::new(&CONFIG).expect("a grid");
    let mut numbers = Random(1);
    let mut random = || numbers.unit();
    let points = (0..POINTS)
        .map(|i| match kind {
            Points::Uniform => [random(), random(), random(), random()],
            // Rays of 32 samples through a thin shell about a sphere.
            Points::Surface => {
                let (ray, sample) = ((i / 32) as f32, (i % 32) as f32 / 32.0);
                let (angle, z) = (ray * 2.399_963, ray / (POINTS / 32) as f32 * 2.0 - 1.0);
                let r = (1.0 - z * z).sqrt() * 0.4;
                [0.5 + r * angle.cos(), 0.5 + r * angle.sin(), 0.5 + 0.4 * z, sample]
            }
        })
        .collect();
    Case {
        table: grid.init_table(1),
        d_features: (0..POINTS * grid.num_features()).map(|_| random() - 0.5).collect(),
        points,
        grid,
    }
}

#[divan::bench(args = [Points::Uniform, Points::Surface])]
fn encode(bencher: Bencher<'_, '_>, kind: Points) {
    let Case { grid, table, points, .. } = case(kind);
    let width = grid.num_features();
    // A call writes all levels of its points.
    let mut features = vec![0.0; POINTS * width];
    bencher.counter(ItemsCount::new(POINTS)).bench_local(|| {
        points
            .par_chunks(TASK)
            .zip(features.par_chunks_mut(TASK * width))
            .for_each(|(points, features)| grid.encode(black_box(&table), points, features));
    });
}

#[divan::bench(args = [Points::Uniform, Points::Surface])]
fn encode_backward(bencher: Bencher<'_, '_>, kind: Points) {
    let Case { grid, points, d_features, .. } = case(kind);
    let mut d_table = vec![0.0; grid.num_parameters()];
    bencher.counter(ItemsCount::new(POINTS)).bench_local(|| {
        grid.encode_backward(black_box(&points), &d_features, &mut d_table);
    });
}

#[divan::bench(args = [Points::Uniform, Points::Surface])]
fn encode_backward_points(bencher: Bencher<'_, '_>, kind: Points) {
    let Case { grid, table, points, d_features } = case(kind);
    let width = grid.num_features();
    let mut d_points = vec![[0.0; 4]; POINTS];
    bencher.counter(ItemsCount::new(POINTS)).bench_local(|| {
        points.par_chunks(TASK).zip(d_features.par_chunks(TASK * width)).zip(d_points.par_chunks_mut(TASK)).for_each(
            |((points, d_features), d_points)| {
                grid.encode_backward_points(black_box(&table), points, d_features, d_points);
            },
        );
    });
}

/// The encoding by its definition, point by point.
#[divan::bench(args = [Points::Uniform, Points::Surface])]
fn encode_plain(bencher: Bencher<'_, '_>, kind: Points) {
    let Case { grid, table, points, .. } = case(kind);
    let width = grid.num_features();
    let mut features = vec![0.0; POINTS * width];
    bencher.counter(ItemsCount::new(POINTS)).bench_local(|| {
        points
            .par_iter()
            .zip(features.par_chunks_mut(width))
            .with_min_len(TASK)
            .for_each(|(point, features)| plain(&grid, black_box(&table), point, features));
    });
}

fn plain(grid: &HashGrid<4>, table: &[f32], point: &[f32; 4], features: &mut [f32]) {
    const PRIMES: [u32; 4] = [1, 2_654_435_761, 805_459_861, 3_674_653_429];
    for (l, &n) in grid.resolutions().iter().enumerate() {
        let table = &table[grid.level_range(l)];
        let dense = (u64::from(n) + 1).pow(4) <= 1 << CONFIG.log2_table_size;
        let cell = point.map(|x| ((x * n as f32) as u32).min(n - 1));
        let mut sum = [0.0; 2];
        for corner in 0..16 {
            let (mut row, mut hash, mut stride, mut weight) = (0, 0, 1, 1.0);
            for j in 0..4 {
                let up = corner >> j & 1;
                let fraction = point[j] * n as f32 - cell[j] as f32;
                weight *= if up == 1 { fraction } else { 1.0 - fraction };
                row += (cell[j] + up) * stride;
                stride = stride.wrapping_mul(n + 1);
                hash ^= (cell[j] + up).wrapping_mul(PRIMES[j]);
            }
            let row = if dense { row as usize } else { hash as usize % (table.len() / 2) };
            for f in 0..2 {
                sum[f] += weight * table[row * 2 + f];
            }
        }
        features[l * 2..l * 2 + 2].copy_from_slice(&sum);
    }
}
