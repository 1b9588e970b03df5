//! Functions of `smpl`.

use anyhow::{Context, Result, bail, ensure};
use glam::Vec3;
use smpl::{BodyModel, MotionFrame, MotionSample, Placement, Posed, SurfaceMotion, SurfacePoint, WeightVolume};
use surface_query::{Closest, MeshDistance};

use super::input::{Input, vec3s};
use super::output::{Output, count};

/// Sum of a point's bone weights below which no bone claims it; training's value.
const VOLUME_THRESHOLD: f32 = 1e-3;

/// Columns of `betas`: ten, as usual, or all that the model has.
fn check_betas(input: &Input, model: &BodyModel, columns: usize) -> Result<()> {
    let all = model.num_betas();
    ensure!(
        columns == all || columns == all.min(10),
        input.wrong("betas", &format!("has {columns} for a body, expected {}", all.min(10)))
    );
    Ok(())
}

pub fn skin(mut input: Input, model: &BodyModel, output: &mut Output) -> Result<()> {
    let (vertices, joints) = (model.num_vertices(), model.num_joints());
    let (shape, betas) = input.floats("betas", &[None, None])?;
    check_betas(&input, model, shape[1])?;
    let (bodies, columns) = (shape[0], shape[1]);
    let (_, poses) = input.floats("poses", &[Some(bodies), Some(3 * joints)])?;
    let (_, trans) = input.floats("trans", &[Some(bodies), Some(3)])?;
    count("vertices", &[bodies, vertices, 3])?;
    let (poses, trans) = (vec3s(&poses), vec3s(&trans));
    let shaped: Vec<_> = (0..bodies).map(|b| model.shaped(&betas[b * columns..][..columns])).collect();
    let pose =
        |b: usize| model.pose(&shaped[b], &poses[b * joints..][..joints], Placement::Pelvis { translation: trans[b] });
    let posed: Vec<_> = (0..bodies).map(pose).collect();
    let all = |of: fn(&Posed) -> &[Vec3]| posed.iter().flat_map(of).copied().collect::<Vec<_>>();
    output.vectors("vertices", &[bodies, vertices, 3], &all(|p| &p.vertices))?;
    output.vectors("joints", &[bodies, joints, 3], &all(|p| &p.joints))
}

pub fn motion(mut input: Input, model: &BodyModel, output: &mut Output) -> Result<()> {
    let (shape, betas) = input.floats("betas", &[None])?;
    check_betas(&input, model, shape[0])?;
    let (_, poses) = input.floats("poses", &[Some(3 * model.num_joints())])?;
    let (_, trans) = input.floats("trans", &[Some(3)])?;
    let points = input.points("points")?;
    let kind = input.integer("kind", 0..=1)?;
    let shaped = model.shaped(&betas);
    let placement = Placement::Pelvis { translation: Vec3::from_slice(&trans) };
    let posed = model.pose(&shaped, &vec3s(&poses), placement);
    if let Some(v) = posed.vertices.iter().chain(&shaped.vertices).position(|v| !v.is_finite()) {
        bail!("vertex {v} of the posed body overflows: betas, poses or trans are too large");
    }
    let samples: Vec<Option<MotionSample>> = if kind == 0 {
        let volume = WeightVolume::gaussian(model, &shaped, 32);
        let to_canonical = posed.to_canonical();
        points.iter().map(|&x| volume.map(&to_canonical, x, VOLUME_THRESHOLD)).collect()
    } else {
        let mesh = MeshDistance::new(&posed.vertices, &model.faces).context("the posed body")?;
        let (motion, frame) = (SurfaceMotion::default(), MotionFrame::new(model, &posed));
        let map = |x| {
            let Closest { face, barycentric, signed_distance, .. } = mesh.closest(x);
            motion.map(&frame, x, SurfacePoint { face, barycentric, signed_distance })
        };
        points.iter().map(|&x| map(x)).collect()
    };
    let canonical = samples.iter().flat_map(|s| s.map_or(Vec3::NAN, |s| s.canonical).to_array()).collect();
    output.numbers("canonical", &[points.len(), 3], canonical)?;
    output.floats("likelihood", &[points.len()], samples.iter().map(|s| s.map_or(0.0, |s| s.likelihood)).collect())
}
