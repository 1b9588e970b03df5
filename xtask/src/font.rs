//! The font of charts and captions.

use anyhow::{Result, anyhow};
use plotters::style::FontStyle;

pub const FONT: &str = "sans-serif";
/// Mean width of a letter as a share of its height.
pub const LETTER: f64 = 0.56;

/// SVG text is measured, and PNG text drawn, with a font that comes along: systems may have none.
pub fn register_font() -> Result<()> {
    plotters::style::register_font(FONT, FontStyle::Normal, dejavu::sans::regular())
        .map_err(|_| anyhow!("the font cannot be read"))
}
