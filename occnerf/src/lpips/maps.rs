//! Feature maps, and what happens to them between the convolutions.

use ndarray::ArrayView2;
use rayon::prelude::*;

/// Images or feature maps: image after image, row-major, channels last.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Maps {
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

    /// Pixels of all images.
    pub fn pixels(&self) -> usize {
        self.count * self.height * self.width
    }

    /// Values of one image.
    pub fn image_len(&self) -> usize {
        self.height * self.width * self.channels
    }
}

/// Where a window of `size` every `stride` pixels stands along an axis that is padded with
/// `padding` zeros at both ends.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Window {
    pub size: usize,
    pub stride: usize,
    pub padding: usize,
    /// Whether a last window may reach beyond the end, as long as it starts before it.
    pub ceil: bool,
}

impl Window {
    /// Three pixels, every pixel, with a border of one.
    pub const THREE: Self = Self { size: 3, stride: 1, padding: 1, ceil: false };

    /// Positions along an axis of `length`; `None` if there is not one.
    pub fn positions(&self, length: usize) -> Option<usize> {
        let more = if self.ceil { self.stride - 1 } else { 0 };
        let last = (length + 2 * self.padding + more).checked_sub(self.size)? / self.stride;
        // Only a window of at most the stride's size could otherwise start beyond the end.
        Some(if self.ceil && last * self.stride >= length { last } else { last + 1 }).filter(|&n| n > 0)
    }
}

/// The largest value of each channel in each window.
pub(super) fn max_pool(input: &Maps, window: Window, size: [usize; 2]) -> Maps {
    let mut out = Maps::zeros(input.count, size, input.channels);
    let (c, row_len) = (input.channels, size[1] * input.channels);
    out.data.par_chunks_mut(row_len).enumerate().for_each(|(row, out)| {
        let (image, y) = (row / size[0], row % size[0]);
        for (x, out) in out.chunks_exact_mut(c).enumerate() {
            out.fill(f32::NEG_INFINITY);
            in_window(input, window, [y, x], |at| {
                let values = &input.data[image * input.image_len() + at..][..c];
                out.iter_mut().zip(values).for_each(|(out, &v)| *out = if v > *out { v } else { *out });
            });
        }
    });
    out
}

/// Gradient by the input of [`max_pool`]: of equal values the first in reading order gets it.
/// `d_out` and `out` may hold fewer images than `input`.
pub(super) fn max_pool_backward(input: &Maps, out: &Maps, window: Window, d_out: &Maps) -> Maps {
    let mut d_input = Maps::zeros(d_out.count, [input.height, input.width], input.channels);
    let c = input.channels;
    let (len, out_len) = (input.image_len(), out.image_len());
    d_input.data.par_chunks_mut(len).enumerate().for_each(|(image, d_input)| {
        let (input_values, out_values) = (&input.data[image * len..][..len], &out.data[image * out_len..][..out_len]);
        let d_out = &d_out.data[image * out_len..][..out_len];
        let mut left = vec![0.0; c];
        for (place, (largest, d)) in out_values.chunks_exact(c).zip(d_out.chunks_exact(c)).enumerate() {
            left.copy_from_slice(d);
            in_window(input, window, [place / out.width, place % out.width], |at| {
                let values = &input_values[at..][..c];
                let d_input = &mut d_input[at..][..c];
                for channel in 0..c {
                    let hit = values[channel] == largest[channel];
                    d_input[channel] += if hit { left[channel] } else { 0.0 };
                    left[channel] = if hit { 0.0 } else { left[channel] };
                }
            });
        }
    });
    d_input
}

/// Offsets within an image of the pixels under an unpadded window, in reading order.
fn in_window(maps: &Maps, window: Window, [y, x]: [usize; 2], mut pixel: impl FnMut(usize)) {
    for row in y * window.stride..(y * window.stride + window.size).min(maps.height) {
        for column in x * window.stride..(x * window.stride + window.size).min(maps.width) {
            pixel((row * maps.width + column) * maps.channels);
        }
    }
}

/// Zeroes the gradient where a rectified output is zero.
pub(super) fn rectify_backward(out: &Maps, d_out: &mut Maps) {
    let len = d_out.data.len();
    d_out.data.par_chunks_mut(1 << 12).zip(out.data[..len].par_chunks(1 << 12)).for_each(|(d, out)| {
        d.iter_mut().zip(out).for_each(|(d, &v)| *d = if v > 0.0 { *d } else { 0.0 });
    });
}

/// `data` as rows of `columns`.
pub(super) fn view(data: &[f32], columns: usize) -> ArrayView2<'_, f32> {
    // Every caller hands whole rows; were it not so, the product's own check of shapes would speak
    // up.
    let rows = data.len() / columns;
    ArrayView2::from_shape((rows, columns), &data[..rows * columns]).unwrap_or(ArrayView2::from(&[[0.0; 0]; 0]))
}
