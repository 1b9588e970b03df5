//! Every setting of a run, the named presets, and validation.

mod presets;
mod settings;
mod validate;

pub use self::settings::{
    Component, Config, DistanceKind, EncodingConfig, FALLOFF, FieldConfig, LossConfig, Method, MotionConfig,
    MotionKind, OccludedRule, Preset, RateConfig, RegistrationConfig, SurfaceConfig,
};
pub use self::validate::ConfigError;
