//! Every setting of a run, the named presets, and validation.

mod presets;
mod settings;
mod validate;

pub(crate) use self::settings::FALLOFF;
pub use self::settings::{
    Component, Config, DistanceKind, EncodingConfig, FieldConfig, LossConfig, Method, MotionConfig, MotionKind,
    OccludedRule, Preset, RateConfig, RegistrationConfig, SurfaceConfig,
};
pub use self::validate::ConfigError;
