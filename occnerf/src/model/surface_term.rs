//! The surface term of a block of samples: rows of vertices, mixed by attention.

use std::ops::Range;

use crate::model::samples::Samples;

/// Which rows each sample mixes, and where the mix stands in its input row: after the point term.
pub(crate) struct Mix<'a> {
    pub width: usize,
    pub per_sample: usize,
    pub neighbours: &'a [u32],
    pub attention: &'a [f32],
    pub row: usize,
}

impl<'a> Mix<'a> {
    pub fn new(width: usize, row: usize, range: Range<usize>, samples: &'a Samples, attention: &'a [f32]) -> Self {
        let per_sample = attention.len().checked_div(samples.len()).unwrap_or(0);
        let range = range.start * per_sample..range.end * per_sample;
        Self { width, per_sample, neighbours: &samples.neighbours[range.clone()], attention: &attention[range], row }
    }
}

/// Adds Σ a_i · row i to the surface term of each input row.
pub(crate) struct Gather<'a> {
    pub mix: Mix<'a>,
    pub rows: &'a [f32],
    pub input: &'a mut [f32],
}

impl pulp::WithSimd for Gather<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) {
        let Mix { width, per_sample, neighbours, attention, row } = self.mix;
        let each = neighbours.chunks_exact(per_sample).zip(attention.chunks_exact(per_sample));
        for ((neighbours, attention), input) in each.zip(self.input.chunks_exact_mut(row)) {
            let out = &mut input[width..2 * width];
            for (&v, &a) in neighbours.iter().zip(attention) {
                let from = &self.rows[v as usize * width..][..width];
                for (out, &x) in out.iter_mut().zip(from) {
                    *out = a.mul_add(x, *out);
                }
            }
        }
    }
}
