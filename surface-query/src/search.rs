//! State of a closest-point search during the traversal of the tree.

use crate::tree::LANES;

/// Capacity for faces to compare in `f64`. Six meet at a usual vertex; where the capacity is
/// exceeded the whole search is repeated in `f64`.
const MAX_CANDIDATES: usize = 32;

/// Candidates for the nearest face, given that `f32` distances are off by up to `error`.
pub(crate) struct Search {
    error: f32,
    /// Smallest squared distance so far.
    best: f32,
    /// Squared distance up to which a face may still be the nearest.
    pub bound: f32,
    candidates: [(f32, u32); MAX_CANDIDATES],
    count: usize,
    /// Set when the candidates exceed the capacity.
    pub overflowed: bool,
}

impl Search {
    /// A search for faces within about `reach`.
    #[inline(always)]
    pub fn new(reach: f32, error: f32) -> Self {
        Self {
            error,
            best: f32::INFINITY,
            bound: allow(reach, error),
            candidates: [(0.0, 0); MAX_CANDIDATES],
            count: 0,
            overflowed: false,
        }
    }

    /// Adds the faces of a leaf by squared distance; NaN distances are ignored.
    #[inline(always)]
    pub fn visit(&mut self, leaf: u32, squared: [f32; LANES]) {
        for (lane, d) in squared.into_iter().enumerate() {
            if d <= self.bound {
                self.keep(d, leaf * LANES as u32 + lane as u32);
            }
        }
    }

    #[inline(always)]
    fn keep(&mut self, d: f32, slot: u32) {
        if d < self.best {
            self.best = d;
            self.bound = self.bound.min(allow(d.sqrt(), self.error));
        }
        if self.count == MAX_CANDIDATES {
            self.sift();
        }
        if let Some(free) = self.candidates.get_mut(self.count) {
            *free = (d, slot);
            self.count += 1;
        } else {
            self.overflowed = true;
        }
    }

    /// Drops the candidates beyond the current bound.
    #[cold]
    fn sift(&mut self) {
        let mut kept = 0;
        for i in 0..self.count {
            if self.candidates[i].0 <= self.bound {
                self.candidates[kept] = self.candidates[i];
                kept += 1;
            }
        }
        self.count = kept;
    }

    /// Leaf and lane of the candidates within the bound.
    pub fn candidates(&self) -> impl Iterator<Item = (usize, usize)> + '_ {
        (self.candidates[..self.count].iter())
            .filter(|(d, _)| *d <= self.bound)
            .map(|&(_, slot)| (slot as usize / LANES, slot as usize % LANES))
    }
}

/// Square of a distance plus the error.
#[inline(always)]
fn allow(distance: f32, error: f32) -> f32 {
    let with_error = (distance + error) * (1.0 + 1e-6);
    with_error * with_error + f32::MIN_POSITIVE
}
