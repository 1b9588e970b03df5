//! The order of the house: within a crate no two files import each other, not even by way of
//! others, and the folders of `occnerf` import each other as ARCHITECTURE.md draws it.

mod imports;
mod tokens;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use imports::{Imports, imports};

/// The crates that are not tests.
const PRODUCT: [&str; 10] = [
    "smpl",
    "smpl/array-files",
    "surface-query",
    "visibility",
    "hashgrid",
    "volrender",
    "occnerf",
    "occnerf/capture",
    "occnerf/lpips",
    "xtask",
];
const CRATES: [&str; 5] = ["occnerf", "occnerf/capture", "xtask", "tests/lab", "tests/synth"];

fn workspace() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// Groups of files that import each other, by way of others too: the strongly connected components
/// of more than one file.
fn circles(imports: &Imports) -> Vec<BTreeSet<&str>> {
    let reachable = |from: &str| {
        let (mut seen, mut open) = (BTreeSet::new(), vec![from]);
        while let Some(file) = open.pop() {
            for (_, to) in imports.keys().filter(|(importer, _)| importer == file) {
                if seen.insert(to.as_str()) {
                    open.push(to);
                }
            }
        }
        seen
    };
    let files: BTreeSet<&str> = imports.keys().map(|(from, _)| from.as_str()).collect();
    let reached: BTreeMap<&str, BTreeSet<&str>> = files.iter().map(|&file| (file, reachable(file))).collect();
    let circle = |file: &str| -> BTreeSet<&str> {
        let mutual = |other: &&str| reached.get(other).is_some_and(|back| back.contains(file));
        reached[file].iter().copied().filter(mutual).collect()
    };
    let all: BTreeSet<BTreeSet<&str>> = files.iter().map(|file| circle(file)).collect();
    all.into_iter().filter(|circle| circle.len() > 1).collect()
}

/// A sentence for each circle: its files and what ties them.
fn complaints(name: &str, imports: &Imports) -> Vec<String> {
    let say = |circle: BTreeSet<&str>| {
        let inside = |(from, to): &(String, String)| circle.contains(from.as_str()) && circle.contains(to.as_str());
        let ties = imports.iter().filter(|(arrow, _)| inside(arrow));
        let ties = ties.map(|((from, to), names)| {
            let names: Vec<&str> = names.iter().map(String::as_str).collect();
            format!("  {from} -> {to}: {}", names.join(", "))
        });
        format!("{name}/src, {} files:\n{}", circle.len(), ties.collect::<Vec<_>>().join("\n"))
    };
    circles(imports).into_iter().map(say).collect()
}

#[test]
fn no_files_of_a_crate_import_each_other_in_a_circle() {
    let mut found = Vec::new();
    for name in CRATES {
        let imports = imports(&workspace().join(name).join("src")).unwrap();
        assert!(imports.len() > 5, "{name}: {} imports were read", imports.len());
        found.extend(complaints(name, &imports));
    }
    assert!(found.is_empty(), "{} circles\n{}", found.len(), found.join("\n"));
}

/// The first step of a file's path: a folder, or a file that stands alone.
fn folder(file: &str) -> &str {
    file.split('/').next().unwrap_or(file).trim_end_matches(".rs")
}

/// `name <- names` lines of the block that starts with ```` ```folders ````.
fn drawn(architecture: &str) -> BTreeMap<String, BTreeSet<String>> {
    let block = architecture.lines().skip_while(|line| line.trim() != "```folders").skip(1);
    let lines = block.take_while(|line| line.trim() != "```");
    let entry = |line: &str| {
        let (name, imported) = line.split_once("<-").unwrap_or((line, ""));
        (name.trim().to_owned(), imported.split_whitespace().map(str::to_owned).collect())
    };
    lines.map(entry).collect()
}

#[test]
fn the_folders_of_occnerf_import_each_other_as_drawn() {
    let architecture = std::fs::read_to_string(workspace().join("ARCHITECTURE.md")).unwrap();
    let drawn = drawn(&architecture);
    assert!(drawn.len() > 2, "ARCHITECTURE.md has no block ```folders");
    let mut found: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    for (from, to) in imports(&workspace().join("occnerf/src")).unwrap().keys() {
        let (from, to) = (folder(from), folder(to));
        // `lib.rs` only hands names on, those of other crates too.
        if [from, to].contains(&"lib") {
            continue;
        }
        found.entry(to.to_owned()).or_default();
        let imported = found.entry(from.to_owned()).or_default();
        if from != to {
            imported.insert(to.to_owned());
        }
    }
    let text = |folders: &BTreeMap<String, BTreeSet<String>>| {
        let line = |(name, imported): (&String, &BTreeSet<String>)| {
            let imported: Vec<&str> = imported.iter().map(String::as_str).collect();
            format!("{name} <- {}", imported.join(" ")).trim_end().to_owned()
        };
        folders.iter().map(line).collect::<Vec<_>>().join("\n")
    };
    assert!(drawn == found, "ARCHITECTURE.md draws\n{}\n\nthe imports say\n{}", text(&drawn), text(&found));
}

/// The lengths that files report are not trusted: only `read_bounded` reads one whole.
#[test]
fn the_product_reads_files_up_to_a_bound() {
    let mut found = Vec::new();
    let mut left: Vec<PathBuf> = PRODUCT.iter().map(|name| workspace().join(name).join("src")).collect();
    while let Some(path) = left.pop() {
        let is_source = path.extension().is_some_and(|e| e == "rs");
        if path.is_dir() {
            let entries = std::fs::read_dir(&path).unwrap().map(|entry| entry.unwrap().path());
            left.extend(entries.filter(|entry| !entry.ends_with("tests")));
        } else if is_source && !["tests.rs", "damage.rs"].iter().any(|test| path.to_string_lossy().ends_with(test)) {
            let text = std::fs::read_to_string(&path).unwrap();
            let own = text.lines().take_while(|line| line.trim() != "#[cfg(test)]");
            let raw = |line: &&str| line.contains("fs::read(") || line.contains("fs::read_to_string(");
            let raw = own.filter(raw).filter(|line| !line.trim().starts_with("//") && !line.contains("\"/proc/"));
            found.extend(raw.map(|line| format!("{}: {}", path.display(), line.trim())));
        }
    }
    assert!(found.is_empty(), "array_files::read_bounded instead:\n{}", found.join("\n"));
}

/// A crate in a temporary folder.
fn small_crate(name: &str, files: &[(&str, &str)]) -> Imports {
    let folder = std::env::temp_dir().join(format!("house-{name}-{}", std::process::id()));
    for (path, text) in files {
        let path = folder.join(path);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, text).unwrap();
    }
    let read = imports(&folder).unwrap();
    std::fs::remove_dir_all(folder).unwrap();
    read
}

fn arrows(imports: &Imports) -> Vec<(&str, &str)> {
    imports.keys().map(|(from, to)| (from.as_str(), to.as_str())).collect()
}

#[test]
fn a_parent_that_hands_names_on_is_no_arrow_but_what_it_defines_or_uses_is() {
    let read = small_crate(
        "parent",
        &[
            ("lib.rs", "mod a;\nmod b;\nmod c;\npub use a::{A, Other as Renamed};\npub use self::b::b;\n"),
            ("a/mod.rs", "mod inner;\npub struct A;\npub use inner::Inner;\npub struct Other;"),
            ("a/inner.rs", "use super::A;\npub struct Inner(A);"),
            ("b.rs", "use crate::{A, Renamed};\nuse crate::a::Inner;\nuse glam::Vec3;\npub fn b(a: A) {}"),
            ("c.rs", "// crate::b::b\n#[cfg(test)]\nmod tests { use crate::b::b; }\n#[cfg(test)]\nuse crate::b::b;"),
        ],
    );
    assert_eq!(arrows(&read), [("a/inner.rs", "a/mod.rs"), ("b.rs", "a/inner.rs"), ("b.rs", "a/mod.rs")]);
    assert!(complaints("parent", &read).is_empty());
    let read = small_crate(
        "uses",
        &[("lib.rs", "mod a;\npub struct S;\nfn f() { a::g() }"), ("a.rs", "pub fn g() -> crate::S { crate::S }")],
    );
    assert_eq!(complaints("uses", &read), ["uses/src, 2 files:\n  a.rs -> lib.rs: S\n  lib.rs -> a.rs: g"]);
}

#[test]
fn circles_are_found_by_way_of_others_and_through_renamed_modules_and_blocks() {
    let read = small_crate(
        "ring",
        &[
            ("main.rs", "mod a;\nmod b;\nmod c;\nfn main() { a::go() }"),
            ("a.rs", "use crate::b as other;\npub fn go() { other::go() }"),
            ("b.rs", "pub fn go() { if true { use super::c; c::go::<u8>() } }"),
            ("c.rs", "mod deep { pub fn go() { super::super::a::go() } }\npub fn go<T>() { deep::go() }"),
        ],
    );
    assert_eq!(circles(&read), [BTreeSet::from(["a.rs", "b.rs", "c.rs"])]);
}
