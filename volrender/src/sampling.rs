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

/// Equal bins along a ray, each with one sample: stratified sampling.
///
/// ```
/// let bins = volrender::Bins::new(1.0, 3.0, 4);
/// assert_eq!((bins.width(), bins.at(0, 0.5), bins.at(3, 0.0)), (0.5, 1.25, 2.5));
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bins {
    near: f32,
    width: f32,
}

impl Bins {
    /// `n` bins between the depths `near` and `far`. Without any, the width is 0.
    #[must_use]
    pub fn new(near: f32, far: f32, n: usize) -> Self {
        Self { near, width: if n == 0 { 0.0 } else { (far - near) / n as f32 } }
    }

    /// The width δ of each.
    #[must_use]
    pub fn width(&self) -> f32 {
        self.width
    }

    /// The depth in bin `i` at `place`, from 0 at its near end to 1 at its far end.
    #[must_use]
    pub fn at(&self, i: usize, place: f32) -> f32 {
        self.near + (i as f32 + place) * self.width
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

fn assert_bins(edges: &[f32], values: &[f32]) {
    assert_eq!(edges.len(), values.len() + 1, "{} edges for {} bins", edges.len(), values.len());
}
