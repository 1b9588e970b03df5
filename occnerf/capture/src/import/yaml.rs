//! The part of OpenCV's YAML that calibration files need: numbers, and `!!opencv-matrix` with its
//! `data`.

use std::collections::BTreeMap;

/// Numbers and matrices, row by row, by name. Everything else is ignored; malformed numbers are NaN.
pub(super) fn parse(text: &str) -> BTreeMap<String, Vec<f64>> {
    let number = |text: &str| text.trim().parse().unwrap_or(f64::NAN);
    let mut found = BTreeMap::new();
    let (mut name, mut list) = (String::new(), None::<String>);
    for line in text.lines() {
        // A list may go on over several lines.
        if let Some(text) = &mut list {
            text.push_str(line);
        } else if let Some((key, rest)) = line.split_once(':') {
            let (indented, key, rest) = (key.starts_with([' ', '%']), key.trim(), rest.trim());
            if !indented {
                name = key.trim_matches('"').to_owned();
                if rest.parse::<f64>().is_ok() {
                    found.insert(name.clone(), vec![number(rest)]);
                }
            } else if key == "data" && rest.starts_with('[') {
                list = Some(rest.to_owned());
            }
        }
        if let Some(text) = list.take_if(|text| text.contains(']')) {
            let inside = text.trim_start_matches('[').split(']').next().unwrap_or("");
            let values = inside.split(',').filter(|item| !item.trim().is_empty()).map(number);
            found.insert(name.clone(), values.collect());
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn matrices_and_numbers_are_found_by_name() {
        let text = "%YAML:1.0\n---\nnames:\n  - \"1\"\nK_1: !!opencv-matrix\n  rows: 1\n  cols: 3\n  dt: d\n  data: [ 1., 2,\n      -3e0 ]\nH_1: 256\nx: [a]\n";
        let found = parse(text);
        assert_eq!(found["K_1"], [1.0, 2.0, -3.0]);
        assert_eq!(found["H_1"], [256.0]);
        assert_eq!(found.len(), 2);
        assert!(parse("K: !!opencv-matrix\n  data: [1, x]\n")["K"][1].is_nan());
        assert!(parse("K: !!opencv-matrix\n  data: [1, ").is_empty());
    }
}
