/// The pixels of a square of side `size` around the pixel (column, row) `around`, moved and cut as
/// much as it takes to be inside an image of (W, H), of at most 2^32 pixels: row-major indices into
/// (H, W), row by row. What the square is around may be outside.
///
/// ```
/// let corner = volrender::patch((0, 1), 2, (4, 3));
/// assert_eq!(corner.collect::<Vec<_>>(), [0, 1, 4, 5]);
/// ```
pub fn patch(around: (u32, u32), size: u32, (width, height): (u32, u32)) -> impl Iterator<Item = u32> {
    let size = size.min(width).min(height);
    let left = around.0.saturating_sub(size / 2).min(width - size);
    let top = around.1.saturating_sub(size / 2).min(height - size);
    (top..top + size).flat_map(move |row| (left..left + size).map(move |column| row * width + column))
}

/// Writes the n + 1 edges of `n` equal bins between `near` and `far` into `edges`. The first is
/// `near` and the last `far`, exactly; with `n` 0 there is one edge, `near`.
///
/// # Panics
/// Where `edges` does not have n + 1 places.
pub fn bin_edges(near: f32, far: f32, n: usize, edges: &mut [f32]) {
    assert_eq!(edges.len(), n + 1, "{} edges for {n} bins, expected {}", edges.len(), n + 1);
    edges[0] = near;
    for i in 1..n {
        edges[i] = near + (far - near) * (i as f32 / n as f32);
    }
    if n > 0 {
        edges[n] = far;
    }
}

/// Writes the middle of each bin into `t` (S), for `edges` (S + 1).
///
/// # Panics
/// Where the lengths do not fit.
pub fn bin_midpoints(edges: &[f32], t: &mut [f32]) {
    assert_bins(edges, t);
    for (t, bin) in t.iter_mut().zip(edges.windows(2)) {
        *t = 0.5 * bin[0] + 0.5 * bin[1];
    }
}

/// Writes the width δ of each bin into `delta` (S), for `edges` (S + 1).
///
/// # Panics
/// Where the lengths do not fit.
pub fn bin_widths(edges: &[f32], delta: &mut [f32]) {
    assert_bins(edges, delta);
    for (delta, bin) in delta.iter_mut().zip(edges.windows(2)) {
        *delta = bin[1] - bin[0];
    }
}

/// Writes one sample of each bin into `t` (S), for ascending `edges` (S + 1): stratified sampling.
///
/// `jitter` is called once a bin, in order, for a number in [0, 1) that says where in the bin;
/// values outside are clamped and NaN is 0, so that a sample never leaves its bin.
///
/// # Panics
/// Where the lengths do not fit.
pub fn sample(edges: &[f32], mut jitter: impl FnMut() -> f32, t: &mut [f32]) {
    assert_bins(edges, t);
    for (t, bin) in t.iter_mut().zip(edges.windows(2)) {
        let place = jitter();
        let place = if place > 0.0 { place.min(1.0) } else { 0.0 };
        *t = (bin[0] + (bin[1] - bin[0]) * place).min(bin[1]);
    }
}

fn assert_bins(edges: &[f32], values: &[f32]) {
    assert_eq!(edges.len(), values.len() + 1, "{} edges for {} bins", edges.len(), values.len());
}
