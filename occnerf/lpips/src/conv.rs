//! Convolution with rectification, as im2col and a matrix product.

use ndarray::linalg::general_mat_mul;
use ndarray::{Array2, ArrayView2, ArrayViewMut2, Axis};
use rayon::prelude::*;

use crate::maps::{Maps, Window, rows, rows_mut};

/// Output pixels of one product: their im2col rows fit the cache.
const ROWS: usize = 256;
/// Number of parallel products below which they are split by columns too.
const PARTS: usize = 4;
/// Output pixels of one parallel task of im2col.
const GATHERED: usize = 16;

/// Convolution followed by max(·, 0).
#[derive(Debug)]
pub(crate) struct Conv {
    pub window: Window,
    inputs: usize,
    /// (kernel row, kernel column, input channel) × output channel.
    weight: Array2<f32>,
    bias: Vec<f32>,
}

impl Conv {
    /// Takes `weight` in PyTorch's order: (output, input, kernel row, kernel column).
    pub fn new(window: Window, inputs: usize, weight: &[f32], bias: Vec<f32>) -> Self {
        let taps = window.size * window.size;
        let weight = Array2::from_shape_fn((taps * inputs, bias.len()), |(row, output)| {
            weight[(output * inputs + row % inputs) * taps + row / inputs]
        });
        Self { window, inputs, weight, bias }
    }

    pub fn outputs(&self) -> usize {
        self.bias.len()
    }

    /// Writes the rectified convolution of `input` into `out` (pixels of `size` × outputs).
    pub fn forward(&self, input: &Maps, size: [usize; 2], mut out: ArrayViewMut2<'_, f32>) {
        let (taps, width) = (self.weight.nrows(), part_width(out.dim()));
        let blocks = out.axis_chunks_iter_mut(Axis(0), ROWS).into_par_iter().enumerate();
        blocks.for_each_init(Vec::new, |seen, (block, mut out)| {
            seen.clear();
            seen.resize(out.nrows() * taps, 0.0);
            let gathered = seen.par_chunks_mut(GATHERED * taps).enumerate();
            gathered.for_each(|(i, seen)| self.gather(input, size, block * ROWS + i * GATHERED, seen));
            let seen = rows(seen, taps);
            let weights = self.weight.axis_chunks_iter(Axis(1), width).into_par_iter();
            let parts = out.axis_chunks_iter_mut(Axis(1), width).into_par_iter();
            parts.zip(weights).zip(self.bias.par_chunks(width)).for_each(|((mut out, weight), bias)| {
                general_mat_mul(1.0, &seen, &weight, 0.0, &mut out);
                for mut pixel in out.rows_mut() {
                    pixel.iter_mut().zip(bias).for_each(|(v, b)| *v = (*v + b).max(0.0));
                }
            });
        });
    }

    /// Adds the gradient by the input to `d_input`. `d_out` (pixels of `size` × outputs) is the
    /// gradient by the convolution before rectification.
    pub fn backward(&self, d_out: ArrayView2<'_, f32>, size: [usize; 2], d_input: &mut Maps) {
        let taps = self.weight.nrows();
        let mut d_seen = vec![0.0; d_out.nrows() * taps];
        let width = part_width((d_out.nrows(), taps));
        let blocks = d_out.axis_chunks_iter(Axis(0), ROWS).into_par_iter();
        blocks.zip(d_seen.par_chunks_mut(ROWS * taps)).for_each(|(d_out, d_seen)| {
            let mut d_seen = rows_mut(d_seen, taps);
            let weights = self.weight.axis_chunks_iter(Axis(0), width).into_par_iter();
            let parts = d_seen.axis_chunks_iter_mut(Axis(1), width).into_par_iter();
            parts.zip(weights).for_each(|(mut d_seen, weight)| {
                general_mat_mul(1.0, &d_out, &weight.t(), 0.0, &mut d_seen);
            });
        });
        self.scatter(&d_seen, size, d_input);
    }

    /// Copies the inputs of the output pixels from `first` on into `seen` (pixels × rows of
    /// `weight`), which is zero before.
    fn gather(&self, input: &Maps, size: [usize; 2], first: usize, seen: &mut [f32]) {
        let c = self.inputs;
        for (i, seen) in seen.chunks_exact_mut(self.weight.nrows()).enumerate() {
            let pixel = first + i;
            let (image, y, x) = (pixel / (size[0] * size[1]), pixel / size[1] % size[0], pixel % size[1]);
            let (skip, column, run) = self.span(x, input.width);
            for tap in 0..self.window.size {
                let Some(row) = (y * self.window.stride + tap).checked_sub(self.window.padding) else { continue };
                if row < input.height {
                    let from = ((image * input.height + row) * input.width + column) * c;
                    seen[(tap * self.window.size + skip) * c..][..run * c]
                        .copy_from_slice(&input.data[from..][..run * c]);
                }
            }
        }
    }

    /// Adds the gradient of [`Self::gather`] by the input. Each row of the input is summed by one
    /// task, in an order that does not depend on the number of threads.
    fn scatter(&self, d_seen: &[f32], size: [usize; 2], d_input: &mut Maps) {
        let (c, taps) = (self.inputs, self.weight.nrows());
        let (height, width) = (d_input.height, d_input.width);
        d_input.data.par_chunks_mut(width * c).enumerate().for_each(|(row, d_input)| {
            let (image, row) = (row / height, row % height);
            for tap in 0..self.window.size {
                let Some(offset) = (row + self.window.padding).checked_sub(tap) else { continue };
                let y = offset / self.window.stride;
                if offset % self.window.stride != 0 || y >= size[0] {
                    continue;
                }
                for x in 0..size[1] {
                    let (skip, column, run) = self.span(x, width);
                    let from = ((image * size[0] + y) * size[1] + x) * taps + (tap * self.window.size + skip) * c;
                    let to = d_input[column * c..][..run * c].iter_mut();
                    to.zip(&d_seen[from..]).for_each(|(to, from)| *to += from);
                }
            }
        });
    }

    /// Part of a kernel row inside the image at output column `x`: first kernel column, first input
    /// column, number of columns.
    fn span(&self, x: usize, width: usize) -> (usize, usize, usize) {
        let start = x * self.window.stride;
        let skip = self.window.padding.saturating_sub(start);
        let column = start.saturating_sub(self.window.padding).min(width);
        (skip, column, (self.window.size - skip).min(width - column))
    }
}

/// Columns of one product of an output of `rows` × `columns`: a function of the shape alone, so
/// that the bits do not depend on the number of threads.
fn part_width((rows, columns): (usize, usize)) -> usize {
    columns.div_ceil(PARTS.div_ceil(rows.div_ceil(ROWS).max(1))).next_multiple_of(32)
}
