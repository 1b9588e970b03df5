//! The paper's simulated obstacle (§4, Datasets): a box in front of the camera that hides a
//! rectangle.

use std::ops::Range;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use capture::{Area, CaptureError, Frame};

/// A simulated obstacle in front of the training camera. The default is the paper's: fixed,
/// central, hiding half of the subject's pixels in the first 80 % of the frames, and as high as the
/// picture, as in the code published with it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Obstacle {
    /// Part of the subject's pixels in the occluded frames that is hidden, 0 (no obstacle) to 0.95;
    /// no more than the obstacle's rows have.
    pub fraction: f32,
    /// Part of the video, from its start, that is occluded, 0 to 1.
    pub share: f32,
    /// How far the obstacle's middle stands to the right of the subject's mean column in the
    /// obstacle's rows, in picture widths, −1 to 1.
    pub position: f32,
    /// How far it moves to the right, evenly over the occluded frames, in picture widths, −2 to 2.
    /// It is at `position` half-way through.
    pub travel: f32,
    /// Its height in picture heights, above 0 to 1; its middle is at the subject's mean row, or as
    /// near as the picture allows.
    pub height: f32,
}

/// Where a frame's subject is.
struct Subject {
    /// Pixels by column, of the rows looked at.
    columns: Vec<u32>,
    /// Pixels in other rows.
    elsewhere: u32,
}

impl Subject {
    fn count(mask: &[f32], width: u32, rows: &Range<u32>) -> Self {
        let mut found = Self { columns: vec![0; width as usize], elsewhere: 0 };
        for (row, pixels) in (0..).zip(mask.chunks_exact(width.max(1) as usize)) {
            let subject = pixels.iter().map(|&m| u32::from(m > 0.5));
            if rows.contains(&row) {
                found.columns.iter_mut().zip(subject).for_each(|(count, here)| *count += here);
            } else {
                found.elsewhere += subject.sum::<u32>();
            }
        }
        found
    }
}

impl Default for Obstacle {
    fn default() -> Self {
        Self { fraction: 0.5, share: 0.8, position: 0.0, travel: 0.0, height: 1.0 }
    }
}

impl Obstacle {
    pub(crate) fn check(&self) -> Result<(), CaptureError> {
        for (name, value, low, high) in [
            ("occlusion.fraction", self.fraction, 0.0, 0.95),
            ("occlusion.share", self.share, 0.0, 1.0),
            ("occlusion.position", self.position, -1.0, 1.0),
            ("occlusion.travel", self.travel, -2.0, 2.0),
            ("occlusion.height", self.height, f32::MIN_POSITIVE, 1.0),
        ] {
            if !(low..=high).contains(&value) {
                let least = if low == f32::MIN_POSITIVE { "above 0".to_owned() } else { low.to_string() };
                return Err(CaptureError::setting(name, format!("{least} to {high}"), value));
            }
        }
        Ok(())
    }

    /// The rows that it hides of `frames`, all of this size.
    fn rows(&self, frames: &[Frame], (width, height): (u32, u32)) -> Result<Range<u32>, CaptureError> {
        if self.height >= 1.0 {
            return Ok(0..height);
        }
        let sums = |frame: &Frame| -> Result<[u64; 2], CaptureError> {
            let pixels = frame.pixels()?;
            let counts = pixels
                .mask
                .chunks_exact(width.max(1) as usize)
                .map(|row| row.iter().filter(|m| **m > 0.5).count() as u64);
            Ok((0..)
                .zip(counts)
                .fold([0, 0], |[total, weighted], (row, count)| [total + count, weighted + row * count]))
        };
        let found: Vec<Result<[u64; 2], CaptureError>> = frames.par_iter().map(sums).collect();
        let (mut total, mut weighted) = (0, 0);
        for sums in found {
            let [count, rows] = sums?;
            (total, weighted) = (total + count, weighted + rows);
        }
        let mean = weighted as f64 / total.max(1) as f64 + 0.5;
        let rows = (f64::from(self.height) * f64::from(height)).round().clamp(1.0, f64::from(height)) as u32;
        let start = (mean - 0.5 * f64::from(rows)).round().clamp(0.0, f64::from(height - rows)) as u32;
        Ok(start..start + rows)
    }

    /// The columns that are hidden in each of the occluded frames.
    ///
    /// The obstacle has one width, such that the part of all subject pixels of the occluded frames
    /// that it hides is as near to `fraction` as whole columns come. Ranges are empty where nothing
    /// is hidden.
    fn columns(&self, subject: &[Subject]) -> Result<Vec<Range<u32>>, CaptureError> {
        let affected = subject.len();
        let w = subject.first().map_or(0, |first| first.columns.len() as i64);
        let last = affected.saturating_sub(1) as f64;
        let step = f64::from(self.travel) * w as f64 / last.max(1.0);
        // In frame i the obstacle is `shifts[i]` columns to the right of where it is half-way.
        let shifts: Vec<i64> = (0..affected).map(|i| ((i as f64 - 0.5 * last) * step).round() as i64).collect();
        let reach = shifts.iter().map(|s| s.abs()).max().unwrap_or(0) + w;
        // Subject pixels by column relative to the moving obstacle, from −reach on.
        let mut histogram = vec![0u64; (2 * reach + w) as usize];
        let (mut total, mut weighted) = (0u64, 0u64);
        for (subject, shift) in subject.iter().zip(&shifts) {
            for (column, &count) in subject.columns.iter().enumerate() {
                let count = u64::from(count);
                histogram[(column as i64 - shift + reach) as usize] += count;
                total += count;
                weighted += column as u64 * count;
            }
        }
        let mut hidden = vec![0..0; subject.len()];
        let all = total + subject.iter().map(|s| u64::from(s.elsewhere)).sum::<u64>();
        let wanted = f64::from(self.fraction) * all as f64;
        if wanted > total as f64 {
            let most = (100.0 * total as f64 / all as f64).floor() / 100.0;
            let expected =
                format!("at most {most}, the part of the subject in the rows of an obstacle of height {}", self.height);
            return Err(CaptureError::setting("occlusion.fraction", expected, self.fraction));
        }
        if total == 0 {
            return Ok(hidden);
        }
        // Mean of the subject's pixels, in pixels from the left edge.
        let mean = weighted as f64 / total as f64 + 0.5;
        let centre = mean + f64::from(self.position) * w as f64 + reach as f64;
        let window = grow(&histogram, centre, wanted);
        for (range, shift) in hidden.iter_mut().zip(&shifts) {
            let clip = |x: usize| (x as i64 - reach + shift).clamp(0, w) as u32;
            *range = clip(window.start)..clip(window.end);
        }
        Ok(hidden)
    }

    /// Hides what the obstacle covers in a video of equally large frames; returns what is hidden of
    /// each.
    ///
    /// # Errors
    /// A setting out of its range; pictures that cannot be read.
    pub fn hide(&self, frames: &mut [Frame]) -> Result<Vec<Area>, CaptureError> {
        let Some((width, height)) = frames.first().map(|f| (f.camera.width, f.camera.height)) else {
            return Ok(Vec::new());
        };
        self.check()?;
        let mut areas = vec![Area { columns: 0..0, rows: 0..height }; frames.len()];
        let affected = ((self.share * frames.len() as f32).round() as usize).min(frames.len());
        if self.fraction == 0.0 || affected == 0 {
            return Ok(areas);
        }
        let occluded = &frames[..affected];
        let rows = self.rows(occluded, (width, height))?;
        let subject = |frame: &Frame| Ok(Subject::count(&frame.pixels()?.mask, width, &rows));
        let counted: Vec<Result<Subject, CaptureError>> = occluded.par_iter().map(subject).collect();
        let columns = self.columns(&counted.into_iter().collect::<Result<Vec<_>, _>>()?)?;
        for (area, columns) in areas.iter_mut().zip(columns) {
            *area = Area { columns, rows: rows.clone() };
        }
        for (frame, area) in frames.iter_mut().zip(&areas).filter(|(_, area)| !area.is_empty()) {
            frame.source.hide(area.clone());
        }
        Ok(areas)
    }
}

/// The range around `centre` whose sum is nearest to `target`; of several, the narrowest.
fn grow(histogram: &[u64], centre: f64, target: f64) -> Range<usize> {
    let start = (centre.round().max(0.0) as usize).min(histogram.len());
    let (mut range, mut sum) = (start..start, 0u64);
    let (mut best, mut miss) = (range.clone(), target);
    while range.start > 0 || range.end < histogram.len() {
        // Grow on the side that keeps the middle nearest to the centre.
        let left_arm = centre - range.start as f64;
        let right_arm = range.end as f64 - centre;
        if range.end == histogram.len() || (range.start > 0 && left_arm <= right_arm) {
            range.start -= 1;
            sum += histogram[range.start];
        } else {
            sum += histogram[range.end];
            range.end += 1;
        }
        if (sum as f64 - target).abs() < miss {
            (best, miss) = (range.clone(), (sum as f64 - target).abs());
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn bar(width: usize, rows: usize, columns: Range<usize>) -> Vec<f32> {
        (0..width * rows).map(|i| f32::from(columns.contains(&(i % width)))).collect()
    }

    fn whole(mask: &[f32], width: u32) -> Subject {
        Subject::count(mask, width, &(0..u32::MAX))
    }

    fn always(fraction: f32) -> Obstacle {
        Obstacle { fraction, share: 1.0, ..Obstacle::default() }
    }

    #[test]
    fn half_of_a_bar_is_its_middle_half() {
        let mask = bar(12, 2, 2..10);
        assert_eq!(always(0.5).columns(&[whole(&mask, 12)]).unwrap()[0], 4..8);
        assert_eq!(always(0.25).columns(&[(); 2].map(|()| whole(&mask, 12))).unwrap(), [5..7, 5..7]);
        assert!(always(0.0).columns(&[whole(&mask, 12)]).unwrap()[0].is_empty());
    }

    #[test]
    fn an_empty_video_hides_nothing() {
        assert!(always(0.5).columns(&[whole(&[0.0; 8], 4)]).unwrap()[0].is_empty());
        assert!(always(0.5).columns(&[]).unwrap().is_empty());
        assert!(always(0.5).hide(&mut []).unwrap().is_empty());
    }

    #[test]
    fn a_subject_at_the_border_is_covered_from_there() {
        let mask = bar(10, 1, 0..4);
        assert_eq!(always(0.5).columns(&[whole(&mask, 10)]).unwrap()[0], 1..3);
        let columns = always(0.95).columns(&[whole(&mask, 10)]).unwrap();
        assert!(columns[0].start == 0 && columns[0].end >= 4);
    }

    #[test]
    fn position_moves_the_middle() {
        let mask = bar(40, 3, 10..30);
        assert_eq!(always(0.5).columns(&[whole(&mask, 40)]).unwrap()[0], 15..25);
        assert_eq!(Obstacle { position: 0.125, ..always(0.5) }.columns(&[whole(&mask, 40)]).unwrap()[0], 20..30);
        assert_eq!(Obstacle { position: -0.125, ..always(0.5) }.columns(&[whole(&mask, 40)]).unwrap()[0], 10..20);
    }

    #[test]
    fn a_moving_obstacle_travels_evenly_and_is_central_half_way() {
        let mask = bar(40, 3, 10..30);
        let moving = Obstacle { travel: 0.2, ..always(0.5) };
        let columns = moving.columns(&[(); 5].map(|()| whole(&mask, 40))).unwrap();
        let starts: Vec<u32> = columns.iter().map(|c| c.start).collect();
        assert_eq!(starts.windows(2).map(|s| s[1] - s[0]).collect::<Vec<_>>(), [2; 4]);
        assert_eq!(columns[2], 15..25);
        assert!(columns.iter().all(|c| c.len() == 10));
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(128))]

        #[test]
        fn the_hidden_part_is_the_fraction_to_within_a_column(
            bits in prop::collection::vec(prop::bool::weighted(0.3), 24 * 6 * 4),
            fraction in 0.0f32..0.75, travel in -0.125f32..0.125,
        ) {
            let masks: Vec<Vec<f32>> = bits.chunks(24 * 6).map(|b| b.iter().map(|&b| f32::from(b)).collect()).collect();
            let counts: Vec<Subject> = masks.iter().map(|mask| whole(mask, 24)).collect();
            let columns = Obstacle { travel, ..always(fraction) }.columns(&counts).unwrap();
            let subject = |i: usize, columns: &Range<u32>| masks[i].iter().enumerate()
                .filter(|(p, m)| **m > 0.5 && columns.contains(&(*p as u32 % 24))).count() as f32;
            let total: f32 = (0..4).map(|i| subject(i, &(0..24))).sum();
            let hidden: f32 = (0..4).map(|i| subject(i, &columns[i])).sum();
            // Half a column of four frames of six rows.
            prop_assert!((hidden - fraction * total).abs() <= 12.0, "{hidden} of {total}");
        }
    }
}
