//! Seconds a picture against scores.

use occnerf::SplitMetrics;

use super::scores::{FIELD, Pick};
use crate::bench::chart::{Mark, Panel, Picture, Shape, Style, legend};

/// Seconds a picture against each score.
pub fn charted(scene: &str, points: &[(String, SplitMetrics)]) -> Picture {
    let worths: [(&str, Pick); 4] = [
        ("psnr_mask, dB", |m| m.psnr_mask),
        ("psnr_hidden, dB", |m| m.psnr_hidden),
        ("ssim_mask", |m| m.ssim_mask),
        ("−lpips", |m| m.lpips_full.map(|lpips| -lpips)),
    ];
    let panel = |(label, worth): (&str, Pick)| {
        let mark = |(name, scores): &(String, SplitMetrics)| {
            let style = if name == FIELD { Style(6, Shape::Square) } else { Style(0, Shape::Circle) };
            Some(Mark { at: (scores.render_seconds_per_frame, worth(scores)?), name: name.clone(), style })
        };
        let marks: Vec<Mark> = points.iter().filter_map(mark).collect();
        let all: Vec<(f64, f64)> = marks.iter().map(|mark| mark.at).collect();
        Panel::scatter(label, ["seconds a picture", label], marks, &all)
    };
    let worths = worths.into_iter().filter(|(_, worth)| points.iter().any(|p| worth(&p.1).is_some()));
    Picture {
        title: format!("{scene}: the baked person and the field on unseen views"),
        legend: legend(&[
            ("front", Style(5, Shape::Dash)),
            (FIELD, Style(6, Shape::Square)),
            ("baked", Style(0, Shape::Circle)),
        ]),
        columns: 2,
        size: (640, 460),
        panels: worths.map(panel).collect(),
    }
}
