//! Which file of a crate takes which names from which other file.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use super::tokens::{Token, closing, tokens};

/// (importer, where the names are defined) to the names; files relative to the crate's `src`.
pub type Imports = BTreeMap<(String, String), BTreeSet<String>>;

type Names = Vec<String>;

/// What is known of one module.
#[derive(Default)]
struct Module {
    file: String,
    /// Local names of modules, definitions and `use`s; a definition has no path.
    names: BTreeMap<String, Option<Names>>,
    globs: Vec<Names>,
    /// Paths as written, and whether a `pub use` hands them on.
    mentions: Vec<(Names, bool)>,
}

/// All modules of a crate, by their path from the root.
#[derive(Default)]
struct Crate {
    src: PathBuf,
    modules: BTreeMap<Names, Module>,
}

/// Reads the crate whose sources are in `src`, from `lib.rs` or `main.rs` on. What only tests
/// compile is left out.
pub fn imports(src: &Path) -> std::io::Result<Imports> {
    let mut house = Crate { src: src.to_owned(), ..Crate::default() };
    for root in ["lib.rs", "main.rs"] {
        if src.join(root).exists() {
            house.read(Path::new(root), Vec::new())?;
        }
    }
    let mut out = Imports::new();
    for (path, module) in &house.modules {
        for (mention, handed_on) in &module.mentions {
            let Some((home, name)) = house.resolve(path, mention, 0) else { continue };
            let to = &house.modules[&home].file;
            if *to != module.file && !(*handed_on && home.starts_with(path)) {
                out.entry((module.file.clone(), to.clone())).or_default().insert(name);
            }
        }
    }
    Ok(out)
}

impl Crate {
    fn read(&mut self, file: &Path, path: Names) -> std::io::Result<()> {
        let text = std::fs::read_to_string(self.src.join(file))?;
        let tokens = tokens(&text);
        let mut children = Vec::new();
        self.scan(&tokens, &path, file, &mut children);
        for child in children {
            let is_root = file.parent() == Some(Path::new("")) && path.is_empty();
            let folder = match file.file_stem().and_then(|s| s.to_str()) {
                _ if is_root => PathBuf::new(),
                Some("mod") => file.parent().unwrap_or(file).to_owned(),
                _ => file.with_extension(""),
            };
            let inline = child[path.len()..child.len() - 1].iter();
            let stem = inline.fold(folder, |folder, name| folder.join(name)).join(&child[child.len() - 1]);
            let file = stem.with_extension("rs");
            let file = if self.src.join(&file).exists() { file } else { stem.join("mod.rs") };
            self.read(&file, child)?;
        }
        Ok(())
    }

    /// Takes the names and paths of a module from its tokens; `children` are modules in files.
    fn scan(&mut self, tokens: &[Token], path: &Names, file: &Path, children: &mut Vec<Names>) {
        let mut module = Module { file: file.display().to_string(), ..Module::default() };
        let (mut at, mut depth, mut public) = (0, 0usize, false);
        while at < tokens.len() {
            let name = match &tokens[at] {
                Token::Name(name) => name.as_str(),
                Token::Sign('{') => {
                    (depth, at) = (depth + 1, at + 1);
                    continue;
                }
                Token::Sign(sign) => {
                    depth = depth.saturating_sub(usize::from(*sign == '}'));
                    at += 1;
                    continue;
                }
                Token::Path => {
                    at += 1;
                    continue;
                }
            };
            let follows = match tokens.get(at + 1) {
                Some(Token::Name(name)) => Some(name.clone()),
                _ => None,
            };
            match (name, follows) {
                ("pub", _) => {
                    public = true;
                    at = if tokens.get(at + 1) == Some(&Token::Sign('(')) { closing(tokens, at + 1) } else { at + 1 };
                    continue;
                }
                ("use", _) => {
                    let end = at + tokens[at..].iter().take_while(|t| **t != Token::Sign(';')).count();
                    leaves(&tokens[at + 1..end], &mut Vec::new(), &mut |leaf, local| {
                        if local == "*" {
                            module.globs.push(leaf.clone());
                        } else {
                            module.names.insert(local, Some(leaf.clone()));
                        }
                        module.mentions.push((leaf, public));
                    });
                    at = end;
                }
                ("mod", Some(name)) => {
                    let child: Names = path.iter().cloned().chain([name.clone()]).collect();
                    module.names.insert(name, None);
                    if tokens.get(at + 2) == Some(&Token::Sign('{')) {
                        let end = closing(tokens, at + 2);
                        self.scan(&tokens[at + 3..end - 1], &child, file, children);
                        at = end;
                    } else {
                        children.push(child);
                        at += 2;
                    }
                }
                ("fn" | "struct" | "enum" | "union" | "trait" | "type" | "const" | "static", Some(name)) => {
                    if depth == 0 {
                        module.names.insert(name, None);
                    }
                    at += 2;
                }
                _ => {
                    let mut segments = vec![name.to_owned()];
                    while let (Some(Token::Path), Some(Token::Name(next))) = (tokens.get(at + 1), tokens.get(at + 2)) {
                        segments.push(next.clone());
                        at += 2;
                    }
                    if segments.len() > 1 {
                        module.mentions.push((segments, false));
                    }
                    at += 1;
                }
            }
            public = false;
        }
        self.modules.insert(path.clone(), module);
    }

    /// The module that defines what `path` names, seen from module `from`, and its name there.
    /// `None` for other crates' names and for modules themselves.
    fn resolve(&self, from: &Names, path: &[String], depth: usize) -> Option<(Names, String)> {
        // Re-exports that lead back to themselves do not compile, but must not hang either.
        if depth > 32 {
            return None;
        }
        let mut here = from.clone();
        for (i, segment) in path.iter().enumerate() {
            match segment.as_str() {
                "crate" if i == 0 => here.clear(),
                "self" => {}
                "super" => drop(here.pop()),
                _ => {
                    let mut child = here.clone();
                    child.push(segment.clone());
                    if self.modules.contains_key(&child) {
                        here = child;
                        continue;
                    }
                    let module = self.modules.get(&here)?;
                    return match module.names.get(segment) {
                        Some(Some(used)) if used.first() != Some(segment) || used.len() > 1 => {
                            let rest = used.iter().chain(&path[i + 1..]).cloned();
                            self.resolve(&here, &rest.collect::<Names>(), depth + 1)
                        }
                        Some(_) => Some((here, segment.clone())),
                        None => {
                            let tried = |glob: &Names| {
                                let rest = glob.iter().chain(&path[i..]).cloned();
                                self.resolve(&here, &rest.collect::<Names>(), depth + 1)
                            };
                            // Only a path into the crate can mean what a macro defines there.
                            let fallback = (i > 0).then(|| (here.clone(), segment.clone()));
                            module.globs.iter().find_map(tried).or(fallback)
                        }
                    };
                }
            }
        }
        None
    }
}

/// Calls `found` with each path of a `use` tree and the name it gets; `*` for all names.
fn leaves(tree: &[Token], prefix: &mut Names, found: &mut impl FnMut(Names, String)) {
    let (mut at, before) = (0, prefix.len());
    while let Some(token) = tree.get(at) {
        match token {
            Token::Name(name) if name == "as" => {
                if let Some(Token::Name(local)) = tree.get(at + 1) {
                    found(prefix.clone(), local.clone());
                }
                prefix.truncate(before);
                return;
            }
            // `{self, …}` names what stands before the braces.
            Token::Name(name) if name == "self" && at == 0 && !prefix.is_empty() => {}
            Token::Name(name) => prefix.push(name.clone()),
            Token::Sign('*') => {
                found(prefix.clone(), "*".to_owned());
                prefix.truncate(before);
                return;
            }
            Token::Sign('{') => {
                let end = closing(tree, at);
                let mut rest = &tree[at + 1..end - 1];
                while !rest.is_empty() {
                    let mut length = 0;
                    while length < rest.len() && rest[length] != Token::Sign(',') {
                        length = if rest[length] == Token::Sign('{') { closing(rest, length) } else { length + 1 };
                    }
                    leaves(&rest[..length], prefix, found);
                    rest = &rest[(length + 1).min(rest.len())..];
                }
                prefix.truncate(before);
                return;
            }
            _ => {}
        }
        at += 1;
    }
    if let Some(local) = prefix.last().filter(|_| !tree.is_empty()).cloned() {
        found(prefix.clone(), local);
    }
    prefix.truncate(before);
}
