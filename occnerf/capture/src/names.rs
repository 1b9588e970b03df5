//! Natural order of frame names, and their numbers.

use std::cmp::Ordering;

/// A frame's name. Runs of digits are ordered as numbers, so that `10` comes after `9`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct FrameName<'a>(pub &'a str);

impl Ord for FrameName<'_> {
    fn cmp(&self, other: &Self) -> Ordering {
        let (mut a, mut b) = (self.0, other.0);
        while !a.is_empty() && !b.is_empty() {
            let ((x, after_x), (y, after_y)) = (split(a), split(b));
            let digits = x.starts_with(|c: char| c.is_ascii_digit()) && y.starts_with(|c: char| c.is_ascii_digit());
            let order = if digits {
                let (x, y) = (x.trim_start_matches('0'), y.trim_start_matches('0'));
                x.len().cmp(&y.len()).then_with(|| x.cmp(y))
            } else {
                x.cmp(y)
            };
            if order.is_ne() {
                return order;
            }
            (a, b) = (after_x, after_y);
        }
        // Equal up to leading zeros, or a prefix of the other.
        a.len().cmp(&b.len()).then_with(|| self.0.cmp(other.0))
    }
}

impl PartialOrd for FrameName<'_> {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

/// The first run of digits, or of anything else, and what follows.
fn split(name: &str) -> (&str, &str) {
    let digit = name.starts_with(|c: char| c.is_ascii_digit());
    name.split_at(name.find(|c: char| c.is_ascii_digit() != digit).unwrap_or(name.len()))
}

/// The number in a name: its last run of digits.
pub(super) fn number(name: &str) -> Option<usize> {
    let end = name.rfind(|c: char| c.is_ascii_digit())? + 1;
    let digits = name[..end].bytes().rev().take_while(u8::is_ascii_digit).count();
    name[end - digits..end].parse().ok()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn numbers_are_in_the_order_of_their_values() {
        let mut names =
            ["b2", "10", "frame_000010", "9", "b10", "1", "frame_9", "b1x", "", "b1", "01", "a_1_10", "a_1_9"];
        names.sort_by_key(|name| FrameName(name));
        let expected =
            ["", "01", "1", "9", "10", "a_1_9", "a_1_10", "b1", "b1x", "b2", "b10", "frame_9", "frame_000010"];
        assert_eq!(names, expected);
    }

    proptest! {
        #[test]
        fn the_order_is_total(a in "[a0-2é]{0,5}", b in "[a0-2é]{0,5}", c in "[a0-2é]{0,5}") {
            let (x, y, z) = (FrameName(&a), FrameName(&b), FrameName(&c));
            prop_assert_eq!(x.cmp(&y), y.cmp(&x).reverse());
            prop_assert_eq!(x.cmp(&y).is_eq(), a == b);
            prop_assert!(!(x <= y && y <= z) || x <= z);
        }
    }
}
