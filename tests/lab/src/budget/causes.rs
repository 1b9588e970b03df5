//! Where the error of a picture comes from.

use glam::{IVec2, Vec3};
use occnerf::capture::Pixels;
use occnerf::{Error, Label, PreparedFrame, Renderer, Rendering, Scene, nearest_vertices};
use serde::{Deserialize, Serialize};
use volrender::metrics;

/// Side of the windows that are shifted to where they fit best, as a part of the picture's height,
/// and how far from one shift to the next: 17 pixels and one of 192.
const WINDOW: f32 = 17.0 / 192.0;
const SHIFT: f32 = 1.0 / 192.0;
/// Shifts to each side.
const SHIFTS: i32 = 3;
/// Standard deviation of the blur that tells low frequencies, as a part of the picture's height.
const BLUR: f32 = 1.0 / 32.0;
/// Fewer pixels of never-seen surface than this in a view give no figure for it.
const FEWEST: usize = 16;

/// Causes of error, in the order in which they are told apart.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cause {
    /// Either the person or the picture of it covers the pixel, not both.
    Silhouette,
    /// No training frame shows the surface.
    Unseen,
    /// What is gone where each window is shifted, by up to 1/64 of the height, to where it fits
    /// best.
    Registration,
    /// Of the rest, what varies slowly over the picture: light, and colours of large areas.
    LowFrequency,
    /// Everything else: blur, detail, noise.
    Rest,
}

impl Cause {
    /// All of them, in order.
    pub const ALL: [Self; 5] = [Self::Silhouette, Self::Unseen, Self::Registration, Self::LowFrequency, Self::Rest];

    /// What it is called in tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::Silhouette => "silhouette",
            Self::Unseen => "unseen surface",
            Self::Registration => "registration",
            Self::LowFrequency => "low-frequency colour",
            Self::Rest => "the rest",
        }
    }
}

/// Squared error, summed over the channels of a pixel, by [`Cause::ALL`]. The sum over the causes
/// is the whole; single shares of a pixel may be negative.
pub type Shares = [f32; Cause::ALL.len()];

/// The error of one view.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ViewBudget {
    /// Name of the frame.
    pub name: String,
    /// Name of the camera.
    pub camera: String,
    /// Squared error by [`Cause::ALL`], summed over the picture.
    pub squared: [f64; Cause::ALL.len()],
    /// PSNR (dB) over the subject's pixels on surface that no training frame shows; `None` where
    /// there are fewer than 16.
    pub psnr_unseen: Option<f64>,
    /// SSIM over the same pixels.
    pub ssim_unseen: Option<f64>,
}

/// Draws `frames` over black and splits the error of each by cause; `progress` hears of each
/// picture and its pixels' shares (H × W).
pub fn split_error(
    scene: &Scene,
    renderer: &mut dyn Renderer,
    frames: &[&PreparedFrame],
    mut progress: impl FnMut(&PreparedFrame, &Rendering, &[Shares]),
) -> Result<Vec<ViewBudget>, Error> {
    let frequencies = scene.vertex_frequencies()?;
    let view = |frame: &&PreparedFrame| {
        let mut rendering = renderer.render(&frame.view, Vec3::ZERO)?;
        let truth = frame.pixels()?;
        // An unknown pixel has no error.
        for i in (0..frame.labels.len()).filter(|&i| frame.labels.at(i as u32) == Label::Unknown) {
            let whole = 3 * i..3 * i + 3;
            rendering.image.pixels[whole.clone()].copy_from_slice(&truth.image.pixels[whole]);
            rendering.opacity[i] = 0.0;
        }
        let nearest = nearest_vertices(scene, frame, &truth.mask)?;
        let unseen: Vec<bool> = nearest.iter().map(|v| v.is_some_and(|v| frequencies[v as usize] == 0)).collect();
        let shares = split(&truth, &rendering, &unseen);
        progress(frame, &rendering, &shares);
        let (a, b) = (&rendering.image.pixels[..], &truth.image.pixels[..]);
        let (width, height) = (truth.image.width as usize, truth.image.height as usize);
        let enough = unseen.iter().filter(|&&unseen| unseen).count() >= FEWEST;
        Ok(ViewBudget {
            name: frame.name.clone(),
            camera: frame.camera_name.clone(),
            squared: [0, 1, 2, 3, 4].map(|cause: usize| shares.iter().map(|s| f64::from(s[cause])).sum()),
            psnr_unseen: if enough { metrics::psnr_masked(a, b, &unseen) } else { None },
            ssim_unseen: if enough { metrics::ssim_masked(a, b, &unseen, width, height) } else { None },
        })
    };
    frames.iter().map(view).collect()
}

/// Each pixel's error (H × W) by cause.
fn split(truth: &Pixels, rendering: &Rendering, unseen: &[bool]) -> Vec<Shares> {
    let (width, height) = (truth.image.width as i32, truth.image.height as i32);
    let pick = |pixels: &[f32], i: usize| Vec3::from_slice(&pixels[3 * i..]);
    let (drawn, shown) = (&rendering.image.pixels[..], &truth.image.pixels[..]);
    let covered = |i: usize| (truth.mask[i] > 0.5, rendering.opacity[i] > 0.5);
    let judged: Vec<bool> = (0..truth.mask.len()).map(|i| covered(i) == (true, true) && !unseen[i]).collect();
    let side = |part: f32| (part * height as f32).round().max(1.0) as i32;
    let sums = |values: &[f32], half: i32| window_sums(values, width, height, half);
    // What is drawn a shift away, less what is shown.
    let error = |i: usize, shift: IVec2| {
        let (x, y) = (i as i32 % width + shift.x, i as i32 / width + shift.y);
        pick(drawn, (y.clamp(0, height - 1) * width + x.clamp(0, width - 1)) as usize) - pick(shown, i)
    };
    let mut shifts: Vec<IVec2> =
        (-SHIFTS..=SHIFTS).flat_map(|y| (-SHIFTS..=SHIFTS).map(move |x| IVec2::new(x, y))).collect();
    shifts.sort_by_key(|s| (s.length_squared(), s.y, s.x));
    let mut best = vec![(f32::INFINITY, IVec2::ZERO); judged.len()];
    for shift in shifts {
        let shift = side(SHIFT) * shift;
        let squared = |i: usize| if judged[i] { error(i, shift).length_squared() } else { 0.0 };
        let squared: Vec<f32> = (0..judged.len()).map(squared).collect();
        for (best, sum) in best.iter_mut().zip(sums(&squared, side(WINDOW) / 2)) {
            if sum < best.0 {
                *best = (sum, shift);
            }
        }
    }
    let left: Vec<Vec3> = (0..judged.len()).map(|i| if judged[i] { error(i, best[i].1) } else { Vec3::ZERO }).collect();
    // Three windows after each other are nearly a Gaussian, over the pixels that are judged.
    let deviation = BLUR * height as f32;
    let half = ((4.0 * deviation * deviation + 1.0).sqrt() / 2.0).round() as i32;
    let blurred = |values: Vec<f32>| (0..3).fold(values, |values, _| sums(&values, half));
    let weights = blurred(judged.iter().map(|&j| f32::from(u8::from(j))).collect());
    let low = [0, 1, 2].map(|c| blurred(left.iter().map(|e| e[c]).collect()));
    let shares = |i: usize| -> Shares {
        let whole = error(i, IVec2::ZERO).length_squared();
        let mut shares = Shares::default();
        if judged[i] {
            let slow = Vec3::from_array([0, 1, 2].map(|c| low[c][i])) / weights[i].max(f32::MIN_POSITIVE);
            let (shifted, rest) = (left[i].length_squared(), (left[i] - slow).length_squared());
            shares[2..].copy_from_slice(&[whole - shifted, shifted - rest, rest]);
        } else {
            shares[usize::from(covered(i) == (true, true))] = whole;
        }
        shares
    };
    (0..judged.len()).map(shares).collect()
}

/// Sums over the windows of `2 half + 1` pixels a side around each pixel, as far as the picture
/// goes.
fn window_sums(values: &[f32], width: i32, height: i32, half: i32) -> Vec<f32> {
    let row = width as usize + 1;
    let mut table = vec![0.0f64; row * (height as usize + 1)];
    for (y, line) in values.chunks_exact(width as usize).enumerate() {
        let mut sum = 0.0;
        for (x, &value) in line.iter().enumerate() {
            sum += f64::from(value);
            table[(y + 1) * row + x + 1] = table[y * row + x + 1] + sum;
        }
    }
    let at = |x: i32, y: i32| table[y.clamp(0, height) as usize * row + x.clamp(0, width) as usize];
    let sum = |i: i32| {
        let (x, y) = (i % width, i / width);
        let ([x0, y0], [x1, y1]) = ([x - half, y - half], [x + half + 1, y + half + 1]);
        (at(x1, y1) - at(x0, y1) - at(x1, y0) + at(x0, y0)) as f32
    };
    (0..width * height).map(sum).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use occnerf::capture::Image;
    use testkit::body::Random;

    const SIDE: u32 = 96;

    /// A disc in a texture that a shift of `shift` pixels moves.
    fn disc(shift: f32) -> (Image, Vec<f32>) {
        let (mut image, mut mask) = (Image::new(SIDE, SIDE), vec![0.0; (SIDE * SIDE) as usize]);
        for i in 0..SIDE * SIDE {
            let at = glam::Vec2::new((i % SIDE) as f32, (i / SIDE) as f32);
            if at.distance(glam::Vec2::splat(48.0)) < 40.0 {
                let (x, y) = (at.x - shift, at.y);
                let color = Vec3::new(0.5 + 0.3 * (0.9 * x).sin(), 0.5 + 0.3 * (0.7 * y + 0.5 * x).sin(), 0.4);
                color.write_to_slice(&mut image.pixels[3 * i as usize..]);
                mask[i as usize] = 1.0;
            }
        }
        (image, mask)
    }

    /// The part of the error that each cause has.
    fn parts(drawn: (Image, Vec<f32>), unseen: impl Fn(usize) -> bool) -> [f32; 5] {
        let (image, mask) = disc(0.0);
        let truth = Pixels { image, mask, occluder: None };
        let rendering = Rendering { image: drawn.0, opacity: drawn.1 };
        let unseen: Vec<bool> = (0..truth.mask.len()).map(|i| unseen(i) && truth.mask[i] > 0.5).collect();
        let shares = split(&truth, &rendering, &unseen);
        for (i, shares) in shares.iter().enumerate() {
            let each = rendering.image.pixels[3 * i..].iter().zip(&truth.image.pixels[3 * i..]).take(3);
            let whole: f32 = each.map(|(a, b)| (a - b) * (a - b)).sum();
            assert!((shares.iter().sum::<f32>() - whole).abs() < 1e-5);
        }
        let totals = [0, 1, 2, 3, 4].map(|c: usize| shares.iter().map(|s| s[c]).sum::<f32>());
        totals.map(|total| total / totals.iter().sum::<f32>())
    }

    #[test]
    fn each_cause_gets_the_error_that_is_made_on_purpose() {
        let moved = disc(1.0);
        assert!(parts(moved.clone(), |_| false)[2] > 0.9);
        let mut darker = disc(0.0);
        darker.0.pixels.iter_mut().for_each(|p| *p *= 0.8);
        let found = parts(darker, |_| false);
        assert!(found[3] > 0.6 && found[2] < 0.2, "{found:?}");
        let mut noisy = disc(0.0);
        let mut random = Random(1);
        let inside = noisy.1.iter().flat_map(|&m| [m; 3]);
        noisy.0.pixels.iter_mut().zip(inside).for_each(|(p, m)| *p += m * 0.1 * (random.unit() - 0.5));
        let found = parts(noisy, |_| false);
        assert!(found[4] > 0.8, "{found:?}");
        let mut smaller = disc(0.0);
        for i in (0..smaller.1.len()).filter(|i| i % 96 < 40) {
            smaller.1[i] = 0.0;
            smaller.0.pixels[3 * i..3 * i + 3].fill(0.0);
        }
        assert_eq!(parts(smaller, |_| false)[0], 1.0);
        assert_eq!(parts(moved, |_| true)[1], 1.0);
    }

    #[test]
    fn sums_of_windows_are_those_of_their_pixels() {
        let mut random = Random(1);
        let (width, height) = (7, 5);
        let values: Vec<f32> = (0..width * height).map(|_| random.unit()).collect();
        for half in [0, 1, 3, 9] {
            let found = window_sums(&values, width, height, half);
            for (i, found) in found.iter().enumerate() {
                let (x, y) = (i as i32 % width, i as i32 / width);
                let near = |j: &usize| {
                    let (u, v) = (*j as i32 % width, *j as i32 / width);
                    (u - x).abs() <= half && (v - y).abs() <= half
                };
                let expected: f32 = (0..values.len()).filter(near).map(|j| values[j]).sum();
                assert!((found - expected).abs() < 1e-4);
            }
        }
    }
}
