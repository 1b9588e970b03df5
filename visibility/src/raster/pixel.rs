//! What a pixel sees.

/// The part of a face that a sample sees in one layer.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fragment {
    /// The face, counted through all layers.
    pub face: u32,
    /// Third camera coordinate, where the last row of the intrinsics is (0, 0, 1).
    pub depth: f32,
    /// Perspective-correct weights of the corners: non-negative, sum 1.
    pub barycentric: [f32; 3],
}

/// A pixel and the fragments that its samples see.
#[derive(Clone, Copy, Debug)]
pub struct Pixel<'a> {
    /// Row-major index of the pixel.
    pub index: usize,
    pub(super) fragments: &'a [Fragment],
    /// Fragments of every sample; empty where none sees anything.
    pub(super) counts: &'a [usize],
    pub(super) layers: usize,
}

impl Pixel<'_> {
    /// The fragments of every sample, nearest first: at most one fragment a layer. No sample at all
    /// where the whole pixel sees nothing.
    #[inline]
    pub fn samples(&self) -> impl ExactSizeIterator<Item = &[Fragment]> {
        self.counts.iter().zip(self.fragments.chunks_exact(self.layers.max(1))).map(|(&n, sample)| &sample[..n])
    }
}
