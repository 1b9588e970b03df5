//! Atlas parameterisation: axis-aligned projection charts of the prior's faces, packed in a square.

use std::collections::{HashMap, VecDeque};

use glam::{Mat3, Vec2, Vec3};

/// Texels between charts and around them.
pub(super) const PADDING: u32 = 4;
/// Projection directions of charts.
const DIRECTIONS: [Vec3; 6] = [Vec3::Z, Vec3::NEG_Z, Vec3::X, Vec3::NEG_X, Vec3::Y, Vec3::NEG_Y];
/// Passes of majority voting among neighbouring faces.
const VOTES: usize = 6;
/// Least cosine between a face's normal and a direction taken by majority.
const LEAST_COSINE: f32 = 0.35;

/// Packed charts of a mesh.
#[derive(Clone, Debug, Default)]
pub(super) struct AtlasLayout {
    /// Side of the square, texels.
    pub side: u32,
    /// The chart of each face, (F).
    pub charts: Vec<u32>,
    /// Projection of each chart.
    places: Vec<Projection>,
}

/// Orthographic projection along an axis, to texels.
#[derive(Clone, Copy, Debug)]
struct Projection {
    direction: usize,
    scale: f32,
    offset: Vec2,
}

impl Projection {
    /// Projected point in the mesh's unit, viewed against the direction.
    fn flat(direction: usize, v: Vec3) -> Vec2 {
        let forward = DIRECTIONS[direction];
        let up = if forward.y == 0.0 { Vec3::Y } else { Vec3::Z };
        let axes = Mat3::from_cols(up.cross(forward), -up, forward);
        (axes.transpose() * v).truncate()
    }
}

impl AtlasLayout {
    /// Charts of a mesh at a texel width of `texel`, or wider to fit a square of `most` × `most`.
    /// `None` where even charts of one texel do not fit.
    pub fn new(vertices: &[Vec3], faces: &[[u32; 3]], texel: f32, most: u32) -> Option<Self> {
        let directions = directions(vertices, faces);
        // Lower bound of the texel width, from the area.
        let area = |face: &[u32; 3]| {
            let [a, b, c] = face.map(|v| vertices[v as usize]);
            0.5 * (b - a).cross(c - a).length()
        };
        let least = faces.iter().map(area).sum::<f32>().sqrt() / most as f32;
        let texel = texel.max(least);
        let charts = charts(vertices, faces, &directions, texel);
        let count = charts.iter().map(|c| c + 1).max().unwrap_or(0) as usize;
        let mut boxes = vec![(0, Vec2::INFINITY, Vec2::NEG_INFINITY); count];
        for ((face, &chart), &direction) in faces.iter().zip(&charts).zip(&directions) {
            let (of, low, high) = &mut boxes[chart as usize];
            *of = direction;
            for &v in face {
                let flat = Projection::flat(direction, vertices[v as usize]);
                (*low, *high) = (low.min(flat), high.max(flat));
            }
        }
        let mut scale = 1.0 / texel;
        while scale * texel > 1e-3 {
            let sizes: Vec<[u32; 2]> = boxes
                .iter()
                .map(|(_, low, high)| {
                    ((*high - *low) * scale).ceil().max(Vec2::ZERO).to_array().map(|side| side as u32 + 2 * PADDING)
                })
                .collect();
            if let Some((side, corners)) = pack(&sizes, most) {
                let place = |(&(direction, low, _), corner): (&(usize, Vec2, Vec2), [u32; 2])| {
                    let inner = Vec2::from(corner.map(|c| (c + PADDING) as f32));
                    Projection { direction, scale, offset: inner - scale * low }
                };
                return Some(Self { side, charts, places: boxes.iter().zip(corners).map(place).collect() });
            }
            scale *= 0.93;
        }
        None
    }

    /// Atlas coordinates of a point of the mesh, texels.
    pub fn place(&self, chart: u32, point: Vec3) -> Vec2 {
        let Projection { direction, scale, offset } = self.places[chart as usize];
        scale * Projection::flat(direction, point) + offset
    }
}

/// Projection direction of each face: the nearest to its normal, then by majority voting.
fn directions(vertices: &[Vec3], faces: &[[u32; 3]]) -> Vec<usize> {
    let normals: Vec<Vec3> = faces
        .iter()
        .map(|face| {
            let [a, b, c] = face.map(|v| vertices[v as usize]);
            (b - a).cross(c - a).normalize_or_zero()
        })
        .collect();
    let best =
        |n: &Vec3| (0..6).fold(0, |best, d| if n.dot(DIRECTIONS[d]) > n.dot(DIRECTIONS[best]) { d } else { best });
    let mut of: Vec<usize> = normals.iter().map(best).collect();
    let near = adjacent(faces);
    for _ in 0..VOTES {
        let vote = |(i, near): (usize, &Vec<u32>)| {
            let votes = |d: usize| near.iter().filter(|&&n| of[n as usize] == d).count();
            let joins = |d: &usize| votes(*d) * 3 >= 2 * near.len() && normals[i].dot(DIRECTIONS[*d]) >= LEAST_COSINE;
            if near.is_empty() { of[i] } else { (0..6).find(joins).unwrap_or(of[i]) }
        };
        of = near.iter().enumerate().map(vote).collect();
    }
    of
}

/// Neighbours of each face across its edges.
fn adjacent(faces: &[[u32; 3]]) -> Vec<Vec<u32>> {
    let mut edges: HashMap<(u32, u32), Vec<u32>> = HashMap::with_capacity(faces.len() * 3 / 2);
    let sides = |&[a, b, c]: &[u32; 3]| [(a, b), (b, c), (c, a)].map(|(a, b)| (a.min(b), a.max(b)));
    for (face, corners) in (0..).zip(faces) {
        sides(corners).into_iter().for_each(|edge| edges.entry(edge).or_default().push(face));
    }
    let others = |(face, corners): (u32, &[u32; 3])| {
        let across = sides(corners).into_iter().filter_map(|edge| edges.get(&edge)).flatten().copied();
        across.filter(|&other| other != face).collect()
    };
    (0..).zip(faces).map(others).collect()
}

/// Charts of the faces: connected faces of one direction whose projections do not overlap.
fn charts(vertices: &[Vec3], faces: &[[u32; 3]], directions: &[usize], texel: f32) -> Vec<u32> {
    const NONE: u32 = u32::MAX;
    let near = adjacent(faces);
    let (mut charts, mut count) = (vec![NONE; faces.len()], 0);
    let (mut queue, mut taken) = (VecDeque::new(), HashMap::new());
    // Faces refused by the current chart.
    let mut refused = vec![NONE; faces.len()];
    for seed in 0..faces.len() {
        if charts[seed] != NONE {
            continue;
        }
        taken.clear();
        queue.push_back(seed);
        while let Some(face) = queue.pop_front() {
            if charts[face] != NONE || refused[face] == count || directions[face] != directions[seed] {
                continue;
            }
            let corners = faces[face].map(|v| Projection::flat(directions[seed], vertices[v as usize]) / texel);
            let texels = inner_texels(corners);
            if texels.iter().any(|texel| taken.contains_key(texel)) {
                refused[face] = count;
                continue;
            }
            taken.extend(texels.into_iter().map(|texel| (texel, ())));
            charts[face] = count;
            queue.extend(near[face].iter().map(|&n| n as usize));
        }
        // A seed is never refused.
        charts[seed] = count;
        count += 1;
    }
    charts
}

/// Texels with their centres inside a triangle.
fn inner_texels([a, b, c]: [Vec2; 3]) -> Vec<[i32; 2]> {
    let (low, high) = (a.min(b).min(c).floor(), a.max(b).max(c).ceil());
    let area = (b - a).perp_dot(c - a);
    let mut texels = Vec::new();
    for y in low.y as i32..high.y as i32 {
        for x in low.x as i32..high.x as i32 {
            let p = Vec2::new(x as f32 + 0.5, y as f32 + 0.5);
            let edges = [(b - a).perp_dot(p - a), (c - b).perp_dot(p - b), (a - c).perp_dot(p - c)];
            if edges.iter().all(|edge| edge / area > 1e-3) {
                texels.push([x, y]);
            }
        }
    }
    texels
}

/// Shelf packing of boxes by descending height: side of the square, at most `most`, and corners.
fn pack(sizes: &[[u32; 2]], most: u32) -> Option<(u32, Vec<[u32; 2]>)> {
    let mut order: Vec<usize> = (0..sizes.len()).collect();
    order.sort_by_key(|&i| (std::cmp::Reverse(sizes[i][1]), std::cmp::Reverse(sizes[i][0]), i));
    let widest = sizes.iter().map(|size| size[0].max(size[1])).max().unwrap_or(1);
    (1..=most / 32).map(|n| 32 * n).filter(|&side| side >= widest).find_map(|side| {
        let mut corners = vec![[0; 2]; sizes.len()];
        let (mut x, mut y, mut height) = (0, 0, 0);
        for &i in &order {
            let size = sizes[i];
            if x + size[0] > side {
                (x, y, height) = (0, y + height, 0);
            }
            if y + size[1] > side {
                return None;
            }
            corners[i] = [x, y];
            x += size[0];
            height = height.max(size[1]);
        }
        Some((side, corners))
    })
}
