//! The README's settings of the presets are made from the presets.

use occnerf::{Config, Method, Preset};

/// Keys, with the names of their tables, and values of a preset.
fn settings(preset: Preset) -> Vec<(String, String)> {
    let (mut found, mut table) = (Vec::new(), String::new());
    let text = toml::to_string(&Config::preset(preset, Method::Occnerf)).unwrap();
    for line in text.lines() {
        match line.split_once(" = ") {
            Some((key, value)) => found.push((format!("{table}{key}"), value.to_owned())),
            None => table = line.trim_matches(['[', ']']).to_owned() + ".",
        }
    }
    // The first two are the names of preset and method.
    found.split_off(2)
}

#[test]
fn the_readme_shows_the_presets_as_they_are() {
    let presets = [Preset::Fast, Preset::Balanced, Preset::Paper].map(settings);
    let (mut rows, mut same) = (String::new(), Vec::new());
    for (i, (key, value)) in presets[0].iter().enumerate() {
        let cells = presets.each_ref().map(|preset| preset[i].1.as_str());
        match cells.iter().all(|cell| cell == value) {
            true => same.push(format!("`{key}` {value}")),
            false => rows += &format!("| `{key}` | {} |\n", cells.join(" | ")),
        }
    }
    let head = "| | `fast` | `balanced` | `paper` |\n| --- | --- | --- | --- |\n";
    let shown = format!("{head}{rows}\nThe same in all: {}.\n", same.join(", "));
    let words = |text: &str| text.split_whitespace().collect::<Vec<_>>().join(" ");
    let readme = include_str!("../../README.md");
    assert!(words(readme).contains(&words(&shown)), "the settings should be\n\n{shown}");
}
