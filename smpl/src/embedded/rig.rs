//! Skeleton, skinning weights and joint regressor of the embedded body.

use glam::{DMat4, DVec4, Vec3};

use crate::sparse::SparseRows;

/// SMPL's joints in its order: parent, position with the floor at y = 0, metres, and the axis of
/// the limb through it.
pub(super) const JOINTS: [(usize, [f32; 3], Vec3); 24] = [
    (usize::MAX, [0.0, 0.93, 0.0], Vec3::Y),
    (0, [0.088, 0.885, 0.004], Vec3::Y),
    (0, [-0.088, 0.885, 0.004], Vec3::Y),
    (0, [0.0, 1.02, -0.012], Vec3::Y),
    (1, [0.097, 0.478, -0.002], Vec3::Y),
    (2, [-0.097, 0.478, -0.002], Vec3::Y),
    (3, [0.0, 1.125, -0.016], Vec3::Y),
    (4, [0.104, 0.082, -0.024], Vec3::Y),
    (5, [-0.104, 0.082, -0.024], Vec3::Y),
    (6, [0.0, 1.19, -0.012], Vec3::Y),
    (7, [0.113, 0.022, 0.095], Vec3::Z),
    (8, [-0.113, 0.022, 0.095], Vec3::Z),
    (9, [0.0, 1.415, -0.022], Vec3::Y),
    (9, [0.055, 1.365, -0.018], Vec3::X),
    (9, [-0.055, 1.365, -0.018], Vec3::X),
    (12, [0.0, 1.505, 0.006], Vec3::Y),
    (13, [0.172, 1.374, -0.016], Vec3::X),
    (14, [-0.172, 1.374, -0.016], Vec3::X),
    (16, [0.440, 1.380, -0.014], Vec3::X),
    (17, [-0.440, 1.380, -0.014], Vec3::X),
    (18, [0.690, 1.380, -0.008], Vec3::X),
    (19, [-0.690, 1.380, -0.008], Vec3::X),
    (20, [0.775, 1.373, -0.006], Vec3::X),
    (21, [-0.775, 1.373, -0.006], Vec3::X),
];

/// Rounds of smoothing of the weights over the mesh; one round spreads them by about half an edge.
const ROUNDS: usize = 12;

/// Most joints a vertex follows.
const MAX_JOINTS: usize = 4;

pub(super) fn parents() -> Vec<Option<usize>> {
    JOINTS.iter().map(|&(parent, ..)| (parent != usize::MAX).then_some(parent)).collect()
}

/// Vertices joined to each by an edge, ascending.
pub(super) fn neighbours(vertices: usize, faces: &[[u32; 3]]) -> Vec<Vec<u32>> {
    let mut out = vec![Vec::new(); vertices];
    for &[a, b, c] in faces {
        for [i, j] in [[a, b], [b, c], [c, a]] {
            out[i as usize].push(j);
            out[j as usize].push(i);
        }
    }
    for list in &mut out {
        list.sort_unstable();
        list.dedup();
    }
    out
}

/// The joint that a vertex follows before smoothing.
fn owner(p: Vec3) -> usize {
    // Left joints; the right one is always the next.
    let side = |left: usize| if p.x >= 0.0 { left } else { left + 1 };
    let x = p.x.abs();
    if p.y < 0.80 + 0.85 * x && p.y < 1.0 && x < 0.3 {
        return side(match () {
            () if p.z > 0.095 && p.y < 0.1 => 10,
            () if p.y < 0.085 + 0.35 * (p.z + 0.024).max(0.0) => 7,
            () if p.y < 0.478 => 4,
            () => 1,
        });
    }
    // The sleeve's seam leans out from the armpit to the top of the shoulder.
    if p.y > 1.25 && x > 0.172 - 0.25 * (p.y - 1.374).clamp(-0.1, 0.1) {
        return side(match () {
            () if x > 0.775 => 22,
            () if x > 0.690 => 20,
            () if x > 0.440 => 18,
            () => 16,
        });
    }
    match () {
        () if p.y > 1.46 && p.y - 1.505 + 0.5 * (p.z - 0.006) > 0.0 => 15,
        () if p.y > 1.415 - 0.4 * (x - 0.02).min(0.0) && x < 0.075 => 12,
        () if p.y > 1.31 && x > 0.055 => side(13),
        () if p.y > 1.19 => 9,
        () if p.y > 1.125 => 6,
        () if p.y > 1.02 => 3,
        () => 0,
    }
}

/// Joints by region, smoothed along the surface: neighbouring limbs do not mix however close they
/// are.
pub(super) fn skinning_weights(vertices: &[Vec3], faces: &[[u32; 3]]) -> SparseRows<f32> {
    let neighbours = neighbours(vertices.len(), faces);
    let mut weights = vec![[0.0f32; 24]; vertices.len()];
    for (row, &v) in weights.iter_mut().zip(vertices) {
        if v.x == 0.0 && matches!(owner(v), 1 | 2) {
            // Between the legs.
            row[1] = 0.5;
            row[2] = 0.5;
        } else {
            row[owner(v)] = 1.0;
        }
    }
    for _ in 0..ROUNDS {
        weights = (0..weights.len())
            .map(|i| {
                let mut row = weights[i];
                let share = 1.0 / neighbours[i].len().max(1) as f32;
                for joint in 0..24 {
                    let around: f32 = neighbours[i].iter().map(|&n| weights[n as usize][joint]).sum();
                    row[joint] = 0.4 * row[joint] + 0.6 * share * around;
                }
                row
            })
            .collect();
    }
    SparseRows::from_rows(weights.iter().map(|row| {
        let mut kept: Vec<(u32, f32)> =
            (0..24u32).map(|joint| (joint, row[joint as usize])).filter(|&(_, w)| w > 0.01).collect();
        kept.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
        kept.truncate(MAX_JOINTS);
        kept.sort_by_key(|&(joint, _)| joint);
        let sum: f32 = kept.iter().map(|&(_, w)| w).sum();
        kept.into_iter().map(move |(joint, w)| (joint, w / sum))
    }))
}

/// Each joint as a mean of the vertices in a slab across its limb, so that it follows the shape.
pub(super) fn joint_regressor(vertices: &[Vec3]) -> SparseRows<f32> {
    SparseRows::from_rows(JOINTS.iter().map(|&(_, position, axis)| {
        let joint = Vec3::from(position);
        // Joints of a limb must not follow the other one.
        let reach = if joint.x.abs() > 0.08 { 0.13 } else { 0.2 };
        let mut slab: Vec<u32> = (0..vertices.len() as u32)
            .filter(|&v| {
                let r = vertices[v as usize] - joint;
                r.dot(axis).abs() < 0.025 && r.length() < reach
            })
            .collect();
        loop {
            let weights = least_norm(&slab, vertices, joint);
            let keep: Vec<bool> = weights.iter().map(|&w| w >= 0.0).collect();
            if keep.iter().all(|&k| k) {
                return slab.into_iter().zip(weights);
            }
            let mut kept = keep.iter();
            slab.retain(|_| kept.next().copied().unwrap_or(false));
        }
    }))
}

/// The most even weights that sum to 1 and whose mean of the vertices is `target`.
fn least_norm(slab: &[u32], vertices: &[Vec3], target: Vec3) -> Vec<f32> {
    let rows: Vec<DVec4> = (slab.iter()).map(|&v| (vertices[v as usize] - target).as_dvec3().extend(1.0)).collect();
    let even = 1.0 / rows.len().max(1) as f64;
    let mut gram = DMat4::ZERO;
    let mut rest = DVec4::W;
    for row in &rows {
        gram += DMat4::from_cols(row * row.x, row * row.y, row * row.z, row * row.w);
        rest -= row * even;
    }
    let multipliers = gram.inverse() * rest;
    rows.iter().map(|row| (even + row.dot(multipliers)) as f32).collect()
}
