//! Encoding with the paper's sizes (D 4, L 16, F 2, T 2^19), forward and backward. Uniform points
//! share few corners; points near a surface share more, as in a trained scene. `cargo bench -p
//! hashgrid`: times are per call of [`POINTS`] points; items/s are points.

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
