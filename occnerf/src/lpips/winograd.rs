//! Convolutions of 3 × 3 taps by minimal filtering (Winograd 1980; Lavin and Gray, "Fast Algorithms
//! for Convolutional Neural Networks", 2016): four pixels of a channel from 16 products instead of
//! 36.

use ndarray::linalg::general_mat_mul;
use ndarray::{Array2, ArrayView2, ArrayViewMut2, Axis, Slice};
use rayon::prelude::*;

use super::maps::{Maps, view};

/// Products of a tile: 4 × 4.
const PRODUCTS: usize = 16;
/// Tiles that are done together, as far as they are of whole rows.
const TILES: usize = 256;
/// Four pixels of the input along an axis to what is multiplied.
const LIFT: [[f32; 4]; 4] = [[1.0, 0.0, -1.0, 0.0], [0.0, 1.0, 1.0, 0.0], [0.0, -1.0, 1.0, 0.0], [0.0, 1.0, 0.0, -1.0]];
/// Three taps to what they are multiplied with.
const TAPS: [[f64; 3]; 4] = [[1.0, 0.0, 0.0], [0.5, 0.5, 0.5], [0.5, -0.5, 0.5], [0.0, 0.0, 1.0]];
/// The products to two pixels of the output.
const DROP: [[f32; 4]; 2] = [[1.0, 1.0, 1.0, 0.0], [0.0, 1.0, -1.0, -1.0]];

/// A convolution of 3 × 3 taps, every pixel, with a border of one zero. Linear: neither bias nor
/// rectification.
#[derive(Clone, Debug)]
pub(super) struct Winograd {
    /// Inputs by outputs, for each of the products.
    weights: Vec<Array2<f32>>,
}

/// Pictures in tiles of 2 × 2 pixels, the last of a row or column hanging over where there is an
/// odd number.
#[derive(Clone, Copy)]
struct Tiling {
    height: usize,
    width: usize,
    rows: usize,
    columns: usize,
}

impl Tiling {
    fn new([height, width]: [usize; 2]) -> Self {
        Self { height, width, rows: height.div_ceil(2), columns: width.div_ceil(2) }
    }

    /// Image, row and column of the upper left pixel of a tile.
    fn corner(&self, tile: usize) -> [usize; 3] {
        let row = tile / self.columns;
        [row / self.rows, 2 * (row % self.rows), 2 * (tile % self.columns)]
    }

    /// Number of a pixel; none outside.
    fn pixel(&self, image: usize, y: Option<usize>, x: Option<usize>) -> Option<usize> {
        let (y, x) = (y.filter(|&y| y < self.height)?, x.filter(|&x| x < self.width)?);
        Some((image * self.height + y) * self.width + x)
    }

    /// Rows of pixels before a row of tiles.
    fn above(&self, row: usize) -> usize {
        row / self.rows * self.height + 2 * (row % self.rows)
    }
}

impl Winograd {
    /// From PyTorch's order of the weights: (outputs, inputs, 3, 3).
    pub fn new(inputs: usize, outputs: usize, weight: &[f32]) -> Self {
        let product = |i: usize, j: usize| {
            Array2::from_shape_fn((inputs, outputs), |(input, output)| {
                let taps = &weight[(output * inputs + input) * 9..][..9];
                let taps = taps.iter().enumerate();
                taps.map(|(at, &tap)| TAPS[i][at / 3] * TAPS[j][at % 3] * f64::from(tap)).sum::<f64>() as f32
            })
        };
        Self { weights: (0..PRODUCTS).map(|k| product(k / 4, k % 4)).collect() }
    }

    /// Writes the convolution of `input` into `out` (pixels × outputs).
    pub fn forward(&self, input: &Maps, out: ArrayViewMut2<'_, f32>) {
        let (c, outputs) = (input.channels, out.ncols());
        let tiling = Tiling::new([input.height, input.width]);
        let rows = input.count * tiling.rows;
        let at_once = (TILES / tiling.columns).max(1);
        let (mut products, mut below) = (Vec::new(), out);
        for first in (0..rows).step_by(at_once) {
            let last = (first + at_once).min(rows);
            let tiles = first * tiling.columns..last * tiling.columns;
            products.resize(PRODUCTS * tiles.len() * outputs, 0.0);
            let each = products.par_chunks_mut(tiles.len() * outputs).enumerate();
            each.for_each_init(Vec::new, |lifted, (k, product)| {
                lifted.resize(tiles.len() * c, 0.0);
                for (tile, lifted) in tiles.clone().zip(lifted.chunks_exact_mut(c)) {
                    let [image, y, x] = tiling.corner(tile);
                    let pixel =
                        |i: usize, j: usize| tiling.pixel(image, (y + i).checked_sub(1), (x + j).checked_sub(1));
                    let values = |i, j| pixel(i, j).map(|pixel| &input.data[pixel * c..][..c]);
                    sum(lifted, &LIFT[k / 4], &LIFT[k % 4], values);
                }
                multiply(lifted, self.weights[k].view(), product);
            });
            let above = tiling.above(first);
            let (mut band, rest) = below.split_at(Axis(0), (tiling.above(last) - above) * tiling.width);
            below = rest;
            let rows: Vec<_> = band.axis_chunks_iter_mut(Axis(0), tiling.width).enumerate().collect();
            rows.into_par_iter().for_each(|(row, mut out)| {
                let (image, y) = ((above + row) / tiling.height, (above + row) % tiling.height);
                let first_tile = (image * tiling.rows + y / 2) * tiling.columns - tiles.start;
                for (x, mut out) in out.rows_mut().into_iter().enumerate() {
                    let Some(out) = out.as_slice_mut() else { continue };
                    let product =
                        |i: usize, j: usize| products.get(((4 * i + j) * tiles.len() + first_tile + x / 2) * outputs..);
                    sum(out, &DROP[y % 2], &DROP[x % 2], |i, j| product(i, j).map(|product| &product[..outputs]));
                }
            });
        }
    }

    /// Adds the gradient by the input to `d_input`; `d_out` (pixels × outputs) is that by the
    /// output.
    pub fn backward(&self, d_out: ArrayView2<'_, f32>, d_input: &mut Maps) {
        let (c, outputs) = (d_input.channels, d_out.ncols());
        let tiling = Tiling::new([d_input.height, d_input.width]);
        let of_image = tiling.rows * tiling.columns;
        let at_once = (TILES / of_image).max(1);
        let image_len = d_input.image_len();
        let mut products = Vec::new();
        for (band, d_input) in d_input.data.chunks_mut(at_once * image_len).enumerate() {
            let images = d_input.len() / image_len;
            let first = band * at_once;
            let d_out = d_out.slice_axis(Axis(0), Slice::from(first * tiling.height * tiling.width..));
            let tiles = images * of_image;
            products.resize(PRODUCTS * tiles * c, 0.0);
            products.par_chunks_mut(tiles * c).enumerate().for_each_init(Vec::new, |lifted, (k, product)| {
                lifted.resize(tiles * outputs, 0.0);
                let column = |k: usize| [DROP[0][k], DROP[1][k]];
                for (tile, lifted) in lifted.chunks_exact_mut(outputs).enumerate() {
                    let [image, y, x] = tiling.corner(tile);
                    let pixel = |i: usize, j: usize| tiling.pixel(image, Some(y + i), Some(x + j));
                    let values = |i, j| d_out.row(pixel(i, j)?).to_slice();
                    sum(lifted, &column(k / 4), &column(k % 4), values);
                }
                multiply(lifted, self.weights[k].t(), product);
            });
            d_input.par_chunks_mut(image_len).enumerate().for_each(|(image, d_input)| {
                // A pixel is in up to four tiles; row by row they come in one order.
                for (pixel, d_input) in d_input.chunks_exact_mut(c).enumerate() {
                    let [y, x] = [pixel / tiling.width, pixel % tiling.width];
                    for (row, i) in seen(y, tiling.rows) {
                        for (column, j) in seen(x, tiling.columns) {
                            let tile = image * of_image + row * tiling.columns + column;
                            let product = |p: usize, q: usize| products.get(((4 * p + q) * tiles + tile) * c..);
                            let column = |i: usize| LIFT.map(|row| row[i]);
                            add(d_input, &column(i), &column(j), |p, q| product(p, q).map(|product| &product[..c]));
                        }
                    }
                }
            });
        }
    }
}

/// The tiles that see a pixel along an axis of so many `tiles`, and where they see it: tile t sees
/// 2 t − 1 to 2 t + 2.
fn seen(at: usize, tiles: usize) -> impl Iterator<Item = (usize, usize)> {
    (at.saturating_sub(1) / 2..=at.div_ceil(2))
        .filter(move |&tile| tile < tiles)
        .map(move |tile| (tile, at + 1 - 2 * tile))
}

/// `out` = rows of `lifted` × `weight`.
fn multiply(lifted: &[f32], weight: ArrayView2<'_, f32>, out: &mut [f32]) {
    let lifted = view(lifted, weight.nrows());
    if let Ok(mut out) = ArrayViewMut2::from_shape((lifted.nrows(), weight.ncols()), out) {
        general_mat_mul(1.0, &lifted, &weight, 0.0, &mut out);
    }
}

/// Σ `a`[i] · `b`[j] · `values`(i, j), where there are any.
fn sum<'a, const N: usize>(
    out: &mut [f32],
    a: &[f32; N],
    b: &[f32; N],
    values: impl Fn(usize, usize) -> Option<&'a [f32]>,
) {
    out.fill(0.0);
    add(out, a, b, values);
}

fn add<'a, const N: usize>(
    out: &mut [f32],
    a: &[f32; N],
    b: &[f32; N],
    values: impl Fn(usize, usize) -> Option<&'a [f32]>,
) {
    for (i, a) in a.iter().enumerate().filter(|(_, a)| **a != 0.0) {
        for (j, b) in b.iter().enumerate().filter(|(_, b)| **b != 0.0) {
            if let Some(values) = values(i, j) {
                out.iter_mut().zip(values).for_each(|(out, value)| *out += a * b * value);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use volrender::RandomStream;

    /// Sums over the nine taps, in double precision.
    fn plain(input: &Maps, weight: &[f32], outputs: usize) -> Vec<f64> {
        let (c, mut out) = (input.channels, Vec::new());
        for pixel in 0..input.pixels() {
            let (image, y, x) =
                (pixel / (input.height * input.width), pixel / input.width % input.height, pixel % input.width);
            for output in 0..outputs {
                let mut sum = 0.0;
                for (tap, channel) in (0..9).flat_map(|tap| (0..c).map(move |channel| (tap, channel))) {
                    let (row, column) = (y + tap / 3, x + tap % 3);
                    if (1..=input.height).contains(&row) && (1..=input.width).contains(&column) {
                        let at = (image * input.height + row - 1) * input.width + column - 1;
                        sum += f64::from(input.data[at * c + channel])
                            * f64::from(weight[(output * c + channel) * 9 + tap]);
                    }
                }
                out.push(sum);
            }
        }
        out
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]

        #[test]
        fn it_is_the_convolution_and_its_backward_pass_the_transpose(
            count in 1usize..4, height in 1usize..20, width in 1usize..40, inputs in 1usize..9, outputs in 1usize..9,
            beside in 0usize..3, seed in any::<u64>(),
        ) {
            let random = |address: u64, len: usize| -> Vec<f32> {
                let mut stream = RandomStream::new(&[seed, address]);
                (0..len).map(|_| 2.0 * stream.uniform() - 1.0).collect()
            };
            let mut input = Maps::zeros(count, [height, width], inputs);
            input.data = random(0, input.data.len());
            let weight = random(1, inputs * outputs * 9);
            let minimal = Winograd::new(inputs, outputs, &weight);
            // The output may be some columns of something wider.
            let mut wide = Array2::<f32>::from_elem((input.pixels(), outputs + beside), 7.0);
            minimal.forward(&input, wide.slice_axis_mut(Axis(1), Slice::from(beside..)));
            let out = wide.slice_axis(Axis(1), Slice::from(beside..));
            prop_assert!(wide.slice_axis(Axis(1), Slice::from(..beside)).iter().all(|&x| x == 7.0));
            for (a, b) in out.iter().zip(plain(&input, &weight, outputs)) {
                prop_assert!((f64::from(*a) - b).abs() < 1e-5 * (9 * inputs) as f64, "{a} instead of {b}");
            }
            // ⟨d, conv(x)⟩ = ⟨convᵀ(d), x⟩, added to what is there.
            let d_out = Array2::from_shape_vec(wide.raw_dim(), random(2, wide.len())).unwrap_or_default();
            let d_out = d_out.slice_axis(Axis(1), Slice::from(beside..));
            let mut d_input = Maps::zeros(count, [height, width], inputs);
            d_input.data.fill(0.5);
            minimal.backward(d_out, &mut d_input);
            let dot = |a: &mut dyn Iterator<Item = (f32, f32)>| a.map(|(a, b)| f64::from(a) * f64::from(b)).sum::<f64>();
            let left = dot(&mut d_out.iter().copied().zip(out.iter().copied()));
            let right = dot(&mut d_input.data.iter().map(|d| d - 0.5).zip(input.data.iter().copied()));
            let size = (input.pixels() * outputs * 9 * inputs) as f64;
            prop_assert!((left - right).abs() < 1e-6 * size, "{left} and {right}");
        }
    }
}
