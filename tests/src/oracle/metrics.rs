/// Peak signal-to-noise ratio in dB of values from 0 to 1, over all of them; infinite for equal
/// inputs.
///
/// # Panics
/// Where lengths differ.
#[must_use]
pub fn psnr(a: &[f32], b: &[f32]) -> f64 {
    assert_eq!(a.len(), b.len(), "psnr: different lengths");
    let squared: f64 = a.iter().zip(b).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum();
    -10.0 * (squared / a.len() as f64).log10()
}

const WINDOW: isize = 7;

/// SSIM of every pixel, channels averaged: `a`, `b` (H, W, 3) from 0 to 1, result (H, W). 7×7
/// uniform window, sample covariance, K1 0.01, K2 0.03, data range 1; beyond the border the image
/// is mirrored with the edge sample repeated (Wang et al. 2004, as
/// `skimage.metrics.structural_similarity` computes its full map).
///
/// # Panics
/// Where lengths are not 3·W·H.
#[must_use]
pub fn ssim_map(a: &[f32], b: &[f32], width: usize, height: usize) -> Vec<f64> {
    for image in [a, b] {
        assert_eq!(image.len(), width * height * 3, "ssim: not (H, W, 3)");
    }
    let mirrored = |i: isize, n: usize| {
        let period = 2 * n as isize;
        let i = i.rem_euclid(period);
        (if i < n as isize { i } else { period - 1 - i }) as usize
    };
    let n = (WINDOW * WINDOW) as f64;
    let (c1, c2) = (0.01f64.powi(2), 0.03f64.powi(2));
    let mut map = vec![0.0; width * height];
    for y in 0..height {
        for x in 0..width {
            for channel in 0..3 {
                let mut pairs = Vec::new();
                for dy in -WINDOW / 2..=WINDOW / 2 {
                    for dx in -WINDOW / 2..=WINDOW / 2 {
                        let row = mirrored(y as isize + dy, height);
                        let column = mirrored(x as isize + dx, width);
                        let i = (row * width + column) * 3 + channel;
                        pairs.push((f64::from(a[i]), f64::from(b[i])));
                    }
                }
                let mean_a = pairs.iter().map(|p| p.0).sum::<f64>() / n;
                let mean_b = pairs.iter().map(|p| p.1).sum::<f64>() / n;
                let (mut aa, mut bb, mut ab) = (0.0, 0.0, 0.0);
                for (pa, pb) in pairs {
                    aa += (pa - mean_a) * (pa - mean_a) / (n - 1.0);
                    bb += (pb - mean_b) * (pb - mean_b) / (n - 1.0);
                    ab += (pa - mean_a) * (pb - mean_b) / (n - 1.0);
                }
                let luminance = (2.0 * mean_a * mean_b + c1) / (mean_a.powi(2) + mean_b.powi(2) + c1);
                let structure = (2.0 * ab + c2) / (aa + bb + c2);
                map[y * width + x] += luminance * structure / 3.0;
            }
        }
    }
    map
}

/// Mean of [`ssim_map`] over the pixels whose window lies within the image.
///
/// # Panics
/// Where an image is smaller than the window, or lengths are not 3·W·H.
#[must_use]
pub fn ssim(a: &[f32], b: &[f32], width: usize, height: usize) -> f64 {
    let border = WINDOW as usize / 2;
    assert!(width.min(height) > 2 * border, "ssim: {width}×{height} is smaller than the 7×7 window");
    let map = ssim_map(a, b, width, height);
    let mut sum = 0.0;
    for y in border..height - border {
        for x in border..width - border {
            sum += map[y * width + x];
        }
    }
    sum / ((width - 2 * border) * (height - 2 * border)) as f64
}

/// Intersection over union of a mask, at 0.5, and of the pixels whose centres are `covered`, over
/// the pixels outside `ignored`.
pub fn mask_iou(mask: &[f32], ignored: Option<&[bool]>, width: usize, covered: impl Fn(f32, f32) -> bool) -> f32 {
    let (mut both, mut either) = (0, 0);
    for (i, &coverage) in mask.iter().enumerate().filter(|(i, _)| !ignored.is_some_and(|ignored| ignored[*i])) {
        let (covered, subject) = (covered((i % width) as f32 + 0.5, (i / width) as f32 + 0.5), coverage > 0.5);
        both += usize::from(covered && subject);
        either += usize::from(covered || subject);
    }
    both as f32 / either.max(1) as f32
}
