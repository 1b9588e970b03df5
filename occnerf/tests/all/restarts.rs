//! A field that has become empty: training restarts at lower rates instead of going on with
//! nothing.

use crate::common;

use common::{TempDir, config, scene};
use occnerf::{Method, Trainer};

#[test]
fn training_of_an_empty_field_begins_anew_three_times_also_from_a_checkpoint() {
    let mut config = config(Method::Occnerf);
    config.steps = 140;
    let mut sound = Trainer::new(scene(), config.clone()).unwrap();
    assert!((0..config.steps).all(|_| sound.step().unwrap().restarts == 0));
    // Nothing can be learnt from densities that are zero to the last digit.
    (config.field.density_bias, config.field.density_bias_outside) = (-90.0, -90.0);
    let dir = TempDir::new("restarts");
    let [path, end, other] = ["at-50", "end", "other"].map(|name| dir.path(&format!("{name}.safetensors")));
    let mut trainer = Trainer::new(scene(), config.clone()).unwrap();
    for step in 0..config.steps {
        if step == 50 {
            trainer.save(&path).unwrap();
        }
        let report = trainer.step().unwrap();
        assert!(report.loss.is_finite());
        assert_eq!(u64::from(report.restarts), ((step + 1) / 32).min(3), "step {step}");
    }
    trainer.save(&end).unwrap();
    let mut resumed = Trainer::resume(scene(), &path).unwrap();
    (50..config.steps).for_each(|_| assert!(resumed.step().unwrap().restarts >= 1));
    resumed.save(&other).unwrap();
    assert_eq!(std::fs::read(&other).unwrap(), std::fs::read(&end).unwrap());
}
