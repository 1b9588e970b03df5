//! Live samples of rays, structure of arrays.

use glam::{Vec3, Vec4};

use crate::model::body::Body;

/// Live samples of consecutive rays, structure of arrays.
#[derive(Clone, Debug, Default)]
pub(crate) struct Samples {
    /// First sample of each ray, and the end of the last.
    pub starts: Vec<usize>,
    /// Depth along the ray.
    pub t: Vec<f32>,
    /// Width of the sample's bin.
    pub delta: Vec<f32>,
    /// Foreground likelihood f.
    pub likelihood: Vec<f32>,
    pub world: Vec<Vec3>,
    /// x̂.
    pub canonical: Vec<Vec3>,
    /// v̂.
    pub closest: Vec<Vec3>,
    /// d.
    pub distance: Vec<f32>,
    /// All levels, finest first; empty where not needed.
    pub neighbours: Vec<u32>,
    /// Initial colour before the sigmoid and, as w, the weight of the perceptron's output; empty
    /// for grey and 1.
    pub base: Vec<Vec4>,
}

impl Samples {
    /// [`Samples::base`] of sample `s`.
    pub fn base(&self, s: usize) -> Vec4 {
        self.base.get(s).copied().unwrap_or(Vec4::W)
    }

    pub fn clear(&mut self) {
        self.starts.clear();
        self.starts.push(0);
        self.t.clear();
        self.delta.clear();
        self.likelihood.clear();
        self.world.clear();
        self.canonical.clear();
        self.closest.clear();
        self.distance.clear();
        self.neighbours.clear();
        self.base.clear();
    }

    pub fn len(&self) -> usize {
        self.t.len()
    }

    /// Appends a point of the canonical space whose surface is known, as of a ray of no length.
    pub fn push_canonical(&mut self, body: &Body, at: Vec3, closest: Vec3, distance: f32, neighbours: bool) {
        if neighbours {
            let first = self.neighbours.len();
            self.neighbours.resize(first + body.query.neighbours_per_query(), 0);
            body.query.neighbours(at, &mut self.neighbours[first..]);
        }
        self.t.push(0.0);
        self.delta.push(0.0);
        self.likelihood.push(1.0);
        self.world.push(at);
        self.canonical.push(at);
        self.closest.push(closest);
        self.distance.push(distance);
    }
}
