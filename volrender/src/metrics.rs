//! Image metrics, in `f64`. Images are row-major H × W × 3 with values in \[0, 1\].

use rayon::prelude::*;

use crate::camera::Error;

/// Peak signal-to-noise ratio in dB, −10 log10 of the mean squared difference of all values (any
/// shape). Infinite for equal images, NaN for empty ones.
///
/// ```
/// let psnr = volrender::metrics::psnr(&[0.5; 12], &[0.6; 12]);
/// assert!((psnr - 20.0).abs() < 1e-5);
/// ```
///
/// # Panics
/// If the lengths differ.
pub fn psnr(a: &[f32], b: &[f32]) -> f64 {
    assert_eq!(a.len(), b.len(), "images of {} and {} values", a.len(), b.len());
    let sum: f64 = a.iter().zip(b).map(|(&a, &b)| squared(a, b)).sum();
    decibels(sum / a.len() as f64)
}

/// [`psnr`] over the pixels where `mask` (H·W) is true. `None` for an empty mask.
///
/// # Panics
/// If the lengths are not 3·H·W, 3·H·W and H·W.
pub fn psnr_masked(a: &[f32], b: &[f32], mask: &[bool]) -> Option<f64> {
    assert_mask(a, b, mask);
    let mut sum = 0.0;
    let mut count = 0u64;
    for (pixel, _) in mask.iter().enumerate().filter(|(_, inside)| **inside) {
        for i in 3 * pixel..3 * pixel + 3 {
            sum += squared(a[i], b[i]);
        }
        count += 3;
    }
    (count > 0).then(|| decibels(sum / count as f64))
}

fn squared(a: f32, b: f32) -> f64 {
    let difference = f64::from(a) - f64::from(b);
    difference * difference
}

fn decibels(mean_squared: f64) -> f64 {
    -10.0 * mean_squared.log10()
}

const WINDOW: usize = 7;
const BORDER: usize = WINDOW / 2;

/// Structural similarity (Wang et al. 2004), the mean over the three channels and the pixels whose
/// window lies within the image. It equals scikit-image's `structural_similarity(a, b,
/// data_range=1, channel_axis=-1)`: 7×7 uniform window, sample covariance (n / (n − 1)), K1 0.01,
/// K2 0.03, data range 1.
///
/// ```
/// let image: Vec<f32> = (0..3 * 8 * 8).map(|i| (i % 10) as f32 / 10.0).collect();
/// let darker: Vec<f32> = image.iter().map(|x| 0.9 * x).collect();
/// assert_eq!(volrender::metrics::ssim(&image, &image, 8, 8)?, 1.0);
/// assert!(volrender::metrics::ssim(&image, &darker, 8, 8)? < 1.0);
/// # Ok::<(), volrender::Error>(())
/// ```
///
/// # Errors
/// An image smaller than the window.
///
/// # Panics
/// If the lengths are not 3·H·W.
pub fn ssim(a: &[f32], b: &[f32], width: usize, height: usize) -> Result<f64, Error> {
    if width < WINDOW || height < WINDOW {
        return Err(Error::image_size(width, height, WINDOW));
    }
    let map = ssim_map(a, b, width, height);
    let rows = map.chunks_exact(width).take(height - BORDER).skip(BORDER);
    let sum: f64 = rows.flat_map(|row| &row[BORDER..width - BORDER]).sum();
    Ok(sum / ((width - 2 * BORDER) * (height - 2 * BORDER)) as f64)
}

/// Structural similarity averaged over the pixels where `mask` (H·W) is true, with the constants of
/// [`ssim`]. `None` for an empty mask.
///
/// Beyond the border the image is mirrored with the edge sample repeated (scipy's `reflect`).
/// Windows extend 3 pixels beyond the mask's edge, so the pixels there have an influence.
///
/// ```
/// let (a, b) = ([0.5; 3 * 16], [0.25; 3 * 16]);
/// let ssim = volrender::metrics::ssim_masked(&a, &b, &[true; 16], 4, 4).unwrap();
/// assert!((ssim - 0.8001).abs() < 1e-4); // (2 · 0.5 · 0.25 + C1) / (0.5² + 0.25² + C1)
/// ```
///
/// # Panics
/// If the lengths are not 3·H·W, 3·H·W and H·W.
pub fn ssim_masked(a: &[f32], b: &[f32], mask: &[bool], width: usize, height: usize) -> Option<f64> {
    assert_mask(a, b, mask);
    let count = mask.iter().filter(|inside| **inside).count();
    if count == 0 {
        return None;
    }
    let map = ssim_map(a, b, width, height);
    let inside = map.iter().zip(mask).filter(|(_, inside)| **inside);
    Some(inside.map(|(ssim, _)| ssim).sum::<f64>() / count as f64)
}

fn assert_mask(a: &[f32], b: &[f32], mask: &[bool]) {
    assert!(
        a.len() == 3 * mask.len() && b.len() == 3 * mask.len(),
        "images of {} and {} values, expected 3 for each of the mask's {} pixels",
        a.len(),
        b.len(),
        mask.len()
    );
}

/// Sums over a window of a, b, a², b² and a·b, for each channel.
const MOMENTS: usize = 5;
type Moments = [f64; 3 * MOMENTS];

/// Structural similarity around every pixel (H·W), channels averaged.
fn ssim_map(a: &[f32], b: &[f32], width: usize, height: usize) -> Vec<f64> {
    assert!(
        a.len() == 3 * width * height && b.len() == a.len(),
        "images of {} and {} values, expected 3 × {width} × {height}",
        a.len(),
        b.len()
    );
    let mut map = vec![0.0; width * height];
    if map.is_empty() {
        return map;
    }
    let columns = mirrored(width);
    let lines = mirrored(height);
    map.par_chunks_mut(width).enumerate().for_each_init(
        || vec![[0.0; 3 * MOMENTS]; width],
        |vertical, (y, map)| {
            vertical.fill([0.0; 3 * MOMENTS]);
            for &line in &lines[y..y + WINDOW] {
                let row = 3 * width * line..3 * width * (line + 1);
                add_line(&a[row.clone()], &b[row], vertical);
            }
            for (x, ssim) in map.iter_mut().enumerate() {
                let mut sums: Moments = [0.0; 3 * MOMENTS];
                for &column in &columns[x..x + WINDOW] {
                    for (sum, value) in sums.iter_mut().zip(&vertical[column]) {
                        *sum += value;
                    }
                }
                *ssim = mean_ssim(&sums);
            }
        },
    );
    map
}

/// Adds the moments of one image row, column by column.
fn add_line(a: &[f32], b: &[f32], vertical: &mut [Moments]) {
    let pixels = a.as_chunks::<3>().0.iter().zip(b.as_chunks::<3>().0);
    for ((a, b), sums) in pixels.zip(vertical) {
        for channel in 0..3 {
            let (a, b) = (f64::from(a[channel]), f64::from(b[channel]));
            let moments = [a, b, a * a, b * b, a * b];
            for k in 0..MOMENTS {
                sums[k * 3 + channel] += moments[k];
            }
        }
    }
}

fn mean_ssim(sums: &Moments) -> f64 {
    const C1: f64 = 0.01 * 0.01;
    const C2: f64 = 0.03 * 0.03;
    let n = (WINDOW * WINDOW) as f64;
    let mut mean = 0.0;
    for channel in 0..3 {
        let [a, b, aa, bb, ab] = [0, 1, 2, 3, 4].map(|k| sums[k * 3 + channel] / n);
        let unbiased = n / (n - 1.0);
        let variances = unbiased * ((aa - a * a) + (bb - b * b));
        let covariance = unbiased * (ab - a * b);
        let numerator = (2.0 * a * b + C1) * (2.0 * covariance + C2);
        let denominator = (a * a + b * b + C1) * (variances + C2);
        mean += numerator / denominator / 3.0;
    }
    mean
}

/// Indices of −3 ‥ n + 2 of a line of n samples, mirrored with the edge sample repeated.
fn mirrored(n: usize) -> Vec<usize> {
    let period = 2 * n as isize;
    (-(BORDER as isize)..(n + BORDER) as isize)
        .map(|i| i.rem_euclid(period) as usize)
        .map(|i| if i < n { i } else { 2 * n - 1 - i })
        .collect()
}
