/// Running counts of how often each vertex of a mesh was seen, and attention weights from them.
///
/// 64-bit integers: exact beyond the 2²⁴ of `f32`, saturating, independent of the order of
/// addition.
///
/// ```
/// use visibility::VisibilityCounts;
///
/// let mut counts = VisibilityCounts::new(3);
/// counts.add_visible(&[true, false, true]);
/// counts.add(&[2, 2]);
/// assert_eq!(counts.counts(), [1, 0, 3]);
/// let mut attention = [0.0; 2];
/// counts.attention(&[1, 2], &mut attention);
/// assert_eq!(attention, [0.2, 0.8]);
/// ```
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct VisibilityCounts {
    counts: Vec<u64>,
}

impl VisibilityCounts {
    /// Zero counts of `n` vertices.
    pub fn new(n: usize) -> Self {
        Self { counts: vec![0; n] }
    }

    /// Restores saved counts, (V).
    pub fn from_counts(counts: Vec<u64>) -> Self {
        Self { counts }
    }

    /// The counts, (V).
    pub fn counts(&self) -> &[u64] {
        &self.counts
    }

    /// Adds 1 to each of `vertices`, once per occurrence.
    ///
    /// # Panics
    /// If an index is out of range.
    pub fn add(&mut self, vertices: &[u32]) {
        let n = self.counts.len();
        for &v in vertices {
            assert!((v as usize) < n, "add: vertex {v} of {n}");
            let count = &mut self.counts[v as usize];
            *count = count.saturating_add(1);
        }
    }

    /// Adds 1 to every vertex marked in `visible` (V), as [`crate::visible_vertices`] returns it.
    ///
    /// # Panics
    /// If `visible` does not have an entry per vertex.
    pub fn add_visible(&mut self, visible: &[bool]) {
        let (flags, vertices) = (visible.len(), self.counts.len());
        assert_eq!(flags, vertices, "add_visible: {flags} flags for {vertices} vertices");
        for (count, &seen) in self.counts.iter_mut().zip(visible) {
            *count = count.saturating_add(u64::from(seen));
        }
    }

    /// Writes attention weights (OccNeRF §3.3) of `neighbours` into `out`, of the same length:
    /// (1 + c_i) / Σ_j (1 + c_j). Positive, sum 1, uniform for zero counts.
    ///
    /// # Panics
    /// If the lengths differ or an index is out of range.
    #[inline]
    pub fn attention(&self, neighbours: &[u32], out: &mut [f32]) {
        assert_eq!(neighbours.len(), out.len(), "attention: {} neighbours, {} outputs", neighbours.len(), out.len());
        let weight = |v: u32| u128::from(self.counts[v as usize]) + 1;
        let sum: u128 = neighbours.iter().map(|&v| weight(v)).sum();
        let inverse = 1.0 / sum as f64;
        for (a, &v) in out.iter_mut().zip(neighbours) {
            *a = ((self.counts[v as usize] as f64 + 1.0) * inverse) as f32;
        }
    }
}
