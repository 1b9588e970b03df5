//! Seconds a picture against scores.

use occnerf::SplitMetrics;

use super::scores::{FIELD, Pick};
use crate::bench::chart::{self, Axis, Mark, Panel, Picture, Shape, Style};
use crate::bench::front::front;

/// Seconds a picture against each score.
pub fn charted(scene: &str, points: &[(String, SplitMetrics)]) -> Picture {
    let worths: [(&str, Pick); 4] = [
        ("psnr_mask, dB", |m| m.psnr_mask),
        ("psnr_hidden, dB", |m| m.psnr_hidden),
        ("ssim_mask", |m| m.ssim_mask),
        ("−lpips", |m| m.lpips_full.map(|lpips| -lpips)),
    ];
    let panel = |(label, worth): (&str, Pick)| {
        let scored: Vec<(&str, (f64, f64))> = points
            .iter()
            .filter_map(|(name, scores)| Some((name.as_str(), (scores.render_seconds_per_frame, worth(scores)?))))
            .collect();
        let at: Vec<(f64, f64)> = scored.iter().map(|point| point.1).collect();
        let mut along: Vec<(f64, f64)> = at.iter().zip(front(&at)).filter(|(_, on)| *on).map(|(at, _)| *at).collect();
        along.sort_by(|a, b| a.0.total_cmp(&b.0));
        let style = |name: &str| if name == FIELD { Style(6, Shape::Square) } else { Style(0, Shape::Circle) };
        Panel {
            title: label.to_owned(),
            labels: ["seconds a picture".to_owned(), label.to_owned()],
            scales: [Axis::around(at.iter().map(|at| at.0), true), Axis::around(at.iter().map(|at| at.1), false)],
            lines: vec![chart::Line { points: along, color: 5 }],
            marks: scored
                .iter()
                .map(|(name, at)| Mark { at: *at, name: (*name).to_owned(), style: style(name) })
                .collect(),
        }
    };
    let legend =
        [("front", Style(5, Shape::Dash)), (FIELD, Style(6, Shape::Square)), ("baked", Style(0, Shape::Circle))];
    Picture {
        title: format!("{scene}: the baked person and the field on unseen views"),
        legend: legend.iter().map(|(name, style)| ((*name).to_owned(), *style)).collect(),
        columns: 2,
        size: (640, 460),
        panels: worths
            .into_iter()
            .filter(|(_, worth)| points.iter().any(|p| worth(&p.1).is_some()))
            .map(panel)
            .collect(),
    }
}
