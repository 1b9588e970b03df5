/// Row-major pixel indices of a square patch of side `size` around pixel (column, row) `around`,
/// shifted, and cropped if necessary, to lie inside an image of (W, H), at most 2^32 pixels.
/// `around` may lie outside.
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

/// Equal bins along a ray for stratified sampling, one sample per bin.
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
    /// `n` bins between the depths 0 ≤ `near` ≤ `far`; of width 0 if `n` is 0.
    pub fn new(near: f32, far: f32, n: usize) -> Self {
        Self { near, width: if n == 0 { 0.0 } else { (far - near) / n as f32 } }
    }

    /// Width δ of a bin.
    pub fn width(&self) -> f32 {
        self.width
    }

    /// Depth in bin `i` at `offset`, from 0 at its near end to 1 at its far end.
    pub fn at(&self, i: usize, offset: f32) -> f32 {
        self.near + (i as f32 + offset) * self.width
    }
}
