//! Means and spreads over seeds, as Markdown, JSON and a picture.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use image::RgbImage;
use occnerf::SplitMetrics;
use serde::Serialize;

use super::rows::{Row, Table};
use crate::results;
use xtask::run::{self, Metrics};
use xtask::train::scene_name;
use xtask::{pictures, table};

/// Results of a scene.
#[derive(Serialize)]
pub struct Summary {
    scene: String,
    /// Settings common to all rows, and runs of each.
    settings: String,
    #[serde(skip)]
    table: Table,
    /// Network of lpips_full, and the perceptual term of training.
    lpips: Option<String>,
    perceptual: String,
    rows: Vec<Entry>,
}

#[derive(Serialize)]
struct Entry {
    name: String,
    occluded: String,
    steps: u64,
    runs: Vec<Metrics>,
    #[serde(skip)]
    pictures: PathBuf,
}

type PickSplit = fn(&Metrics) -> Option<&SplitMetrics>;
/// What a column shows of a split.
type Column = (&'static str, fn(&SplitMetrics) -> Option<f64>, usize);

const COLUMNS: [Column; 9] = [
    ("psnr_mask", |s| s.psnr_mask, 2),
    ("psnr_hidden", |s| s.psnr_hidden, 2),
    ("ssim_mask", |s| s.ssim_mask, 4),
    ("psnr_vis", |s| s.psnr_vis, 2),
    ("ssim_vis", |s| s.ssim_vis, 4),
    ("psnr_full", |s| s.psnr_full, 2),
    ("ssim_full", |s| s.ssim_full, 4),
    ("lpips_full", |s| s.lpips_full, 4),
    ("iou", |s| s.mask_iou, 3),
];

impl Summary {
    pub fn new(scene: &str, settings: String, table: Table) -> Self {
        Self { scene: scene.to_owned(), settings, table, lpips: None, perceptual: String::new(), rows: Vec::new() }
    }

    /// Adds a run of a row.
    pub fn add(&mut self, row: &Row, directory: &Path, metrics: Metrics) {
        if self.rows.last().is_none_or(|entry| entry.name != row.name) {
            let sheet = if metrics.splits.novel_view.is_some() { "novel_views.png" } else { "train_views.png" };
            self.rows.push(Entry {
                name: row.name.clone(),
                occluded: if row.learns() { metrics.occluded.clone() } else { "–".to_owned() },
                steps: metrics.steps,
                runs: Vec::new(),
                pictures: directory.join("renders").join(sheet),
            });
        }
        self.lpips.clone_from(&metrics.lpips);
        // The ablation of the term does not speak for the table.
        if !["", "none"].contains(&metrics.perceptual.as_str()) || self.perceptual.is_empty() {
            self.perceptual.clone_from(&metrics.perceptual);
        }
        if let Some(entry) = self.rows.last_mut() {
            entry.runs.push(metrics);
        }
    }

    /// The table: novel views where the capture has them, and training views on what they show.
    pub fn markdown(&self) -> String {
        // Without the folders: tables are shown elsewhere.
        let (scene, set) = (self.name(), results::set_of(&self.name()));
        let mut text = format!("# {scene}\n\n{set}. {}; perceptual term: {}", self.settings, self.perceptual);
        if let Some(network) = &self.lpips {
            text.push_str(&format!("; lpips_full by {network}"));
        }
        text.push_str(".\n");
        let unseen = if self.table == Table::Choices { "Training frames that are held out" } else { "Novel views" };
        let splits: [(&str, PickSplit); 2] = [
            (unseen, |m| m.splits.novel_view.as_ref()),
            ("Training views, over visible pixels", |m| m.splits.train_view.as_ref()),
        ];
        for (title, split) in splits {
            let mut lines = vec![["row", "occluded", "steps", "train s", "parameters"].map(str::to_owned).to_vec()];
            lines[0].extend(COLUMNS.iter().map(|column| column.0.to_owned()));
            for entry in &self.rows {
                let scores: Vec<&SplitMetrics> = entry.runs.iter().filter_map(split).collect();
                if scores.is_empty() {
                    continue;
                }
                let seconds = entry.runs.iter().map(|m| m.train_seconds).sum::<f64>() / entry.runs.len() as f64;
                let mut line = vec![
                    entry.name.clone(),
                    entry.occluded.clone(),
                    entry.steps.to_string(),
                    format!("{seconds:.0}"),
                    entry.runs.first().map_or(0, |m| m.parameters).to_string(),
                ];
                line.extend(COLUMNS.iter().map(|(_, pick, digits)| {
                    let values: Vec<f64> = scores.iter().filter_map(|s| pick(s)).collect();
                    cell(&values, *digits)
                }));
                lines.push(line);
            }
            if lines.len() > 1 {
                text.push_str(&format!("\n{title}:\n\n{}", table::aligned(&lines, 2)));
            }
        }
        text
    }

    /// The scene without the folders that lead to it.
    fn name(&self) -> String {
        scene_name(Some(&self.scene))
    }

    /// The pictures of all methods under another name, for a folder with those of other scenes.
    pub fn chart(&self, directory: &Path, name: &str) -> Result<PathBuf> {
        let copy = directory.join(format!("{name}.png"));
        std::fs::copy(directory.join(self.file("png")), &copy).with_context(|| copy.display().to_string())?;
        Ok(copy)
    }

    /// The table for README: few rows, few columns, novel views.
    pub fn front(&self) -> String {
        let heads = ["method", "hidden pixels", "steps", "seconds", "psnr_mask", "psnr_hidden", "ssim_mask"];
        let mut lines = vec![heads.map(str::to_owned).to_vec()];
        for entry in self.rows.iter().filter(|entry| self.table.shown().contains(&&*entry.name)) {
            let splits: Vec<&SplitMetrics> = entry.runs.iter().filter_map(|m| Some(m.splits.first()?.1)).collect();
            let seconds = entry.runs.iter().map(|m| m.train_seconds).sum::<f64>() / entry.runs.len() as f64;
            // RESULTS has the standard deviations.
            let mean = |pick: fn(&SplitMetrics) -> Option<f64>, digits: usize| {
                let values: Vec<f64> = splits.iter().filter_map(|s| pick(s)).collect();
                let mean = values.iter().sum::<f64>() / values.len() as f64;
                cell(if values.is_empty() { &[] } else { std::slice::from_ref(&mean) }, digits)
            };
            // The column beside it says what hidden pixels are taken for.
            let name = entry.name.trim_end_matches("-bg").to_owned();
            let (steps, seconds) = (entry.steps.to_string(), format!("{seconds:.0}"));
            let scores = [mean(|s| s.psnr_mask, 2), mean(|s| s.psnr_hidden, 2), mean(|s| s.ssim_mask, 3)];
            lines.push([vec![name, entry.occluded.clone(), steps, seconds], scores.to_vec()].concat());
        }
        table::aligned(&lines, 2)
    }

    /// The name of one of its files, by the extension.
    pub fn file(&self, extension: &str) -> String {
        format!("{}.{extension}", self.table.name())
    }

    /// Writes the table as .md and .json, and the pictures as .png.
    pub fn write(&self, directory: &Path) -> Result<()> {
        run::write(&directory.join(self.file("md")), &self.markdown())?;
        run::write(&directory.join(self.file("json")), &serde_json::to_string_pretty(self)?)?;
        // A row a camera: the truth, then what each method makes of it.
        let (mut columns, mut names): (Vec<Vec<RgbImage>>, _) = (Vec::new(), vec!["truth"]);
        for entry in self.table.shown().iter().filter_map(|name| self.rows.iter().find(|entry| entry.name == *name)) {
            let sheet = image::open(&entry.pictures).with_context(|| entry.pictures.display().to_string())?.into_rgb8();
            let cells = pictures::cells(&sheet);
            let column = |c: usize| cells.iter().filter_map(|row| row.get(c).cloned()).collect();
            if columns.is_empty() {
                columns.push(column(0));
            }
            columns.push(column(1));
            names.push(&entry.name);
        }
        let cameras = columns.iter().map(Vec::len).min().unwrap_or(0);
        let rows: Vec<Vec<RgbImage>> =
            (0..cameras).map(|camera| columns.iter().map(|column| column[camera].clone()).collect()).collect();
        if rows.is_empty() {
            return Ok(());
        }
        pictures::save(&pictures::captioned(&pictures::sheet(&rows), &names)?, &directory.join(self.file("png")))
    }
}

/// Mean and, of several, standard deviation.
fn cell(values: &[f64], digits: usize) -> String {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    match values.len() {
        0 => "–".to_owned(),
        1 => format!("{mean:.digits$}"),
        _ => {
            let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (n - 1.0);
            format!("{mean:.digits$} ± {:.digits$}", variance.sqrt())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_show_mean_and_standard_deviation() {
        assert_eq!(cell(&[], 2), "–");
        assert_eq!(cell(&[1.234], 2), "1.23");
        assert_eq!(cell(&[1.0, 2.0, 3.0], 2), "2.00 ± 1.00");
    }
}
