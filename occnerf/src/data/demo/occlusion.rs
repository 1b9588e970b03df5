//! The paper's simulated obstacle (§4, Datasets): a box in front of the camera that hides a fixed rectangle in the
//! middle of the picture.

use std::ops::Range;

/// Columns that an obstacle as high as the picture must cover to hide `fraction` of all subject pixels of `masks`,
/// each (H, `width`): centred on the subject's mean column, and as near to the fraction as whole columns come.
/// Empty where no mask has a subject pixel.
pub(super) fn hidden_columns(masks: &[&[f32]], width: u32, fraction: f32) -> Range<u32> {
    let mut histogram = vec![0u64; width as usize];
    for mask in masks {
        for (i, _) in mask.iter().enumerate().filter(|(_, m)| **m > 0.5) {
            histogram[i % width as usize] += 1;
        }
    }
    let total: u64 = histogram.iter().sum();
    if total == 0 {
        return 0..0;
    }
    let weighted: u64 = histogram.iter().enumerate().map(|(x, n)| x as u64 * n).sum();
    // Centre of the subject's pixels, in pixels from the left edge.
    let centre = weighted as f64 / total as f64 + 0.5;
    let target = f64::from(fraction) * total as f64;
    let miss = |range: &Range<u32>| {
        let hidden: u64 = histogram[range.start as usize..range.end as usize].iter().sum();
        (hidden as f64 - target).abs()
    };
    let start = (centre.round() as u32).min(width);
    let mut best = start..start;
    let mut range = best.clone();
    while range.start > 0 || range.end < width {
        // Grow on the side that keeps the middle nearest to the centre.
        let left_arm = centre - f64::from(range.start);
        let right_arm = f64::from(range.end) - centre;
        if range.end == width || (range.start > 0 && left_arm <= right_arm) {
            range.start -= 1;
        } else {
            range.end += 1;
        }
        if miss(&range) < miss(&best) {
            best = range.clone();
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn half_of_a_bar_is_its_middle_half() {
        // 2 rows of 12 columns, subject on columns 2..10.
        let mask: Vec<f32> = (0..24).map(|i| f32::from((2..10).contains(&(i % 12)))).collect();
        assert_eq!(hidden_columns(&[&mask], 12, 0.5), 4..8);
        assert_eq!(hidden_columns(&[&mask, &mask], 12, 0.25), 5..7);
        assert_eq!(hidden_columns(&[&mask], 12, 0.0).len(), 0);
    }

    #[test]
    fn an_empty_video_hides_nothing() {
        assert!(hidden_columns(&[&[0.0; 8]], 4, 0.5).is_empty());
        assert!(hidden_columns(&[], 4, 0.5).is_empty());
    }

    #[test]
    fn a_subject_at_the_border_is_covered_from_there() {
        let mask: Vec<f32> = (0..10).map(|i| f32::from(i < 4)).collect();
        assert_eq!(hidden_columns(&[&mask], 10, 0.5), 1..3);
        let columns = hidden_columns(&[&mask], 10, 0.95);
        assert!(columns.start == 0 && columns.end >= 4);
    }
}
