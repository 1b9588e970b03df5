//! What the machine gives for plain work: the measure of what a step achieves.

use std::hint::black_box;
use std::time::Instant;

use rayon::prelude::*;

/// On one thread and on all of the current pool.
pub struct Machine {
    /// Of `matrixmultiply`'s product, 10⁹ operations a second.
    pub gflops: (f64, f64),
    /// Bytes read of a copy larger than the caches, 10⁹ a second; as many are written.
    pub copy: (f64, f64),
}

const REPEATS: usize = 7;

impl Machine {
    pub fn measure() -> Self {
        let threads = rayon::current_num_threads().max(1);
        Self { gflops: (product(1), product(threads)), copy: (copy(1), copy(threads)) }
    }
}

/// The best of a few rates: what disturbs a measurement only slows it.
fn best(work: f64, mut run: impl FnMut()) -> f64 {
    run();
    let rate = |_| {
        let start = Instant::now();
        run();
        1e-9 * work / start.elapsed().as_secs_f64().max(1e-9)
    };
    (0..REPEATS).map(rate).fold(0.0, f64::max)
}

fn product(threads: usize) -> f64 {
    const ROWS: usize = 256;
    const WIDTH: usize = 64;
    const TIMES: usize = 400;
    let work = threads * TIMES * 2 * ROWS * WIDTH * WIDTH;
    let b = ndarray::Array2::<f32>::from_elem((WIDTH, WIDTH), 0.5);
    best(work as f64, || {
        (0..threads).into_par_iter().with_max_len(1).for_each(|_| {
            let a = ndarray::Array2::<f32>::from_elem((ROWS, WIDTH), 0.25);
            let mut c = ndarray::Array2::<f32>::zeros((ROWS, WIDTH));
            for _ in 0..TIMES {
                ndarray::linalg::general_mat_mul(1.0, &a, black_box(&b), 0.0, &mut c);
            }
            black_box(c);
        });
    })
}

fn copy(threads: usize) -> f64 {
    const NUMBERS: usize = 1 << 24;
    let from = vec![1.0f32; NUMBERS];
    let mut to = vec![0.0f32; NUMBERS];
    let part = NUMBERS.div_ceil(threads);
    best(4.0 * NUMBERS as f64, || {
        to.par_chunks_mut(part).zip(from.par_chunks(part)).for_each(|(to, from)| to.copy_from_slice(black_box(from)));
    })
}
