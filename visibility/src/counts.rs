/// Counts of how often each vertex of a mesh was seen.
///
/// Counts are whole numbers in 64 bits, so they go on growing where `f32` would stop at 2²⁴, and
/// they do not depend on the order in which they were added.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct VisibilityCounts {
    counts: Vec<u64>,
}

impl VisibilityCounts {
    /// `n` vertices, none seen yet.
    #[must_use]
    pub fn new(n: usize) -> Self {
        Self { counts: vec![0; n] }
    }

    /// Continues from counts saved earlier, (V).
    #[must_use]
    pub fn from_counts(counts: Vec<u64>) -> Self {
        Self { counts }
    }

    /// The counts, (V).
    #[must_use]
    pub fn counts(&self) -> &[u64] {
        &self.counts
    }

    /// Adds 1 to every vertex named; one named several times gets as many.
    ///
    /// # Panics
    /// If a vertex does not exist.
    pub fn add(&mut self, vertices: &[u32]) {
        let n = self.counts.len();
        for &v in vertices {
            assert!((v as usize) < n, "add: vertex {v} of {n}");
            let count = &mut self.counts[v as usize];
            *count = count.saturating_add(1);
        }
    }

    /// Adds 1 to every vertex that is `visible` (V), as [`crate::visible_vertices`] tells.
    ///
    /// # Panics
    /// If `visible` has another length.
    pub fn add_visible(&mut self, visible: &[bool]) {
        assert_eq!(
            visible.len(),
            self.counts.len(),
            "add_visible: {} flags for {} vertices",
            visible.len(),
            self.counts.len()
        );
        for (count, &seen) in self.counts.iter_mut().zip(visible) {
            *count = count.saturating_add(u64::from(seen));
        }
    }

    /// Forgets a share of the past: every count becomes ⌊`keep` · count⌋.
    ///
    /// # Panics
    /// Unless 0 ≤ `keep` ≤ 1.
    pub fn decay(&mut self, keep: f64) {
        assert!((0.0..=1.0).contains(&keep), "decay: keep = {keep}, expected 0 to 1");
        if keep < 1.0 {
            for count in &mut self.counts {
                // Truncates; the product is never above the count, which f64 may have rounded up.
                *count = ((*count as f64 * keep) as u64).min(*count);
            }
        }
    }

    /// Attention of a list of vertices, OccNeRF §3.3: (1 + c_i) / Σ_j (1 + c_j) into `out` (as
    /// many). Positive, sums to 1, and uniform before anything was seen.
    ///
    /// # Panics
    /// If the lengths differ or a vertex does not exist.
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

    /// Attention where counts come from places that are spread over the surface, so that a vertex of
    /// a coarse part gets more of them: (1 + s_i c_i) / Σ_j (1 + s_j c_j) into `out`. `scale` (V) is
    /// s, at least 0: the mean area around a vertex over that around each. Positive, sums to 1, and
    /// uniform before anything was seen.
    ///
    /// # Panics
    /// If the lengths differ or a vertex does not exist.
    #[inline]
    pub fn attention_scaled(&self, scale: &[f32], neighbours: &[u32], out: &mut [f32]) {
        assert_eq!(scale.len(), self.counts.len(), "attention: {} scales of {} counts", scale.len(), self.counts.len());
        assert_eq!(neighbours.len(), out.len(), "attention: {} neighbours, {} outputs", neighbours.len(), out.len());
        let weight = |v: u32| 1.0 + f64::from(scale[v as usize]) * self.counts[v as usize] as f64;
        let inverse = 1.0 / neighbours.iter().map(|&v| weight(v)).sum::<f64>();
        for (a, &v) in out.iter_mut().zip(neighbours) {
            *a = (weight(v) * inverse) as f32;
        }
    }

    /// Sum of all counts.
    #[must_use]
    pub fn total(&self) -> u128 {
        self.counts.iter().map(|&c| u128::from(c)).sum()
    }

    /// Share of each vertex in the total, (V); zeros before anything was seen.
    #[must_use]
    pub fn frequencies(&self) -> Vec<f32> {
        let total = self.total().max(1) as f64;
        (self.counts.iter()).map(|&c| (c as f64 / total) as f32).collect()
    }
}
