//! Labels of a training image's pixels: subject, background, or unknown.

use crate::config::OccludedRule;

/// A pixel of a training frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Label {
    /// The mask shows the subject here.
    Subject,
    /// Free of the subject.
    Background,
    /// Occluded: the subject may be behind.
    Unknown,
}

/// The labels of a frame's pixels, 2 bits each.
///
/// ```
/// use occnerf::{Label, Labels};
///
/// let labels = Labels::new(&[Label::Background, Label::Subject, Label::Unknown]);
/// assert_eq!((labels.at(2), labels.num_subject(), labels.subject(0)), (Label::Unknown, 1, 1));
/// ```
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Labels {
    words: Vec<Word>,
    len: usize,
}

/// 64 pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Word {
    subject: u64,
    unknown: u64,
}

impl Labels {
    /// Packs the labels of pixels in row-major order.
    #[must_use]
    pub fn new(labels: &[Label]) -> Self {
        let word = |labels: &[Label]| {
            let bits = |wanted: Label| {
                labels.iter().enumerate().fold(0, |bits, (i, label)| bits | u64::from(*label == wanted) << i)
            };
            Word { subject: bits(Label::Subject), unknown: bits(Label::Unknown) }
        };
        Self { words: labels.chunks(64).map(word).collect(), len: labels.len() }
    }

    /// Number of pixels.
    #[must_use]
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there are no pixels.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// The label of a pixel.
    ///
    /// # Panics
    /// For a pixel beyond the last.
    #[must_use]
    pub fn at(&self, pixel: u32) -> Label {
        assert!((pixel as usize) < self.len, "pixel {pixel} of {}", self.len);
        let (word, bit) = (self.words[pixel as usize / 64], 1 << (pixel % 64));
        match (word.subject & bit != 0, word.unknown & bit != 0) {
            (true, _) => Label::Subject,
            (false, true) => Label::Unknown,
            (false, false) => Label::Background,
        }
    }

    /// All labels in order.
    pub fn iter(&self) -> impl Iterator<Item = Label> + '_ {
        (0..self.len as u32).map(|pixel| self.at(pixel))
    }

    /// Number of subject pixels.
    #[must_use]
    pub fn num_subject(&self) -> usize {
        self.words.iter().map(|word| word.subject.count_ones() as usize).sum()
    }

    /// The `n`-th subject pixel in order.
    ///
    /// # Panics
    /// From [`Labels::num_subject`] on.
    #[must_use]
    pub fn subject(&self, n: usize) -> u32 {
        let mut left = n;
        for (at, word) in (0..).zip(&self.words) {
            let (mut bits, count) = (word.subject, word.subject.count_ones() as usize);
            if left < count {
                // Clears the lowest set bits.
                (0..left).for_each(|_| bits &= bits - 1);
                return 64 * at + bits.trailing_zeros();
            }
            left -= count;
        }
        panic!("subject pixel {n} of {}", self.num_subject());
    }
}

/// Width of silhouette outside the mask that counts as misregistration of the prior, metres.
const SLIVER: f32 = 0.03;
/// Largest thickness of occluded clothes beyond the prior's silhouette, metres.
const CLOTHES: f32 = 0.04;

/// Labels the pixels of a frame of `width` × H pixels.
///
/// `mask`: subject coverage; `silhouette`: pixels that the posed prior covers; `occluder`: known
/// occluder pixels, possibly incomplete; `pixels_per_metre`: image scale at the subject's depth.
/// Unknown are the occluder's pixels, and the silhouette outside the mask, opened by 3 cm and
/// dilated by 4 cm.
pub(crate) fn label_pixels(
    rule: OccludedRule,
    mask: &[f32],
    silhouette: &[bool],
    occluder: Option<&[bool]>,
    width: usize,
    pixels_per_metre: f32,
) -> Vec<Label> {
    assert_eq!(mask.len(), silhouette.len());
    let subject: Vec<bool> = mask.iter().map(|&m| m > 0.5).collect();
    let mut unknown = vec![false; mask.len()];
    if rule == OccludedRule::Unknown {
        let missing: Vec<bool> = silhouette.iter().zip(&subject).map(|(&s, &m)| s && !m).collect();
        let radius = 0.5 * SLIVER * pixels_per_metre;
        let opened = dilate(&erode(&missing, width, radius), width, radius);
        unknown = dilate(&opened, width, CLOTHES * pixels_per_metre);
        unknown.iter_mut().zip(occluder.into_iter().flatten()).for_each(|(unknown, &known)| *unknown |= known);
    }
    subject
        .iter()
        .zip(unknown)
        .map(|(&subject, unknown)| match (subject, unknown) {
            (true, _) => Label::Subject,
            (false, true) => Label::Unknown,
            (false, false) => Label::Background,
        })
        .collect()
}

/// Pixels no farther than `radius` pixels from a set one.
pub(crate) fn dilate(set: &[bool], width: usize, radius: f32) -> Vec<bool> {
    around(set, width, radius, |set, width| {
        squared_distance(set, width).iter().map(|&d| d <= radius * radius).collect()
    })
}

/// Erosion; pixels beyond the image count as set.
fn erode(set: &[bool], width: usize, radius: f32) -> Vec<bool> {
    around(set, width, 1.0, |set, width| {
        let unset: Vec<bool> = set.iter().map(|s| !s).collect();
        squared_distance(&unset, width).iter().map(|&d| d > radius * radius).collect()
    })
}

/// The result of `filter` on the rows and columns within `margin` pixels of the set ones, and the
/// default elsewhere.
pub(crate) fn around<T: Copy + Default>(
    set: &[bool],
    width: usize,
    margin: f32,
    filter: impl Fn(&[bool], usize) -> Vec<T>,
) -> Vec<T> {
    if margin >= set.len() as f32 {
        return filter(set, width);
    }
    let mut found = vec![T::default(); set.len()];
    let rows = || set.chunks(width.max(1));
    let is_set = |row: &[bool]| row.contains(&true);
    let (Some(top), Some(bottom)) = (rows().position(is_set), rows().rposition(is_set)) else { return found };
    let left = rows().filter_map(|row| row.iter().position(|&s| s)).min().unwrap_or(0);
    let right = rows().filter_map(|row| row.iter().rposition(|&s| s)).max().unwrap_or(0);
    let margin = margin.ceil() as usize;
    let columns = left.saturating_sub(margin)..(right + margin + 1).min(width);
    let (first, last) = (top.saturating_sub(margin), bottom + margin);
    let inside: Vec<bool> =
        rows().skip(first).take(last + 1 - first).flat_map(|row| &row[columns.clone()]).copied().collect();
    let filtered = filter(&inside, columns.len());
    for (row, of) in found.chunks_mut(width).skip(first).zip(filtered.chunks(columns.len())) {
        row[columns.clone()].copy_from_slice(of);
    }
    found
}

/// Squared distance in pixels to the nearest set pixel, infinite where there is none (Felzenszwalb
/// and Huttenlocher 2012: lower envelopes of parabolas, along columns, then rows).
pub(crate) fn squared_distance(set: &[bool], width: usize) -> Vec<f32> {
    let height = set.len().checked_div(width).unwrap_or(0);
    let mut field: Vec<f32> = set.iter().map(|&s| if s { 0.0 } else { f32::INFINITY }).collect();
    let mut line = vec![0.0; width.max(height)];
    for column in 0..width {
        for row in 0..height {
            line[row] = field[row * width + column];
        }
        for (row, d) in lower_envelope(&line[..height]).into_iter().enumerate() {
            field[row * width + column] = d;
        }
    }
    for row in field.chunks_exact_mut(width.max(1)) {
        let transformed = lower_envelope(row);
        row.copy_from_slice(&transformed);
    }
    field
}

fn lower_envelope(f: &[f32]) -> Vec<f32> {
    let mut parabolas: Vec<(usize, f32)> = Vec::with_capacity(f.len());
    for (q, &value) in f.iter().enumerate().filter(|(_, v)| v.is_finite()) {
        let mut from = f32::NEG_INFINITY;
        while let Some(&(p, start)) = parabolas.last() {
            let (pf, qf) = (p as f32, q as f32);
            from = ((value + qf * qf) - (f[p] + pf * pf)) / (2.0 * (qf - pf));
            if from > start {
                break;
            }
            parabolas.pop();
            from = f32::NEG_INFINITY;
        }
        parabolas.push((q, from));
    }
    let mut current = 0;
    (0..f.len())
        .map(|x| {
            while current + 1 < parabolas.len() && parabolas[current + 1].1 < x as f32 {
                current += 1;
            }
            parabolas.get(current).map_or(f32::INFINITY, |&(p, _)| {
                let offset = x as f32 - p as f32;
                offset * offset + f[p]
            })
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const WIDTH: usize = 24;
    const HEIGHT: usize = 20;

    /// A few overlapping rectangles.
    fn blobs() -> impl Strategy<Value = Vec<bool>> {
        let rectangle = (0..WIDTH, 0..HEIGHT, 2..14usize, 2..14usize);
        prop::collection::vec(rectangle, 1..4).prop_map(|rectangles| {
            let inside = |x: usize, y: usize| {
                let is_in = |&(left, top, w, h): &(usize, usize, usize, usize)| {
                    (left..left + w).contains(&x) && (top..top + h).contains(&y)
                };
                rectangles.iter().any(is_in)
            };
            (0..WIDTH * HEIGHT).map(|i| inside(i % WIDTH, i / WIDTH)).collect()
        })
    }

    /// Squared distance of pixel `at` from the nearest one that is `wanted`.
    fn nearest(set: &[bool], width: usize, at: usize, wanted: bool) -> f32 {
        let squared = |j: usize| {
            let (x, y) = ((j % width).abs_diff(at % width), (j / width).abs_diff(at / width));
            (x * x + y * y) as f32
        };
        (0..set.len()).filter(|&j| set[j] == wanted).map(squared).fold(f32::INFINITY, f32::min)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        #[test]
        fn distances_and_filters_equal_brute_force(
            width in 1usize..12, height in 1usize..12,
            bits in prop::collection::vec(prop::bool::weighted(0.1), 144),
            radius in 0.0f32..4.0, most in prop::bool::ANY,
        ) {
            let set: Vec<bool> = bits[..width * height].iter().map(|bit| bit ^ most).collect();
            let fast = squared_distance(&set, width);
            let [dilated, eroded] = [dilate(&set, width, radius), erode(&set, width, radius)];
            for i in 0..set.len() {
                let [on, off] = [true, false].map(|wanted| nearest(&set, width, i, wanted));
                let reach = radius * radius;
                prop_assert_eq!((fast[i], dilated[i], eroded[i]), (on, on <= reach, off > reach));
            }
        }

        #[test]
        fn packed_labels_say_what_the_labels_say(
            kinds in prop::collection::vec(0..3usize, 0..12),
            lengths in prop::collection::vec(1..90usize, 12),
        ) {
            let label = |kind: usize| [Label::Subject, Label::Background, Label::Unknown][kind];
            let runs = kinds.into_iter().zip(lengths);
            let plain: Vec<Label> =
                runs.flat_map(|(kind, length)| std::iter::repeat_n(label(kind), length)).collect();
            let labels = Labels::new(&plain);
            prop_assert_eq!(labels.iter().collect::<Vec<_>>(), plain.clone());
            prop_assert_eq!((labels.len(), labels.is_empty()), (plain.len(), plain.is_empty()));
            let is_subject = |&i: &u32| plain[i as usize] == Label::Subject;
            let subject: Vec<u32> = (0..plain.len() as u32).filter(is_subject).collect();
            let found: Vec<u32> = (0..labels.num_subject()).map(|n| labels.subject(n)).collect();
            prop_assert_eq!(found, subject);
        }

        /// What is missing of the silhouette, opened by 3 cm and dilated by 4 cm, and the occluder.
        #[test]
        fn labels_are_those_of_their_definition(
            subject in blobs(), silhouette in blobs(), occluder in prop::option::of(blobs()),
            scale in 20.0f32..200.0,
        ) {
            let within = |set: &[bool], wanted: bool, radius: f32| -> Vec<bool> {
                let near = |i: usize| nearest(set, WIDTH, i, wanted) <= radius * radius;
                (0..set.len()).map(near).collect()
            };
            let missing: Vec<bool> = silhouette.iter().zip(&subject).map(|(&s, &m)| s && !m).collect();
            let eroded: Vec<bool> = within(&missing, false, 0.5 * 0.03 * scale).iter().map(|i| !i).collect();
            let unknown = within(&within(&eroded, true, 0.5 * 0.03 * scale), true, 0.04 * scale);
            // A coverage of exactly one half is not the subject's yet.
            let mask: Vec<f32> = subject.iter().map(|&s| if s { 0.6 } else { 0.5 }).collect();
            let of = |rule| label_pixels(rule, &mask, &silhouette, occluder.as_deref(), WIDTH, scale);
            let [found, known] = [OccludedRule::Unknown, OccludedRule::Background].map(of);
            for i in 0..mask.len() {
                let hidden = unknown[i] || occluder.as_ref().is_some_and(|o| o[i]);
                let label = |unknown: bool| match (subject[i], unknown) {
                    (true, _) => Label::Subject,
                    (false, true) => Label::Unknown,
                    (false, false) => Label::Background,
                };
                prop_assert_eq!((found[i], known[i]), (label(hidden), label(false)), "pixel {}", i);
            }
        }
    }

    #[test]
    fn pictures_of_no_pixels_or_one_and_extreme_scales_have_labels() {
        assert!(label_pixels(OccludedRule::Unknown, &[], &[], None, 0, 100.0).is_empty());
        assert!(label_pixels(OccludedRule::Unknown, &[], &[], None, 5, 100.0).is_empty());
        for scale in [0.0, 1e-30, 1.0, 1e6, f32::INFINITY] {
            let found = label_pixels(OccludedRule::Unknown, &[0.0], &[true], None, 1, scale);
            // Beyond the border nothing is known, so nothing erodes it.
            assert_eq!(found, [Label::Unknown], "{scale}");
        }
        // So close that the opening is wider than the picture: what the mask leaves free is then
        // misregistration.
        let silhouette: Vec<bool> = (0..WIDTH * HEIGHT).map(|i| i % WIDTH > 3).collect();
        let mask = [0.0; WIDTH * HEIGHT];
        let found = label_pixels(OccludedRule::Unknown, &mask, &silhouette, None, WIDTH, 1e5);
        assert!(found.iter().all(|l| *l == Label::Background));
    }
}
