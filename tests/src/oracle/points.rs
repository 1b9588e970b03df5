use glam::Vec3;

/// The `k` points nearest to `q` with their distances: nearest first, ties by lower index; all
/// points where there are fewer than `k`. A distance that is NaN sorts last.
#[must_use]
pub fn knn(points: &[Vec3], q: Vec3, k: usize) -> Vec<(u32, f64)> {
    let mut all: Vec<(u32, f64)> =
        points.iter().enumerate().map(|(i, p)| (i as u32, p.as_dvec3().distance(q.as_dvec3()).abs())).collect();
    all.sort_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));
    all.truncate(k);
    all
}

/// Farthest point sampling from point 0: `count` (at most N) distinct indices, each the point
/// farthest from those before it, ties by lower index.
#[must_use]
pub fn farthest_points(points: &[Vec3], count: usize) -> Vec<u32> {
    let mut chosen: Vec<u32> = Vec::new();
    for _ in 0..count.min(points.len()) {
        let mut best: Option<(f64, u32)> = None;
        for i in 0..points.len() as u32 {
            if chosen.contains(&i) {
                continue;
            }
            // An empty set is infinitely far from everything, so the first choice is index 0.
            let gap = chosen
                .iter()
                .map(|&c| points[c as usize].as_dvec3().distance_squared(points[i as usize].as_dvec3()))
                .fold(f64::INFINITY, f64::min);
            if best.is_none_or(|(farthest, _)| gap > farthest) {
                best = Some((gap, i));
            }
        }
        chosen.extend(best.map(|(_, i)| i));
    }
    chosen
}
