//! What the kernels are measured on, and what is noted of each.

use std::time::Instant;

use glam::Vec3;
use serde::{Deserialize, Serialize};
use smpl::{BodyModel, Placement, Posed, Shaped};

/// Times that a measurement is repeated; the median holds.
const REPEATS: usize = 5;
/// Queries lie within this many metres of the skin.
pub const REACH: f32 = 0.05;

/// A way of doing it: what it costs and how far off it is.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Sample {
    pub kernel: String,
    pub name: String,
    /// Nanoseconds an item.
    pub nanoseconds: f64,
    /// In the unit of the kernel.
    pub error: f64,
    /// What is within the presets.
    pub default: bool,
}

/// A kernel with the names of its axes.
pub struct Kernel {
    pub name: &'static str,
    pub cost: &'static str,
    pub error: &'static str,
    pub samples: Vec<Sample>,
}

impl Kernel {
    pub fn add(&mut self, name: String, seconds: f64, items: usize, error: f64, default: bool) {
        let nanoseconds = 1e9 * seconds / items.max(1) as f64;
        self.samples.push(Sample { kernel: self.name.to_owned(), name, nanoseconds, error, default });
    }
}

/// Repeatable numbers in [0, 1) (splitmix64).
pub struct Random(pub u64);

impl Random {
    pub fn next(&mut self) -> f32 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) >> 40) as f32 / (1 << 24) as f32
    }
}

pub fn median(mut work: impl FnMut()) -> f64 {
    let mut times: Vec<f64> = (0..REPEATS)
        .map(|_| {
            let start = Instant::now();
            work();
            start.elapsed().as_secs_f64()
        })
        .collect();
    times.sort_by(f64::total_cmp);
    times[REPEATS / 2]
}

pub fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = values.fold((0.0, 0usize), |(s, n), v| (s + v, n + 1));
    sum / count.max(1) as f64
}

/// The embedded body at rest and in a pose with bent limbs, and points around it.
pub struct Figure {
    pub body: BodyModel,
    pub shaped: Shaped,
    pub posed: Posed,
    /// (face, barycentrics, point at rest) within reach of the skin.
    pub near: Vec<(u32, [f32; 3], Vec3)>,
}

impl Figure {
    pub fn new(points: usize) -> Self {
        let body = BodyModel::embedded();
        let shaped = body.shaped(&[]);
        let mut pose = vec![Vec3::ZERO; body.num_joints()];
        for (joint, turn) in [
            (1, Vec3::new(-0.6, 0.0, 0.1)),
            (2, Vec3::new(0.3, 0.0, -0.1)),
            (4, Vec3::new(1.0, 0.0, 0.0)),
            (16, Vec3::new(0.3, 0.0, -0.9)),
            (17, Vec3::new(-0.3, 0.0, 0.9)),
            (18, Vec3::new(0.0, -1.2, 0.0)),
        ] {
            if let Some(at) = pose.get_mut(joint) {
                *at = turn;
            }
        }
        let posed = body.pose(&shaped, &pose, Placement::default());
        let mut random = Random(1);
        let near = (0..points)
            .map(|_| {
                let face = ((random.next() * body.faces.len() as f32) as usize).min(body.faces.len() - 1);
                let (u, v) = (random.next(), random.next());
                let (u, v) = if u + v > 1.0 { (1.0 - u, 1.0 - v) } else { (u, v) };
                let [a, b, c] = body.faces[face].map(|i| shaped.vertices[i as usize]);
                let normal = (b - a).cross(c - a).normalize_or_zero();
                let at = a + u * (b - a) + v * (c - a) + (2.0 * random.next() - 1.0) * REACH * normal;
                (face as u32, [1.0 - u - v, u, v], at)
            })
            .collect();
        Self { body, shaped, posed, near }
    }

    pub fn queries(&self) -> Vec<Vec3> {
        self.near.iter().map(|n| n.2).collect()
    }
}
