use glam::{DVec3, Vec3};

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
/// nearly so. Points that are not finite are chosen last, in the order of their indices. Takes a
/// nanosecond for each pair of a point and a sample.
#[must_use]
pub fn farthest_points(points: &[Vec3], count: usize) -> Vec<u32> {
    let count = count.min(points.len());
    let (finite, others): (Vec<u32>, Vec<u32>) =
        (0..points.len() as u32).partition(|&i| points[i as usize].is_finite());
    let positions: Vec<DVec3> = finite.iter().map(|&i| points[i as usize].as_dvec3()).collect();
    // Squared distances to the nearest chosen point; −1 once chosen itself.
    let mut gaps = vec![f64::INFINITY; positions.len()];
    let mut chosen = Vec::with_capacity(count);
    let mut next = 0;
    while chosen.len() < count.min(positions.len()) {
        chosen.push(finite[next]);
        gaps[next] = -1.0;
        let (sample, mut farthest) = (positions[next], -1.0);
        for (i, (gap, position)) in gaps.iter_mut().zip(&positions).enumerate() {
            *gap = gap.min(position.distance_squared(sample));
            if *gap > farthest {
                (farthest, next) = (*gap, i);
            }
        }
    }
    chosen.extend(others.into_iter().take(count - chosen.len()));
    chosen
}
