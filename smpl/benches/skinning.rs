//! Skinning, motion fields and construction, for the embedded body (6890 vertices, 4 % of the 207
//! pose terms not zero); `dense` fills every pose term, as in SMPL itself.

use divan::counter::ItemsCount;
use divan::{Bencher, black_box};
use glam::{Mat3, Vec3};
use rayon::prelude::*;
use smpl::{BodyModel, Placement, Shaped, SparseRows, SurfaceMotion, WeightVolume, WeightVolumeConfig, rodrigues};

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

    /// The vertices of `dense` from the definition, the bones given: every term and every weight of
    /// each vertex.
    #[divan::bench]
    fn dense_plain(bencher: Bencher<'_, '_>) {
        let (body, pose) = (super::dense(), pose(0));
        let bones = body.pose(&body.shaped(&BETAS), &pose, Placement::default()).bones;
        let turns = pose[1..].iter().map(|&r| rodrigues(r) - Mat3::IDENTITY);
        let terms: Vec<f32> = turns.flat_map(|r| r.transpose().to_cols_array()).collect();
        let n = body.num_vertices();
        let mut weights = vec![0.0; n * bones.len()];
        for (v, weights) in weights.chunks_exact_mut(bones.len()).enumerate() {
            body.weights.row(v).for_each(|(joint, w)| weights[joint] = w);
        }
        let posedirs: Vec<Vec3> = body.posedirs.values.clone();
        bencher.bench(|| {
            let vertex = |v: usize| {
                let shape = BETAS.iter().zip(body.shapedirs.chunks_exact(n)).map(|(&beta, s)| beta * s[v]);
                let pose = terms.iter().zip(&posedirs[terms.len() * v..]).map(|(&term, &d)| term * d);
                let rest = body.v_template[v] + shape.sum::<Vec3>() + pose.sum::<Vec3>();
                let weights = &weights[bones.len() * v..];
                bones.iter().zip(weights).map(|(bone, &w)| w * bone.transform_point3(rest)).sum::<Vec3>()
            };
            (0..n).map(vertex).collect::<Vec<_>>()
        });
    }

    #[divan::bench]
    fn pose_only(bencher: Bencher<'_, '_>) {
        let body = body();
        let (shaped, pose) = (body.shaped(&BETAS), pose(0));
        bencher.bench(|| body.pose(&shaped, black_box(&pose), Placement::default()));
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

    #[divan::bench]
    fn volume_backward(bencher: Bencher<'_, '_>) {
        let body = body();
        let shaped = body.shaped(&BETAS);
        let posed = body.pose(&shaped, &pose(0), Placement::default());
        let to_canonical = posed.to_canonical();
        let volume = WeightVolume::gaussian(&body, &shaped, &WeightVolumeConfig::default());
        let mut d_weights = vec![0.0; volume.weights.len()];
        bencher.counter(ItemsCount::new(posed.vertices.len())).bench_local(|| {
            for &x in &posed.vertices {
                volume.map_backward(&to_canonical, x, Vec3::ONE, 1.0, &mut d_weights);
            }
        });
    }

    #[divan::bench]
    fn volume_update(bencher: Bencher<'_, '_>) {
        let body = body();
        let shaped = body.shaped(&BETAS);
        let mut volume = WeightVolume::gaussian(&body, &shaped, &WeightVolumeConfig::default());
        bencher.bench_local(|| volume.update());
    }
}

mod construction {
    use super::*;

    #[divan::bench(sample_count = 5)]
    fn embedded() -> BodyModel {
        BodyModel::embedded()
    }

    #[divan::bench(sample_count = 5)]
    fn volume(bencher: Bencher<'_, '_>) {
        let body = body();
        let shaped = body.shaped(&BETAS);
        bencher.bench(|| WeightVolume::gaussian(&body, &shaped, &WeightVolumeConfig::default()));
    }
}
