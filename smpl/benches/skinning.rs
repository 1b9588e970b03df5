//! Skinning and motion fields, for the embedded body (6890 vertices, 4 % of the 207
//! pose terms not zero); `dense` fills every pose term, as in SMPL itself.

use divan::counter::ItemsCount;
use divan::{Bencher, black_box};
use glam::Vec3;
use rayon::prelude::*;
use smpl::{BodyModel, Placement, Shaped, SparseRows, SurfaceMotion, WeightVolume, WeightVolumeConfig};

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

mod batch_of_32 {
    use super::*;

    /// A shape a frame, as smplx computes it. Divide by 32.
    fn run(bencher: Bencher<'_, '_>, body: &BodyModel) {
        let poses: Vec<_> = (0..32).map(pose).collect();
        bencher.counter(ItemsCount::new(32usize)).bench(|| {
            let shape = |_| body.shaped(black_box(&BETAS));
            let shaped: Vec<Shaped> = (0..32).into_par_iter().map(shape).collect();
            let frames: Vec<_> =
                (shaped.iter().zip(&poses)).map(|(s, p)| (s, p.as_slice(), Placement::default())).collect();
            body.pose_batch(&frames)
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

mod motion {
    use super::*;

    #[divan::bench]
    fn surface(bencher: Bencher<'_, '_>) {
        let body = body();
        let posed = body.pose(&body.shaped(&BETAS), &pose(0), Placement::default());
        let field = SurfaceMotion::default();
        bencher.counter(ItemsCount::new(body.faces.len())).bench(|| {
            let mut sum = Vec3::ZERO;
            for (i, face) in body.faces.iter().enumerate() {
                let x = posed.vertices[face[0] as usize];
                if let Some(s) = field.map(&body, &posed, x, i as u32, [0.4, 0.3, 0.3], 0.0) {
                    sum += s.canonical;
                }
            }
            sum
        });
    }

    #[divan::bench]
    fn volume(bencher: Bencher<'_, '_>) {
        let body = body();
        let shaped = body.shaped(&BETAS);
        let posed = body.pose(&shaped, &pose(0), Placement::default());
        let to_canonical = posed.to_canonical();
        let volume = WeightVolume::gaussian(&body, &shaped, &WeightVolumeConfig::default());
        bencher.counter(ItemsCount::new(posed.vertices.len())).bench(|| {
            let mut sum = Vec3::ZERO;
            for &x in &posed.vertices {
                if let Some(s) = volume.map(&to_canonical, x, 1e-3) {
                    sum += s.canonical;
                }
            }
            sum
        });
    }
}
