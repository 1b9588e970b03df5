//! Shape and pose blend shapes of the embedded body.

use glam::Vec3;

use crate::model::{BodyModel, TERMS_PER_JOINT};
use crate::sparse::SparseRows;

/// (10·V): displacement of every vertex for one unit of each beta. `vertices` stand on the floor y
/// = 0.
pub(super) fn shape_directions(vertices: &[Vec3], faces: &[[u32; 3]]) -> Vec<Vec3> {
    let normals = normals(vertices, faces);
    let directions: [fn(Vec3, Vec3) -> Vec3; 10] =
        [height, weight, sex, muscle, head, belly, chest, width, leg_length, arm_length];
    let mut out = Vec::with_capacity(10 * vertices.len());
    for direction in directions {
        out.extend(vertices.iter().zip(&normals).map(|(&p, &n)| direction(p, n)));
    }
    out
}

/// 1 on the arms, 0 on the torso.
fn on_arm(p: Vec3) -> f32 {
    ramp(0.14, 0.24, p.x.abs()) * ramp(1.2, 1.28, p.y)
}

/// A bump of height 1 about `centre` with the given widths.
fn bump(p: Vec3, centre: [f32; 3], width: [f32; 3]) -> f32 {
    let q = (Vec3::new(p.x.abs(), p.y, p.z) - Vec3::from(centre)) / Vec3::from(width);
    (-0.5 * q.length_squared()).exp()
}

fn height(p: Vec3, _: Vec3) -> Vec3 {
    0.03 * (p - Vec3::new(0.0, 0.93, 0.0))
}

fn weight(p: Vec3, n: Vec3) -> Vec3 {
    let torso = 0.004 + 0.012 * bump(p, [0.0, 1.02, 0.0], [1.0, 0.16, 1.0]);
    // Less between the legs, where the two sides meet.
    let legs = 0.002 + 0.011 * ramp(0.1, 0.75, p.y) * (0.2 + 0.8 * ramp(0.0, 0.09, p.x.abs()));
    let body = legs + (torso - legs) * ramp(0.78, 0.95, p.y);
    let arm = 0.008 - 0.0065 * ramp(0.3, 0.7, p.x.abs());
    let trunk = body + (0.002 - body) * ramp(1.40, 1.52, p.y);
    n * (trunk + (arm - trunk) * on_arm(p))
}

fn sex(p: Vec3, n: Vec3) -> Vec3 {
    let shoulders = 0.012 * ramp(1.15, 1.35, p.y) * (p.x / 0.17).clamp(-1.0, 1.0);
    let neck = ramp(1.38, 1.42, p.y) * (1.0 - ramp(0.08, 0.12, p.x.abs()));
    let hips = -0.007 * bump(p, [0.12, 0.90, -0.03], [0.08, 0.07, 0.1]);
    let bust = -0.010 * bump(p, [0.075, 1.255, 0.11], [0.04, 0.04, 0.05]);
    let waist = 0.005 * bump(p, [0.12, 1.07, 0.0], [0.06, 0.06, 0.1]);
    Vec3::X * (shoulders * (1.0 - neck)) + n * (hips + bust + waist + 0.002 * neck)
}

fn muscle(p: Vec3, n: Vec3) -> Vec3 {
    let arm = bump(p, [0.30, 1.38, -0.01], [0.09, 0.1, 0.1])
        + 0.6 * bump(p, [0.52, 1.38, -0.01], [0.06, 0.1, 0.1])
        + 0.8 * bump(p, [0.18, 1.38, -0.01], [0.05, 0.06, 0.08]);
    let leg = 1.2 * bump(p, [0.09, 0.65, 0.0], [0.1, 0.12, 0.2]) + bump(p, [0.10, 0.34, -0.06], [0.06, 0.06, 0.06]);
    let torso =
        bump(p, [0.075, 1.26, 0.1], [0.05, 0.05, 0.06]) + 0.8 * bump(p, [0.12, 1.25, -0.08], [0.08, 0.08, 0.06]);
    n * (0.006 * (arm + leg + torso))
}

fn head(p: Vec3, _: Vec3) -> Vec3 {
    0.035 * ramp(1.44, 1.54, p.y) * (p - Vec3::new(0.0, 1.50, 0.01))
}

fn belly(p: Vec3, _: Vec3) -> Vec3 {
    Vec3::Z * (0.016 * bump(p, [0.0, 1.03, 0.11], [0.09, 0.09, 0.08]))
}

fn chest(p: Vec3, n: Vec3) -> Vec3 {
    n * (0.010 * bump(p, [0.0, 1.25, 0.0], [0.12, 0.09, 0.5]) * (1.0 - on_arm(p)))
}

fn width(p: Vec3, _: Vec3) -> Vec3 {
    let torso = ramp(0.80, 0.95, p.y) * (1.0 - ramp(1.38, 1.44, p.y) * (1.0 - on_arm(p)));
    let legs = 0.5 * (1.0 - ramp(0.80, 0.95, p.y));
    Vec3::X * (0.010 * (torso + legs) * (p.x / 0.15).clamp(-1.0, 1.0))
}

fn leg_length(p: Vec3, _: Vec3) -> Vec3 {
    Vec3::NEG_Y * (0.03 * ((0.85 - p.y) / 0.75).clamp(0.0, 1.0))
}

fn arm_length(p: Vec3, _: Vec3) -> Vec3 {
    Vec3::X * (0.022 * p.x.signum() * ((p.x.abs() - 0.2) / 0.48).clamp(0.0, 1.0))
}

/// Share of the correction that is applied: all of it overshoots at turns beyond a radian.
const PART: f32 = 0.7;

/// (V, 207): corrects linear blending to second order in the angle.
///
/// A vertex that follows joint j (and everything beyond it) with weight w, and its parent with the
/// rest, should turn about j by the fraction w of the rotation, but is put at (1−w) r + w R r,
/// which lies closer to the axis. To second order the difference is −w (1−w) ½(M + Mᵀ) r with M = R
/// − I and r the vertex seen from the joint: linear in M, which is what pose blend shapes can say.
pub(super) fn pose_directions(model: &BodyModel) -> SparseRows<Vec3> {
    let joints = model.shaped(&[]).joints;
    SparseRows::from_rows((0..model.num_vertices()).map(|v| {
        let mut beyond = vec![0.0f32; joints.len()];
        for (joint, w) in model.weights.row(v) {
            beyond[joint] += w;
        }
        // Children come after their parents.
        for joint in (1..joints.len()).rev() {
            if let Some(parent) = model.parents[joint] {
                beyond[parent] += beyond[joint];
            }
        }
        let mut row = Vec::new();
        for joint in 1..joints.len() {
            let w = beyond[joint].min(1.0);
            let amount = -PART * w * (1.0 - w);
            if amount > -0.01 {
                continue;
            }
            let r = (model.v_template[v] - joints[joint]).to_array();
            for a in 0..3 {
                for b in 0..3 {
                    let mut d = [0.0; 3];
                    d[a] += 0.5 * amount * r[b];
                    d[b] += 0.5 * amount * r[a];
                    let term = TERMS_PER_JOINT * (joint - 1) + 3 * a + b;
                    row.push((term as u32, Vec3::from(d)));
                }
            }
        }
        row
    }))
}

/// Area-weighted, then evened out over the mesh, so that moving along them does not fold creases;
/// shorter than 1 there.
fn normals(vertices: &[Vec3], faces: &[[u32; 3]]) -> Vec<Vec3> {
    let mut out = vec![Vec3::ZERO; vertices.len()];
    for face in faces {
        let [a, b, c] = face.map(|i| vertices[i as usize]);
        for i in face {
            out[*i as usize] += (b - a).cross(c - a);
        }
    }
    out.iter_mut().for_each(|n| *n = n.normalize_or_zero());
    let neighbours = super::rig::neighbours(vertices.len(), faces);
    for _ in 0..6 {
        out = (0..out.len())
            .map(|i| {
                let sum: Vec3 = neighbours[i].iter().map(|&n| out[n as usize]).sum();
                0.5 * out[i] + 0.5 * sum / neighbours[i].len().max(1) as f32
            })
            .collect();
    }
    out
}

/// 0 below `low`, 1 above `high`, smooth between.
fn ramp(low: f32, high: f32, x: f32) -> f32 {
    let s = ((x - low) / (high - low)).clamp(0.0, 1.0);
    s * s * (3.0 - 2.0 * s)
}
