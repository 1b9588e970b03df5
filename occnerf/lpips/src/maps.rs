//! Feature maps, max pooling and rectification.

use ndarray::{ArrayView2, ArrayViewMut2};
use rayon::prelude::*;

/// Images or feature maps: (image, row, column, channel), row-major.
#[derive(Debug, Default)]
pub(crate) struct Maps {
    pub count: usize,
    pub height: usize,
    pub width: usize,
    pub channels: usize,
    pub data: Vec<f32>,
}

impl Maps {
    pub fn zeros(count: usize, [height, width]: [usize; 2], channels: usize) -> Self {
        Self { count, height, width, channels, data: vec![0.0; count * height * width * channels] }
    }

    /// Values of one image.
    pub fn image_len(&self) -> usize {
        self.height * self.width * self.channels
    }

    /// Pixels of all images × channels.
    pub fn pixels_mut(&mut self) -> ArrayViewMut2<'_, f32> {
        rows_mut(&mut self.data, self.channels)
    }
}

/// `data` as rows of `columns` values.
pub(crate) fn rows(data: &[f32], columns: usize) -> ArrayView2<'_, f32> {
    ArrayView2::from_shape((data.len() / columns, columns), data).expect("`data` consists of whole rows")
}

/// `data` as rows of `columns` values.
pub(crate) fn rows_mut(data: &mut [f32], columns: usize) -> ArrayViewMut2<'_, f32> {
    ArrayViewMut2::from_shape((data.len() / columns, columns), data).expect("`data` consists of whole rows")
}

/// Window of a convolution or a pooling along both axes.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Window {
    pub size: usize,
    pub stride: usize,
    /// Zeros at both ends.
    pub padding: usize,
    /// Whether the last window may reach beyond the end (PyTorch's `ceil_mode`).
    pub ceil: bool,
}

impl Window {
    /// Number of positions along an axis of `length`; `None` if there is none.
    pub fn positions(&self, length: usize) -> Option<usize> {
        let more = if self.ceil { self.stride - 1 } else { 0 };
        let last = (length + 2 * self.padding + more).checked_sub(self.size)? / self.stride;
        // The last window has to start before the end.
        Some(if self.ceil && last * self.stride >= length { last } else { last + 1 }).filter(|&n| n > 0)
    }
}

/// Maximum of each channel in each window.
pub(crate) fn max_pool(input: &Maps, window: Window, size: [usize; 2]) -> Maps {
    let mut out = Maps::zeros(input.count, size, input.channels);
    let (c, row_len) = (input.channels, size[1] * input.channels);
    out.data.par_chunks_mut(row_len).enumerate().for_each(|(row, out)| {
        let (image, y) = (row / size[0], row % size[0]);
        for (x, out) in out.chunks_exact_mut(c).enumerate() {
            out.fill(f32::NEG_INFINITY);
            for_each_pixel(input, window, [y, x], |at| {
                let values = &input.data[image * input.image_len() + at..][..c];
                out.iter_mut().zip(values).for_each(|(out, &v)| *out = if v > *out { v } else { *out });
            });
        }
    });
    out
}

/// Gradient of [`max_pool`] by its input. Among equal maxima the first in row-major order gets it.
/// `d_out` may hold fewer images than `input`.
pub(crate) fn max_pool_backward(input: &Maps, out: &Maps, window: Window, d_out: &Maps) -> Maps {
    let mut d_input = Maps::zeros(d_out.count, [input.height, input.width], input.channels);
    let c = input.channels;
    let (len, out_len) = (input.image_len(), out.image_len());
    d_input.data.par_chunks_mut(len).enumerate().for_each(|(image, d_input)| {
        let input_values = &input.data[image * len..][..len];
        let maxima = out.data[image * out_len..][..out_len].chunks_exact(c);
        let d_out = d_out.data[image * out_len..][..out_len].chunks_exact(c);
        let mut pending = vec![0.0; c];
        for (place, (maxima, d)) in maxima.zip(d_out).enumerate() {
            pending.copy_from_slice(d);
            for_each_pixel(input, window, [place / out.width, place % out.width], |at| {
                let values = &input_values[at..][..c];
                let d_input = &mut d_input[at..][..c];
                for channel in 0..c {
                    let hit = values[channel] == maxima[channel];
                    d_input[channel] += if hit { pending[channel] } else { 0.0 };
                    pending[channel] = if hit { 0.0 } else { pending[channel] };
                }
            });
        }
    });
    d_input
}

/// Calls `pixel` with the offset within an image of each pixel of an unpadded window, row-major.
fn for_each_pixel(maps: &Maps, window: Window, [y, x]: [usize; 2], mut pixel: impl FnMut(usize)) {
    for row in y * window.stride..(y * window.stride + window.size).min(maps.height) {
        for column in x * window.stride..(x * window.stride + window.size).min(maps.width) {
            pixel((row * maps.width + column) * maps.channels);
        }
    }
}

/// Zeroes the gradient where the rectified output is zero.
pub(crate) fn rectify_backward(out: &Maps, d_out: &mut Maps) {
    let len = d_out.data.len();
    d_out.data.par_chunks_mut(1 << 12).zip(out.data[..len].par_chunks(1 << 12)).for_each(|(d, out)| {
        d.iter_mut().zip(out).for_each(|(d, &v)| *d = if v > 0.0 { *d } else { 0.0 });
    });
}
