//! What a configuration may ask for.

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

impl Config {
    /// Checks every value that would otherwise fail later and less clearly.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let whole: [(&'static str, usize, std::ops::RangeInclusive<usize>, &'static str); 10] = [
            ("patches", self.patches, 1..=1024, "expected 1 to 1024"),
            ("patch_size", self.patch_size as usize, 1..=256, "expected 1 to 256 pixels"),
            ("samples", self.samples, 1..=1024, "expected 1 to 1024"),
            ("field.width", self.field.width, 1..=1024, "expected 1 to 1024"),
            ("field.depth", self.field.depth, 1..=16, "expected 1 to 16"),
            ("registration.rounds", self.registration.rounds, 0..=100, "expected at most 100"),
            // At 128 the weights, their moments and their gradient take 1.3 GB.
            ("motion.resolution", self.motion.resolution, 2..=128, "expected 2 to 128"),
            ("surface.k", self.surface.k, 1..=32, "expected 1 to 32"),
            ("surface.coarse_levels", self.surface.coarse_levels, 0..=6, "expected 0 to 6"),
            ("steps", usize::try_from(self.steps).unwrap_or(usize::MAX), 0..=100_000_000, "expected at most 10^8"),
        ];
        for (key, value, range, expected) in whole {
            if !range.contains(&value) {
                return Err(ConfigError { key, value: value.to_string(), expected });
            }
        }
        // Products that decide about memory: 2²⁷ table entries are 2 GB with both moments; a live
        // sample takes 2 to 4 kB, and about a third live, so 2²³ samples are 6 to 12 GB.
        let table = (self.encoding.levels as u64).saturating_mul(self.encoding.features as u64);
        let table = table.saturating_mul(1u64.checked_shl(self.encoding.log2_table_size).unwrap_or(u64::MAX));
        if table > 1 << 27 {
            let expected = "levels · features · 2^log2_table_size may be at most 2^27";
            return Err(ConfigError { key: "encoding.log2_table_size", value: table.to_string(), expected });
        }
        let samples = self.patches * (self.patch_size as usize).pow(2) * self.samples;
        if samples > 1 << 23 {
            let expected = "patches · patch_size² · samples may be at most 2^23";
            return Err(ConfigError { key: "patches", value: samples.to_string(), expected });
        }
        if self.held_out == 1 {
            let expected = "expected 0 for none or at least 2: with 1 nothing is left to learn from";
            return Err(ConfigError { key: "held_out", value: self.held_out.to_string(), expected });
        }
        if self.motion.shell_interval > 0 && self.motion.kind != MotionKind::Surface {
            let (value, expected) =
                (self.motion.shell_interval.to_string(), "expected 0 unless motion.kind is surface");
            return Err(ConfigError { key: "motion.shell_interval", value, expected });
        }
        if self.field.prior_colors && self.motion.kind != MotionKind::Surface {
            let expected = "expected false unless motion.kind is surface";
            return Err(ConfigError { key: "field.prior_colors", value: "true".to_owned(), expected });
        }
        let transmittance = self.min_transmittance;
        if !(0.0..1.0).contains(&transmittance) {
            let expected = "expected at least 0 and below 1";
            return Err(ConfigError { key: "min_transmittance", value: transmittance.to_string(), expected });
        }
        if self.motion.margin > 0.3 {
            let (value, expected) = (self.motion.margin.to_string(), "expected at most 0.3 normalised metres");
            return Err(ConfigError { key: "motion.margin", value, expected });
        }
        let at_least_zero = "expected a finite number of at least 0";
        let above_zero = "expected a finite number above 0";
        let any = "expected a finite number";
        let real: [(&'static str, f32, f32, &'static str); 17] = [
            ("field.density_scale", self.field.density_scale, f32::MIN_POSITIVE, above_zero),
            ("field.density_bias", self.field.density_bias, f32::MIN, any),
            ("field.density_bias_outside", self.field.density_bias_outside, f32::MIN, any),
            ("encoding.distance_max", self.encoding.distance_max, f32::MIN_POSITIVE, above_zero),
            ("-encoding.distance_min", -self.encoding.distance_min, f32::MIN_POSITIVE, above_zero),
            ("motion.margin", self.motion.margin, f32::MIN_POSITIVE, above_zero),
            ("motion.depth", self.motion.depth, f32::MIN_POSITIVE, above_zero),
            ("loss.mse", self.loss.mse, 0.0, at_least_zero),
            ("loss.perceptual", self.loss.perceptual, 0.0, at_least_zero),
            ("loss.completeness", self.loss.completeness, 0.0, at_least_zero),
            ("rates.field", self.rates.field, 0.0, at_least_zero),
            ("rates.vertices", self.rates.vertices, 0.0, at_least_zero),
            ("rates.table", self.rates.table, 0.0, at_least_zero),
            ("rates.motion", self.rates.motion, 0.0, at_least_zero),
            ("rates.final_fraction", self.rates.final_fraction, f32::MIN_POSITIVE, above_zero),
            ("rates.beta_2", self.rates.beta_2, 0.0, at_least_zero),
            ("1 - rates.beta_2", 1.0 - self.rates.beta_2, f32::MIN_POSITIVE, above_zero),
        ];
        for (key, value, least, expected) in real {
            if !(value.is_finite() && value >= least) {
                return Err(ConfigError { key, value: value.to_string(), expected });
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::settings::{Method, Preset};

    #[test]
    fn a_bad_value_is_named_with_its_key() {
        let mut config = Config::preset(Preset::Fast, Method::Occnerf);
        config.rates.table = f32::NAN;
        assert!(config.validate().unwrap_err().to_string().contains("rates.table"));
        config = Config::preset(Preset::Fast, Method::Occnerf);
        config.encoding.log2_table_size = 40;
        assert!(config.validate().unwrap_err().to_string().contains("encoding.log2_table_size"));
        config = Config::preset(Preset::Fast, Method::Occnerf);
        config.motion.margin = 5.0;
        assert!(config.validate().unwrap_err().to_string().contains("motion.margin"));
        config = Config::preset(Preset::Fast, Method::Occnerf);
        config.samples = 0;
        assert!(config.validate().unwrap_err().to_string().contains("`samples` is 0"));
    }
}
