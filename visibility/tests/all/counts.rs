//! Counts and attention.

use visibility::VisibilityCounts;

#[test]
fn counts_go_on_where_f32_stops_and_never_wrap() {
    let mut seen = VisibilityCounts::from_counts(vec![1 << 24, u64::MAX, u64::MAX, 3]);
    seen.add(&[0, 0, 1]);
    seen.add_visible(&[true, false, true, false]);
    assert_eq!(seen.counts(), [(1 << 24) + 3, u64::MAX, u64::MAX, 3]);
    let mut out = [0.0; 2];
    seen.attention(&[1, 2], &mut out);
    assert_eq!(out, [0.5; 2]);
    seen.attention(&[3, 3], &mut out);
    assert_eq!(out, [0.5; 2]);
}

#[test]
#[should_panic(expected = "vertex 3 of 3")]
fn an_index_out_of_range_panics() {
    VisibilityCounts::new(3).add(&[0, 3]);
}
