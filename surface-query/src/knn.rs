//! Exact k nearest points of one level, by squared `f32` distance, ties by lower index.

use std::num::NonZero;

use glam::Vec3;
use kiddo::{ImmutableKdTree, SquaredEuclidean};

use crate::Error;

/// Largest supported k.
pub(crate) const MAX_K: usize = 1 << 16;

/// Largest k whose list is kept on the stack.
const SMALL_K: usize = 64;

/// Squared distance of a query to a point. Every ranking uses this expression, so that grid, tree
/// and brute force agree to the last bit.
#[inline(always)]
pub(crate) fn distance_squared(p: Vec3, q: Vec3) -> f32 {
    let d = q - p;
    d.x * d.x + d.y * d.y + d.z * d.z
}

/// Orders by distance, then by index: the bits of a non-negative float are ordered like the float.
#[inline(always)]
fn key(d: f32, local: u32) -> u64 {
    u64::from(d.to_bits()) << 32 | u64::from(local)
}

/// One level of the pyramid.
pub(crate) struct Level {
    /// Original indices, ascending, so that local order is original order.
    pub ids: Vec<u32>,
    pub points: Vec<Vec3>,
    tree: ImmutableKdTree<f32, 3>,
}

impl Level {
    pub fn new(vertices: &[Vec3], ids: &[u32]) -> Result<Self, Error> {
        let mut ids = ids.to_vec();
        ids.sort_unstable();
        let points: Vec<Vec3> = ids.iter().map(|&i| vertices[i as usize]).collect();
        let coordinates: Vec<[f32; 3]> = points.iter().map(|p| p.to_array()).collect();
        let tree = ImmutableKdTree::new_from_slice(&coordinates)
            .map_err(|error| Error(format!("nearest-neighbour tree: {error}")))?;
        Ok(Self { ids, points, tree })
    }

    /// Upper bound of the distance from `centre` to the k-th nearest point; infinite for fewer than
    /// k points or on overflow.
    pub fn kth_distance(&self, centre: Vec3, k: usize) -> f32 {
        let Some(k_nonzero) = NonZero::new(k) else { return 0.0 };
        let found = self.tree.query(&centre.to_array()).nearest_n::<SquaredEuclidean<f32>>(k_nonzero).execute();
        if found.len() < k {
            return f32::INFINITY;
        }
        let squared = found.iter().fold(0.0, |m: f32, item| m.max(item.distance));
        // Covers another order of summation in the tree, and underflow.
        (squared * (1.0 + SLACK) + f32::MIN_POSITIVE).sqrt() * (1.0 + SLACK)
    }

    /// Local indices of at least all points within `radius` of `centre`.
    pub fn within(&self, centre: Vec3, radius: f32) -> Vec<u32> {
        let squared = radius * radius * (1.0 + SLACK) + f32::MIN_POSITIVE;
        if !squared.is_finite() {
            return (0..self.points.len() as u32).collect();
        }
        let found = self.tree.query(&centre.to_array()).within::<SquaredEuclidean<f32>>(squared).unsorted().execute();
        found.into_iter().map(|item| item.item).collect()
    }

    /// Writes the original indices of the k nearest points into `out` (k), by way of the tree.
    pub fn nearest(&self, q: Vec3, out: &mut [u32]) {
        let wanted = out.len().min(self.points.len());
        if !q.is_finite() {
            // All distances are taken as infinite.
            self.write(out, |j| j as u64, wanted);
            return;
        }
        let radius = self.kth_distance(q, wanted);
        let near =
            if radius < f32::INFINITY { self.within(q, radius) } else { (0..self.points.len() as u32).collect() };
        self.nearest_of(&near, q, out);
    }

    /// Writes the original indices of the k nearest of the candidates `list` into `out` (k).
    #[inline(always)]
    pub fn nearest_of(&self, list: &[u32], q: Vec3, out: &mut [u32]) {
        // Buffers of common sizes stay in registers.
        match out.len() {
            1 => self.select::<1>(list, q, out),
            3 => self.select::<3>(list, q, out),
            4 => self.select::<4>(list, q, out),
            5 => self.select::<5>(list, q, out),
            8 => self.select::<8>(list, q, out),
            k if k <= SMALL_K => {
                let mut best = [u64::MAX; SMALL_K];
                collect(&self.points, list, q, &mut best[..k]);
                self.write(out, |j| best[j], list.len().min(k));
            }
            k => {
                let key_of = |local: u32| key(distance_squared(self.points[local as usize], q), local);
                let mut keys: Vec<u64> = list.iter().map(|&local| key_of(local)).collect();
                if k < keys.len() {
                    keys.select_nth_unstable(k);
                }
                keys.truncate(k);
                keys.sort_unstable();
                self.write(out, |j| keys[j], keys.len());
            }
        }
    }

    #[inline(always)]
    fn select<const K: usize>(&self, list: &[u32], q: Vec3, out: &mut [u32]) {
        let mut best = [u64::MAX; K];
        collect(&self.points, list, q, &mut best);
        self.write(out, |j| best[j], list.len().min(K));
    }

    /// Original indices of the first `found` keys, repeated cyclically to the end of `out`.
    #[inline(always)]
    fn write(&self, out: &mut [u32], key_at: impl Fn(usize) -> u64, found: usize) {
        for j in 0..found {
            out[j] = self.ids[key_at(j) as u32 as usize];
        }
        for j in found..out.len() {
            out[j] = out[j - found];
        }
    }
}

/// Relative allowance for the rounding of the tree's incremental box distances: a few ulp per level
/// of the tree.
const SLACK: f32 = 1e-4;

/// Sorts the smallest keys of the list into `best`.
#[inline(always)]
fn collect(points: &[Vec3], list: &[u32], q: Vec3, best: &mut [u64]) {
    let last = best.len() - 1;
    for &local in list {
        let mut key = key(distance_squared(points[local as usize], q), local);
        if key < best[last] {
            for slot in best.iter_mut() {
                let (low, high) = ((*slot).min(key), (*slot).max(key));
                *slot = low;
                key = high;
            }
        }
    }
}
