use glam::{DVec3, Vec3};

/// Points of one leaf of the sampling tree. Smaller leaves skip more distances but cost more box tests.
const BUCKET: usize = 32;

/// Nested subsets of a point set: level 0 holds every point, each further level a farthest point sampling of
/// the level above it.
#[derive(Clone, Debug, PartialEq)]
pub struct Pyramid {
    /// `levels[0]` is 0, 1, …, N−1; further levels are in the order of sampling and hold indices into the
    /// original points. Each level is a prefix of the one above it from level 1 on: farthest point sampling
    /// is greedy, so sampling a sampled set again repeats its beginning.
    pub levels: Vec<Vec<u32>>,
}

impl Pyramid {
    /// Samples `levels` levels beyond the finest. Level l+1 holds ⌊`ratio` · size of level l⌋ points, at least
    /// one while there are any; the first is index 0. 6890 points at ratio 0.25: 6890, 1722, 430, 107.
    ///
    /// A `ratio` outside (0, 1] is clamped into it; NaN counts as 1.
    #[must_use]
    pub fn new(points: &[Vec3], ratio: f32, levels: usize) -> Self {
        let ratio = if ratio.is_nan() { 1.0 } else { ratio.clamp(0.0, 1.0) };
        // The factor undoes the rounding of a decimal ratio to f32: 10 · 0.7f32 is 6.9999998 in f64.
        let smaller = |n: usize| ((n as f64 * f64::from(ratio) * (1.0 + 1e-7)) as usize).max(1);
        let n = points.len();
        let mut pyramid = vec![(0..n as u32).collect::<Vec<u32>>()];
        if levels > 0 {
            let mut size = smaller(n).min(n);
            let sampled = farthest_points(points, size);
            for _ in 0..levels {
                pyramid.push(sampled[..size].to_vec());
                size = smaller(size).min(size);
            }
        }
        Self { levels: pyramid }
    }
}

/// Exact farthest point sampling (Gonzalez 1985): `count` distinct indices, first index 0, then again and again
/// the point whose distance to the nearest chosen point is largest; ties go to the lower index. At most N are
/// returned.
///
/// Distances are compared in `f64`, in which the squared distance of two `f32` points is exact or nearly so.
/// Points that are not finite are chosen last, in the order of their indices.
///
/// The work is that of a bucket k-d tree (Han et al., *QuickFPS*, 2023): a bucket whose box is farther from the
/// new sample than any of its points is from the chosen ones is skipped.
#[must_use]
pub fn farthest_points(points: &[Vec3], count: usize) -> Vec<u32> {
    let count = count.min(points.len());
    let mut chosen = Vec::with_capacity(count);
    if count == 0 {
        return chosen;
    }
    let mut finite: Vec<u32> = Vec::with_capacity(points.len());
    let mut others: Vec<u32> = Vec::new();
    for (i, p) in (0u32..).zip(points) {
        if p.is_finite() {
            finite.push(i);
        } else {
            others.push(i);
        }
    }
    let mut buckets = Vec::with_capacity(finite.len() / (BUCKET / 2) + 1);
    split(points, &mut finite, &mut buckets);

    let mut next = buckets.iter().enumerate().flat_map(|(b, bucket)| bucket.ids.iter().map(move |&i| (i, b))).min();
    while let Some((index, bucket)) = next {
        chosen.push(index);
        buckets[bucket].take(index);
        if chosen.len() == count {
            return chosen;
        }
        let sample = points[index as usize].as_dvec3();
        next = None;
        let mut best = (-1.0, u32::MAX);
        for (b, bucket) in buckets.iter_mut().enumerate() {
            if bucket.distance_squared(sample) < bucket.gap {
                bucket.update(sample);
            }
            if bucket.gap > best.0 || bucket.gap == best.0 && bucket.farthest < best.1 {
                best = (bucket.gap, bucket.farthest);
                next = (bucket.gap >= 0.0).then_some((bucket.farthest, b));
            }
        }
    }
    chosen.extend(others.into_iter().take(count - chosen.len()));
    chosen
}

/// A few neighbouring points and how far each is from the chosen ones.
struct Bucket {
    min: DVec3,
    max: DVec3,
    /// Ascending.
    ids: Vec<u32>,
    x: Vec<f64>,
    y: Vec<f64>,
    z: Vec<f64>,
    /// Squared distance to the nearest chosen point; −1 once chosen itself.
    gaps: Vec<f64>,
    /// Largest of `gaps`, and the lowest id that has it.
    gap: f64,
    farthest: u32,
}

impl Bucket {
    fn new(points: &[Vec3], ids: &mut [u32]) -> Self {
        ids.sort_unstable();
        let at = || ids.iter().map(|&i| points[i as usize].as_dvec3());
        Self {
            min: at().fold(DVec3::INFINITY, DVec3::min),
            max: at().fold(DVec3::NEG_INFINITY, DVec3::max),
            ids: ids.to_vec(),
            x: at().map(|p| p.x).collect(),
            y: at().map(|p| p.y).collect(),
            z: at().map(|p| p.z).collect(),
            gaps: vec![f64::INFINITY; ids.len()],
            gap: f64::INFINITY,
            farthest: ids.first().copied().unwrap_or(u32::MAX),
        }
    }

    /// Squared distance to the box. Rounding is monotone and the terms are summed in the same order as in
    /// [`Bucket::update`], so this is never above the computed distance of any point in the box.
    #[inline]
    fn distance_squared(&self, p: DVec3) -> f64 {
        let d = p - p.clamp(self.min, self.max);
        d.x * d.x + d.y * d.y + d.z * d.z
    }

    fn take(&mut self, index: u32) {
        if let Ok(at) = self.ids.binary_search(&index) {
            self.gaps[at] = -1.0;
        }
        self.refresh();
    }

    fn update(&mut self, s: DVec3) {
        for (((gap, x), y), z) in self.gaps.iter_mut().zip(&self.x).zip(&self.y).zip(&self.z) {
            let (dx, dy, dz) = (s.x - x, s.y - y, s.z - z);
            let d = dx * dx + dy * dy + dz * dz;
            *gap = if d < *gap { d } else { *gap };
        }
        self.refresh();
    }

    fn refresh(&mut self) {
        let gap = self.gaps.iter().fold(-1.0, |m: f64, &g| if g > m { g } else { m });
        let at = self.gaps.iter().position(|&g| g == gap).unwrap_or(0);
        self.gap = gap;
        self.farthest = self.ids[at];
    }
}

/// Halves `ids` at the median of the widest axis until they fit a bucket.
fn split(points: &[Vec3], ids: &mut [u32], buckets: &mut Vec<Bucket>) {
    if ids.is_empty() {
        return;
    }
    if ids.len() <= BUCKET {
        buckets.push(Bucket::new(points, ids));
        return;
    }
    let at = |i: u32| points[i as usize];
    let (min, max) = ids.iter().fold((Vec3::MAX, Vec3::MIN), |(min, max), &i| (min.min(at(i)), max.max(at(i))));
    let axis = (max.as_dvec3() - min.as_dvec3()).max_position();
    let middle = ids.len() / 2;
    ids.select_nth_unstable_by(middle, |&a, &b| at(a)[axis].total_cmp(&at(b)[axis]));
    let (low, high) = ids.split_at_mut(middle);
    split(points, low, buckets);
    split(points, high, buckets);
}
