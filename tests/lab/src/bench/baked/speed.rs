//! How fast a baked person is drawn.

use std::time::Instant;

use anyhow::Result;
use glam::{Affine3A, Vec2};
use occnerf::bake::Avatar;
use occnerf::{Model, PosedView};
use volrender::Camera;

use super::baking::Baking;
use crate::bench::chart::{self, Axis, Mark, Panel, Picture, Shape, Style};

/// Sizes of the pictures whose drawing is timed.
const SIZES: [(u32, u32); 4] = [(256, 256), (512, 512), (1024, 1024), (1920, 1080)];

/// How fast pictures of a size are drawn.
pub struct Speed {
    baking: Baking,
    threads: usize,
    size: (u32, u32),
    seconds: f64,
}

/// Draws a pose of the video at several sizes on one thread and on two.
pub fn speeds(model: &Model, avatar: &Avatar, view: &PosedView, baking: Baking) -> Result<Vec<Speed>> {
    let bones: Vec<Affine3A> = view.posed.bones.clone();
    let mut speeds = Vec::new();
    for threads in [1, 2] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build()?;
        for size in SIZES {
            // As high as the picture, whatever its shape.
            let square = view.camera.resized(size.1, size.1);
            let aside = 0.5 * (size.0 - size.1) as f32;
            let camera = Camera { centre: square.centre + Vec2::X * aside, width: size.0, ..square };
            let mut renderer = baking.renderer(model, avatar);
            let mut best = f64::INFINITY;
            for _ in 0..3 {
                let start = Instant::now();
                pool.install(|| (0..10).try_for_each(|_| renderer.draw(&bones, &camera).map(drop)))?;
                best = best.min(start.elapsed().as_secs_f64() / 10.0);
            }
            speeds.push(Speed { baking, threads, size, seconds: best });
        }
    }
    Ok(speeds)
}

/// A row for each number of samples and threads, a column for each size.
pub fn rates(speeds: &[Speed]) -> Vec<Vec<String>> {
    let titles = ["samples a pixel, threads".to_owned()];
    let sizes = SIZES.map(|(width, height)| format!("{width} × {height}"));
    let mut rows = vec![titles.into_iter().chain(sizes).collect()];
    for line in speeds.chunks(SIZES.len()) {
        let Speed { baking, threads, .. } = line[0];
        let cells = line.iter().map(|speed| format!("{:.0}", speed.seconds.recip()));
        rows.push([format!("{}, {threads}", baking.count())].into_iter().chain(cells).collect());
    }
    rows
}

/// Milliseconds against pixels, on one thread and on two.
pub fn growth(scene: &str, speeds: &[Speed]) -> Picture {
    let pixels = |speed: &Speed| f64::from(speed.size.0) * f64::from(speed.size.1);
    let panel = |threads: usize| {
        let shown = || speeds.iter().filter(move |speed| speed.threads == threads);
        let of: Vec<&Speed> = shown().collect();
        let at = |speed: &&Speed| (pixels(speed), 1e3 * speed.seconds);
        let mark = |speed: &&Speed| Mark {
            at: at(speed),
            name: String::new(),
            style: Style(1, if !speed.baking.smooth { Shape::Circle } else { Shape::Square }),
        };
        Panel {
            title: format!("{threads} thread{}", if threads == 1 { "" } else { "s" }),
            labels: ["pixels".to_owned(), "milliseconds a picture".to_owned()],
            scales: [
                Axis::around(shown().map(pixels), true),
                Axis::around(shown().map(|speed| 1e3 * speed.seconds), true),
            ],
            lines: of
                .chunks(SIZES.len())
                .map(|line| chart::Line { points: line.iter().map(at).collect(), color: 1 })
                .collect(),
            marks: of.iter().map(mark).collect(),
        }
    };
    let of_samples =
        [("1 sample a pixel", Shape::Circle), ("4 samples", Shape::Square)].map(|(n, s)| (n.to_owned(), Style(5, s)));
    Picture {
        title: format!("{scene}: drawing the baked person"),
        legend: of_samples.into(),
        columns: 2,
        size: (480, 360),
        panels: [1, 2].map(panel).into(),
    }
}
