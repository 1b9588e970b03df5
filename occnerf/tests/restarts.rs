//! Learning rates far too high: training begins anew at lower ones instead of ending with nothing.
#![allow(clippy::unwrap_used, reason = "a failure here is a failed test")]

mod common;

use common::{TempDir, config, scene};
use occnerf::{Method, Trainer};

#[test]
fn a_field_that_became_empty_begins_anew_at_lower_rates_also_from_a_checkpoint() {
    let mut config = config(Method::Occnerf);
    config.steps = 130;
    config.rates.field *= 300.0;
    config.rates.table *= 300.0;
    let dir = TempDir::new("restarts");
    let [path, other] = ["a", "b"].map(|name| dir.path(&format!("{name}.safetensors")));
    let mut trainer = Trainer::new(scene(), config.clone()).unwrap();
    let mut restarts = Vec::new();
    for step in 0..config.steps {
        if step == 50 {
            trainer.save(&path).unwrap();
        }
        let report = trainer.step();
        assert!(report.loss.is_finite());
        restarts.push(report.restarts);
    }
    assert!(restarts[30] == 0 && restarts[31] == 1 && restarts.is_sorted(), "{restarts:?}");
    trainer.save(&path.with_extension("end")).unwrap();
    let mut resumed = Trainer::resume(scene(), &path).unwrap();
    (50..config.steps).for_each(|_| assert!(resumed.step().restarts >= 1));
    resumed.save(&other).unwrap();
    assert_eq!(std::fs::read(&other).unwrap(), std::fs::read(path.with_extension("end")).unwrap());
}
