//! Charts of named points and lines, as SVG and PNG.

use std::ops::Range;
use std::path::{Path, PathBuf};

use anyhow::{Result, anyhow};
use image::RgbImage;
use image::imageops::{self, FilterType};
use plotters::coord::Shift;
use plotters::coord::ranged1d::{KeyPointHint, NoDefaultFormatting, Ranged, ValueFormatter};
use plotters::prelude::*;
use plotters::style::FontStyle;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use xtask::process::say;
use xtask::scale::{Scale, number};

const FONT: &str = "sans-serif";
/// Mean width of a letter as a share of its height.
const LETTER: f64 = 0.56;
/// Factor by which PNGs are drawn larger before they are reduced, for smooth edges.
const OVERSAMPLING: i32 = 2;
/// Height of the title and of each legend row, and sizes of text, in pixels.
const TITLE: i32 = 34;
const ROW: i32 = 20;
const SMALL: i32 = 11;

/// Colours that are told apart by colour-blind people too (Okabe and Ito 2008).
pub const COLORS: [RGBColor; 7] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(230, 159, 0),
    RGBColor(110, 110, 110),
    RGBColor(0, 0, 0),
];

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Shape {
    Circle,
    Ring,
    Square,
    Triangle,
    Cross,
    /// A piece of a line, for the legend.
    Dash,
}

/// Colour and shape.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Style(pub usize, pub Shape);

/// A point; without a name if that is empty.
pub struct Mark {
    pub at: (f64, f64),
    pub name: String,
    pub style: Style,
}

/// A line from point to point.
pub struct Line {
    pub points: Vec<(f64, f64)>,
    pub color: usize,
}

/// Numbers along an axis, or names at 0, 1, ….
#[derive(Clone)]
pub enum Axis {
    Numbers(Scale),
    Names(Vec<String>),
}

impl Axis {
    /// A scale that shows all of `values`.
    pub fn around(values: impl Iterator<Item = f64>, logarithmic: bool) -> Self {
        Self::Numbers(Scale::around(values, logarithmic))
    }

    fn shows(&self, value: f64) -> bool {
        match self {
            Self::Numbers(scale) => scale.shows(value),
            Self::Names(_) => true,
        }
    }

    /// 0 at the low end, 1 at the high end.
    fn share(&self, value: f64) -> f64 {
        match self {
            Self::Numbers(scale) => scale.share(value),
            Self::Names(names) => (value + 0.5) / names.len().max(1) as f64,
        }
    }
}

impl Ranged for Axis {
    type FormatOption = NoDefaultFormatting;
    type ValueType = f64;

    fn map(&self, value: &f64, limit: (i32, i32)) -> i32 {
        limit.0 + (self.share(*value) * f64::from(limit.1 - limit.0)).round() as i32
    }

    fn key_points<Hint: KeyPointHint>(&self, _: Hint) -> Vec<f64> {
        match self {
            Self::Numbers(scale) => scale.ticks(),
            Self::Names(names) => (0..names.len()).map(|i| i as f64).collect(),
        }
    }

    fn range(&self) -> Range<f64> {
        match self {
            Self::Numbers(Scale::Linear(range) | Scale::Logarithmic(range)) => range.clone(),
            Self::Names(names) => -0.5..names.len() as f64 - 0.5,
        }
    }
}

impl ValueFormatter<f64> for Axis {
    fn format_ext(&self, value: &f64) -> String {
        match self {
            Self::Numbers(_) => number(*value),
            Self::Names(names) => names.get(value.round().max(0.0) as usize).cloned().unwrap_or_default(),
        }
    }
}

/// One pair of axes.
pub struct Panel {
    pub title: String,
    pub labels: [String; 2],
    pub scales: [Axis; 2],
    pub lines: Vec<Line>,
    pub marks: Vec<Mark>,
}

impl Panel {
    /// Marks, and a line along the front of `all`.
    pub fn scatter(title: &str, labels: [&str; 2], marks: Vec<Mark>, all: &[(f64, f64)]) -> Self {
        let mut along: Vec<(f64, f64)> = all.iter().zip(front(all)).filter(|(_, on)| *on).map(|(at, _)| *at).collect();
        along.sort_by(|a, b| a.0.total_cmp(&b.0));
        Self {
            title: title.to_owned(),
            labels: labels.map(str::to_owned),
            scales: [
                Axis::around(marks.iter().map(|m| m.at.0), true),
                Axis::around(marks.iter().map(|m| m.at.1), false),
            ],
            lines: vec![Line { points: along, color: 5 }],
            marks,
        }
    }
}

/// Whether each point (cost, worth) is on the Pareto front: no other has at most its cost and at
/// least its worth, and one of the two strictly. Equal points stand or fall together; a point that
/// is not finite is never on it.
pub fn front(points: &[(f64, f64)]) -> Vec<bool> {
    let finite = |p: &(f64, f64)| p.0.is_finite() && p.1.is_finite();
    let beats = |a: &(f64, f64), b: &(f64, f64)| a.0 <= b.0 && a.1 >= b.1 && a != b;
    points.iter().map(|p| finite(p) && !points.iter().any(|other| finite(other) && beats(other, p))).collect()
}

/// Entries of a legend.
pub fn legend(entries: &[(&str, Style)]) -> Vec<(String, Style)> {
    entries.iter().map(|&(name, style)| (name.to_owned(), style)).collect()
}

/// Panels in rows under a title and a legend.
pub struct Picture {
    pub title: String,
    pub legend: Vec<(String, Style)>,
    pub columns: usize,
    /// Of a panel, in pixels.
    pub size: (u32, u32),
    pub panels: Vec<Panel>,
}

impl Picture {
    fn head(&self) -> i32 {
        TITLE + if self.legend.is_empty() { 0 } else { ROW }
    }

    fn extent(&self) -> (u32, u32) {
        let columns = self.columns.clamp(1, self.panels.len().max(1));
        let rows = self.panels.len().div_ceil(columns) as u32;
        (columns as u32 * self.size.0, self.head() as u32 + rows * self.size.1)
    }

    /// Writes STEM.svg and STEM.png and says so.
    pub fn write(&self, stem: &Path) -> Result<[PathBuf; 2]> {
        // Text is measured and drawn with a font that comes along: systems may have none.
        plotters::style::register_font(FONT, FontStyle::Normal, dejavu::sans::regular())
            .map_err(|_| anyhow!("the font cannot be read"))?;
        let (svg, png) = (stem.with_extension("svg"), stem.with_extension("png"));
        let size = self.extent();
        let mut text = String::new();
        self.draw(&SVGBackend::with_string(&mut text, size).into_drawing_area(), 1)?;
        xtask::run::write(&svg, &text)?;
        let large = (size.0 * OVERSAMPLING as u32, size.1 * OVERSAMPLING as u32);
        let mut pixels = vec![255; 3 * large.0 as usize * large.1 as usize];
        self.draw(&BitMapBackend::with_buffer(&mut pixels, large).into_drawing_area(), OVERSAMPLING)?;
        let picture = RgbImage::from_raw(large.0, large.1, pixels).ok_or_else(|| anyhow!("picture of no size"))?;
        xtask::pictures::save(&imageops::resize(&picture, size.0, size.1, FilterType::Triangle), &png)?;
        say!("written: {}\nwritten: {}", svg.display(), png.display());
        Ok([svg, png])
    }

    fn draw<B: DrawingBackend>(&self, root: &DrawingArea<B, Shift>, scale: i32) -> Result<()> {
        self.paint(root, scale).map_err(|error| anyhow!("drawing: {error}"))
    }

    fn paint<B: DrawingBackend>(&self, root: &DrawingArea<B, Shift>, scale: i32) -> Outcome<B> {
        root.fill(&WHITE)?;
        root.draw(&Text::new(self.title.clone(), (12 * scale, 9 * scale), font(17, scale)))?;
        let mut x = 16;
        for (name, style) in &self.legend {
            mark(root, (x * scale, (TITLE + ROW / 2 - 2) * scale), *style, scale)?;
            root.draw(&Text::new(name.clone(), ((x + 9) * scale, (TITLE + 2) * scale), font(12, scale)))?;
            x += 26 + (letters(name) * 12.0 * 1.1) as i32;
        }
        let columns = self.columns.clamp(1, self.panels.len().max(1)) as i32;
        let (width, height) = (self.size.0 as i32, self.size.1 as i32);
        for (i, panel) in (0..).zip(&self.panels) {
            let (x, y) = (i % columns * width, self.head() + i / columns * height);
            let (xs, ys) = (x * scale..(x + width) * scale, y * scale..(y + height) * scale);
            panel.paint(&root.clone().shrink((xs.start, ys.start), (width * scale, height * scale)), scale)?;
        }
        root.present()
    }
}

type Outcome<B> = Result<(), DrawingAreaErrorKind<<B as DrawingBackend>::ErrorType>>;

impl Panel {
    fn paint<B: DrawingBackend>(&self, area: &DrawingArea<B, Shift>, scale: i32) -> Outcome<B> {
        let [x, y] = self.scales.clone();
        let mut chart = ChartBuilder::on(area)
            .margin(10 * scale)
            .caption(&self.title, font(14, scale))
            .x_label_area_size(40 * scale)
            .y_label_area_size(56 * scale)
            .build_cartesian_2d(x, y)?;
        chart
            .configure_mesh()
            .max_light_lines(1)
            .light_line_style(TRANSPARENT)
            .bold_line_style(RGBColor(225, 225, 225).stroke_width(scale as u32))
            .axis_style(RGBColor(120, 120, 120).stroke_width(scale as u32))
            .label_style(font(SMALL, scale))
            .axis_desc_style(font(12, scale))
            .x_desc(&self.labels[0])
            .y_desc(&self.labels[1])
            .draw()?;
        let plot = chart.plotting_area().clone();
        let (width, height) = plot.dim_in_pixel();
        let plain = plot.strip_coord_spec();
        let place = |at: (f64, f64)| -> Option<(i32, i32)> {
            if !(self.scales[0].shows(at.0) && self.scales[1].shows(at.1)) {
                return None;
            }
            let (u, v) = (self.scales[0].share(at.0), self.scales[1].share(at.1));
            let at = |share: f64, length: u32| (share * f64::from(length)).round() as i32;
            ((-0.01..=1.01).contains(&u) && (-0.01..=1.01).contains(&v)).then(|| (at(u, width), at(1.0 - v, height)))
        };
        for line in &self.lines {
            let points: Vec<(i32, i32)> = line.points.iter().filter_map(|&p| place(p)).collect();
            plain.draw(&PathElement::new(points, COLORS[line.color].stroke_width(2 * scale as u32)))?;
        }
        let marks: Vec<(&Mark, (i32, i32))> = self.marks.iter().filter_map(|m| Some((m, place(m.at)?))).collect();
        for (m, at) in &marks {
            mark(&plain, *at, m.style, scale)?;
        }
        let spots: Vec<((i32, i32), &str)> = marks.iter().map(|(m, at)| (*at, m.name.as_str())).collect();
        for label in arrange(&spots, (width as i32, height as i32), scale) {
            if let Some(from) = label.leader {
                let grey = RGBColor(170, 170, 170).stroke_width(scale as u32);
                plain.draw(&PathElement::new(vec![from, label.nearest(from)], grey))?;
            }
            let color = COLORS[marks[label.index].0.style.0];
            let text = font(SMALL, scale).color(&color);
            plain.draw(&Text::new(marks[label.index].0.name.clone(), label.corner, text))?;
        }
        Ok(())
    }
}

fn font(size: i32, scale: i32) -> TextStyle<'static> {
    (FONT, size * scale).into_font().color(&RGBColor(40, 40, 40)).pos(Pos::new(HPos::Left, VPos::Top))
}

fn letters(text: &str) -> f64 {
    text.chars().count() as f64 * LETTER
}

fn mark<B: DrawingBackend>(area: &DrawingArea<B, Shift>, at: (i32, i32), style: Style, scale: i32) -> Outcome<B> {
    let (color, r) = (COLORS[style.0], 4 * scale);
    let line = color.stroke_width(2 * scale as u32);
    match style.1 {
        Shape::Circle => area.draw(&Circle::new(at, r, color.filled())),
        Shape::Ring => area.draw(&Circle::new(at, r, line)),
        Shape::Square => area.draw(&Rectangle::new([(at.0 - r, at.1 - r), (at.0 + r, at.1 + r)], color.filled())),
        Shape::Triangle => area.draw(&TriangleMarker::new(at, r + 2 * scale, color.filled())),
        Shape::Dash => area.draw(&PathElement::new(vec![(at.0 - 2 * r, at.1), (at.0 + r, at.1)], line)),
        Shape::Cross => area.draw(&plotters::element::Cross::new(at, r + scale, line)),
    }
}

/// Where a name stands.
struct Label {
    index: usize,
    corner: (i32, i32),
    size: (i32, i32),
    /// Where the line to its point begins, if the name is not right beside it.
    leader: Option<(i32, i32)>,
}

impl Label {
    /// The place of its edge that is nearest to a point.
    fn nearest(&self, at: (i32, i32)) -> (i32, i32) {
        let (x, y) = self.corner;
        (at.0.clamp(x, x + self.size.0), at.1.clamp(y, y + self.size.1))
    }

    fn overlap(&self, low: (i32, i32), high: (i32, i32)) -> i64 {
        let along = |a: i32, length: i32, low: i32, high: i32| (high.min(a + length) - low.max(a)).max(0);
        let (x, y) = (self.corner.0, self.corner.1);
        i64::from(along(x, self.size.0, low.0, high.0)) * i64::from(along(y, self.size.1, low.1, high.1))
    }
}

/// Places names one after another where they cover least of points and other names, near their
/// points.
fn arrange(spots: &[((i32, i32), &str)], area: (i32, i32), scale: i32) -> Vec<Label> {
    let mut placed: Vec<Label> = Vec::new();
    for (index, &(at, name)) in spots.iter().enumerate().filter(|(_, s)| !s.1.is_empty()) {
        let size = ((letters(name) * f64::from(SMALL * scale)) as i32 + 2 * scale, (SMALL + 2) * scale);
        let mut best: Option<(i64, Label)> = None;
        for ring in 0..9 {
            for turn in 0..16 {
                let angle = std::f64::consts::TAU * f64::from(turn) / 16.0;
                let reach = f64::from((8 + 13 * ring) * scale);
                let (dx, dy) = (reach * angle.cos(), reach * angle.sin());
                // Names left of their point end there, those right of it begin there.
                let x = at.0 + dx as i32 - (0.5 * (1.0 - angle.cos()) * f64::from(size.0)) as i32;
                let corner = (x, at.1 + dy as i32 - size.1 / 2);
                let label = Label { index, corner, size, leader: (ring > 0).then_some(at) };
                let end = (corner.0 + size.0, corner.1 + size.1);
                let whole = i64::from(size.0) * i64::from(size.1);
                let outside = whole - label.overlap((0, 0), area);
                let r = 5 * scale;
                let points = spots.iter().map(|(p, _)| label.overlap((p.0 - r, p.1 - r), (p.0 + r, p.1 + r)));
                let names = placed.iter().map(|other| other.overlap(corner, end));
                let far = i64::from(ring) * i64::from(scale * scale) * 40;
                let cost = 20 * outside + 3 * points.sum::<i64>() + 6 * names.sum::<i64>() + far;
                if best.as_ref().is_none_or(|(least, _)| cost < *least) {
                    best = Some((cost, label));
                }
            }
        }
        placed.extend(best.map(|(_, label)| label));
    }
    placed
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_nothing_there_is_no_front_and_what_is_not_finite_is_not_on_it() {
        assert!(front(&[]).is_empty());
        assert_eq!(front(&[(f64::NAN, 1.0), (1.0, f64::INFINITY), (2.0, 2.0)]), [false, false, true]);
        assert_eq!(
            front(&[(1.0, 1.0), (1.0, 1.0), (0.0, 0.0), (-0.0, 0.0), (1.0, 0.0)])[..],
            [true, true, true, true, false]
        );
    }
}
