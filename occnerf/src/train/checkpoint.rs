//! Checkpoints: the model with the state of training, replaced atomically.

use std::path::Path;

use crate::Error;
use crate::model::file::{array, read, write};
use crate::model::parameters::PARTS;
use crate::model::saved::{config_of, parse};
use crate::scene::prepared::Scene;
use crate::train::trainer::Trainer;

impl<'a> Trainer<'a> {
    /// Writes the model and the state of training. An old file survives until the new one is complete
    /// and on the disk.
    ///
    /// # Errors
    /// [`Error::Diverged`] where a number is not finite: the old file stays; [`Error::Io`].
    pub fn save(&self, path: &Path) -> Result<(), Error> {
        self.check_finite()?;
        let header = self.model.header(&self.scene.name)?;
        let mut arrays = self.model.arrays();
        for ((_, name), adam) in PARTS.into_iter().zip(&self.optimiser.moments) {
            for (order, moment) in [("first", &adam.first), ("second", &adam.second)] {
                arrays.push(array(format!("{name}.{order}_moment"), &moment[..]));
            }
        }
        write(path, &header, arrays)
    }

    fn check_finite(&self) -> Result<(), Error> {
        for ((part, name), adam) in PARTS.into_iter().zip(&self.optimiser.moments) {
            let values = self.model.parameters.get(part);
            for (suffix, array) in [("", values), (".first_moment", &adam.first), (".second_moment", &adam.second)] {
                if let Some(at) = array.iter().position(|v| !v.is_finite()) {
                    let (step, key) = (self.model.steps_done, format!("{name}{suffix}"));
                    return Err(Error::Diverged { step, key, value: array[at] });
                }
            }
        }
        Ok(())
    }

    /// Resumes from a checkpoint of the same scene and configuration; the number of steps may differ.
    ///
    /// # Errors
    /// [`Error::Io`]; [`Error::Array`] and [`Error::File`] for a damaged checkpoint, or one of another scene.
    pub fn resume(scene: &'a Scene, path: &Path) -> Result<Self, Error> {
        let bytes = read(path)?;
        let contents = parse(path, &bytes)?;
        let trained_on = contents.require("scene")?;
        if trained_on != scene.name {
            let what = format!("was trained on scene {trained_on:?}, expected {:?}", scene.name);
            return Err(contents.corrupt(what));
        }
        let config = config_of(&contents)?;
        let mut trainer = Self::new(scene, config).map_err(|e| contents.corrupt(e.to_string()))?;
        trainer.model.restore(&contents)?;
        let steps_done = trainer.model.steps_done;
        for ((part, name), adam) in PARTS.into_iter().zip(&mut trainer.optimiser.moments) {
            let count = trainer.model.parameters.get(part).len();
            adam.first = contents.floats(&format!("{name}.first_moment"), count)?;
            adam.second = contents.floats(&format!("{name}.second_moment"), count)?;
            if let Some(at) = adam.second.iter().position(|&v| v < 0.0) {
                let what = format!("`{name}.second_moment` is {} at {at}, expected at least 0", adam.second[at]);
                return Err(contents.corrupt(what));
            }
            adam.steps = steps_done;
        }
        Ok(trainer)
    }
}
