//! Before/after slider of two pictures of a view.

use std::io::Cursor;
use std::path::Path;

use anyhow::{Context, Result};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use image::{ImageFormat, RgbImage};

use crate::pictures;
use crate::process::note;

/// Most views of a viewer.
const MOST: usize = 15;
/// Most pixels of a contact sheet.
const MAX_PIXELS: u64 = pictures::MAX_SHEET_PIXELS + pictures::MAX_SHEET_PIXELS / 8;

/// Ground truth and renderings of evaluation views, from `eval`'s contact sheet.
pub struct Views {
    /// Name of a view, truth, result.
    pairs: Vec<(String, RgbImage, RgbImage)>,
}

impl Views {
    /// Reads a sheet of pairs; `None` without a file.
    pub fn read(path: &Path) -> Result<Option<Self>> {
        if !path.exists() {
            return Ok(None);
        }
        let (width, height) = image::image_dimensions(path).with_context(|| path.display().to_string())?;
        if u64::from(width) * u64::from(height) > MAX_PIXELS {
            note!("warning: {}: {width}×{height} pixels are too many for the page", path.display());
            return Ok(None);
        }
        let sheet = image::open(path).with_context(|| path.display().to_string())?.into_rgb8();
        let mut pairs = Vec::new();
        for (row, cells) in pictures::cells(&sheet).into_iter().enumerate() {
            for (column, pair) in cells.chunks_exact(2).enumerate() {
                pairs.push((format!("camera {}, moment {}", row + 1, column + 1), pair[0].clone(), pair[1].clone()));
            }
        }
        let stride = pairs.len().div_ceil(MOST).max(1);
        Ok(Some(Self { pairs: pairs.into_iter().step_by(stride).collect() }))
    }

    /// Whether both have the same ground truth.
    fn alike(&self, other: &Self) -> bool {
        self.pairs.len() == other.pairs.len() && self.pairs.iter().zip(&other.pairs).all(|(a, b)| a.1 == b.1)
    }
}

fn encode(picture: &RgbImage) -> Result<String> {
    let mut bytes = Cursor::new(Vec::new());
    picture.write_to(&mut bytes, ImageFormat::Png)?;
    Ok(STANDARD.encode(bytes.into_inner()))
}

/// A viewer for each set of views, with the ground truth and every run selectable on either side.
pub fn viewers(runs: &[(String, Views)]) -> Result<String> {
    let mut text = String::new();
    let mut groups: Vec<Vec<&(String, Views)>> = Vec::new();
    for run in runs.iter().filter(|r| !r.1.pairs.is_empty()) {
        match groups.iter_mut().find(|g| g[0].1.alike(&run.1)) {
            Some(group) => group.push(run),
            None => groups.push(vec![run]),
        }
    }
    for group in groups {
        let first = &group[0].1.pairs;
        let side = |name: &str, pictures: Vec<&RgbImage>| -> Result<serde_json::Value> {
            let images: Vec<String> = pictures.into_iter().map(encode).collect::<Result<_>>()?;
            Ok(serde_json::json!({ "name": name, "images": images }))
        };
        let mut sides = vec![side("truth", first.iter().map(|p| &p.1).collect())?];
        for (name, views) in &group {
            sides.push(side(name, views.pairs.iter().map(|p| &p.2).collect())?);
        }
        let views: Vec<&str> = first.iter().map(|p| p.0.as_str()).collect();
        // `<` could end the script element.
        let data = serde_json::json!({ "views": views, "sides": sides }).to_string().replace('<', "\\u003c");
        text.push_str("<div class=viewer><div><select aria-label=\"view\"></select>");
        text.push_str("<select aria-label=\"left\"></select><select aria-label=\"right\"></select></div>");
        text.push_str("<div class=pair><img alt=\"left\"><img alt=\"right\"><b></b>");
        text.push_str("<input type=range min=0 max=100 step=0.5 value=50 aria-label=\"left to right\"></div>");
        text.push_str("<div class=ends><span></span><span></span></div>");
        text.push_str(&format!("<script type=\"application/json\">{data}</script></div>\n"));
    }
    Ok(text)
}
