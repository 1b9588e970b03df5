//! Background at the rims of masks.

use glam::Vec3;

use crate::capture::{Image, Pixels};
use crate::scene::labels::squared_distance;

/// Width of the rim relative to the height of the mask, and least width, pixels.
const RIM: f32 = 0.025;
const LEAST_RIM: usize = 2;
/// Least distance between the mean colours of background and person beside a pixel.
const CONTRAST: f32 = 0.15;
/// Largest distance of a background pixel from the mean colour of the background, also relative to that from
/// the person's.
const ALIKE: f32 = 0.1;
const NEARER: f32 = 0.3;

/// Pixels of a mask with the mean colour of the background beside them, unlike the person's deeper inside,
/// that such pixels join to the background. `outside`: known background, beside pixels of the mask.
pub(super) fn background(pixels: &Pixels, photograph: &Image, mut outside: Vec<bool>) -> Vec<usize> {
    let (width, height) = (photograph.width as usize, photograph.height as usize);
    let inside: Vec<bool> = pixels.mask.iter().map(|&m| m > 0.5).collect();
    let is_row = |y: &usize| inside[y * width..][..width].contains(&true);
    let rows = (0..height).rev().find(is_row).zip((0..height).find(is_row)).map_or(0, |(last, first)| last - first);
    let rim = ((rows as f32 * RIM).round() as usize).max(LEAST_RIM);
    outside.iter_mut().zip(&inside).for_each(|(outside, inside)| *outside &= !inside);
    let depth = squared_distance(&inside.iter().map(|i| !i).collect::<Vec<_>>(), width);
    let color = |i: usize| Vec3::from_slice(&photograph.pixels[3 * i..]);
    let around = Means::new([width, height], |i| outside[i].then(|| color(i)));
    let within = Means::new([width, height], |i| (depth[i] > (rim * rim) as f32).then(|| color(i)));
    let is_background = |i: usize| {
        let (Some(background), Some(person)) = (around.at(i, rim), within.at(i, 2 * rim)) else { return false };
        let away = color(i).distance(background);
        background.distance(person) > CONTRAST && away < ALIKE && away < NEARER * color(i).distance(person)
    };
    let mut open: Vec<usize> = (0..inside.len()).filter(|&i| outside[i]).collect();
    let mut reached = outside;
    let mut found = Vec::new();
    while let Some(i) = open.pop() {
        let (x, y) = (i % width, i / width);
        let near = [
            (x > 0, i.wrapping_sub(1)),
            (x + 1 < width, i + 1),
            (y > 0, i.wrapping_sub(width)),
            (y + 1 < height, i + width),
        ];
        for (_, j) in near.into_iter().filter(|near| near.0) {
            if inside[j] && !reached[j] && is_background(j) {
                reached[j] = true;
                found.push(j);
                open.push(j);
            }
        }
    }
    found
}

/// Mean colours of a set of pixels in squares, by a summed-area table (Crow 1984).
struct Means {
    width: usize,
    height: usize,
    /// Sums and counts above and to the left, (H + 1, W + 1).
    sums: Vec<(Vec3, f32)>,
}

impl Means {
    /// Of the pixels that have a `color`.
    fn new([width, height]: [usize; 2], color: impl Fn(usize) -> Option<Vec3>) -> Self {
        let mut sums = vec![(Vec3::ZERO, 0.0); (width + 1) * (height + 1)];
        for y in 0..height {
            let mut row = (Vec3::ZERO, 0.0);
            for x in 0..width {
                if let Some(color) = color(y * width + x) {
                    row = (row.0 + color, row.1 + 1.0);
                }
                let above: (Vec3, f32) = sums[y * (width + 1) + x + 1];
                sums[(y + 1) * (width + 1) + x + 1] = (above.0 + row.0, above.1 + row.1);
            }
        }
        Self { width, height, sums }
    }

    /// Mean in the square about a pixel; `None` where it has none of the set.
    fn at(&self, pixel: usize, radius: usize) -> Option<Vec3> {
        let (x, y) = (pixel % self.width, pixel / self.width);
        let (left, right) = (x.saturating_sub(radius), (x + radius + 1).min(self.width));
        let (top, bottom) = (y.saturating_sub(radius), (y + radius + 1).min(self.height));
        let [a, b, c, d] = [(left, top), (right, top), (left, bottom), (right, bottom)]
            .map(|(x, y)| self.sums[y * (self.width + 1) + x]);
        let count = d.1 - b.1 - c.1 + a.1;
        (count > 0.5).then(|| (d.0 - b.0 - c.0 + a.0) / count)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use volrender::RandomStream;

    const SIDE: usize = 80;

    /// A light disc before a dark wall with noise of deviation `noise`, and a mask of it that has also the
    /// pixels of `wall`.
    fn scene(noise: f32, seed: u64, wall: impl Fn(usize, usize) -> bool) -> (Pixels, Image) {
        let mut stream = RandomStream::new(&[seed]);
        let is_person = |x: usize, y: usize| (x as f32 - 40.0).hypot(y as f32 - 40.0) < 25.0;
        let place = |i: usize| (i % SIDE, i / SIDE);
        let each = (0..SIDE * SIDE).map(place);
        let colors = each.clone().flat_map(|(x, y)| {
            let tone = if is_person(x, y) { 0.8 } else { 0.3 };
            [0; 3].map(|_| tone + noise * stream.normal())
        });
        let photograph = Image { width: SIDE as u32, height: SIDE as u32, pixels: colors.collect() };
        let mask: Vec<f32> = each.map(|(x, y)| if is_person(x, y) || wall(x, y) { 1.0 } else { 0.0 }).collect();
        let mut image = photograph.clone();
        image.multiply(&mask);
        (Pixels { image, mask, occluder: None }, photograph)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(16))]

        #[test]
        fn means_are_those_of_a_loop_over_the_square(seed in any::<u64>(), pixel in 0usize..63, radius in 1usize..5) {
            let mut stream = RandomStream::new(&[seed]);
            let colors: Vec<Option<Vec3>> =
                (0..63).map(|_| (stream.uniform() < 0.4).then(|| Vec3::splat(stream.uniform()))).collect();
            let found = Means::new([9, 7], |i| colors[i]).at(pixel, radius);
            let is_near = |i: &usize| (i % 9).abs_diff(pixel % 9) <= radius && (i / 9).abs_diff(pixel / 9) <= radius;
            let near: Vec<Vec3> = (0..63).filter(is_near).filter_map(|i| colors[i]).collect();
            let expected = (!near.is_empty()).then(|| near.iter().sum::<Vec3>() / near.len() as f32);
            prop_assert_eq!(found.is_some(), expected.is_some());
            prop_assert!(found.zip(expected).is_none_or(|(a, b)| a.distance(b) < 1e-4));
        }

        /// A strip of the wall 3 pixels wide beside the person.
        #[test]
        fn wall_in_the_mask_is_found_and_nothing_else(seed in any::<u64>(), noise in 0.0f32..0.015) {
            let is_strip = |x: usize, y: usize| (62..68).contains(&x) && (30..50).contains(&y);
            let (pixels, photograph) = scene(noise, seed, is_strip);
            let found = background(&pixels, &photograph, vec![true; SIDE * SIDE]);
            let is_wall = |i: usize| (i % SIDE) as f32 - 40.0 > 0.0
                && is_strip(i % SIDE, i / SIDE)
                && ((i % SIDE) as f32 - 40.0).hypot((i / SIDE) as f32 - 40.0) >= 25.0;
            prop_assert!(found.iter().all(|&i| is_wall(i)));
            let strip = (0..SIDE * SIDE).filter(|&i| is_wall(i)).count();
            prop_assert!(found.len() > strip / 2, "{} of {strip}", found.len());
            prop_assert!(background(&scene(noise, seed, |_, _| false).0, &photograph, vec![true; SIDE * SIDE]).is_empty());
        }
    }

    #[test]
    fn without_known_background_and_without_a_mask_there_is_none() {
        let (mut pixels, photograph) = scene(0.0, 1, |x, y| (62..68).contains(&x) && (30..50).contains(&y));
        assert!(background(&pixels, &photograph, vec![false; SIDE * SIDE]).is_empty());
        pixels.mask.fill(0.0);
        assert!(background(&pixels, &photograph, vec![true; SIDE * SIDE]).is_empty());
    }
}
