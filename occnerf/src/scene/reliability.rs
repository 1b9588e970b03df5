//! Reliability of photographed colours where frames disagree: by depth inside the mask and by
//! slant.

use glam::Vec3;

use crate::capture::Light;
use crate::scene::registration::deviation;
use crate::scene::seen::{ColorObservation, MOST, albedo};

/// Depths in a mask and cosines between normal and view direction that are told apart.
const BINS: [usize; 2] = [MOST + 1, 5];
/// First bin of cosines of a frontal colour, and least observations of a bin.
const FRONTAL: usize = 3;
const ENOUGH: u32 = 30;
/// Deviation of deep, frontal colours from the albedo at which frames half disagree. It is 0.02 to
/// 0.03 where registration and masks are exact, up to 0.047 on fine stripes, 0.061 on real video
/// with dirty masks.
const DISAGREEMENT: f32 = 0.055;
/// How sharply frames are told apart there.
const SHARPNESS: i32 = 12;

/// Inverse variance of colours by depth and slant, relative to that of deep and frontal ones:
/// bodies off their place and background in masks show at rims.
pub(crate) struct Reliability {
    /// 1 less the ratio; 0 where there are too few to tell.
    unreliable: [[f32; BINS[1]]; BINS[0]],
    /// How far frames disagree, from 0 to 1.
    pub disagreement: f32,
}

impl Reliability {
    /// Of the colours of frames under a light, with depths in their masks; `views`: posed vertices
    /// and centre of projection of each frame.
    pub fn measure(frames: &[Vec<(ColorObservation, usize)>], views: &[(&[Vec3], Vec3)], light: Light) -> Self {
        let seen = frames.iter().zip(views).flat_map(|(frame, &(vertices, eye))| {
            let cosine =
                move |seen: &ColorObservation| seen.2.dot((eye - vertices[seen.0 as usize]).normalize_or_zero());
            frame.iter().map(move |(seen, depth)| (Self::bin(*depth as f32, cosine(seen)), seen))
        });
        Self::of(seen, views.first().map_or(0, |view| view.0.len()), light)
    }

    /// Of colours in bins.
    fn of<'a>(
        seen: impl Iterator<Item = ([usize; 2], &'a ColorObservation)> + Clone,
        vertices: usize,
        light: Light,
    ) -> Self {
        let is_best = |[depth, slant]: [usize; 2]| depth + 1 == BINS[0] && slant >= FRONTAL;
        let best = seen.clone().filter(|(bin, _)| is_best(*bin)).map(|(_, seen)| seen);
        let albedo = albedo(best, vertices, light);
        let known = seen.filter(|(_, seen)| albedo[seen.0 as usize].1 > 0.0).map(|(bin, (v, color, normal))| {
            let (sum, squares) = albedo[*v as usize];
            (bin, *color - sum / squares * light.on(*normal))
        });
        let best: Vec<Vec3> = known.clone().filter(|(bin, _)| is_best(*bin)).map(|(_, residual)| residual).collect();
        let least = best.iter().map(|residual| residual.length_squared()).sum::<f32>() / best.len().max(1) as f32;
        let ratio = (deviation(best.into_iter()).unwrap_or(0.0) / DISAGREEMENT).powi(SHARPNESS);
        let mut sums = [[(0.0, 0u32); BINS[1]]; BINS[0]];
        for ([depth, slant], residual) in known {
            let sum = &mut sums[depth][slant];
            *sum = (sum.0 + residual.length_squared(), sum.1 + 1);
        }
        let unreliable = |(sum, count): (f32, u32)| match count {
            ENOUGH.. => (1.0 - least * count as f32 / sum.max(f32::MIN_POSITIVE)).max(0.0),
            _ => 0.0,
        };
        Self { unreliable: sums.map(|row| row.map(unreliable)), disagreement: ratio / (1.0 + ratio) }
    }

    fn bin(depth: f32, cosine: f32) -> [usize; 2] {
        let slant = (cosine.max(0.0) * BINS[1] as f32) as usize;
        [(depth.max(1.0) as usize).min(BINS[0]) - 1, slant.min(BINS[1] - 1)]
    }

    /// Weight of a colour at a depth inside its mask, pixels from 1, and with this cosine between
    /// normal and view direction: 1 where frames agree.
    pub fn at(&self, depth: f32, cosine: f32) -> f32 {
        let [depth, slant] = Self::bin(depth, cosine);
        1.0 - self.disagreement * self.unreliable[depth][slant]
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        /// Colours `rim` times as far off at the edge as inside, by `noise`.
        #[test]
        fn rims_count_by_their_inverse_variance_where_frames_disagree(rim in 1.5f32..4.0, noise in 0.01f32..0.3) {
            let colours: Vec<([usize; 2], ColorObservation)> = (0..4000u32)
                .map(|i| {
                    let (frame, edge) = (i % 20, i % 40 >= 20);
                    let side = if frame % 2 == 0 { noise } else { -noise };
                    let colour = Vec3::splat(0.5 + side * if edge { rim } else { 1.0 });
                    (Reliability::bin(if edge { 1.0 } else { 9.0 }, 0.9), (i / 40, colour, Vec3::Y))
                })
                .collect();
            let found = Reliability::of(colours.iter().map(|(bin, seen)| (*bin, seen)), 100, Light::default());
            prop_assert!((found.at(9.0, 0.9) - 1.0).abs() < 1e-3);
            let (ratio, at) = ((1.48 * noise / DISAGREEMENT).powi(SHARPNESS), found.at(1.0, 0.9));
            prop_assert!((found.disagreement - ratio / (1.0 + ratio)).abs() < 1e-3, "{}", found.disagreement);
            let expected = 1.0 - found.disagreement * (1.0 - 1.0 / (rim * rim));
            prop_assert!((at - expected).abs() < 1e-3, "{at} for {expected}");
            // Slants that nothing was seen at.
            prop_assert_eq!(found.at(1.0, 0.1), 1.0);
        }
    }
}
