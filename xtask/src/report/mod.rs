//! `report`: runs and benches on one page that needs no other file.

mod curves;
mod page;
mod viewer;

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};
use clap::Args;
use occnerf::{Capacity, Choice, Pruned};
use serde_json::Value;

use self::curves::{Log, curves};
use self::page::Page;
use self::viewer::{Views, viewers};
use crate::process::say;
use crate::results;
use crate::run::{self, LOG, METRICS, Metrics, PERSON, RunConfig};
use crate::table;
use crate::{budget, capacity};

/// Charts and pictures larger than this are left out, and named.
const MAX_BYTES: u64 = 16 << 20;
const NOVEL: &str = "renders/novel_views.png";
const CAPTIONS: [(&str, &str); 3] = [
    (budget::PICTURE, budget::CAPTION),
    ("novel_views.png", "Views that training never saw: truth left, result right; a row a camera"),
    ("train_views.png", "Training views: what the video showed left, result right"),
];

#[derive(Args)]
pub struct ReportArguments {
    /// Directories of runs, of `reproduce`, or of benches
    #[arg(required = true, value_name = "RUN")]
    runs: Vec<PathBuf>,
    /// The page [default: report.html in RUN, or beside the first of several]
    #[arg(long)]
    out: Option<PathBuf>,
}

/// Runs the command.
pub fn report(arguments: &ReportArguments) -> Result<()> {
    let mut directories = Vec::new();
    for directory in &arguments.runs {
        directories.extend(expand(directory)?);
    }
    let (benches, runs): (Vec<PathBuf>, Vec<PathBuf>) = directories.into_iter().partition(|d| is_bench(d));
    let out = match (&arguments.out, &arguments.runs[..]) {
        (Some(out), _) => out.clone(),
        (None, [one]) => one.join("report.html"),
        (None, several) => several[0].parent().unwrap_or(Path::new("")).join("report.html"),
    };
    let folder = out.parent().filter(|folder| *folder != Path::new("")).unwrap_or(Path::new("."));
    let mut page = Page::new();
    let runs: Vec<Run> = runs.iter().map(|d| Run::read(d)).collect::<Result<_>>()?;
    if !runs.is_empty() {
        add_runs(&mut page, &runs, folder)?;
    }
    for directory in &benches {
        add_bench(&mut page, directory)?;
    }
    let title = match (&runs[..], &benches[..]) {
        ([one], []) => one.title(),
        ([], [one]) => name(one),
        _ => format!("{} runs and benches", runs.len() + benches.len()),
    };
    run::write(&out, &page.finish(&title))?;
    say!("written: {}", out.display());
    Ok(())
}

/// The page of a run that has just been scored.
pub fn write(directory: &Path, metrics: &Metrics) -> Result<()> {
    let run = Run { name: metrics.method.clone(), directory: directory.to_owned(), metrics: metrics.clone() };
    let mut page = Page::new();
    let title = run.title();
    add_runs(&mut page, &[run], directory)?;
    run::write(&directory.join("report.html"), &page.finish(&title))
}

fn is_bench(directory: &Path) -> bool {
    directory.join(results::BENCH_LOG).is_file() || directory.join(results::KERNELS).is_file()
}

/// The directory itself if it is a run or a bench, else the runs in it.
fn expand(directory: &Path) -> Result<Vec<PathBuf>> {
    ensure!(directory.is_dir(), "{}: no such directory", directory.display());
    let is_run = |d: &Path| d.join(METRICS).exists() || d.join("config.toml").exists();
    if is_bench(directory) || is_run(directory) {
        return Ok(vec![directory.to_owned()]);
    }
    let entries = std::fs::read_dir(directory).with_context(|| directory.display().to_string())?;
    let mut inside: Vec<PathBuf> = entries.filter_map(|e| Some(e.ok()?.path())).filter(|p| is_run(p)).collect();
    inside.sort();
    if inside.is_empty() {
        let (metrics, log) = (METRICS, results::BENCH_LOG);
        bail!("{}: neither a run ({metrics}) nor a bench ({log}), nor are there runs in it", directory.display());
    }
    Ok(inside)
}

fn name(directory: &Path) -> String {
    directory.file_name().map_or_else(|| directory.display().to_string(), |n| n.to_string_lossy().into_owned())
}

/// A scored run.
struct Run {
    name: String,
    directory: PathBuf,
    metrics: Metrics,
}

impl Run {
    fn read(directory: &Path) -> Result<Self> {
        RunConfig::read(directory)?;
        let metrics = Metrics::read(directory)?;
        Ok(Self { name: name(directory), directory: directory.to_owned(), metrics })
    }

    fn title(&self) -> String {
        let m = &self.metrics;
        format!("{} on {}, {} steps", m.method, m.scene, m.steps)
    }
}

/// Everything of `runs`, on a page that will lie in `folder`.
fn add_runs(page: &mut Page, runs: &[Run], folder: &Path) -> Result<()> {
    page.heading("Scores");
    let rows: Vec<(String, &Metrics)> = runs.iter().map(|r| (r.name.clone(), &r.metrics)).collect();
    page.paragraph("Views that training never saw. Methods are ranked by psnr_mask and psnr_hidden, dB.");
    page.table(&cells(&table::markdown(&rows)));
    let memory = |r: &Run| format!("{:.0}", r.metrics.peak_rss_bytes as f64 / 1e6);
    let more = ["", "method", "scene", "preset", "seed", "peak memory, MB"].map(str::to_owned).to_vec();
    let row = |r: &Run| {
        let m = &r.metrics;
        vec![r.name.clone(), m.method.clone(), m.scene.clone(), m.preset.clone(), m.seed.to_string(), memory(r)]
    };
    page.table(&std::iter::once(more).chain(runs.iter().map(row)).collect::<Vec<_>>());
    for run in runs {
        if let Some(capacity) = capacity::read(&run.directory)? {
            page.subheading(&format!("{}: sizes from the scene", run.name));
            add_capacity(page, &capacity);
        }
    }
    for run in runs {
        if let Some(table) = budget::read(&run.directory)? {
            page.subheading(&format!("{}: where the error comes from", run.name));
            page.paragraph("Parts of the squared error of the views, and what PSNR would gain without them.");
            page.table(&cells(&table));
        }
    }
    let (mut views, mut logs) = (Vec::new(), Vec::new());
    for run in runs {
        views.extend(Views::read(&run.directory.join(NOVEL))?.map(|v| (run.name.clone(), v)));
        logs.extend(Log::read(&run.directory.join(LOG))?.map(|l| (run.name.clone(), l)));
    }
    add_people(page, runs, folder)?;
    let viewer = viewers(&views)?;
    if !viewer.is_empty() {
        page.heading("Truth and result");
        page.paragraph("Drag the line over the picture; choose the view and what stands on either side.");
        page.raw(&viewer);
    }
    let drawn = [
        curves(&logs, "psnr", "PSNR of the training patches, dB", false),
        curves(&logs, "loss", "Weighted loss", true),
        curves(&logs, "live_samples", "Live samples a step", false),
    ];
    if drawn.iter().any(|d| !d.is_empty()) {
        page.heading("Training");
        drawn.iter().for_each(|d| page.raw(d));
    }
    page.heading("Pictures");
    for run in runs {
        if runs.len() > 1 {
            page.subheading(&run.name);
        }
        add_pictures(page, &run.directory.join("renders"))?;
    }
    page.heading("Configuration");
    for run in runs {
        let path = run.directory.join("config.toml");
        let text = std::fs::read_to_string(&path).with_context(|| path.display().to_string())?;
        page.folded(&format!("{}: config.toml", run.name), &text);
    }
    Ok(())
}

/// Links the pages that `view` wrote of the runs' people, from a page in `folder`.
fn add_people(page: &mut Page, runs: &[Run], folder: &Path) -> Result<()> {
    for run in runs {
        let path = std::path::absolute(run.directory.join(PERSON))?;
        if path.is_file() {
            let from = path.strip_prefix(std::path::absolute(folder)?).unwrap_or(&path);
            page.link(&from.to_string_lossy(), &format!("{}: the person, to turn around and play", run.name));
        }
    }
    Ok(())
}

/// Each size that was chosen, with its reason, and what pruning took.
fn add_capacity(page: &mut Page, capacity: &Capacity) {
    let header = ["size", "preset", "chosen", "why"].map(str::to_owned).to_vec();
    let row = |c: &Choice| vec![c.key.clone(), c.preset.to_string(), c.chosen.to_string(), c.why.clone()];
    page.table(&std::iter::once(header).chain(capacity.choices.iter().map(row)).collect::<Vec<_>>());
    if let Some(Pruned { rows, dropped, parameters }) = capacity.pruned {
        page.paragraph(&format!(
            "Pruned after training: {dropped} of {rows} rows of the table, which no ray touched; {parameters} parameters left."
        ));
    }
}

/// Every PNG of a directory, if it is there.
fn add_pictures(page: &mut Page, directory: &Path) -> Result<()> {
    for path in files(directory, "png")? {
        let file = name(&path);
        let caption = CAPTIONS.iter().find(|(n, _)| *n == file).map_or(file.as_str(), |(_, c)| c);
        if let Some(bytes) = bytes(page, &path)? {
            ensure!(bytes.starts_with(b"\x89PNG"), "{}: not a PNG", path.display());
            page.picture("image/png", &bytes, caption);
        }
    }
    Ok(())
}

fn add_bench(page: &mut Page, directory: &Path) -> Result<()> {
    page.heading(&name(directory));
    let log = directory.join(results::BENCH_LOG);
    let points = Log::read(&log)?;
    let lines = points.as_ref().map_or(&[][..], Log::lines);
    if let Some(row) = lines.iter().position(|line| !line["name"].is_string()) {
        bail!("{}, line {}: not a point of a bench, which has a name", log.display(), row + 1);
    }
    for path in files(directory, "md")? {
        let text = std::fs::read_to_string(&path).with_context(|| path.display().to_string())?;
        add_markdown(page, &text);
    }
    for path in files(directory, "svg")? {
        if let Some(bytes) = bytes(page, &path)? {
            ensure!(bytes.starts_with(b"<svg"), "{}: not an SVG", path.display());
            page.picture("image/svg+xml", &bytes, &name(&path));
        }
    }
    let command = |line: &Value| Some(format!("{:<24} {}", line["name"].as_str()?, line["command"].as_str()?));
    let mut commands: Vec<String> = lines.iter().filter_map(command).collect();
    // A point that was run again.
    commands.dedup();
    if !commands.is_empty() {
        page.folded("What runs each point alone", &commands.join("\n"));
    }
    if let Some(line) = lines.first() {
        page.folded("Configuration of the first point", &serde_json::to_string_pretty(&line["job"])?);
    }
    Ok(())
}

/// Files of one kind, by name; none where there is no such directory.
fn files(directory: &Path, extension: &str) -> Result<Vec<PathBuf>> {
    if !directory.is_dir() {
        return Ok(Vec::new());
    }
    let entries = std::fs::read_dir(directory).with_context(|| directory.display().to_string())?;
    let mut paths: Vec<PathBuf> = entries.filter_map(|e| Some(e.ok()?.path())).collect();
    paths.retain(|p| p.is_file() && p.extension().is_some_and(|e| e.eq_ignore_ascii_case(extension)));
    paths.sort();
    Ok(paths)
}

/// The file's bytes; where there are too many, the page says so.
fn bytes(page: &mut Page, path: &Path) -> Result<Option<Vec<u8>>> {
    let size = std::fs::metadata(path).with_context(|| path.display().to_string())?.len();
    if size > MAX_BYTES {
        page.paragraph(&format!("{} is left out: {} MB.", path.display(), size >> 20));
        return Ok(None);
    }
    std::fs::read(path).map(Some).with_context(|| path.display().to_string())
}

/// Headings, tables and paragraphs, as benches write them.
fn add_markdown(page: &mut Page, text: &str) {
    let mut rows = String::new();
    for line in text.lines().chain([""]) {
        if line.starts_with('|') {
            rows.push_str(line);
            rows.push('\n');
            continue;
        }
        if !rows.is_empty() {
            page.table(&cells(&std::mem::take(&mut rows)));
        }
        if line.starts_with("##") {
            page.subheading(line.trim_start_matches('#').trim());
        } else if !line.trim().is_empty() {
            page.paragraph(line);
        }
    }
}

/// The cells of a Markdown table, without its rule.
fn cells(table: &str) -> Vec<Vec<String>> {
    let row = |line: &str| -> Vec<String> {
        let inner = line.trim().trim_start_matches('|');
        inner.strip_suffix('|').unwrap_or(inner).split('|').map(|c| c.trim().to_owned()).collect()
    };
    let rule = |cells: &Vec<String>| cells.iter().all(|c| !c.is_empty() && c.chars().all(|c| "-:".contains(c)));
    table.lines().map(row).filter(|cells| !rule(cells)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn markdown_becomes_headings_of_any_depth_tables_and_paragraphs() {
        let mut page = Page::new();
        add_markdown(&mut page, "## a\n\ntext\n\n### `b`: c\n| d | e |\n| --- | ---: |\n| f | 1.5 |");
        let page = page.finish("title");
        assert!(page.contains("<h3>a</h3>") && page.contains("<h3>`b`: c</h3>") && !page.contains("##"), "{page}");
        assert!(page.contains("<p>text</p>") && page.matches("<tr>").count() == 2, "{page}");
    }
}
