//! Skinning, for the embedded body (6890 vertices, 4 % of the 207
//! pose terms not zero); `dense` fills every pose term, as in SMPL itself.

use divan::{Bencher, black_box};
use glam::Vec3;
use smpl::{BodyModel, Placement, SparseRows};

fn main() {
    divan::main();
}

const BETAS: [f32; 10] = [0.5, -0.5, 0.3, 0.2, 0.1, 0.0, 0.4, -0.2, 0.6, -0.7];

fn body() -> BodyModel {
    BodyModel::embedded()
}

fn dense() -> BodyModel {
    let mut body = body();
    let row = |v: usize| (0..207u32).map(move |t| (t, Vec3::splat(1e-4) * ((v + t as usize) % 7) as f32));
    body.posedirs = SparseRows::from_rows((0..body.num_vertices()).map(row));
    body
}

fn pose(seed: usize) -> Vec<Vec3> {
    (0..24).map(|i| Vec3::new(0.1, -0.2, 0.15) * ((i * 7 + seed) % 5) as f32 * 0.4).collect()
}

mod one_frame {
    use super::*;

    fn run(bencher: Bencher<'_, '_>, body: &BodyModel) {
        let pose = pose(0);
        bencher.bench(|| {
            let shaped = body.shaped(black_box(&BETAS));
            body.pose(&shaped, black_box(&pose), Placement::default())
        });
    }

    #[divan::bench]
    fn sparse(bencher: Bencher<'_, '_>) {
        run(bencher, &body());
    }

    #[divan::bench]
    fn dense(bencher: Bencher<'_, '_>) {
        run(bencher, &super::dense());
    }
}
