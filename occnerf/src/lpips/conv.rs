//! Convolutions as matrix products, which ndarray does: a row of the left operand is what the
//! kernel sees at a pixel.

use ndarray::linalg::general_mat_mul;
use ndarray::{Array2, ArrayView2, ArrayViewMut2, Axis, Slice};
use rayon::prelude::*;

use super::maps::{Maps, Window, view};
use super::winograd::Winograd;

/// Pixels of one product.
const PIXELS: usize = 256;
/// A product of fewer blocks of pixels is split along the other axis too, into about so many parts
/// in all.
const PARTS: usize = 4;
/// Input channels from which on minimal filtering pays.
const MINIMAL: usize = 16;

/// A convolution followed by max(·, 0).
#[derive(Clone, Debug)]
pub(super) struct Conv {
    pub window: Window,
    pub inputs: usize,
    weight: Weight,
    bias: Vec<f32>,
}

#[derive(Clone, Debug)]
enum Weight {
    /// Kernel row, kernel column and input channel by output channel.
    Plain(Array2<f32>),
    /// With less to multiply.
    Minimal(Winograd),
}

impl Conv {
    /// From PyTorch's order of the weights: (outputs, inputs, size, size).
    pub fn new(window: Window, inputs: usize, weight: &[f32], bias: Vec<f32>) -> Self {
        let taps = window.size * window.size;
        let outputs = bias.len();
        if window == Window::THREE && inputs >= MINIMAL {
            let minimal = Winograd::new(inputs, outputs, weight);
            return Self { window, inputs, weight: Weight::Minimal(minimal), bias };
        }
        let turned = Array2::from_shape_fn((taps * inputs, outputs), |(row, output)| {
            weight[(output * inputs + row % inputs) * taps + row / inputs]
        });
        Self { window, inputs, weight: Weight::Plain(turned), bias }
    }

    pub fn outputs(&self) -> usize {
        self.bias.len()
    }

    /// Writes the rectified convolution of `input` into `out` (pixels of `size` × outputs).
    pub fn forward(&self, input: &Maps, size: [usize; 2], mut out: ArrayViewMut2<'_, f32>) {
        let finish = |out: &mut ArrayViewMut2<'_, f32>, first: usize| {
            for mut row in out.rows_mut() {
                row.iter_mut().zip(&self.bias[first..]).for_each(|(v, b)| *v = (*v + b).max(0.0));
            }
        };
        let weight = match &self.weight {
            Weight::Plain(weight) => weight.view(),
            Weight::Minimal(minimal) => {
                minimal.forward(input, out.view_mut());
                let blocks: Vec<_> = out.axis_chunks_iter_mut(Axis(0), PIXELS).collect();
                blocks.into_par_iter().for_each(|mut out| finish(&mut out, 0));
                return;
            }
        };
        let columns = weight.nrows();
        let blocks = out.nrows().div_ceil(PIXELS);
        if blocks < PARTS || self.is_pointwise() {
            // Few pixels and many channels: what the kernel sees is laid out once for all parts.
            let mut seen = Vec::new();
            if !self.is_pointwise() {
                seen = vec![0.0; out.nrows() * columns];
                seen.par_chunks_mut(16 * columns)
                    .enumerate()
                    .for_each(|(i, seen)| self.gather(input, size, 16 * i, seen));
            }
            let seen = view(if self.is_pointwise() { &input.data } else { &seen }, columns);
            tiles(out).into_par_iter().for_each(|(row, column, mut out)| {
                let seen = seen.slice_axis(Axis(0), Slice::from(row..row + out.nrows()));
                let weight = weight.slice_axis(Axis(1), Slice::from(column..column + out.ncols()));
                general_mat_mul(1.0, &seen, &weight, 0.0, &mut out);
                finish(&mut out, column);
            });
        } else {
            let blocks: Vec<_> = out.axis_chunks_iter_mut(Axis(0), PIXELS).enumerate().collect();
            blocks.into_par_iter().for_each_init(Vec::new, |seen, (block, mut out)| {
                seen.clear();
                seen.resize(out.nrows() * columns, 0.0);
                self.gather(input, size, block * PIXELS, seen);
                general_mat_mul(1.0, &view(seen, columns), &weight, 0.0, &mut out);
                finish(&mut out, 0);
            });
        }
    }

    /// Adds the gradient by the input to `d_input`; `d_out` (pixels of `size` × outputs) is that by
    /// the convolution, before rectification.
    pub fn backward(&self, d_out: ArrayView2<'_, f32>, size: [usize; 2], d_input: &mut Maps) {
        let weight = match &self.weight {
            Weight::Plain(weight) => weight.view(),
            Weight::Minimal(minimal) => return minimal.backward(d_out, d_input),
        };
        let columns = weight.nrows();
        let mut d_seen = vec![0.0; d_out.nrows() * columns];
        if let Ok(d_seen) = ArrayViewMut2::from_shape((d_out.nrows(), columns), &mut d_seen) {
            tiles(d_seen).into_par_iter().for_each(|(row, column, mut d_seen)| {
                let d_out = d_out.slice_axis(Axis(0), Slice::from(row..row + d_seen.nrows()));
                let weight = weight.slice_axis(Axis(0), Slice::from(column..column + d_seen.ncols()));
                general_mat_mul(1.0, &d_out, &weight.t(), 0.0, &mut d_seen);
            });
        }
        self.scatter(&d_seen, size, d_input);
    }

    /// What the kernel sees at a pixel.
    fn columns(&self) -> usize {
        self.window.size * self.window.size * self.inputs
    }

    /// A kernel of one pixel sees the input as it is.
    fn is_pointwise(&self) -> bool {
        self.window.size == 1 && self.window.stride == 1 && self.window.padding == 0
    }

    /// What the kernel sees at the output pixels from `first` on, a row each, into zeros.
    fn gather(&self, input: &Maps, size: [usize; 2], first: usize, seen: &mut [f32]) {
        let c = self.inputs;
        for (i, seen) in seen.chunks_exact_mut(self.columns()).enumerate() {
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

    /// The reverse of [`Self::gather`]: adds to each row of the input what the output pixels that
    /// saw it hand back, in an order that does not depend on who does it.
    fn scatter(&self, d_seen: &[f32], size: [usize; 2], d_input: &mut Maps) {
        let (c, columns) = (self.inputs, self.columns());
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
                    let from = ((image * size[0] + y) * size[1] + x) * columns + (tap * self.window.size + skip) * c;
                    let to = d_input[column * c..][..run * c].iter_mut();
                    to.zip(&d_seen[from..]).for_each(|(to, from)| *to += from);
                }
            }
        });
    }

    /// Along a row: kernel columns that hang over the left end at position `x`, first column seen,
    /// and how many are.
    fn span(&self, x: usize, width: usize) -> (usize, usize, usize) {
        let start = x * self.window.stride;
        let skip = self.window.padding.saturating_sub(start);
        let column = start.saturating_sub(self.window.padding).min(width);
        (skip, column, (self.window.size - skip).min(width - column))
    }
}

/// Parts of a product, with first row and column each; the cut depends on the shape alone, and no
/// element on the cut.
fn tiles(out: ArrayViewMut2<'_, f32>) -> Vec<(usize, usize, ArrayViewMut2<'_, f32>)> {
    let (rows, columns) = out.dim();
    let blocks = rows.div_ceil(PIXELS).max(1);
    let width = columns.div_ceil(PARTS.div_ceil(blocks)).next_multiple_of(32);
    let (mut parts, mut below) = (Vec::new(), out);
    for row in (0..rows).step_by(PIXELS) {
        let (block, rest) = below.split_at(Axis(0), PIXELS.min(rows - row));
        below = rest;
        let mut right = block;
        for column in (0..columns).step_by(width) {
            let (part, rest) = right.split_at(Axis(1), width.min(columns - column));
            right = rest;
            parts.push((row, column, part));
        }
    }
    parts
}
