//! Joins files and fits with the frames of a video: by name, else by number, else in order.

use std::collections::BTreeSet;

use super::video::Video;
use crate::names::number;

/// The frames of a list of entries.
#[derive(Debug, PartialEq)]
pub(super) struct Joined {
    /// The frame of each entry; `None` where its picture is absent.
    pub at: Vec<Option<usize>>,
    /// The correspondence, where it is not by name.
    pub note: Option<String>,
}

/// Why entries have no frames.
#[derive(Debug, PartialEq)]
pub(super) enum Disjoint {
    /// Two entries have this number.
    Twice(usize),
    /// No name or number of an entry belongs to a frame, and their count is another.
    Apart,
}

/// The frames of named entries, sorted in the natural order of their names.
///
/// Names alone do not decide: of a video whose pictures are counted from 1, masks that a tool
/// counts from 0 have the names of their neighbours.
pub(super) fn by_name(video: &Video, names: &[&str]) -> Result<Joined, Disjoint> {
    let at: Vec<Option<usize>> = names.iter().map(|name| video.index(name)).collect();
    let matched = |at: &[Option<usize>]| at.iter().flatten().count();
    let named = matched(&at);
    let by_name = |at| Ok(Joined { at, note: None });
    if named == names.len() {
        return by_name(at);
    }
    let is_named = 2 * named >= names.len().min(video.names.len());
    let in_order = |why: &str| {
        if names.len() != video.names.len() {
            return Err(Disjoint::Apart);
        }
        let note = format!("joined in order, `{}` with picture `{}`{why}", names[0], video.names[0]);
        Ok(Joined { at: (0..names.len()).map(Some).collect(), note: Some(note) })
    };
    let numbers: Option<Vec<usize>> = names.iter().map(|name| number(name)).collect();
    let Some((numbers, frames)) = numbers.zip(video.numbers()) else {
        return if is_named { by_name(at) } else { in_order(": not all have numbers") };
    };
    if let Some(pair) = numbers.windows(2).find(|pair| pair[0] >= pair[1]) {
        return Err(Disjoint::Twice(pair[1]));
    }
    let consecutive = |numbers: &[usize]| numbers.windows(2).all(|pair| pair[1] == pair[0] + 1);
    let begins_alike = numbers[0] == frames[0];
    if numbers.len() == frames.len() && consecutive(&numbers) && !(is_named && begins_alike) {
        return in_order(if consecutive(&frames) { "" } else { ": their numbers have no gaps, the pictures' have" });
    }
    let same_width = names[0].len() == video.names[0].len();
    let offset = offset(&frames, &numbers, same_width).ok_or(Disjoint::Apart)?;
    let numbered: Vec<Option<usize>> = numbers.iter().map(|&n| place(&frames, n, offset)).collect();
    // Both begin and end together under another offset.
    let is_shifted = !begins_alike && numbers[0].abs_diff(frames[0]) == last_difference(&numbers, &frames);
    if is_named && (named > matched(&numbered) || (named == matched(&numbered) && !is_shifted)) {
        return by_name(at);
    }
    let first = numbered.iter().position(Option::is_some).unwrap_or(0);
    let frame = numbered[first].map_or("", |frame| &video.names[frame]);
    let note = format!("joined by number, `{}` with picture `{frame}`", names[first]);
    Ok(Joined { at: numbered, note: Some(note) })
}

/// The distance of the last of two lists of numbers.
fn last_difference(a: &[usize], b: &[usize]) -> usize {
    a.last().zip(b.last()).map_or(0, |(a, b)| a.abs_diff(*b))
}

/// The frames of indices that an estimator counted from 0, given in order.
pub(super) fn by_index(video: &Video, indices: &BTreeSet<usize>) -> Option<Joined> {
    let last = *indices.last()?;
    let numbers = video.numbers();
    let gaps = video.gaps();
    let count = video.names.len();
    // Some pictures of a whole video were lost, rather than every n-th one kept.
    let span = numbers.as_ref().map_or(count, |numbers| numbers[count - 1] - numbers[0] + 1);
    let is_lost = span > count && 10 * (span - count) <= span && last + 1 != count;
    if last < count && !is_lost {
        let note = (!gaps.is_empty()).then(|| {
            format!("frames counted in the order of the pictures, whose numbers have gaps ({gaps}): is it of these pictures?")
        });
        return Some(Joined { at: indices.iter().copied().map(Some).collect(), note });
    }
    let (frames, indices) = (numbers?, indices.iter().copied().collect::<Vec<_>>());
    let offset = offset(&frames, &indices, false)?;
    let at: Vec<Option<usize>> = indices.iter().map(|&n| place(&frames, n, offset)).collect();
    let matched = at.iter().flatten().count();
    let note = format!("joined by number, frame 0 with number {offset}: pictures are missing");
    (2 * matched >= indices.len()).then_some(Joined { at, note: Some(note) })
}

fn place(frames: &[usize], number: usize, offset: i64) -> Option<usize> {
    let wanted = usize::try_from(i64::try_from(number).ok()?.checked_add(offset)?).ok()?;
    frames.binary_search(&wanted).ok()
}

/// The difference of a frame's number and an entry's under which most have a partner. Of equals:
/// the one under which both begin and end together, then the same numbers where names look alike,
/// then a count from 0 beside frames counted from 1.
fn offset(frames: &[usize], numbers: &[usize], same_width: bool) -> Option<i64> {
    let signed = |n: &usize| i64::try_from(*n).ok();
    let (first, last) = (signed(frames.first()?)?, signed(frames.last()?)?);
    let mut candidates = if same_width || first == 0 { vec![0, 1] } else { vec![1, 0] };
    if numbers.first() == Some(&0) {
        candidates.push(first);
    }
    let ends = [first - signed(numbers.first()?)?, last - signed(numbers.last()?)?];
    if ends[0] == ends[1] {
        candidates.insert(0, ends[0]);
    } else if numbers.len() >= frames.len() {
        candidates.extend(ends);
    }
    let matches = |offset: i64| numbers.iter().filter(|&&n| place(frames, n, offset).is_some()).count();
    let most = candidates.iter().map(|&offset| matches(offset)).max().filter(|most| *most > 0)?;
    candidates.into_iter().find(|&offset| matches(offset) == most)
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use proptest::prelude::*;

    use super::*;

    fn video(names: Vec<String>) -> Video {
        Video { paths: vec![PathBuf::new(); names.len()], names, size: (4, 2) }
    }

    proptest! {
        /// Whatever is missing of pictures and masks of one video, partners show the same instant.
        #[test]
        fn partners_are_of_one_instant(
            count in 8usize..40,
            base in 0usize..2,
            mask_base in 0usize..2,
            lost_frame in 1usize..7,
            lost_mask in prop::option::of(1usize..7),
            like in any::<bool>(),
        ) {
            let video = video((0..count).filter(|i| *i != lost_frame).map(|i| format!("{:06}", i + base)).collect());
            let kept: Vec<usize> = (0..count).filter(|i| Some(*i) != lost_mask).collect();
            // Named alike, or as another tool does; counted as the frames are, or not.
            let name = |i: &usize| if like { format!("{:06}", i + mask_base) } else { format!("m{:04}", i + mask_base) };
            let names: Vec<String> = kept.iter().map(name).collect();
            let names: Vec<&str> = names.iter().map(String::as_str).collect();
            let joined = by_name(&video, &names).unwrap();
            prop_assert_eq!(joined.note.is_none(), like && base == mask_base);
            for (i, at) in kept.iter().zip(&joined.at) {
                let expected = video.names.iter().position(|name| number(name) == Some(i + base));
                prop_assert_eq!(*at, expected, "instant {} of {:?}", i, joined.note);
            }
            // A fit of the whole video.
            let joined = by_index(&video, &(0..count).collect()).unwrap();
            for (i, at) in joined.at.iter().enumerate() {
                prop_assert_eq!(*at, video.names.iter().position(|name| number(name) == Some(i + base)));
            }
            prop_assert!(joined.note.is_some());
        }

        #[test]
        fn the_number_of_a_name_is_its_last(prefix in "[a-zé_]{0,4}", n in 0usize..100_000, suffix in "[a-zé_]{0,4}") {
            let name = format!("{prefix}{n:05}{suffix}");
            prop_assert_eq!(number(&name), Some(n));
            prop_assert_eq!(number(&format!("7_{name}")), Some(n));
            prop_assert_eq!(number(&prefix), None);
        }
    }

    #[test]
    fn a_mask_that_two_files_claim_or_no_frame_has_is_refused() {
        let frames = video((1..=4).map(|i| format!("{i:06}")).collect());
        assert_eq!(by_name(&frames, &["a_01", "b_01"]), Err(Disjoint::Twice(1)));
        assert_eq!(by_name(&frames, &["00007"]), Err(Disjoint::Apart));
        assert_eq!(by_name(&frames, &["p", "q"]), Err(Disjoint::Apart));
        assert_eq!(by_name(&frames, &["p", "q", "r", "s"]).unwrap().at, [Some(0), Some(1), Some(2), Some(3)]);
        assert_eq!(by_index(&frames, &(0..20).collect()), None);
    }
}
