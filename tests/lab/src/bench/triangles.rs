//! `bench triangles`: size of an avatar against accuracy.

use std::fmt::Write as _;
use std::path::Path;

use anyhow::{Context, Result, ensure};
use occnerf::bake::Avatar;
use occnerf::bake::export::GlbOptions;
use occnerf::{PreparedFrame, evaluate};
use xtask::baked;
use xtask::eval::{Drawn, scored_frames};
use xtask::run::write;

use super::chart::{Mark, Panel, Picture, Shape, Style, legend};
use crate::scene;

/// Triangles, beside those that the avatar has, and the quality of the texture as JPEG.
const TRIANGLES: [usize; 6] = [10000, 8000, 6000, 4000, 3000, 2000];
const JPEG: u8 = 85;
const WORTHS: [(&str, usize); 3] = [("psnr_mask, dB", 2), ("psnr_hidden, dB", 2), ("ssim_mask", 4)];

/// Scores the avatar of the run in `directory` with fewer and fewer triangles, texture as PNG and JPEG,
/// on unseen views, or on training views where there are no others; a table and a chart below `out`.
pub fn run(directory: &Path, out: &Path) -> Result<()> {
    let (run, source) = scene::of_run(directory)?;
    let scene = source.scene(&run.train)?;
    let path = baked::path(directory);
    ensure!(path.exists(), "{}: no avatar; cargo xtask export {0} makes one", directory.display());
    let whole = Avatar::load(&path)?;
    let frames: Vec<&PreparedFrame> =
        if scene.eval.is_empty() { scored_frames(&scene).collect() } else { scene.eval.iter().collect() };
    let mut text = "| triangles | texture | MB |".to_owned();
    WORTHS.iter().for_each(|(name, _)| text.push_str(&format!(" {name} |")));
    text.push_str("\n| ---: | --- | ---: | ---: | ---: | ---: |\n");
    let mut points = Vec::new();
    for triangles in [&[whole.faces.len()], &TRIANGLES[..]].concat() {
        let mut avatar = whole.clone();
        avatar.simplify(triangles)?;
        for jpeg in [None, Some(JPEG)] {
            if let Some(quality) = jpeg {
                avatar.atlas.rgb = image::load_from_memory(&avatar.atlas.to_jpeg(quality)?)?.into_rgb8().into_raw();
            }
            let size = avatar.to_glb_with(&GlbOptions { jpeg, ..GlbOptions::default() })?.len() as f64 * 1e-6;
            let drawn = Drawn::Avatar { body: &scene.body, light: scene.colors()?.light, avatar: &avatar };
            let found = evaluate(&scene, drawn.renderer(&scene)?.as_mut(), &frames, None, |_, _| {})?;
            let worths = [found.psnr_mask, found.psnr_hidden, found.ssim_mask].map(|worth| worth.unwrap_or(f64::NAN));
            let name = jpeg.map_or("PNG".to_owned(), |quality| format!("JPEG {quality}"));
            write!(text, "| {} | {name} | {size:.2} |", avatar.faces.len())?;
            for (worth, (_, digits)) in worths.iter().zip(WORTHS) {
                write!(text, " {worth:.digits$} |")?;
            }
            text.push('\n');
            points.push((avatar.faces.len(), jpeg.is_some(), size, worths));
        }
    }
    xtask::say!("{text}");
    std::fs::create_dir_all(out).with_context(|| out.display().to_string())?;
    write(&out.join("triangles.md"), &text)?;
    let style = |jpeg: bool| if jpeg { Style(1, Shape::Ring) } else { Style(0, Shape::Circle) };
    let panel = |(i, (worth, _)): (usize, &(&str, usize))| {
        let mark = |&(triangles, jpeg, size, worths): &(usize, bool, f64, [f64; 3])| Mark {
            at: (size, worths[i]),
            name: if jpeg { String::new() } else { triangles.to_string() },
            style: style(jpeg),
        };
        let all: Vec<(f64, f64)> = points.iter().map(|(_, _, size, worths)| (*size, worths[i])).collect();
        Panel::scatter("", ["MB of the GLB", worth], points.iter().map(mark).collect(), &all)
    };
    Picture {
        title: format!("{}: triangles and texture of the avatar, unseen views", source.scene),
        legend: legend(&[("PNG", style(false)), ("JPEG", style(true)), ("front", Style(5, Shape::Dash))]),
        columns: 2,
        size: (640, 460),
        panels: WORTHS.iter().enumerate().map(panel).collect(),
    }
    .write(&out.join("triangles"))?;
    Ok(())
}
