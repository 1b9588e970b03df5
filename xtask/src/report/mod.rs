//! HTML report of runs in a single file.

mod curves;
mod page;
mod viewer;

use std::fs::File;
use std::io::{ErrorKind, Read};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};
use array_files::read_bounded;

pub use self::curves::Log;
use self::curves::curves;
pub use self::page::{Page, escape};
use self::viewer::{Views, viewers};
use crate::process::note;
use crate::run::{self, AVATAR, CHECKPOINT, LOG, METRICS, Metrics, PERSON, RunConfig, Verdict};
use crate::table;

/// Largest embedded file.
const MAX_BYTES: u64 = 16 << 20;
/// Bytes of a viewer page that hold its source.
const PAGE_START: u64 = 4096;
/// Contact sheets of both splits.
pub const SHEETS: [&str; 2] = ["renders/novel_views.png", "renders/train_views.png"];
const REPORT: &str = "report.html";
const STALE: &str = "its scores and pictures are of an earlier training; cargo xtask eval";
const CAPTIONS: [(&str, &str); 2] = [
    ("novel_views.png", "Views that training never saw: truth left, result right; a row a camera"),
    ("train_views.png", "Training views: what the video showed left, result right"),
];

/// Writes the report of a run.
pub fn write(directory: &Path, metrics: &Metrics) -> Result<()> {
    let run = Run::new(metrics.method.clone(), directory, metrics.clone())?;
    let mut page = Page::default();
    let title = run.title();
    add_runs(&mut page, &[run], directory)?;
    run::write(&directory.join(REPORT), &page.finish(&title))
}

/// Writes the report of a run again where there is one that was made of something else.
pub fn refresh(directory: &Path) -> Result<()> {
    let path = directory.join(REPORT);
    if !path.is_file() || !directory.join(METRICS).is_file() {
        return Ok(());
    }
    let run = Run::new(String::new(), directory, Metrics::read(directory)?)?;
    if carries(&path, &run.source()?)? { Ok(()) } else { write(directory, &run.metrics) }
}

/// Whether the head of a page has this text.
fn carries(page: &Path, text: &str) -> Result<bool> {
    let mut start = Vec::new();
    File::open(page)?.take(PAGE_START).read_to_end(&mut start)?;
    Ok(String::from_utf8_lossy(&start).contains(text))
}

/// Last part of a path.
pub fn name(directory: &Path) -> String {
    directory.file_name().map_or_else(|| directory.display().to_string(), |n| n.to_string_lossy().into_owned())
}

/// A scored run.
pub struct Run {
    /// Name on the page.
    pub name: String,
    /// Run directory.
    pub directory: PathBuf,
    /// Scores.
    pub metrics: Metrics,
    /// Identity of what it has learnt.
    learnt: String,
}

impl Run {
    fn new(name: String, directory: &Path, metrics: Metrics) -> Result<Self> {
        Ok(Self { name, directory: directory.to_owned(), metrics, learnt: run::identity(directory)? })
    }

    /// Reads the scores of a run.
    pub fn read(directory: &Path) -> Result<Self> {
        RunConfig::read(directory)?;
        let run = Self::new(name(directory), directory, Metrics::read(directory)?)?;
        if run.is_stale() {
            note!("warning: {}: {STALE}", directory.display());
        }
        Ok(run)
    }

    /// Whether the scores are of what the run had learnt before.
    fn is_stale(&self) -> bool {
        let has_learnt = [CHECKPOINT, AVATAR].iter().any(|name| self.directory.join(name).is_file());
        has_learnt && self.metrics.of != self.learnt
    }

    /// Whether the viewer's page shows what the run has learnt; `None` without a page.
    fn shown(&self) -> Result<Option<bool>> {
        let page = self.directory.join(PERSON);
        page.is_file().then(|| carries(&page, &self.learnt)).transpose()
    }

    /// What a report is made of: identities of what was learnt and of what was scored, and whether
    /// the viewer's page is of the former.
    fn source(&self) -> Result<String> {
        Ok(format!("{} {} {:?}", self.learnt, self.metrics.of, self.shown()?))
    }

    /// Title of its page.
    pub fn title(&self) -> String {
        let m = &self.metrics;
        format!("{} on {}, {} steps", m.method, m.scene, m.steps)
    }
}

/// Adds scores, pictures, curves and configuration of `runs` to a page in `folder`.
pub fn add_runs(page: &mut Page, runs: &[Run], folder: &Path) -> Result<()> {
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
    let (mut views, mut logs) = (Vec::new(), Vec::new());
    for run in runs {
        page.source(&run.source()?);
        if run.is_stale() {
            page.paragraph(&format!("{}: {STALE}", run.name));
        }
        if let Some(verdict) = Verdict::read(&run.directory)? {
            page.subheading(&format!("{}: what this scene needed, and why", run.name));
            page.table(&verdict.parts);
            page.paragraph(&verdict.why);
        }
        views.extend(Views::read(&run.directory.join(SHEETS[0]))?.map(|v| (run.name.clone(), v)));
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
        let text = run::read_text(&run.directory.join("config.toml"))?;
        page.folded(&format!("{}: config.toml", run.name), &text);
    }
    Ok(())
}

/// Links the runs' viewer pages from a page in `folder`.
fn add_people(page: &mut Page, runs: &[Run], folder: &Path) -> Result<()> {
    for run in runs {
        if let Some(fresh) = run.shown()? {
            let path = std::path::absolute(run.directory.join(PERSON))?;
            let from = path.strip_prefix(std::path::absolute(folder)?).unwrap_or(&path);
            let stale = if fresh { "" } else { " (before the last training)" };
            page.link(&from.to_string_lossy(), &format!("{}: the person, to turn around and play{stale}", run.name));
        }
    }
    Ok(())
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

/// Files of one kind, by name; none where there is no such directory.
pub fn files(directory: &Path, extension: &str) -> Result<Vec<PathBuf>> {
    if !directory.is_dir() {
        return Ok(Vec::new());
    }
    let entries = std::fs::read_dir(directory).with_context(|| directory.display().to_string())?;
    let mut paths: Vec<PathBuf> = entries.filter_map(|e| Some(e.ok()?.path())).collect();
    paths.retain(|p| p.is_file() && p.extension().is_some_and(|e| e.eq_ignore_ascii_case(extension)));
    paths.sort();
    Ok(paths)
}

/// The file's bytes; `None` for a large file, which the page names.
pub fn bytes(page: &mut Page, path: &Path) -> Result<Option<Vec<u8>>> {
    match read_bounded(path, MAX_BYTES) {
        Err(error) if error.kind() == ErrorKind::FileTooLarge => {
            page.paragraph(&format!("{} is left out: {error}.", path.display()));
            Ok(None)
        }
        read => read.map(Some).with_context(|| path.display().to_string()),
    }
}

/// The cells of a Markdown table, without its rule.
pub fn cells(table: &str) -> Vec<Vec<String>> {
    let row = |line: &str| -> Vec<String> {
        let inner = line.trim().trim_start_matches('|');
        inner.strip_suffix('|').unwrap_or(inner).split('|').map(|c| c.trim().to_owned()).collect()
    };
    let rule = |cells: &Vec<String>| cells.iter().all(|c| !c.is_empty() && c.chars().all(|c| "-:".contains(c)));
    table.lines().map(row).filter(|cells| !rule(cells)).collect()
}
