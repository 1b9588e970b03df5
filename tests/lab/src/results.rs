//! `--publish`: results of a command become a section of RESULTS.md, replaced by its next run.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

use anyhow::{Context, Result};

use xtask::process::say;
use xtask::run;

/// Points of a bench, one JSON line each.
pub const BENCH_LOG: &str = "bench.jsonl";

/// A section of a document.
pub struct Section<'a> {
    /// Tells it from the others, in lower case.
    pub name: &'a str,
    /// Its heading.
    pub title: &'a str,
    /// Markdown below the heading.
    pub body: &'a str,
    /// Pictures, copied beside the document into charts/.
    pub charts: &'a [PathBuf],
}

/// Captures that settings were chosen on, and names that go on with a dash; `zju_demo` shows the
/// person of `humannerf_demo`.
const TUNING: [&str; 3] = ["demo", "humannerf_demo", "zju_demo"];

/// What figures on a scene, by its name, speak for.
pub fn set_of(scene: &str) -> &'static str {
    let of = |name: &&str| scene.strip_prefix(*name).is_some_and(|rest| rest.is_empty() || rest.starts_with('-'));
    if TUNING.iter().any(of) {
        "A *tuning* capture: settings were chosen on it"
    } else {
        "A *reporting* capture: no setting was chosen on it"
    }
}

/// Puts a section into tests/lab/RESULTS.md, with the command, commit and machine that it comes
/// from.
pub fn publish(section: &Section<'_>) -> Result<()> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR"));
    let document = folder.join("RESULTS.md");
    let old = std::fs::read_to_string(&document).unwrap_or_default();
    let mut body = format!("{}\n\n{}\n", origin(), demoted(section.body));
    for chart in section.charts {
        let name = chart.file_name().context("a chart without a name")?.to_string_lossy();
        let copy = folder.join("charts").join(&*name);
        std::fs::copy(chart, &copy).with_context(|| format!("{} to {}", chart.display(), copy.display()))?;
        body.push_str(&format!("\n![{}: {name}](charts/{name})\n", section.title));
    }
    run::write(&document, &replaced(&old, section.name, &format!("## {}\n\n{body}", section.title)))?;
    say!("published: {}, section `{}`", document.display(), section.name);
    Ok(())
}

/// Puts the table between the marks of README's `table`.
pub fn publish_table(table: &str) -> Result<()> {
    let document = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../README.md");
    let old = std::fs::read_to_string(&document).with_context(|| document.display().to_string())?;
    run::write(&document, &replaced(&old, "table", &format!("{table}\n{}\n", wrapped(origin()))))?;
    say!("published: {}", document.display());
    Ok(())
}

/// The PNGs of a folder whose names begin with `stem`, in order.
pub fn charts(folder: &Path, stem: &str) -> Result<Vec<PathBuf>> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).with_context(|| folder.display().to_string())? {
        let path = entry?.path();
        let named = path.file_name().is_some_and(|name| name.to_string_lossy().starts_with(stem));
        if named && path.extension().is_some_and(|e| e == "png") {
            found.push(path);
        }
    }
    found.sort();
    Ok(found)
}

/// The document with what stands between the marks of `name` replaced, or added at the end.
fn replaced(document: &str, name: &str, text: &str) -> String {
    let (begin, end) = (format!("<!-- begin {name} -->\n"), format!("<!-- end {name} -->\n"));
    let section = format!("{begin}{text}{end}");
    let found = document.find(&begin).zip(document.find(&end)).filter(|(from, to)| from < to);
    match found {
        Some((from, to)) => format!("{}{section}{}", &document[..from], &document[to + end.len()..]),
        None => format!("{}\n\n{section}", document.trim_end()),
    }
}

/// Lines of at most 100 columns, as far as words are no longer.
fn wrapped(text: &str) -> String {
    let mut lines = vec![String::new()];
    for word in text.split(' ') {
        match lines.last_mut() {
            Some(line) if line.is_empty() || line.chars().count() + 1 + word.chars().count() <= 100 => {
                line.push_str(if line.is_empty() { "" } else { " " });
                line.push_str(word);
            }
            _ => lines.push(word.to_owned()),
        }
    }
    lines.join("\n")
}

/// Headings two levels lower, as parts of a section.
fn demoted(text: &str) -> String {
    let line = |line: &str| if line.starts_with('#') { format!("##{line}\n") } else { format!("{line}\n") };
    text.trim().lines().map(line).collect()
}

/// The command of this process, the commit that it was begun from and the machine.
fn origin() -> &'static str {
    // What is published changes the tree.
    static ORIGIN: OnceLock<String> = OnceLock::new();
    ORIGIN.get_or_init(found_origin)
}

fn found_origin() -> String {
    let arguments = std::env::args().skip(1).map(|argument| {
        // Paths say where a user keeps files: of those the name is enough.
        let name = Path::new(&argument).file_name().map(|name| name.to_string_lossy().into_owned());
        if Path::new(&argument).is_absolute() { name.unwrap_or(argument) } else { argument }
    });
    let command = arguments.filter(|a| a != "--publish").collect::<Vec<_>>().join(" ");
    let git = |arguments: &[&str]| {
        // Commands are given from anywhere.
        let git = || Command::new("git").current_dir(env!("CARGO_MANIFEST_DIR")).args(arguments).output();
        let output = git().ok().filter(|o| o.status.success());
        output.map(|output| String::from_utf8_lossy(&output.stdout).trim().to_owned())
    };
    let commit = git(&["rev-parse", "--short", "HEAD"]).unwrap_or_else(|| "unknown".to_owned());
    let changed = git(&["status", "--porcelain", "--untracked-files=no"]).is_some_and(|status| !status.is_empty());
    let also = if changed { " with changes" } else { "" };
    let cores = std::thread::available_parallelism().map_or(0, usize::from);
    let processors = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let model = processors.lines().find_map(|line| line.strip_prefix("model name")).unwrap_or("");
    let model = model.trim_start_matches([' ', '\t', ':']);
    format!("`cargo lab {command}`, commit {commit}{also}, {cores} cores, {model}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn captures_that_settings_were_chosen_on_are_told_by_their_names() {
        let chosen_on = |scene: &str| set_of(scene).contains("*tuning*");
        assert!(["demo", "demo-hidden-80", "humannerf_demo", "zju_demo"].into_iter().all(chosen_on));
        assert!(!["mild", "walk", "demonstration", "my-demo"].into_iter().any(chosen_on));
    }

    #[test]
    fn a_section_replaces_its_older_self_and_nothing_else() {
        let document = "# Results\n\ntext\n";
        let one = replaced(document, "a", "## A\n1\n");
        assert_eq!(one, "# Results\n\ntext\n\n<!-- begin a -->\n## A\n1\n<!-- end a -->\n");
        let two = replaced(&one, "b", "## B\n");
        assert_eq!(replaced(&two, "a", "## A\n2\n"), two.replace("1\n", "2\n"));
        assert_eq!(demoted("# x\ny\n"), "### x\ny\n");
        assert_eq!(wrapped("word ".repeat(21).trim_end()), format!("{}\nword", "word ".repeat(20).trim_end()));
    }
}
