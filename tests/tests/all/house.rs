//! The order of the house: within a crate no two files import each other, not even by way of
//! others, and the folders of `occnerf` import each other as ARCHITECTURE.md draws it.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use testkit::files::Directory;

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

type Names = Vec<String>;
/// Importing and imported files, relative to the crate's `src`.
type Imports = BTreeSet<(String, String)>;

/// The modules of a crate by their path from the root: the file, and the paths of imported names.
#[derive(Default)]
struct Crate {
    modules: BTreeMap<Names, (String, BTreeMap<String, Names>)>,
    /// Paths as written, the module where they stand, and whether a `pub use` hands them on.
    mentions: Vec<(Names, Names, bool)>,
}

/// Lines of a file without comments and without what only tests compile, which stands last unless
/// it is one item.
fn source(path: &Path) -> String {
    let text = std::fs::read_to_string(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    let (mut lines, mut out) = (text.lines(), String::new());
    while let Some(line) = lines.next() {
        if line.trim() == "#[cfg(test)]" && !lines.next().is_some_and(|item| item.ends_with(';')) {
            break;
        }
        if !line.trim_start().starts_with("//") && line.trim() != "#[cfg(test)]" {
            out.push_str(line);
            out.push('\n');
        }
    }
    out
}

/// Words, `::` and single signs.
fn tokens(text: &str) -> Vec<&str> {
    let is_word = |c: char| c.is_alphanumeric() || c == '_';
    let (mut rest, mut out) = (text, Vec::new());
    while let Some(first) = rest.chars().next() {
        let length = match first {
            first if is_word(first) => rest.find(|c| !is_word(c)).unwrap_or(rest.len()),
            _ if rest.starts_with("::") => 2,
            first => first.len_utf8(),
        };
        if !first.is_whitespace() {
            out.push(&rest[..length]);
        }
        rest = &rest[length..];
    }
    out
}

/// Calls `found` with each path of the `use` tree at `at` and the name that it gets; returns where
/// the tree ends.
fn leaves(tokens: &[&str], mut at: usize, mut path: Names, found: &mut impl FnMut(Names, &str)) -> usize {
    if tokens[at] == "{" {
        while tokens[at] != "}" {
            at += 1;
            if tokens[at] != "}" {
                at = leaves(tokens, at, path.clone(), found);
            }
        }
        return at + 1;
    }
    let name = if tokens[at] == "self" { path.last().cloned().unwrap_or_default() } else { tokens[at].to_owned() };
    path.push(tokens[at].to_owned());
    match tokens.get(at + 1..at + 3) {
        Some(["::", next]) if *next != "<" => leaves(tokens, at + 2, path, found),
        Some(["as", local]) => {
            found(path, local);
            at + 3
        }
        _ => {
            found(path, &name);
            at + 1
        }
    }
}

impl Crate {
    /// Reads module `path` from a file, and its children.
    fn read(&mut self, src: &Path, file: &str, path: &Names) {
        let text = source(&src.join(file));
        let tokens = tokens(&text);
        let children: Vec<&str> = tokens.windows(3).filter(|w| w[0] == "mod" && w[2] == ";").map(|w| w[1]).collect();
        let (mut names, mut at) = (BTreeMap::<String, Names>::new(), 0);
        while at + 1 < tokens.len() {
            let is_known = children.contains(&tokens[at]) || names.contains_key(tokens[at]);
            let begins = is_known || ["crate", "super", "self"].contains(&tokens[at]);
            let goes_on = at > 0 && ["::", "."].contains(&tokens[at - 1]);
            if !begins || goes_on || tokens[at + 1] != "::" {
                at += 1;
                continue;
            }
            let before = &tokens[at.saturating_sub(2)..at];
            let is_use = before.last() == Some(&"use");
            let handed_on = is_use && ["pub", ")"].contains(&before[0]);
            at = leaves(&tokens, at, Vec::new(), &mut |leaf, local| {
                if is_use {
                    names.insert(local.to_owned(), leaf.clone());
                }
                self.mentions.push((path.clone(), leaf, handed_on));
            });
        }
        self.modules.insert(path.clone(), (file.to_owned(), names));
        for child in children {
            let below = [&path[..], &[child.to_owned()]].concat();
            let stem = below.join("/");
            let file = format!("{stem}.rs");
            let file = if src.join(&file).exists() { file } else { format!("{stem}/mod.rs") };
            self.read(src, &file, &below);
        }
    }

    /// The module that defines what `path` names, seen from module `from`; `None` for modules
    /// themselves and for names that lead back to themselves.
    fn resolve(&self, from: &Names, path: &[String], depth: usize) -> Option<Names> {
        let mut here = from.clone();
        for (i, segment) in path.iter().enumerate() {
            match segment.as_str() {
                "crate" => here.clear(),
                "self" => {}
                "super" => drop(here.pop()),
                _ => {
                    let child = [&here[..], std::slice::from_ref(segment)].concat();
                    if self.modules.contains_key(&child) {
                        here = child;
                        continue;
                    }
                    let Some(used) = self.modules[&here].1.get(segment) else { return Some(here) };
                    let whole = [&used[..], &path[i + 1..]].concat();
                    return if depth > 32 { None } else { self.resolve(&here, &whole, depth + 1) };
                }
            }
        }
        None
    }
}

/// Reads the crate whose sources are in `src`. What only tests compile is left out, and so are
/// names that a module hands on from those below it.
fn imports(src: &Path) -> Imports {
    let mut house = Crate::default();
    let root = if src.join("lib.rs").exists() { "lib.rs" } else { "main.rs" };
    house.read(src, root, &Vec::new());
    let arrow = |(from, path, handed_on): &(Names, Names, bool)| {
        let to = house.resolve(from, path, 0)?;
        let files = [from, &to].map(|module| house.modules[module].0.clone());
        (files[0] != files[1] && !(*handed_on && to.starts_with(from))).then(|| files.into())
    };
    house.mentions.iter().filter_map(arrow).collect()
}

/// The imports among files that import each other, by way of others too, and between such circles.
fn circles(mut left: Imports) -> Imports {
    loop {
        let ends = |end: fn(&(String, String)) -> &String| left.iter().map(end).cloned().collect::<BTreeSet<_>>();
        let (from, to, before) = (ends(|arrow| &arrow.0), ends(|arrow| &arrow.1), left.len());
        left.retain(|arrow| from.contains(&arrow.1) && to.contains(&arrow.0));
        if left.len() == before {
            return left;
        }
    }
}

fn workspace() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

#[test]
fn no_files_of_a_crate_import_each_other_in_a_circle() {
    for name in CRATES {
        let imports = imports(&workspace().join(name).join("src"));
        assert!(imports.len() > 5, "{name}: {} imports were read", imports.len());
        assert_eq!(circles(imports), Imports::new(), "{name}/src");
    }
}

#[test]
fn the_folders_of_occnerf_import_each_other_as_drawn() {
    let architecture = std::fs::read_to_string(workspace().join("ARCHITECTURE.md")).unwrap();
    let drawn = architecture.lines().skip_while(|line| line.trim() != "```folders").skip(1);
    let drawn: BTreeSet<(String, BTreeSet<&str>)> = (drawn.take_while(|line| line.trim() != "```"))
        .map(|line| line.split_once("<-").unwrap_or((line, "")))
        .map(|(name, imported)| (name.trim().to_owned(), imported.split_whitespace().collect()))
        .collect();
    let imports = imports(&workspace().join("occnerf/src"));
    // The first step of a file's path: a folder, or a file that stands alone.
    let first = |file: &str| file.split('/').next().unwrap_or(file).trim_end_matches(".rs").to_owned();
    let mut found: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    for (from, to) in imports.iter().map(|(from, to)| (first(from), first(to))) {
        // `lib.rs` only hands names on, those of other crates too.
        if from != "lib" && to != "lib" {
            found.entry(to.clone()).or_default();
            found.entry(from.clone()).or_default().extend((from != to).then_some(to));
        }
    }
    let found: BTreeSet<(String, BTreeSet<&str>)> =
        found.iter().map(|(name, imported)| (name.clone(), imported.iter().map(String::as_str).collect())).collect();
    assert_eq!(drawn, found, "ARCHITECTURE.md draws the left, the imports say the right");
}

/// The lengths that files report are not trusted: only `read_bounded` reads one whole.
#[test]
fn the_product_reads_files_up_to_a_bound() {
    let mut left: Vec<PathBuf> = PRODUCT.iter().map(|name| workspace().join(name).join("src")).collect();
    while let Some(path) = left.pop() {
        let is_source = path.extension().is_some_and(|e| e == "rs");
        if path.is_dir() {
            let entries = std::fs::read_dir(&path).unwrap().map(|entry| entry.unwrap().path());
            left.extend(entries.filter(|entry| !entry.ends_with("tests")));
        } else if is_source && !["tests.rs", "damage.rs"].iter().any(|test| path.to_string_lossy().ends_with(test)) {
            for line in source(&path).lines().filter(|line| !line.contains("\"/proc/")) {
                let is_raw = line.contains("fs::read(") || line.contains("fs::read_to_string(");
                assert!(!is_raw, "array_files::read_bounded instead: {}: {}", path.display(), line.trim());
            }
        }
    }
}

/// The imports of a crate of these files.
fn of_files(files: &[(&str, &str)]) -> Vec<(String, String)> {
    let folder = Directory::new("house");
    files.iter().for_each(|(path, text)| folder.write(path, text));
    imports(folder.path()).into_iter().collect()
}

fn arrow(from: &str, to: &str) -> (String, String) {
    (from.to_owned(), to.to_owned())
}

#[test]
fn a_parent_that_hands_names_on_is_no_arrow_but_what_it_defines_or_uses_is() {
    let read = of_files(&[
        ("lib.rs", "mod a;\nmod b;\nmod c;\npub use a::{A, Other as Renamed};\npub use self::b::b;\n"),
        ("a/mod.rs", "mod inner;\npub struct A;\npub use inner::Inner;\npub struct Other;"),
        ("a/inner.rs", "use super::A;\npub struct Inner(A);"),
        ("b.rs", "use crate::{A, Renamed};\nuse crate::a::Inner;\nuse glam::Vec3;\npub fn b(a: A) {}"),
        ("c.rs", "// crate::b::b\n#[cfg(test)]\nuse crate::b::b;\n#[cfg(test)]\nmod tests { use crate::b::b; }"),
    ]);
    assert_eq!(read, [arrow("a/inner.rs", "a/mod.rs"), arrow("b.rs", "a/inner.rs"), arrow("b.rs", "a/mod.rs")]);
    assert!(circles(read.into_iter().collect()).is_empty());
}

#[test]
fn circles_are_found_by_way_of_others_and_through_renamed_modules_and_blocks() {
    let read = of_files(&[
        ("main.rs", "mod a;\nmod b;\nmod c;\nfn main() { a::go() }"),
        ("a.rs", "use crate::b as other;\npub fn go() { other::go() }"),
        ("b.rs", "pub fn go() { if true { use super::c; c::go::<u8>() } }"),
        ("c.rs", "pub fn go<T>() { super::a::go() }"),
    ]);
    let ring = [arrow("a.rs", "b.rs"), arrow("b.rs", "c.rs"), arrow("c.rs", "a.rs")];
    assert_eq!(circles(read.into_iter().collect()), Imports::from(ring));
}
