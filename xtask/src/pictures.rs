//! Contact sheets.

use std::path::Path;

use ab_glyph::{Font, FontRef, Glyph, ScaleFont, point};
use anyhow::Result;
use image::{ImageFormat, Rgb, RgbImage, imageops};
use occnerf::capture::Image;

use crate::run::{replace, unquoted};

/// Most pixels of a sheet: 96 MiB in memory, below the limits of image readers.
pub const MAX_SHEET_PIXELS: u64 = 1 << 25;
/// Gap between the cells of a sheet in pixels.
const GAP: u32 = 4;

/// 8-bit picture of sRGB values in [0, 1].
pub fn to_rgb(image: &Image) -> RgbImage {
    RgbImage::from_fn(image.width, image.height, |x, y| {
        let at = 3 * (y * image.width + x) as usize;
        Rgb(std::array::from_fn(|c| (image.pixels[at + c] * 255.0).round().clamp(0.0, 255.0) as u8))
    })
}

/// A premultiplied picture composited over grey by its `coverage` (H × W).
pub fn over_grey(pixels: &[f32], coverage: &[f32], width: u32, height: u32) -> RgbImage {
    let over = pixels.chunks_exact(3).zip(coverage).flat_map(|(p, &m)| p.iter().map(move |c| c + (1.0 - m) * 0.35));
    to_rgb(&Image { width, height, pixels: over.collect() })
}

/// Downsamples a picture to at most `most` pixels.
pub fn reduced(picture: RgbImage, most: u64) -> RgbImage {
    let (width, height) = picture.dimensions();
    let scale = (most as f64 / (f64::from(width) * f64::from(height))).sqrt();
    if scale >= 1.0 {
        return picture;
    }
    let side = |n: u32| ((f64::from(n) * scale) as u32).max(1);
    imageops::resize(&picture, side(width), side(height), imageops::FilterType::Triangle)
}

/// Rows of equally large pictures on white.
pub fn sheet(rows: &[Vec<RgbImage>]) -> RgbImage {
    let cell = |f: fn(&RgbImage) -> u32| rows.iter().flatten().map(f).max().unwrap_or(1);
    let (width, height) = (cell(RgbImage::width), cell(RgbImage::height));
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0) as u32;
    let size = (columns * (width + GAP) + GAP, rows.len() as u32 * (height + GAP) + GAP);
    let mut sheet = RgbImage::from_pixel(size.0, size.1, Rgb([255; 3]));
    for (r, row) in rows.iter().enumerate() {
        for (c, picture) in row.iter().enumerate() {
            let (x, y) = (GAP + c as u32 * (width + GAP), GAP + r as u32 * (height + GAP));
            imageops::replace(&mut sheet, picture, i64::from(x), i64::from(y));
        }
    }
    sheet
}

/// A sheet with a name above each column.
pub fn captioned(sheet: &RgbImage, names: &[&str]) -> Result<RgbImage> {
    const STRIP: u32 = 20;
    /// Largest height of a line of text in pixels.
    const LARGEST: f32 = 14.0;
    // Embedded; systems may have no font.
    let font = FontRef::try_from_slice(dejavu::sans::regular())?;
    let advance = |c: char| font.as_scaled(LARGEST).h_advance(font.glyph_id(c));
    let column = (sheet.width() - GAP) as f32 / names.len().max(1) as f32;
    let widths: Vec<f32> = names.iter().map(|name| name.chars().map(advance).sum()).collect();
    let shrunk = widths.iter().fold(1.0f32, |scale, width| scale.min((column - GAP as f32) / width));
    let mut out = RgbImage::from_pixel(sheet.width(), STRIP + sheet.height(), Rgb([255; 3]));
    imageops::replace(&mut out, sheet, 0, i64::from(STRIP));
    let scaled = font.as_scaled(shrunk * LARGEST);
    let baseline = 0.5 * (STRIP as f32 + scaled.ascent() + scaled.descent());
    for (c, (name, width)) in names.iter().zip(widths).enumerate() {
        let mut x = 0.5 * GAP as f32 + (c as f32 + 0.5) * column - 0.5 * shrunk * width;
        for letter in name.chars() {
            let glyph = Glyph { position: point(x, baseline), ..scaled.scaled_glyph(letter) };
            x += shrunk * advance(letter);
            let Some(outline) = font.outline_glyph(glyph) else { continue };
            let corner = outline.px_bounds().min;
            outline.draw(|u, v, cover| {
                let (u, v) = (corner.x as i64 + i64::from(u), corner.y as i64 + i64::from(v));
                if (0..i64::from(out.width())).contains(&u) && (0..i64::from(STRIP)).contains(&v) {
                    let pixel = out.get_pixel_mut(u as u32, v as u32);
                    pixel.0 = pixel.0.map(|value| (f32::from(value) * (1.0 - cover.min(1.0))) as u8);
                }
            });
        }
    }
    Ok(out)
}

/// The pictures of a [`sheet`], separated at its white gaps. Assumes equal sizes and edges that are
/// not white.
pub fn cells(sheet: &RgbImage) -> Vec<Vec<RgbImage>> {
    let white = |x, y| sheet.get_pixel(x, y).0 == [255; 3];
    let column = |x| (0..sheet.height()).all(|y| white(x, y));
    let row = |y| (0..sheet.width()).all(|x| white(x, y));
    let spans = |length: u32, gap: &dyn Fn(u32) -> bool| {
        let mut spans: Vec<(u32, u32)> = Vec::new();
        for at in (0..length).filter(|&at| !gap(at)) {
            match spans.last_mut() {
                Some((start, size)) if *start + *size == at => *size += 1,
                _ => spans.push((at, 1)),
            }
        }
        spans
    };
    let (columns, rows) = (spans(sheet.width(), &column), spans(sheet.height(), &row));
    let cell =
        |&(x, width): &(u32, u32), &(y, height): &(u32, u32)| imageops::crop_imm(sheet, x, y, width, height).to_image();
    rows.iter().map(|row| columns.iter().map(|column| cell(column, row)).collect()).collect()
}

/// Writes a PNG.
pub fn save(picture: &RgbImage, path: &Path) -> Result<()> {
    replace(path, |to| picture.write_to(to, ImageFormat::Png).map_err(unquoted))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn captions_stand_above_their_columns_and_change_nothing_below() {
        let plain = sheet(&[vec![RgbImage::from_pixel(60, 30, Rgb([9; 3])); 3]]);
        for names in [&["truth", "a", "a-longer-name"][..], &[]] {
            let whole = captioned(&plain, names).unwrap();
            let strip = whole.height() - plain.height();
            assert_eq!(imageops::crop_imm(&whole, 0, strip, plain.width(), plain.height()).to_image(), plain);
            let third = |c: u32| (c * whole.width() / 3..(c + 1) * whole.width() / 3).collect::<Vec<_>>();
            let ink = |c| third(c).iter().any(|&x| (0..strip).any(|y| whole.get_pixel(x, y).0[0] < 128));
            assert!((0..3).all(|c| ink(c) != names.is_empty()));
        }
    }

    #[test]
    fn a_sheet_of_large_pictures_stays_small_enough_to_be_read() {
        let large = || RgbImage::from_pixel(3300, 3300, Rgb([9; 3]));
        let row = vec![reduced(large(), MAX_SHEET_PIXELS / 18); 6];
        let sheet = sheet(&[row.clone(), row.clone(), row]);
        assert!(u64::from(sheet.width()) * u64::from(sheet.height()) < MAX_SHEET_PIXELS + MAX_SHEET_PIXELS / 50);
        assert_eq!(reduced(large(), 1 << 40).dimensions(), (3300, 3300));
        assert_eq!(reduced(RgbImage::new(1, 9), 3).dimensions(), (1, 5));
    }

    #[test]
    fn a_sheet_comes_apart_into_its_pictures() {
        let picture = |i: u8| RgbImage::from_fn(5, 7, |x, y| Rgb([i, x as u8, y as u8]));
        let rows = vec![vec![picture(1), picture(2), picture(3)], vec![picture(4), picture(5), picture(6)]];
        assert_eq!(cells(&sheet(&rows)), rows);
        assert!(cells(&sheet(&[])).is_empty());
        assert!(cells(&RgbImage::from_pixel(9, 9, Rgb([255; 3]))).is_empty());
    }
}
