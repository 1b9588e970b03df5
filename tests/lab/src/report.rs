//! `report`: runs and benches on one page that needs no other file.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};
use clap::Args;
use serde_json::Value;
use xtask::report::{Log, Page, Run, add_runs, bytes, cells, files, name};
use xtask::run::{METRICS, write};
use xtask::say;

use crate::{budget, results};

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
    let mut page = Page::default();
    let runs: Vec<Run> = runs.iter().map(|d| Run::read(d)).collect::<Result<_>>()?;
    if !runs.is_empty() {
        add_runs(&mut page, &runs, folder)?;
        add_budgets(&mut page, &runs)?;
    }
    for directory in &benches {
        add_bench(&mut page, directory)?;
    }
    let title = match (&runs[..], &benches[..]) {
        ([one], []) => one.title(),
        ([], [one]) => name(one),
        _ => format!("{} runs and benches", runs.len() + benches.len()),
    };
    write(&out, &page.finish(&title))?;
    say!("written: {}", out.display());
    Ok(())
}

fn is_bench(directory: &Path) -> bool {
    directory.join(results::BENCH_LOG).is_file()
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

/// Where the error of each run comes from, as far as `budget` has told.
fn add_budgets(page: &mut Page, runs: &[Run]) -> Result<()> {
    for run in runs {
        if let Some(table) = budget::read(&run.directory)? {
            page.subheading(&format!("{}: where the error comes from", run.name));
            page.paragraph(budget::CAPTION);
            page.table(&cells(&table));
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn markdown_becomes_headings_of_any_depth_tables_and_paragraphs() {
        let mut page = Page::default();
        add_markdown(&mut page, "## a\n\ntext\n\n### `b`: c\n| d | e |\n| --- | ---: |\n| f | 1.5 |");
        let page = page.finish("title");
        assert!(page.contains("<h3>a</h3>") && page.contains("<h3>`b`: c</h3>") && !page.contains("##"), "{page}");
        assert!(page.contains("<p>text</p>") && page.matches("<tr>").count() == 2, "{page}");
    }
}
