//! The two priors of the weight volumes.

use glam::{Mat3, Vec3};
use rayon::prelude::*;

use super::volume::{WeightVolume, WeightVolumeConfig};
use crate::model::{BodyModel, Shaped};

/// Weight that the background keeps inside the body, so that learning can still raise it.
const BACKGROUND_FLOOR: f32 = 1e-3;

/// Bones with less than this at a sample of the diffused prior are switched off there.
const DIFFUSED_CUT: f32 = 1e-3;

/// Weight that the background keeps of the Gaussian prior, whose tails matter at the joints.
const GAUSSIAN_CUT: f32 = 1e-4;

/// The margin is at least this part of a cell's diagonal. At 1 the surface would see no background
/// at all, but limbs that hang beside the body would be within the body's margin: at 0.7, 32
/// samples and a walking pose the 90th percentile of |x̂ − rest| over the vertices is 27 mm instead
/// of 57, for f ≥ 0.99 instead of 0.999 on the surface.
const CELL_SHARE: f32 = 0.7;

/// Sample positions of a volume.
struct Grid {
    n: usize,
    min: Vec3,
    max: Vec3,
    /// `config.margin`, or what the cells need.
    margin: f32,
}

impl Grid {
    /// The box of the vertices and everything around them that is not background.
    fn new(shaped: &Shaped, config: &WeightVolumeConfig) -> Self {
        let n = config.resolution;
        assert!(n >= 2, "weight volume: resolution {n}, need at least 2");
        assert!(!shaped.vertices.is_empty(), "weight volume: no vertices");
        let low = shaped.vertices.iter().copied().fold(Vec3::INFINITY, Vec3::min);
        let high = shaped.vertices.iter().copied().fold(Vec3::NEG_INFINITY, Vec3::max);
        // The margin follows from the cell and the cell from the margin. At the coarsest
        // resolutions they run away from each other, hence the fixed number of rounds.
        let mut margin = config.margin;
        let mut pad = margin + config.falloff;
        for _ in 0..8 {
            let cell = (high - low + 2.0 * pad) / (n - 1) as f32;
            margin = config.margin.max(CELL_SHARE * cell.length());
            pad = margin + config.falloff;
        }
        Self { n, min: low - pad, max: high + pad, margin }
    }

    fn samples(&self) -> usize {
        self.n.pow(3)
    }

    fn position(&self, i: usize) -> Vec3 {
        let n = self.n;
        let at = Vec3::new((i % n) as f32, (i / n % n) as f32, (i / (n * n)) as f32);
        self.min + at * self.cell()
    }

    fn cell(&self) -> Vec3 {
        (self.max - self.min) / (self.n - 1) as f32
    }
}

impl WeightVolume {
    /// The paper's prior: bone i, from joint i to each of its children (leaves: to twice the mean
    /// of their own vertices), is an oriented Gaussian g_i; the background is 1 − min(Σ g, 1).
    ///
    /// Admitted weakness: with the default widths, Σ w falls to a few percent at knees and elbows,
    /// so that limbs come apart there until Δ has filled the holes. [`WeightVolume::diffused`] has
    /// none.
    ///
    /// # Panics
    /// If the resolution is below 2, or `shaped` is not of `model`.
    #[must_use]
    pub fn gaussian(model: &BodyModel, shaped: &Shaped, config: &WeightVolumeConfig) -> Self {
        let grid = Grid::new(shaped, config);
        let joints = model.num_joints();
        let bones: Vec<Vec<Gaussian>> = (0..joints)
            .map(|joint| {
                let start = shaped.joints[joint];
                let mut ends: Vec<Vec3> = (0..joints)
                    .filter(|&child| model.parents[child] == Some(joint))
                    .map(|child| shaped.joints[child])
                    .collect();
                if ends.is_empty() {
                    ends.push(2.0 * own_centre(model, shaped, joint) - start);
                }
                ends.iter().map(|&end| Gaussian::new(start, end, config)).collect()
            })
            .collect();
        let samples = grid.samples();
        let mut prior = vec![0.0f32; samples * (joints + 1)];
        let (body, background) = prior.split_at_mut(samples * joints);
        for (bone, channel) in bones.iter().zip(body.chunks_exact_mut(samples)) {
            for (i, value) in channel.iter_mut().enumerate() {
                let x = grid.position(i);
                let g: f32 = bone.iter().map(|g| g.value(x)).sum();
                if g > GAUSSIAN_CUT {
                    *value = g.min(1.0);
                    background[i] += g;
                }
            }
        }
        for value in background {
            *value = (1.0 - value.min(1.0)).max(BACKGROUND_FLOOR);
        }
        Self::from_prior(grid.n, grid.min, grid.max, &prior)
    }

    /// The skinning weights of the canonical mesh, spread into the volume: every sample gets the
    /// mean of the weights of the vertices about as near as the nearest one. Inside the body and up
    /// to the margin outside, f is 1 to within 1 % in the canonical pose; beyond, the background
    /// takes over smoothly.
    ///
    /// Distances are to vertices, so edges should not be much longer than the margin.
    ///
    /// # Panics
    /// If the resolution is below 2, or `shaped` is not of `model`.
    #[must_use]
    pub fn diffused(model: &BodyModel, shaped: &Shaped, config: &WeightVolumeConfig) -> Self {
        let grid = Grid::new(shaped, config);
        let joints = model.num_joints();
        let samples = grid.samples();
        let cloud = Cloud::new(&shaped.vertices);
        let nearest: Vec<f32> = (0..samples).into_par_iter().map(|i| cloud.nearest_squared(grid.position(i))).collect();
        let outside = flood(&grid, &nearest);
        // Wide enough to be smooth from sample to sample.
        let width = 0.25 * grid.cell().length_squared();
        let rows: Vec<Vec<f32>> = (0..samples)
            .into_par_iter()
            .map(|i| {
                let mut row = vec![0.0f32; joints + 1];
                let background = if outside[i] {
                    let beyond = nearest[i].sqrt() - grid.margin;
                    let s = (beyond / config.falloff.max(f32::MIN_POSITIVE)).clamp(0.0, 1.0);
                    s * s * (3.0 - 2.0 * s)
                } else {
                    0.0
                };
                row[joints] = background.max(BACKGROUND_FLOOR);
                if background < 1.0 {
                    let body = &mut row[..joints];
                    gather(model, shaped, grid.position(i), nearest[i], width, body);
                    let sum: f32 = body.iter().sum();
                    body.iter_mut().for_each(|w| *w = if *w < DIFFUSED_CUT * sum { 0.0 } else { *w });
                    let sum: f32 = body.iter().sum();
                    let share = 1.0 - row[joints];
                    row[..joints].iter_mut().for_each(|w| *w *= share / sum);
                }
                row
            })
            .collect();
        let mut prior = vec![0.0f32; samples * (joints + 1)];
        for (channel, values) in prior.chunks_exact_mut(samples).enumerate() {
            for (value, row) in values.iter_mut().zip(&rows) {
                *value = row[channel];
            }
        }
        Self::from_prior(grid.n, grid.min, grid.max, &prior)
    }
}

/// exp(−½ (x − centre)ᵀ Σ⁻¹ (x − centre)) with one deviation along a bone and another across.
struct Gaussian {
    centre: Vec3,
    /// World to standard deviations.
    whiten: Mat3,
}

impl Gaussian {
    fn new(start: Vec3, end: Vec3, config: &WeightVolumeConfig) -> Self {
        let direction = (end - start).normalize_or(Vec3::Y);
        let (u, v) = direction.any_orthonormal_pair();
        // Short bones (pelvis to hips) would otherwise be sheets.
        let along = (config.gaussian_along * start.distance(end)).max(0.5 * config.gaussian_across);
        let across = config.gaussian_across;
        Self {
            centre: start.midpoint(end),
            whiten: Mat3::from_cols(direction / along, u / across, v / across).transpose(),
        }
    }

    fn value(&self, x: Vec3) -> f32 {
        (-0.5 * (self.whiten * (x - self.centre)).length_squared()).exp()
    }
}

/// Mean of the vertices, weighted by how much they belong to `joint`; the joint itself if none
/// does.
fn own_centre(model: &BodyModel, shaped: &Shaped, joint: usize) -> Vec3 {
    let (mut sum, mut total) = (Vec3::ZERO, 0.0);
    for (v, &vertex) in shaped.vertices.iter().enumerate() {
        for (column, w) in model.weights.row(v) {
            if column == joint {
                sum += w * vertex;
                total += w;
            }
        }
    }
    if total > 0.0 { sum / total } else { shaped.joints[joint] }
}

/// Points by coordinate, padded with the first to a multiple of [`LANES`].
struct Cloud {
    x: Vec<f32>,
    y: Vec<f32>,
    z: Vec<f32>,
}

const LANES: usize = 16;

impl Cloud {
    fn new(points: &[Vec3]) -> Self {
        let padded = points.len().next_multiple_of(LANES);
        let padded = || points.iter().chain(points.iter().cycle()).take(padded);
        Self {
            x: padded().map(|p| p.x).collect(),
            y: padded().map(|p| p.y).collect(),
            z: padded().map(|p| p.z).collect(),
        }
    }

    fn nearest_squared(&self, q: Vec3) -> f32 {
        let arch = pulp::Arch::new();
        arch.dispatch(|| {
            let mut least = [f32::INFINITY; LANES];
            let y = self.y.chunks_exact(LANES);
            let z = self.z.chunks_exact(LANES);
            for ((x, y), z) in self.x.chunks_exact(LANES).zip(y).zip(z) {
                for i in 0..LANES {
                    let d = Vec3::new(x[i] - q.x, y[i] - q.y, z[i] - q.z);
                    let squared = d.x * d.x + d.y * d.y + d.z * d.z;
                    least[i] = if squared < least[i] { squared } else { least[i] };
                }
            }
            least.into_iter().fold(f32::INFINITY, f32::min)
        })
    }
}

/// Adds the skinning weights of vertices near `x`, weighted by exp(−(d² − d_min²)/2h²) with h² =
/// `width`.
fn gather(model: &BodyModel, shaped: &Shaped, x: Vec3, nearest_squared: f32, width: f32, out: &mut [f32]) {
    for (v, vertex) in shaped.vertices.iter().enumerate() {
        let excess = (vertex.distance_squared(x) - nearest_squared) / (2.0 * width);
        if excess < 8.0 {
            let kernel = (-excess).exp();
            for (joint, w) in model.weights.row(v) {
                out[joint] += kernel * w;
            }
        }
    }
}

/// Marks the samples outside the body: those reached from the border without coming nearer to a
/// vertex than the margin, and their surroundings. The shell that stops the flood is more than a
/// cell thick, so it cannot leak through a mesh whose edges are shorter than that.
fn flood(grid: &Grid, nearest: &[f32]) -> Vec<bool> {
    let n = grid.n;
    let passable = |i: usize| nearest[i] > grid.margin * grid.margin;
    let mut reached = vec![false; nearest.len()];
    let mut open: Vec<usize> = (0..nearest.len())
        .filter(|&i| {
            let on_border = |c: usize| c == 0 || c == n - 1;
            on_border(i % n) || on_border(i / n % n) || on_border(i / (n * n))
        })
        .filter(|&i| passable(i))
        .collect();
    for &i in &open {
        reached[i] = true;
    }
    while let Some(i) = open.pop() {
        let coordinates = [i % n, i / n % n, i / (n * n)];
        for (axis, stride) in [1, n, n * n].into_iter().enumerate() {
            let below = (coordinates[axis] > 0).then(|| i - stride);
            let above = (coordinates[axis] + 1 < n).then(|| i + stride);
            for next in [below, above].into_iter().flatten() {
                if !reached[next] && passable(next) {
                    reached[next] = true;
                    open.push(next);
                }
            }
        }
    }
    reached
}
