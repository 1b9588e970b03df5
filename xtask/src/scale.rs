//! An axis of numbers, linear or logarithmic.

use std::ops::Range;

/// Margin of an axis relative to the range of its values.
const ROOM: f64 = 0.06;
/// Largest shown value.
const LARGEST: f64 = 1e100;
/// Most decades with a tick each.
const MOST_DECADES: f64 = 12.0;

/// Axis transform.
#[derive(Clone, Debug, PartialEq)]
pub enum Scale {
    /// Equal steps are equally long.
    Linear(Range<f64>),
    /// Equal factors are equally long.
    Logarithmic(Range<f64>),
}

impl Scale {
    /// Scale over the range of `values`, of those up to 1e100 in magnitude and, on a logarithmic
    /// scale, above 1e-100.
    pub fn around(values: impl Iterator<Item = f64>, logarithmic: bool) -> Self {
        let values = values.filter(|v| fits(*v, logarithmic));
        let place = |v: f64| if logarithmic { v.ln() } else { v };
        let (low, high) = values.map(place).fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| (a.min(v), b.max(v)));
        let (low, high) = if low <= high { (low, high) } else { (0.0, 1.0) };
        // e^0.24 = 1.27 is above the ratio of any two ticks, so that an axis of one value has one.
        let room = (ROOM * (high - low)).max(if logarithmic { 0.12 } else { 1e-3 + 1e-3 * high.abs() });
        let (low, high) = (low - room, high + room);
        if logarithmic { Self::Logarithmic(low.exp()..high.exp()) } else { Self::Linear(low..high) }
    }

    /// Whether a value is shown.
    pub fn shows(&self, value: f64) -> bool {
        fits(value, matches!(self, Self::Logarithmic(_)))
    }

    /// 0 at the low end, 1 at the high end.
    pub fn share(&self, value: f64) -> f64 {
        match self {
            Self::Linear(r) => (value - r.start) / (r.end - r.start),
            Self::Logarithmic(r) => (value / r.start).ln() / (r.end / r.start).ln(),
        }
    }

    /// Tick values.
    pub fn ticks(&self) -> Vec<f64> {
        match self {
            Self::Linear(r) => {
                let rough = (r.end - r.start) / 6.0;
                let power = 10f64.powf(rough.log10().floor());
                let step = [1.0, 2.0, 5.0, 10.0].map(|m| m * power).into_iter().find(|s| *s >= rough);
                let step = step.unwrap_or(rough);
                let (first, last) = ((r.start / step).ceil() as i64, (r.end / step).floor() as i64);
                (first..=last).map(|i| i as f64 * step).collect()
            }
            Self::Logarithmic(r) => {
                let decades = (r.end / r.start).log10();
                let digits: &[f64] = match decades {
                    d if d < 0.5 => &[1.0, 1.2, 1.4, 1.6, 1.8, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0, 6.0, 7.0, 8.0, 9.0],
                    d if d < 1.0 => &[1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0],
                    d if d < 3.0 => &[1.0, 2.0, 5.0],
                    _ => &[1.0],
                };
                let powers = (r.start.log10().floor() as i32)..=(r.end.log10().ceil() as i32);
                let powers = powers.step_by((decades / MOST_DECADES).ceil().max(1.0) as usize);
                let all = powers.flat_map(|p| digits.iter().map(move |d| d * 10f64.powi(p)));
                all.filter(|v| r.contains(v)).collect()
            }
        }
    }
}

/// Whether a value is shown; sums and powers of shown values are finite.
fn fits(value: f64, logarithmic: bool) -> bool {
    value.abs() <= LARGEST && (!logarithmic || value >= 1.0 / LARGEST)
}

/// Four digits at most, no zeros at the end.
pub fn number(value: f64) -> String {
    if value == 0.0 || !value.is_finite() {
        return value.abs().to_string();
    }
    if !(1e-9..1e15).contains(&value.abs()) {
        return format!("{value:.3e}");
    }
    let digits = (3 - value.abs().log10().floor() as i32).clamp(0, 12) as usize;
    let text = format!("{value:.digits$}");
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_owned() } else { text }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn numbers_are_short() {
        let written = [0.0, 0.1 + 0.2, 17.5, 1200.0, 1e-5, -2.25].map(number);
        assert_eq!(written, ["0", "0.3", "17.5", "1200", "0.00001", "-2.25"]);
    }

    #[test]
    fn losses_of_a_training_that_blew_up_are_drawn_in_no_time() {
        let start = std::time::Instant::now();
        let far: [&[f64]; 7] = [
            &[1e308, 1e-300, 1.0],
            &[1e99, 1e-99],
            &[f64::MAX, f64::MIN],
            &[5e-324],
            &[1e100, -1e100],
            &[],
            &[f64::NAN, -1.0, 2.22e5],
        ];
        for values in far {
            for logarithmic in [false, true] {
                let scale = Scale::around(values.iter().copied(), logarithmic);
                let ticks = scale.ticks();
                assert!((1..=20).contains(&ticks.len()), "{values:?}: {ticks:?}");
                let places = values.iter().filter(|v| scale.shows(**v)).map(|v| scale.share(*v));
                places.for_each(|place| assert!((0.0..=1.0).contains(&place), "{values:?}: {place}"));
                assert!(ticks.iter().all(|tick| number(*tick).len() < 20));
            }
        }
        assert!(start.elapsed().as_secs() < 1);
    }

    proptest! {
        #[test]
        fn an_axis_shows_every_value_and_has_a_few_ticks(
            values in prop::collection::vec(0.001f64..1e6, 1..20), logarithmic: bool,
        ) {
            let scale = Scale::around(values.iter().copied(), logarithmic);
            for value in values {
                prop_assert!((0.0..=1.0).contains(&scale.share(value)));
            }
            let ticks = scale.ticks();
            prop_assert!((1..=20).contains(&ticks.len()), "{:?}: {:?}", scale, ticks);
            prop_assert!(ticks.iter().all(|t| (-1e-9..=1.0 + 1e-9).contains(&scale.share(*t))));
        }
    }
}
