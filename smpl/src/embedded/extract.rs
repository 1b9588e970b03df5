//! Meshing the implicit surface: naive surface nets (Gibson 1998) on half the body, projected onto
//! the surface.

use std::collections::HashMap;

use glam::Vec3;
use rayon::prelude::*;

use super::half::Half;
use super::shape::distance;

/// Edge of a grid cell, metres.
const CELL: f32 = 0.009;

/// Cells of the grid: x from the plane of symmetry, y from below the floor, z from behind the back.
const CELLS: [usize; 3] = [101, 196, 46];

/// First grid corner. Cells straddle the plane of symmetry, so that their vertices lie in it.
const START: Vec3 = Vec3::new(-0.5 * CELL, -0.025, -0.175);

/// Corners an edge of the blocks that are left out where the surface is far.
const BLOCK: usize = 8;

/// The distance is of first order only: its slope may be this much above 1.
const SLOPE: f32 = 1.8;

/// The half with x ≥ 0, open along x = 0.
pub(super) fn half_surface() -> Half {
    let corners = CELLS.map(|n| n + 1);
    let at = |i: [usize; 3]| (i[2] * corners[1] + i[1]) * corners[0] + i[0];
    let values = sample(corners);

    let mut vertex_of: HashMap<[usize; 3], u32> = HashMap::new();
    let mut vertices = Vec::new();
    for z in 0..CELLS[2] {
        for y in 0..CELLS[1] {
            for x in 0..CELLS[0] {
                if let Some(vertex) = cell_vertex([x, y, z], |i| values[at(i)]) {
                    vertex_of.insert([x, y, z], vertices.len() as u32);
                    vertices.push(project(vertex, 1));
                }
            }
        }
    }

    let mut faces = Vec::new();
    for z in 1..CELLS[2] {
        for y in 1..CELLS[1] {
            for x in 1..CELLS[0] {
                for axis in 0..3 {
                    let start = [x, y, z];
                    let mut end = start;
                    end[axis] += 1;
                    let (a, b) = (values[at(start)], values[at(end)]);
                    if (a < 0.0) == (b < 0.0) {
                        continue;
                    }
                    // The four cells around the edge, counter-clockwise seen from its end.
                    let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
                    let quad = [(1, 1), (0, 1), (0, 0), (1, 0)].map(|(du, dv)| {
                        let mut cell = start;
                        cell[u] -= du;
                        cell[v] -= dv;
                        vertex_of.get(&cell).copied()
                    });
                    if let [Some(i), Some(j), Some(k), Some(l)] = quad {
                        let quad = if a < 0.0 { [i, j, k, l] } else { [l, k, j, i] };
                        faces.extend(split(quad, &vertices));
                    }
                }
            }
        }
    }
    Half { vertices, faces }
}

/// Values at the corners; only their sign is right far from the surface.
fn sample(corners: [usize; 3]) -> Vec<f32> {
    let blocks = corners.map(|n| n.div_ceil(BLOCK));
    let position = |i: [f32; 3]| START + CELL * Vec3::from(i);
    let slabs: Vec<Vec<f32>> = (0..blocks[2])
        .into_par_iter()
        .map(|bz| {
            let depth = BLOCK.min(corners[2] - bz * BLOCK);
            let mut slab = vec![0.0f32; depth * corners[1] * corners[0]];
            for by in 0..blocks[1] {
                for bx in 0..blocks[0] {
                    let first = [bx * BLOCK, by * BLOCK, bz * BLOCK];
                    let half = 0.5 * (BLOCK - 1) as f32;
                    let centre = distance(position(first.map(|i| i as f32 + half)));
                    let far = centre.abs() > SLOPE * CELL * half * 3f32.sqrt();
                    for z in 0..depth {
                        for y in first[1]..corners[1].min(first[1] + BLOCK) {
                            for x in first[0]..corners[0].min(first[0] + BLOCK) {
                                let here = [x, y, first[2] + z].map(|i| i as f32);
                                let value = if far { centre } else { distance(position(here)) };
                                slab[(z * corners[1] + y) * corners[0] + x] = value;
                            }
                        }
                    }
                }
            }
            slab
        })
        .collect();
    slabs.concat()
}

/// Mean of the crossings on the edges of a cell; `None` where there are none.
fn cell_vertex(cell: [usize; 3], value: impl Fn([usize; 3]) -> f32) -> Option<Vec3> {
    let corner = |i: usize| [i & 1, i >> 1 & 1, i >> 2];
    let values: [f32; 8] = std::array::from_fn(|i| {
        let offset = corner(i);
        value([0, 1, 2].map(|axis| cell[axis] + offset[axis]))
    });
    let (mut sum, mut count) = (Vec3::ZERO, 0.0);
    for i in 0..8 {
        for bit in [1, 2, 4] {
            let j = i | bit;
            if j != i && (values[i] < 0.0) != (values[j] < 0.0) {
                let t = values[i] / (values[i] - values[j]);
                let point = |i: usize| Vec3::from(corner(i).map(|c| c as f32));
                sum += point(i).lerp(point(j), t);
                count += 1.0;
            }
        }
    }
    if count == 0.0 {
        return None;
    }
    let mut vertex = START + CELL * (Vec3::from(cell.map(|c| c as f32)) + sum / count);
    if cell[0] == 0 {
        vertex.x = 0.0;
    }
    Some(vertex)
}

/// Two triangles along the shorter diagonal.
fn split([a, b, c, d]: [u32; 4], vertices: &[Vec3]) -> [[u32; 3]; 2] {
    let length = |i: u32, j: u32| vertices[i as usize].distance_squared(vertices[j as usize]);
    if length(a, c) <= length(b, d) { [[a, b, c], [a, c, d]] } else { [[a, b, d], [b, c, d]] }
}

/// Newton's method along the gradient; vertices in the plane of symmetry stay there.
fn project(mut v: Vec3, steps: usize) -> Vec3 {
    let in_plane = v.x == 0.0;
    for _ in 0..steps {
        let d = distance(v);
        let gradient = gradient(v);
        // Never farther than a cell: at creases the gradient means little.
        let step = d / gradient.length_squared().max(0.25);
        v -= (step * gradient).clamp_length_max(0.5 * CELL);
        if in_plane {
            v.x = 0.0;
        }
    }
    v
}

fn gradient(v: Vec3) -> Vec3 {
    let h = 5e-4;
    let slope = |axis: Vec3| (distance(v + h * axis) - distance(v - h * axis)) / (2.0 * h);
    Vec3::new(slope(Vec3::X), slope(Vec3::Y), slope(Vec3::Z))
}

/// Evens out the triangles: moves every vertex towards the mean of its neighbours along the
/// surface.
pub(super) fn relax(mut mesh: Half) -> Half {
    let neighbours = super::rig::neighbours(mesh.vertices.len(), &mesh.faces);
    for _ in 0..6 {
        let old = &mesh.vertices;
        let moved: Vec<Vec3> = (0..old.len())
            .into_par_iter()
            .map(|i| {
                let v = old[i];
                let in_plane = v.x == 0.0;
                // Within the plane of symmetry only its own outline counts.
                let around = neighbours[i].iter().map(|&n| old[n as usize]);
                let (sum, count) = around
                    .filter(|n| !in_plane || n.x == 0.0)
                    .fold((Vec3::ZERO, 0.0), |(sum, count), n| (sum + n, count + 1.0));
                if count == 0.0 {
                    return v;
                }
                let normal = gradient(v).normalize_or_zero();
                let step = 0.5 * (sum / count - v);
                project(v + step - step.dot(normal) * normal, 2)
            })
            .collect();
        mesh.vertices = moved;
    }
    mesh
}
