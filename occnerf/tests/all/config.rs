//! Configurations from text: errors name the key and the value.

use crate::common;

use occnerf::{Component, Config, Error, Method, Preset, Scene, Trainer};

fn text() -> String {
    toml::to_string(&Config::preset(Preset::Fast, Method::Occnerf)).unwrap()
}

/// The default text with the first line of `key` (or of a table, with its brackets) replaced.
fn edited(key: &str, by: &str) -> String {
    common::replace_line(&text(), key, by)
}

#[test]
fn text_that_does_not_fit_is_refused_with_the_key_or_value_in_the_message() {
    for (key, by, hint) in [
        ("samples", "samples = \"many\"", "samples"),
        ("samples", "samples = -3", "samples"),
        ("samples", "samples = 4.5", "samples"),
        ("samples", "sample = 48", "sample"),
        ("samples", "", "samples"),
        ("samples", "samples = 48\nsamples = 48", "samples"),
        ("method", "method = \"nerf\"", "nerf"),
        ("preset", "preset = \"quick\"", "quick"),
        ("occluded", "occluded = \"ignored\"", "ignored"),
        ("kind", "kind = \"flow\"", "flow"),
        ("margin", "margin = 0.04\nfalloff = 0.02", "falloff"),
        ("[loss]", "[lose]", "lose"),
        ("seed", "seed = ", "seed"),
    ] {
        let message = toml::from_str::<Config>(&edited(key, by)).unwrap_err().to_string();
        assert!(message.contains(hint), "{by}: {message}");
    }
}

#[test]
fn values_out_of_range_are_refused_before_anything_is_built() {
    for (setting, by, key) in [
        ("samples", "samples = 0", "samples"),
        ("samples", "samples = 1000000", "samples"),
        ("patches", "patches = 0", "patches"),
        ("held_out", "held_out = 1", "held_out"),
        ("patch_size", "patch_size = 0", "patch_size"),
        ("width", "width = 0", "field.width"),
        ("depth", "depth = 0", "field.depth"),
        ("k", "k = 0", "surface.k"),
        ("coarse_levels", "coarse_levels = 40", "surface.coarse_levels"),
        ("mse", "mse = -1.0", "loss.mse"),
        ("mse", "mse = nan", "loss.mse"),
        ("perceptual", "perceptual = inf", "loss.perceptual"),
        ("density_scale", "density_scale = 0.0", "field.density_scale"),
        ("table", "table = nan", "rates.table"),
        ("log2_table_size", "log2_table_size = 40", "encoding.log2_table_size"),
        ("margin", "margin = 5.0", "motion.margin"),
    ] {
        let config: Config = toml::from_str(&edited(setting, by)).unwrap();
        let error = config.validate().unwrap_err();
        assert_eq!(error.key, key, "{by}");
        let message = error.to_string();
        assert!(message.contains(key) && (message.contains("expected") || message.contains("at most")), "{message}");
        let Err(Error::Config(of_scene)) = Scene::new(&common::capture(), common::body(), &config) else {
            panic!("{by}: a scene was made");
        };
        assert_eq!(of_scene, error);
        let Err(Error::Config(of_trainer)) = Trainer::new(common::scene(), config) else {
            panic!("{by}: a trainer was made");
        };
        assert_eq!(of_trainer, error);
    }
}

#[test]
fn encodings_that_cannot_be_built_are_errors_too() {
    type Change = fn(&mut Config);
    let changes: [(&str, Change); 6] = [
        ("no levels", |c| c.encoding.levels = 0),
        ("too many levels", |c| c.encoding.levels = 1000),
        ("no features", |c| c.encoding.features = 0),
        ("a table without end", |c| c.encoding.log2_table_size = 60),
        ("no cells", |c| c.encoding.n_min = 0),
        ("finest below coarsest", |c| c.encoding.n_max = 3),
    ];
    for (name, change) in changes {
        for method in [Method::Occnerf, Method::HashPoint] {
            let mut config = common::config(method);
            change(&mut config);
            assert!(Trainer::new(common::scene(), config).is_err(), "{name}");
        }
    }
}

#[test]
fn every_component_can_be_switched_off_and_the_rest_still_trains() {
    for component in [Component::Surface, Component::Attention, Component::Completeness, Component::Perceptual] {
        let mut config = common::config(Method::Occnerf);
        config.surface.attention = true;
        let all = config.clone();
        config.ablate(component);
        assert_ne!(config, all, "{component:?}");
        let mut trainer = Trainer::new(common::scene(), config).unwrap();
        let report = (0..3).map(|_| trainer.step().unwrap()).last().unwrap();
        assert!(report.loss.is_finite() && report.bad_gradients == 0, "{component:?}: {report:?}");
        assert_eq!(report.completeness == 0.0, component == Component::Completeness);
        assert_eq!(report.perceptual == 0.0, component == Component::Perceptual);
    }
}

/// One pixel, one sample, one patch, one unit: the smallest run there is.
#[test]
fn the_smallest_run_of_every_method_trains_and_the_odd_sizes_too() {
    for method in [Method::Occnerf, Method::HashPoint] {
        for (patches, patch_size, samples, width, depth, k) in
            [(1, 1, 1, 1, 1, 1), (3, 7, 5, 33, 3, 3), (1, 256, 3, 17, 1, 32)]
        {
            let mut config = common::config(method);
            (config.patches, config.patch_size, config.samples) = (patches, patch_size, samples);
            (config.field.width, config.field.depth) = (width, depth);
            (config.surface.k, config.surface.coarse_levels) = (k, 0);
            let scene = Scene::new(&common::capture(), common::body(), &config).unwrap();
            let mut trainer = Trainer::new(&scene, config).unwrap();
            for _ in 0..3 {
                let report = trainer.step().unwrap();
                assert!(report.loss.is_finite() && report.bad_gradients == 0, "{method:?}: {report:?}");
            }
        }
    }
}
