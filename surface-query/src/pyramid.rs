use glam::{DVec3, Vec3};

/// Points of a leaf of the sampling tree: smaller leaves skip more distances but cost more box
/// tests.
const BUCKET: usize = 32;

/// Nested subsets of a point set: level 0 holds every point, each further level a farthest point
/// sampling of the level above it.
///
/// ```
/// use glam::Vec3;
/// use surface_query::Pyramid;
///
/// let points: Vec<Vec3> = (0..8).map(|i| Vec3::X * i as f32).collect();
/// let pyramid = Pyramid::new(&points, 0.5, 2);
/// assert_eq!(pyramid.levels[1..], [vec![0, 7, 3, 5], vec![0, 7]]);
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct Pyramid {
    /// Indices into the points: 0, 1, …, N−1 at level 0, in the order of sampling at further
    /// levels. From level 1 on each level is a prefix of the one above it, since the sampling is
    /// greedy.
    pub levels: Vec<Vec<u32>>,
}

impl Pyramid {
    /// Samples `levels` levels beyond the finest. Level l+1 holds ⌊`ratio` · size of level l⌋
    /// points, at least one while there are any; the first is index 0. 6890 points at ratio 0.25:
    /// 6890, 1722, 430, 107.
    ///
    /// A `ratio` outside (0, 1] is clamped into it; NaN counts as 1.
    #[must_use]
    pub fn new(points: &[Vec3], ratio: f32, levels: usize) -> Self {
        let ratio = if ratio.is_nan() { 1.0 } else { ratio.clamp(0.0, 1.0) };
        // The factor undoes the rounding of a decimal ratio to f32: 10 · 0.7f32 is 6.9999998 in
        // f64.
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

/// Exact farthest point sampling (Gonzalez 1985): `count` distinct indices, at most N. The first is
/// index 0, each further one the point farthest from all chosen before; ties go to the lower index.
///
/// ```
/// use glam::Vec3;
///
/// let line: Vec<Vec3> = (0..5).map(|i| Vec3::X * i as f32).collect();
/// assert_eq!(surface_query::farthest_points(&line, 3), [0, 4, 2]);
/// ```
///
/// Distances are compared in `f64`, in which the squared distance of two `f32` points is exact or
/// nearly so. Points that are not finite are chosen last, in the order of their indices.
///
/// A k-d tree of buckets (Han et al., *QuickFPS*, 2023) skips the boxes that a new sample cannot
/// change.
#[must_use]
pub fn farthest_points(points: &[Vec3], count: usize) -> Vec<u32> {
    let count = count.min(points.len());
    let (mut finite, others): (Vec<u32>, Vec<u32>) =
        (0..points.len() as u32).partition(|&i| points[i as usize].is_finite());
    let mut chosen = Vec::with_capacity(count);
    if !finite.is_empty() {
        let mut root = Node::new(points, &mut finite);
        while chosen.len() < count && root.gap >= 0.0 {
            let index = root.farthest;
            chosen.push(index);
            root.take_farthest();
            root.update(points[index as usize].as_dvec3());
        }
    }
    chosen.extend(others.into_iter().take(count - chosen.len()));
    chosen
}

/// A subset of the points, its box, and its largest distance to the chosen points.
struct Node {
    min: DVec3,
    max: DVec3,
    /// Largest squared distance of a point to the nearest chosen one, infinite before the first; −1
    /// where all are chosen themselves.
    gap: f64,
    /// Lowest index of a point at that distance.
    farthest: u32,
    content: Content,
}

enum Content {
    Bucket(Bucket),
    Halves(Box<[Node; 2]>),
}

/// Points of a leaf, coordinates by axis.
struct Bucket {
    /// Ascending.
    ids: Vec<u32>,
    x: Vec<f64>,
    y: Vec<f64>,
    z: Vec<f64>,
    /// Squared distance to the nearest chosen point; −1 once chosen itself.
    gaps: Vec<f64>,
}

impl Node {
    /// Halves `ids` (one at least) at the median of the widest axis until they fit a bucket.
    fn new(points: &[Vec3], ids: &mut [u32]) -> Self {
        let at = |i: &u32| points[*i as usize].as_dvec3();
        let min = ids.iter().map(at).fold(DVec3::INFINITY, DVec3::min);
        let max = ids.iter().map(at).fold(DVec3::NEG_INFINITY, DVec3::max);
        let content = if ids.len() <= BUCKET {
            ids.sort_unstable();
            Content::Bucket(Bucket {
                ids: ids.to_vec(),
                x: ids.iter().map(|i| at(i).x).collect(),
                y: ids.iter().map(|i| at(i).y).collect(),
                z: ids.iter().map(|i| at(i).z).collect(),
                gaps: vec![f64::INFINITY; ids.len()],
            })
        } else {
            let axis = (max - min).max_position();
            let middle = ids.len() / 2;
            ids.select_nth_unstable_by(middle, |a, b| at(a)[axis].total_cmp(&at(b)[axis]));
            let (low, high) = ids.split_at_mut(middle);
            Content::Halves(Box::new([Self::new(points, low), Self::new(points, high)]))
        };
        let mut node = Self { min, max, gap: f64::INFINITY, farthest: 0, content };
        node.refresh();
        node
    }

    /// Squared distance to the box. Rounding is monotone and the terms are summed in the same order
    /// as in [`Node::update`], so this is never above the computed distance of any point in the
    /// box.
    #[inline]
    fn distance_squared(&self, p: DVec3) -> f64 {
        let d = p - p.clamp(self.min, self.max);
        d.x * d.x + d.y * d.y + d.z * d.z
    }

    /// Marks the farthest point as chosen.
    fn take_farthest(&mut self) {
        match &mut self.content {
            Content::Bucket(bucket) => {
                if let Ok(at) = bucket.ids.binary_search(&self.farthest) {
                    bucket.gaps[at] = -1.0;
                }
            }
            Content::Halves(halves) => {
                let side = usize::from(halves[0].farthest != self.farthest);
                halves[side].take_farthest();
            }
        }
        self.refresh();
    }

    /// Shortens the distances by a new sample.
    fn update(&mut self, s: DVec3) {
        if self.distance_squared(s) >= self.gap {
            return;
        }
        match &mut self.content {
            Content::Bucket(bucket) => {
                let points = bucket.x.iter().zip(&bucket.y).zip(&bucket.z);
                for (gap, ((x, y), z)) in bucket.gaps.iter_mut().zip(points) {
                    let (dx, dy, dz) = (s.x - x, s.y - y, s.z - z);
                    let d = dx * dx + dy * dy + dz * dz;
                    *gap = if d < *gap { d } else { *gap };
                }
            }
            Content::Halves(halves) => halves.iter_mut().for_each(|half| half.update(s)),
        }
        self.refresh();
    }

    fn refresh(&mut self) {
        match &self.content {
            Content::Bucket(bucket) => {
                self.gap = bucket.gaps.iter().fold(-1.0, |m: f64, &g| if g > m { g } else { m });
                let at = bucket.gaps.iter().position(|&g| g == self.gap).unwrap_or(0);
                self.farthest = bucket.ids[at];
            }
            Content::Halves(halves) => {
                let [a, b] = halves.as_ref();
                let second = b.gap > a.gap || b.gap == a.gap && b.farthest < a.farthest;
                let of = if second { b } else { a };
                (self.gap, self.farthest) = (of.gap, of.farthest);
            }
        }
    }
}
