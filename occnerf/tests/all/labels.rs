//! Subject, background or unknown: properties of the rule that no single picture shows.

use occnerf::{Label, Labels, OccludedRule, label_pixels};
use proptest::prelude::*;

const WIDTH: usize = 24;
const HEIGHT: usize = 20;

/// A few overlapping rectangles.
fn blobs() -> impl Strategy<Value = Vec<bool>> {
    let rectangle = (0..WIDTH, 0..HEIGHT, 2..14usize, 2..14usize);
    prop::collection::vec(rectangle, 1..4).prop_map(|rectangles| {
        let inside = |x: usize, y: usize| {
            rectangles.iter().any(|&(left, top, w, h)| (left..left + w).contains(&x) && (top..top + h).contains(&y))
        };
        (0..WIDTH * HEIGHT).map(|i| inside(i % WIDTH, i / WIDTH)).collect()
    })
}

fn mask(subject: &[bool]) -> Vec<f32> {
    subject.iter().map(|&s| f32::from(u8::from(s))).collect()
}

fn labels(mask: &[f32], silhouette: &[bool], scale: f32) -> Vec<Label> {
    label_pixels(OccludedRule::Unknown, mask, silhouette, None, WIDTH, scale)
}

/// Whether a pixel of `set` lies within `radius` of pixel `at`.
fn near(set: &[bool], at: usize, radius: f32) -> bool {
    (0..set.len()).filter(|&j| set[j]).any(|j| {
        let (x, y) = ((j % WIDTH).abs_diff(at % WIDTH) as f32, (j / WIDTH).abs_diff(at / WIDTH) as f32);
        x * x + y * y <= radius * radius
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn packed_labels_say_what_the_labels_say(
        runs in prop::collection::vec((prop::sample::select(vec![Label::Subject, Label::Background, Label::Unknown]), 1..90usize), 0..12),
    ) {
        let plain: Vec<Label> = runs.into_iter().flat_map(|(label, length)| std::iter::repeat_n(label, length)).collect();
        let labels = Labels::new(&plain);
        prop_assert_eq!(labels.iter().collect::<Vec<_>>(), plain.clone());
        prop_assert_eq!((labels.len(), labels.is_empty()), (plain.len(), plain.is_empty()));
        prop_assert!((0..plain.len()).all(|i| labels.at(i as u32) == plain[i]));
        let subject: Vec<u32> = (0..plain.len() as u32).filter(|&i| plain[i as usize] == Label::Subject).collect();
        prop_assert_eq!((0..labels.num_subject()).map(|n| labels.subject(n)).collect::<Vec<_>>(), subject);
    }

    #[test]
    fn hiding_more_of_the_subject_never_makes_an_unknown_pixel_known(
        subject in blobs(), silhouette in blobs(), obstacle in blobs(), scale in 20.0f32..200.0,
    ) {
        let before = labels(&mask(&subject), &silhouette, scale);
        let hidden: Vec<bool> = subject.iter().zip(&obstacle).map(|(&s, &o)| s && !o).collect();
        let after = labels(&mask(&hidden), &silhouette, scale);
        for i in 0..before.len() {
            prop_assert!(before[i] != Label::Unknown || after[i] == Label::Unknown, "pixel {i}");
        }
    }

    #[test]
    fn nothing_is_unknown_farther_than_clothes_from_the_missing_silhouette(
        subject in blobs(), silhouette in blobs(), scale in 20.0f32..200.0,
    ) {
        let found = labels(&mask(&subject), &silhouette, scale);
        let missing: Vec<bool> = silhouette.iter().zip(&subject).map(|(&s, &m)| s && !m).collect();
        for (i, label) in found.iter().enumerate() {
            if *label == Label::Unknown {
                prop_assert!(near(&missing, i, 0.04 * scale + 1e-3), "pixel {i}");
            }
        }
    }

    #[test]
    fn what_lies_deep_in_the_missing_silhouette_is_unknown(
        subject in blobs(), silhouette in blobs(), scale in 20.0f32..200.0,
    ) {
        let found = labels(&mask(&subject), &silhouette, scale);
        let filled: Vec<bool> = silhouette.iter().zip(&subject).map(|(&s, &m)| !s || m).collect();
        for (i, label) in found.iter().enumerate() {
            if !near(&filled, i, 0.015 * scale + 1e-3) {
                prop_assert_eq!(*label, Label::Unknown, "pixel {}", i);
            }
        }
    }

    #[test]
    fn a_known_occluder_joins_what_is_inferred_and_the_background_rule_overrules_both(
        subject in blobs(), silhouette in blobs(), occluder in blobs(), scale in 20.0f32..200.0,
    ) {
        let mask = mask(&subject);
        let known = label_pixels(OccludedRule::Unknown, &mask, &silhouette, Some(&occluder), WIDTH, scale);
        let inferred = label_pixels(OccludedRule::Unknown, &mask, &silhouette, None, WIDTH, scale);
        let background = label_pixels(OccludedRule::Background, &mask, &silhouette, Some(&occluder), WIDTH, scale);
        for i in 0..mask.len() {
            let hidden = (occluder[i] && !subject[i]) || inferred[i] == Label::Unknown;
            prop_assert_eq!(known[i] == Label::Unknown, hidden);
            prop_assert_eq!(background[i] == Label::Background, !subject[i]);
        }
    }
}

#[test]
fn without_a_silhouette_everything_outside_the_mask_is_background() {
    let subject: Vec<f32> = (0..WIDTH * HEIGHT).map(|i| (i % 3) as f32 / 2.0).collect();
    let found = labels(&subject, &[false; WIDTH * HEIGHT], 100.0);
    for (label, &m) in found.iter().zip(&subject) {
        // A coverage of exactly one half is not the subject's yet.
        assert_eq!(*label, if m > 0.5 { Label::Subject } else { Label::Background });
    }
}

#[test]
fn pictures_of_no_pixels_or_one_and_extreme_scales_have_labels() {
    assert!(label_pixels(OccludedRule::Unknown, &[], &[], None, 0, 100.0).is_empty());
    assert!(label_pixels(OccludedRule::Unknown, &[], &[], None, 5, 100.0).is_empty());
    for scale in [0.0, 1e-30, 1.0, 1e6, f32::INFINITY] {
        let found = label_pixels(OccludedRule::Unknown, &[0.0], &[true], None, 1, scale);
        assert_eq!(found, [Label::Unknown], "{scale}: beyond the border nothing is known, so nothing erodes it");
    }
    // So close that the opening is wider than the picture: what the mask leaves free is then
    // misregistration.
    let silhouette: Vec<bool> = (0..WIDTH * HEIGHT).map(|i| i % WIDTH > 3).collect();
    let found = labels(&[0.0; WIDTH * HEIGHT], &silhouette, 1e5);
    assert!(found.iter().all(|l| *l == Label::Background));
}

#[test]
fn a_subject_hidden_as_a_whole_is_unknown_as_a_whole() {
    let silhouette: Vec<bool> = (0..WIDTH * HEIGHT).map(|i| (6..16).contains(&(i % WIDTH))).collect();
    let found = labels(&[0.0; WIDTH * HEIGHT], &silhouette, 100.0);
    for (i, label) in found.iter().enumerate() {
        // Four pixels of clothes on either side.
        let expected = if (2..20).contains(&(i % WIDTH)) { Label::Unknown } else { Label::Background };
        assert_eq!(*label, expected, "pixel {i}");
    }
}
