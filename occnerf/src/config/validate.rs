//! Ranges of the settings.

use std::ops::RangeInclusive;

use crate::config::settings::{Config, MotionKind};

/// A configuration that cannot be run: the key and why.
#[derive(Debug, thiserror::Error, PartialEq)]
#[error("config: `{key}` is {value}: {expected}")]
pub struct ConfigError {
    /// Dotted name of the field.
    pub key: &'static str,
    /// Value that was given.
    pub value: String,
    /// Values that are allowed.
    pub expected: &'static str,
}

fn check(holds: bool, key: &'static str, value: impl ToString, expected: &'static str) -> Result<(), ConfigError> {
    if holds { Ok(()) } else { Err(ConfigError { key, value: value.to_string(), expected }) }
}

impl Config {
    /// Checks every value that would otherwise fail later and less clearly.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let Self { field, encoding, surface, motion, loss, rates, .. } = self;
        let steps = usize::try_from(self.steps).unwrap_or(usize::MAX);
        let whole: [(&str, usize, RangeInclusive<usize>, &str); 10] = [
            ("patches", self.patches, 1..=1024, "expected 1 to 1024"),
            ("patch_size", self.patch_size as usize, 1..=256, "expected 1 to 256 pixels"),
            ("samples", self.samples, 1..=1024, "expected 1 to 1024"),
            ("field.width", field.width, 1..=1024, "expected 1 to 1024"),
            ("field.depth", field.depth, 1..=16, "expected 1 to 16"),
            ("registration.rounds", self.registration.rounds, 0..=100, "expected at most 100"),
            // At 128 the weights, their moments and their gradient take 1.3 GB.
            ("motion.resolution", motion.resolution, 2..=128, "expected 2 to 128"),
            ("surface.k", surface.k, 1..=32, "expected 1 to 32"),
            ("surface.coarse_levels", surface.coarse_levels, 0..=6, "expected 0 to 6"),
            ("steps", steps, 0..=100_000_000, "expected at most 10^8"),
        ];
        for (key, value, range, expected) in whole {
            check(range.contains(&value), key, value, expected)?;
        }
        // Products that decide about memory: 2²⁷ table entries are 2 GB with both moments; a live
        // sample takes 2 to 4 kB, and about a third live, so 2²³ samples are 6 to 12 GB.
        let rows = 1u64.checked_shl(encoding.log2_table_size).unwrap_or(u64::MAX);
        let table = (encoding.levels as u64).saturating_mul(encoding.features as u64).saturating_mul(rows);
        let expected = "levels · features · 2^log2_table_size may be at most 2^27";
        check(table <= 1 << 27, "encoding.log2_table_size", table, expected)?;
        let samples = self.patches * (self.patch_size as usize).pow(2) * self.samples;
        check(samples <= 1 << 23, "patches", samples, "patches · patch_size² · samples may be at most 2^23")?;
        let expected = "expected 0 for none or at least 2: with 1 nothing is left to learn from";
        check(self.held_out != 1, "held_out", self.held_out, expected)?;
        let (surface, interval) = (motion.kind == MotionKind::Surface, motion.shell_interval);
        let expected = "expected 0 unless motion.kind is surface";
        check(surface || interval == 0, "motion.shell_interval", interval, expected)?;
        let expected = "expected false unless motion.kind is surface";
        check(surface || !field.prior_colors, "field.prior_colors", true, expected)?;
        let transmittance = self.min_transmittance;
        let expected = "expected at least 0 and below 1";
        check((0.0..1.0).contains(&transmittance), "min_transmittance", transmittance, expected)?;
        let at_most = "expected at most 0.3 normalised metres";
        check(motion.margin <= 0.3, "motion.margin", motion.margin, at_most)?;
        let at_least_zero = "expected a finite number of at least 0";
        let above_zero = "expected a finite number above 0";
        let real = [
            ("field.density_scale", field.density_scale, f32::MIN_POSITIVE, above_zero),
            ("field.density_bias", field.density_bias, f32::MIN, "expected a finite number"),
            ("field.density_bias_outside", field.density_bias_outside, f32::MIN, "expected a finite number"),
            ("encoding.distance_max", encoding.distance_max, f32::MIN_POSITIVE, above_zero),
            ("-encoding.distance_min", -encoding.distance_min, f32::MIN_POSITIVE, above_zero),
            ("motion.margin", motion.margin, f32::MIN_POSITIVE, above_zero),
            ("motion.depth", motion.depth, f32::MIN_POSITIVE, above_zero),
            ("loss.mse", loss.mse, 0.0, at_least_zero),
            ("loss.perceptual", loss.perceptual, 0.0, at_least_zero),
            ("loss.completeness", loss.completeness, 0.0, at_least_zero),
            ("rates.field", rates.field, 0.0, at_least_zero),
            ("rates.vertices", rates.vertices, 0.0, at_least_zero),
            ("rates.table", rates.table, 0.0, at_least_zero),
            ("rates.motion", rates.motion, 0.0, at_least_zero),
            ("rates.final_fraction", rates.final_fraction, f32::MIN_POSITIVE, above_zero),
            ("rates.beta_2", rates.beta_2, 0.0, at_least_zero),
            ("1 - rates.beta_2", 1.0 - rates.beta_2, f32::MIN_POSITIVE, above_zero),
        ];
        for (key, value, least, expected) in real {
            check(value.is_finite() && value >= least, key, value, expected)?;
        }
        Ok(())
    }
}
