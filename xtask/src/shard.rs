//! Sharding of independent runs over jobs that share a folder.

use std::str::FromStr;

use anyhow::{Context, Error, Result, ensure};
use clap::Args;

/// Shard of this job.
#[derive(Args, Clone, Copy, Debug, Default)]
pub struct ShardArguments {
    /// Run part I of N only, I from 1 to N, or `slurm`: the part that a Slurm array's variables
    /// name. Every part has the same --out; parts may overlap, die and be run again
    #[arg(long, value_name = "I/N", conflicts_with = "merge")]
    pub shard: Option<Shard>,
    /// Run nothing: merge the results of the parts
    #[arg(long)]
    pub merge: bool,
}

impl ShardArguments {
    /// Whether this job writes the tables, as all but shards do.
    pub fn writes_tables(&self) -> bool {
        self.shard.is_none()
    }
}

/// Part `index` of `count`, from 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shard {
    index: usize,
    count: usize,
}

impl Shard {
    /// Whether run number `run` is in this shard. Round robin with a rotating start, so that the
    /// same run of each scene is spread over shards.
    pub fn has(&self, run: usize) -> bool {
        (run + run / self.count) % self.count == self.index
    }

    /// Whether the item `name` is in this shard, by its hash.
    pub fn has_name(&self, name: &str) -> bool {
        // FNV-1a, the same on every machine.
        let hash = name.bytes().fold(0xcbf2_9ce4_8422_2325u64, |h, b| (h ^ u64::from(b)).wrapping_mul(0x100_0000_01b3));
        (hash >> 16) % self.count as u64 == self.index as u64
    }

    /// For names of files: `1-of-4`.
    pub fn name(&self) -> String {
        format!("{}-of-{}", self.index + 1, self.count)
    }

    fn new(index: usize, count: usize) -> Result<Self> {
        ensure!((1..=count).contains(&index) && count <= 1_000_000, "{index}/{count}: expected I/N with I from 1 to N");
        Ok(Self { index: index - 1, count })
    }

    /// From the variables of a Slurm array.
    fn of_array(variable: impl Fn(&str) -> Option<String>) -> Result<Self> {
        let number = |name: &str| -> Result<usize> {
            let text = variable(name).with_context(|| format!("{name} is not set: no job of a Slurm array"))?;
            text.parse().with_context(|| format!("{name} is {text:?}, expected a whole number"))
        };
        let (id, first, count) =
            (number("SLURM_ARRAY_TASK_ID")?, number("SLURM_ARRAY_TASK_MIN")?, number("SLURM_ARRAY_TASK_COUNT")?);
        let step = variable("SLURM_ARRAY_TASK_STEP").map_or(Ok(1), |_| number("SLURM_ARRAY_TASK_STEP"))?;
        let index = id.checked_sub(first).context("SLURM_ARRAY_TASK_ID is below SLURM_ARRAY_TASK_MIN")?;
        Self::new(index / step.max(1) + 1, count)
    }
}

impl FromStr for Shard {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        if text == "slurm" {
            return Self::of_array(|name| std::env::var(name).ok());
        }
        let (index, count) = text.split_once('/').context("expected I/N, such as 1/4, or slurm")?;
        let number = |text: &str| text.parse().with_context(|| format!("{text:?} is not a whole number"));
        Self::new(number(index)?, number(count)?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_run_is_of_one_part_and_long_ones_are_dealt_out() {
        for count in [1, 2, 3, 7, 36, 1000] {
            let parts: Vec<Shard> = (1..=count).map(|i| format!("{i}/{count}").parse().unwrap()).collect();
            for run in 0..4 * count {
                assert_eq!(parts.iter().filter(|part| part.has(run)).count(), 1);
                let name = format!("run {run}");
                assert_eq!(parts.iter().filter(|part| part.has_name(&name)).count(), 1);
            }
        }
        // The first of 12 rows of 12 scenes is long: every part of 12 has one.
        let long = |part: &Shard| (0..12).filter(|scene| part.has(12 * scene)).count();
        assert!((1..=12).all(|i| long(&format!("{i}/12").parse().unwrap()) == 1));
    }

    #[test]
    fn parts_that_cannot_be_are_refused() {
        for text in ["0/4", "5/4", "1/0", "1", "a/4", "1/4/2", "-1/4", "1/18446744073709551616", "1/2000000", ""] {
            assert!(text.parse::<Shard>().is_err(), "{text}");
        }
    }

    #[test]
    fn an_array_of_slurm_names_its_parts() {
        let of = |id: &'static str, first: &'static str, count: &'static str, step: Option<&'static str>| {
            Shard::of_array(move |name| {
                let value = match name {
                    "SLURM_ARRAY_TASK_ID" => Some(id),
                    "SLURM_ARRAY_TASK_MIN" => Some(first),
                    "SLURM_ARRAY_TASK_COUNT" => Some(count),
                    _ => step,
                };
                value.map(str::to_owned)
            })
        };
        assert_eq!(of("0", "0", "4", None).unwrap(), "1/4".parse().unwrap());
        assert_eq!(of("7", "1", "4", Some("2")).unwrap(), "4/4".parse().unwrap());
        assert!(
            of("9", "1", "4", None).is_err() && of("0", "1", "4", None).is_err() && of("x", "1", "4", None).is_err()
        );
        assert!(Shard::of_array(|_| None).unwrap_err().to_string().contains("SLURM_ARRAY_TASK_ID"));
    }
}
