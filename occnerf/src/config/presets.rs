//! The named settings, every value in one place.

use crate::config::settings::{
    Config, DistanceKind, EncodingConfig, FieldConfig, LossConfig, Method, MotionConfig, MotionKind, OccludedRule,
    Preset, RateConfig, RegistrationConfig, SurfaceConfig, VisibilityKind,
};

impl Config {
    /// The defaults of a preset for a method.
    pub fn preset(preset: Preset, method: Method) -> Self {
        let mut config = match preset {
            Preset::Paper => paper(),
            Preset::Balanced => balanced(),
            Preset::Fast => fast(),
        };
        config.method = method;
        if method != Method::Occnerf {
            config.surface.surface_term = false;
            config.surface.attention = false;
            config.loss.completeness = 0.0;
            // A field of x̂ alone does not know how far the prior's surface is.
            config.field.density_bias_outside = config.field.density_bias;
            config.field.prior_colors = false;
        }
        if method == Method::Humannerf {
            // Without a hash grid the perceptron has to hold the whole person.
            (config.field.width, config.field.depth) = match preset {
                Preset::Paper => (256, 8),
                Preset::Fast | Preset::Balanced => (128, 4),
            };
            if matches!(preset, Preset::Fast | Preset::Balanced) {
                // The higher rate was chosen for a small F behind a hash grid.
                config.rates.field = 2e-3;
            }
        }
        config
    }
}

/// 2⁻²⁵: what remains behind it is lost when it is added to an f32 near 1.
const NOTHING: f32 = 1.0 / (1 << 25) as f32;

/// The paper's setting, which leaves the size of F open.
fn paper() -> Config {
    Config {
        preset: Preset::Paper,
        method: Method::Occnerf,
        occluded: OccludedRule::Unknown,
        seed: 1,
        steps: 10_000,
        patches: 6,
        patch_size: 32,
        samples: 128,
        min_transmittance: NOTHING,
        field: FieldConfig {
            width: 64,
            depth: 2,
            density_scale: 25.0,
            density_bias: 2.0,
            density_bias_outside: -2.0,
            prior_colors: false,
            prior_light: false,
        },
        encoding: EncodingConfig {
            levels: 16,
            features: 2,
            log2_table_size: 19,
            n_min: 16,
            n_max: 2048,
            distance_min: -0.2,
            distance_max: 0.3,
        },
        surface: SurfaceConfig {
            k: 5,
            coarse_levels: 3,
            distance: DistanceKind::Blended,
            surface_term: true,
            attention: true,
            visibility: VisibilityKind::Counted,
        },
        registration: RegistrationConfig { rounds: 0 },
        motion: MotionConfig {
            kind: MotionKind::Volume,
            margin: 0.04,
            falloff: 0.02,
            depth: 0.3,
            correction_spacing: 0,
            shell_interval: 0,
        },
        loss: LossConfig {
            mse: 0.2,
            perceptual: 1.0,
            perceptual_weights: String::new(),
            completeness: 10.0,
            beta: 10.0,
        },
        rates: RateConfig {
            field: 5e-4,
            vertices: 1e-4,
            table: 5e-5,
            motion: 5e-5,
            pose: 0.0,
            final_fraction: 1.0,
            beta_2: 0.999,
        },
    }
}

/// The default.
fn balanced() -> Config {
    Config {
        preset: Preset::Balanced,
        steps: 800,
        patches: 4,
        samples: 48,
        min_transmittance: 0.01,
        field: FieldConfig { width: 64, depth: 2, prior_colors: true, prior_light: true, ..paper().field },
        encoding: EncodingConfig {
            levels: 10,
            features: 2,
            log2_table_size: 16,
            n_min: 12,
            n_max: 384,
            distance_min: -0.4,
            distance_max: 0.6,
        },
        surface: SurfaceConfig { distance: DistanceKind::Exact, ..paper().surface },
        loss: LossConfig { mse: 5.0, ..paper().loss },
        registration: RegistrationConfig { rounds: 12 },
        motion: MotionConfig {
            kind: MotionKind::Surface,
            margin: 0.04,
            falloff: 0.02,
            depth: 0.04,
            correction_spacing: 0,
            shell_interval: 32,
        },
        rates: RateConfig {
            field: 6e-3,
            vertices: 1e-4,
            table: 3e-2,
            motion: 1e-3,
            pose: 0.0,
            final_fraction: 0.05,
            beta_2: 0.99,
        },
        ..paper()
    }
}

/// A first look: half as long.
fn fast() -> Config {
    Config { preset: Preset::Fast, steps: 400, ..balanced() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_preset_of_every_method_is_valid_and_survives_toml() {
        for preset in [Preset::Fast, Preset::Balanced, Preset::Paper] {
            for method in [Method::Prior, Method::Humannerf, Method::HashPoint, Method::Occnerf] {
                let config = Config::preset(preset, method);
                config.validate().unwrap();
                let text = toml::to_string(&config).unwrap();
                assert_eq!(toml::from_str::<Config>(&text).unwrap(), config);
            }
        }
    }
}
