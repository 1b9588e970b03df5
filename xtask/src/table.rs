//! Scores as a table.

use crate::run::Metrics;

fn cell(value: Option<f64>, digits: usize) -> String {
    value.map_or("–".to_owned(), |v| format!("{v:.digits$}"))
}

/// A row for each run: novel views where there are any, ranked quantities first.
pub fn markdown(rows: &[(String, &Metrics)]) -> String {
    let networks: Vec<&str> = rows.iter().filter_map(|(_, m)| m.lpips.as_deref()).collect();
    // Where pixels are unknown, beside the score of the known ones: their share, and a score of
    // all.
    let splits = || rows.iter().filter_map(|(_, m)| m.splits.first());
    let excuses = splits().any(|(_, split)| split.known.is_some_and(|known| known < 1.0));
    let header = "method|occluded|steps|train s|psnr_mask|psnr_hidden|ssim_mask|psnr_vis|ssim_vis|psnr_full|ssim_full|\
        iou|s/frame|params|perceptual term|lpips_full";
    let columns = if networks.is_empty() { 15 } else { 16 };
    let mut lines: Vec<Vec<String>> = vec![header.split('|').take(columns).map(str::to_owned).collect()];
    for (name, m) in rows {
        let Some((_, split)) = m.splits.first() else { continue };
        let mut line = vec![
            name.clone(),
            if m.method == "prior" { "–".to_owned() } else { m.occluded.clone() },
            m.steps.to_string(),
            format!("{:.0}", m.train_seconds),
            cell(split.psnr_mask, 2),
            cell(split.psnr_hidden, 2),
            cell(split.ssim_mask, 4),
            cell(split.psnr_vis, 2),
            cell(split.ssim_vis, 4),
            cell(split.psnr_full, 2),
            cell(split.ssim_full, 4),
            cell(split.mask_iou, 3),
            format!("{:.2}", split.render_seconds_per_frame),
            m.parameters.to_string(),
            if m.perceptual.is_empty() { "–".to_owned() } else { m.perceptual.clone() },
        ];
        if !networks.is_empty() {
            let network = m.lpips.as_deref().filter(|_| split.lpips_full.is_some());
            line.push(network.map_or("–".to_owned(), |n| format!("{} ({n})", cell(split.lpips_full, 4))));
        }
        if excuses {
            line.splice(5..5, [cell(split.psnr_all, 2), cell(split.known, 3)]);
        }
        lines.push(line);
    }
    if excuses {
        lines[0].splice(5..5, ["psnr_all", "known"].map(str::to_owned));
    }
    aligned(&lines, 2)
}

/// Lines of cells, the first of them the header, as a Markdown table; all columns but the first
/// `left` are aligned right.
pub fn aligned(lines: &[Vec<String>], left: usize) -> String {
    let columns = lines.first().map_or(0, Vec::len);
    let widths: Vec<usize> =
        (0..columns).map(|c| lines.iter().map(|l| l[c].chars().count()).max().unwrap_or(0)).collect();
    let mut text = String::new();
    for (i, line) in lines.iter().enumerate() {
        let cells = line
            .iter()
            .zip(&widths)
            .enumerate()
            .map(|(c, (cell, &w))| if c < left { format!("{cell:<w$}") } else { format!("{cell:>w$}") });
        text.push_str(&format!("| {} |\n", cells.collect::<Vec<_>>().join(" | ")));
        if i == 0 {
            let rules = widths
                .iter()
                .enumerate()
                .map(|(c, &w)| if c < left { "-".repeat(w) } else { format!("{}:", "-".repeat(w.saturating_sub(1))) });
            text.push_str(&format!("| {} |\n", rules.collect::<Vec<_>>().join(" | ")));
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::run::Splits;
    use occnerf::SplitMetrics;

    fn metrics(known: Option<f64>, lpips: Option<&str>) -> Metrics {
        let split = SplitMetrics { psnr_mask: Some(20.0), psnr_all: Some(17.0), known, ..SplitMetrics::default() };
        let splits = Splits { novel_view: Some(split), train_view: None };
        Metrics { lpips: lpips.map(str::to_owned), splits, ..Metrics::default() }
    }

    /// The header's and the first row's cells.
    fn cells(metrics: &Metrics) -> Vec<(String, String)> {
        let text = markdown(&[("row".to_owned(), metrics)]);
        let row = |line: usize| -> Vec<String> {
            text.lines().nth(line).unwrap().split('|').map(|cell| cell.trim().to_owned()).collect()
        };
        row(0).into_iter().zip(row(2)).collect()
    }

    #[test]
    fn what_unknown_pixels_excuse_is_said_where_there_are_any() {
        let of = |cells: &[(String, String)], name: &str| cells.iter().find(|c| c.0 == name).map(|c| c.1.clone());
        let all_known = cells(&metrics(Some(1.0), None));
        assert_eq!((of(&all_known, "known"), of(&all_known, "psnr_all")), (None, None));
        let excused = cells(&metrics(Some(0.75), None));
        assert_eq!(of(&excused, "known").as_deref(), Some("0.750"));
        assert_eq!(of(&excused, "psnr_all").as_deref(), Some("17.00"));
        assert_eq!(of(&excused, "psnr_mask").as_deref(), Some("20.00"));
        assert!(of(&excused, "lpips_full").is_none());
        assert!(of(&cells(&metrics(None, Some("alex"))), "lpips_full").is_some());
    }
}
