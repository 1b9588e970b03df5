//! Plain, obviously right answers in `f64`, to compare fast code with.

use glam::{DVec3, Vec3};

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

fn corners(vertices: &[Vec3], face: &[u32; 3]) -> [DVec3; 3] {
    face.map(|i| vertices[i as usize].as_dvec3())
}

/// Closest point of segment `a`–`b` to `q`; a point segment gives `a`.
fn closest_on_segment(a: DVec3, b: DVec3, q: DVec3) -> DVec3 {
    let along = b - a;
    let length_squared = along.length_squared();
    if length_squared == 0.0 {
        return a;
    }
    a + along * ((q - a).dot(along) / length_squared).clamp(0.0, 1.0)
}

/// Closest point of a triangle: the foot of the perpendicular if it falls inside, else the best of
/// the edges.
fn closest_on_triangle([a, b, c]: [DVec3; 3], q: DVec3) -> DVec3 {
    let normal = (b - a).cross(c - a);
    if let Some(n) = normal.try_normalize() {
        let foot = q - n * (q - a).dot(n);
        let inward = |from: DVec3, to: DVec3| (to - from).cross(foot - from).dot(n) >= 0.0;
        if inward(a, b) && inward(b, c) && inward(c, a) {
            return foot;
        }
    }
    let mut best = closest_on_segment(a, b, q);
    for other in [closest_on_segment(b, c, q), closest_on_segment(c, a, q)] {
        if other.distance_squared(q) < best.distance_squared(q) {
            best = other;
        }
    }
    best
}

/// Face, point and unsigned distance of the point of the mesh closest to `q`; ties by lower face.
///
/// # Panics
/// On a mesh without faces.
#[must_use]
pub fn closest_point(vertices: &[Vec3], faces: &[[u32; 3]], q: Vec3) -> (u32, DVec3, f64) {
    let q = q.as_dvec3();
    let mut best: Option<(u32, DVec3, f64)> = None;
    for (i, face) in faces.iter().enumerate() {
        let point = closest_on_triangle(corners(vertices, face), q);
        let distance = point.distance(q);
        if best.is_none_or(|(_, _, nearest)| distance < nearest) {
            best = Some((i as u32, point, distance));
        }
    }
    best.unwrap_or_else(|| panic!("closest_point: a mesh without faces"))
}

/// First face met by the ray `o + t d`, t ≥ 0, from either side, and its `t` (in units of `d`);
/// ties by lower face. Rays in a triangle's plane miss it.
#[must_use]
pub fn first_hit(vertices: &[Vec3], faces: &[[u32; 3]], o: Vec3, d: Vec3) -> Option<(u32, f64)> {
    let (o, d) = (o.as_dvec3(), d.as_dvec3());
    let mut first: Option<(u32, f64)> = None;
    for (i, face) in faces.iter().enumerate() {
        let [a, b, c] = corners(vertices, face);
        let normal = (b - a).cross(c - a);
        let slope = normal.dot(d);
        if slope == 0.0 {
            continue;
        }
        let t = normal.dot(a - o) / slope;
        let p = o + d * t;
        let side = |from: DVec3, to: DVec3| (to - from).cross(p - from).dot(normal) >= 0.0;
        let hit = t >= 0.0 && side(a, b) && side(b, c) && side(c, a);
        if hit && first.is_none_or(|(_, nearest)| t < nearest) {
            first = Some((i as u32, t));
        }
    }
    first
}

/// Generalised winding number of the mesh about `q`: the sum of its faces' signed solid angles over
/// 4π (van Oosterom and Strackee 1983). 1 inside a closed mesh wound outward, 0 outside, 0.5 on a
/// smooth surface.
#[must_use]
pub fn winding_number(vertices: &[Vec3], faces: &[[u32; 3]], q: Vec3) -> f64 {
    let q = q.as_dvec3();
    let solid_angle = |face: &[u32; 3]| {
        let [a, b, c] = corners(vertices, face).map(|v| v - q);
        let (la, lb, lc) = (a.length(), b.length(), c.length());
        let numerator = a.dot(b.cross(c));
        let denominator = la * lb * lc + a.dot(b) * lc + b.dot(c) * la + c.dot(a) * lb;
        2.0 * numerator.atan2(denominator)
    };
    faces.iter().map(solid_angle).sum::<f64>() / (4.0 * std::f64::consts::PI)
}

/// Whether `q` is inside a closed mesh: winding number above ½.
#[must_use]
pub fn inside(vertices: &[Vec3], faces: &[[u32; 3]], q: Vec3) -> bool {
    winding_number(vertices, faces, q) > 0.5
}

const PRIMES: [u32; 4] = [1, 2_654_435_761, 805_459_861, 3_674_653_429];

/// Row of a level's table that holds grid corner `corner` (D), for a level of `resolution` cells an
/// axis.
///
/// Dense, Σ c_j (N+1)^j, where the level's (N+1)^D corners fit 2^T rows; else the XOR of c_j · π_j
/// in wrapping u32, modulo 2^T (Müller et al. 2022, eq. 4).
///
/// # Panics
/// For more than 4 dimensions.
#[must_use]
pub fn hash_index(corner: &[u32], resolution: u32, log2_table_size: u32) -> usize {
    assert!(corner.len() <= PRIMES.len(), "hash_index: {} dimensions, at most {}", corner.len(), PRIMES.len());
    let side = u128::from(resolution) + 1;
    let rows = 1u128 << log2_table_size;
    if side.pow(corner.len() as u32) <= rows {
        let mut index = 0;
        for &c in corner.iter().rev() {
            index = index * side + u128::from(c);
        }
        return index as usize;
    }
    let mut hash = 0u32;
    for (c, prime) in corner.iter().zip(PRIMES) {
        hash ^= c.wrapping_mul(prime);
    }
    (u128::from(hash) % rows) as usize
}

/// Multiresolution hash encoding: `points` (Q × `dims`, from 0 to 1; clamped, NaN as 0), `table`
/// (L, 2^T, F) padded, one entry of `resolutions` a level; returns (Q, L·F), level by level.
///
/// # Panics
/// Where lengths do not fit each other.
#[must_use]
pub fn hash_encode(
    points: &[f64],
    dims: usize,
    resolutions: &[u32],
    table: &[f32],
    log2_table_size: u32,
    features: usize,
) -> Vec<f64> {
    let rows = 1usize << log2_table_size;
    assert_eq!(table.len(), resolutions.len() * rows * features, "hash_encode: table is not (L, 2^T, F)");
    assert_eq!(points.len() % dims, 0, "hash_encode: points are not (Q, {dims})");
    let mut encoded = Vec::new();
    for point in points.chunks(dims) {
        for (level, &resolution) in resolutions.iter().enumerate() {
            let mut cell = vec![0u32; dims];
            let mut fraction = vec![0.0f64; dims];
            for j in 0..dims {
                let x = if point[j].is_nan() { 0.0 } else { point[j].clamp(0.0, 1.0) };
                let p = x * f64::from(resolution);
                cell[j] = (p.floor() as u32).min(resolution - 1);
                fraction[j] = p - f64::from(cell[j]);
            }
            let mut sum = vec![0.0f64; features];
            for mask in 0..1usize << dims {
                let mut weight = 1.0;
                let mut corner = cell.clone();
                for j in 0..dims {
                    if mask >> j & 1 == 1 {
                        corner[j] += 1;
                        weight *= fraction[j];
                    } else {
                        weight *= 1.0 - fraction[j];
                    }
                }
                let row = level * rows + hash_index(&corner, resolution, log2_table_size);
                for f in 0..features {
                    sum[f] += weight * f64::from(table[row * features + f]);
                }
            }
            encoded.extend(sum);
        }
    }
    encoded
}

/// Alpha compositing of one ray, α_i = f_i (1 − exp(−σ_i δ_i)): colour over `background`, opacity,
/// weights (S) and the lowest index of the largest α (`None` for no samples or all-zero α). All
/// inputs are (S).
///
/// # Panics
/// Where the slices differ in length.
#[must_use]
pub fn composite(
    sigma: &[f32],
    likelihood: &[f32],
    delta: &[f32],
    rgb: &[Vec3],
    background: Vec3,
) -> (DVec3, f64, Vec<f64>, Option<u32>) {
    let n = sigma.len();
    assert!(
        likelihood.len() == n && delta.len() == n && rgb.len() == n,
        "composite: {n} σ, {} f, {} δ, {} colours",
        likelihood.len(),
        delta.len(),
        rgb.len()
    );
    let mut color = DVec3::ZERO;
    let mut weights = Vec::new();
    let mut largest = 0.0;
    let mut termination = None;
    let mut transmittance = 1.0;
    for i in 0..n {
        let optical_depth = f64::from(sigma[i]) * f64::from(delta[i]);
        let alpha = f64::from(likelihood[i]) * -(-optical_depth).exp_m1();
        if alpha > largest {
            largest = alpha;
            termination = Some(i as u32);
        }
        weights.push(transmittance * alpha);
        color += rgb[i].as_dvec3() * transmittance * alpha;
        transmittance *= 1.0 - alpha;
    }
    let opacity: f64 = weights.iter().sum();
    (color + background.as_dvec3() * (1.0 - opacity), opacity, weights, termination)
}

/// Peak signal-to-noise ratio in dB of values from 0 to 1, over all of them; infinite for equal
/// inputs.
///
/// # Panics
/// Where lengths differ.
#[must_use]
pub fn psnr(a: &[f32], b: &[f32]) -> f64 {
    assert_eq!(a.len(), b.len(), "psnr: different lengths");
    let squared: f64 = a.iter().zip(b).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum();
    -10.0 * (squared / a.len() as f64).log10()
}

const WINDOW: isize = 7;

/// SSIM of every pixel, channels averaged: `a`, `b` (H, W, 3) from 0 to 1, result (H, W). 7×7
/// uniform window, sample covariance, K1 0.01, K2 0.03, data range 1; beyond the border the image
/// is mirrored with the edge sample repeated (Wang et al. 2004, as
/// `skimage.metrics.structural_similarity` computes its full map).
///
/// # Panics
/// Where lengths are not 3·W·H.
#[must_use]
pub fn ssim_map(a: &[f32], b: &[f32], width: usize, height: usize) -> Vec<f64> {
    for image in [a, b] {
        assert_eq!(image.len(), width * height * 3, "ssim: not (H, W, 3)");
    }
    let mirrored = |i: isize, n: usize| {
        let period = 2 * n as isize;
        let i = i.rem_euclid(period);
        (if i < n as isize { i } else { period - 1 - i }) as usize
    };
    let n = (WINDOW * WINDOW) as f64;
    let (c1, c2) = (0.01f64.powi(2), 0.03f64.powi(2));
    let mut map = vec![0.0; width * height];
    for y in 0..height {
        for x in 0..width {
            for channel in 0..3 {
                let mut pairs = Vec::new();
                for dy in -WINDOW / 2..=WINDOW / 2 {
                    for dx in -WINDOW / 2..=WINDOW / 2 {
                        let row = mirrored(y as isize + dy, height);
                        let column = mirrored(x as isize + dx, width);
                        let i = (row * width + column) * 3 + channel;
                        pairs.push((f64::from(a[i]), f64::from(b[i])));
                    }
                }
                let mean_a = pairs.iter().map(|p| p.0).sum::<f64>() / n;
                let mean_b = pairs.iter().map(|p| p.1).sum::<f64>() / n;
                let (mut aa, mut bb, mut ab) = (0.0, 0.0, 0.0);
                for (pa, pb) in pairs {
                    aa += (pa - mean_a) * (pa - mean_a) / (n - 1.0);
                    bb += (pb - mean_b) * (pb - mean_b) / (n - 1.0);
                    ab += (pa - mean_a) * (pb - mean_b) / (n - 1.0);
                }
                let luminance = (2.0 * mean_a * mean_b + c1) / (mean_a.powi(2) + mean_b.powi(2) + c1);
                let structure = (2.0 * ab + c2) / (aa + bb + c2);
                map[y * width + x] += luminance * structure / 3.0;
            }
        }
    }
    map
}

/// Mean of [`ssim_map`] over the pixels whose window lies within the image.
///
/// # Panics
/// Where an image is smaller than the window, or lengths are not 3·W·H.
#[must_use]
pub fn ssim(a: &[f32], b: &[f32], width: usize, height: usize) -> f64 {
    let border = WINDOW as usize / 2;
    assert!(width.min(height) > 2 * border, "ssim: {width}×{height} is smaller than the 7×7 window");
    let map = ssim_map(a, b, width, height);
    let mut sum = 0.0;
    for y in border..height - border {
        for x in border..width - border {
            sum += map[y * width + x];
        }
    }
    sum / ((width - 2 * border) * (height - 2 * border)) as f64
}

/// Intersection over union of a mask, at 0.5, and of the pixels whose centres are `covered`, over
/// the pixels outside `ignored`.
pub fn mask_iou(mask: &[f32], ignored: Option<&[bool]>, width: usize, covered: impl Fn(f32, f32) -> bool) -> f32 {
    let (mut both, mut either) = (0, 0);
    for (i, &coverage) in mask.iter().enumerate().filter(|(i, _)| !ignored.is_some_and(|ignored| ignored[*i])) {
        let (covered, subject) = (covered((i % width) as f32 + 0.5, (i / width) as f32 + 0.5), coverage > 0.5);
        both += usize::from(covered && subject);
        either += usize::from(covered || subject);
    }
    both as f32 / either.max(1) as f32
}
