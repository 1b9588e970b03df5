//! Counts and attention.

use proptest::prelude::*;
use visibility::VisibilityCounts;

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn the_order_of_additions_does_not_matter(
        (forward, shuffled) in prop::collection::vec(0u32..20, 0..200)
            .prop_flat_map(|list| (Just(list.clone()), Just(list).prop_shuffle())),
        cut in any::<prop::sample::Index>(),
    ) {
        let mut a = VisibilityCounts::new(20);
        a.add(&forward);
        let mut b = VisibilityCounts::new(20);
        let (first, second) = shuffled.split_at(cut.index(shuffled.len() + 1));
        b.add(first);
        b.add(second);
        prop_assert_eq!(a, b);
    }
}

#[test]
fn attention_is_one_plus_count_over_the_sum() {
    let seen = VisibilityCounts::from_counts(vec![0, 3, 11]);
    let mut out = [0.0; 4];
    seen.attention(&[0, 1, 2, 1], &mut out);
    assert_eq!(out, [1.0, 4.0, 12.0, 4.0].map(|w: f32| w / 21.0));
}

#[test]
fn counts_go_on_where_f32_stops_and_never_wrap() {
    let mut seen = VisibilityCounts::from_counts(vec![1 << 24, u64::MAX, u64::MAX]);
    seen.add(&[0, 0, 1]);
    seen.add_visible(&[true, false, true]);
    assert_eq!(seen.counts(), [(1 << 24) + 3, u64::MAX, u64::MAX]);
    let mut out = [0.0; 2];
    seen.attention(&[1, 2], &mut out);
    assert_eq!(out, [0.5; 2]);
}

#[test]
#[should_panic(expected = "vertex 3 of 3")]
fn an_index_out_of_range_panics() {
    VisibilityCounts::new(3).add(&[0, 3]);
}
