//! Colours of a character: its base colour texture, else a pattern.

use glam::{Vec2, Vec3, Vec4};
use image::{ImageReader, RgbaImage};
use rigged::{Character, Texture};

use super::noise::smooth_noise;
use capture::CaptureError;
use capture::MAX_SIDE;

/// Decodes the base colour textures, of [`MAX_SIDE`]² pixels at most all together.
pub(super) fn decode(character: &Character) -> Result<Vec<RgbaImage>, CaptureError> {
    let mut left = u64::from(MAX_SIDE).pow(2);
    character.textures.iter().map(|texture| decoded(texture, &mut left)).collect()
}

fn decoded(texture: &Texture, left: &mut u64) -> Result<RgbaImage, CaptureError> {
    let fault = |found: String| CaptureError::setting("character", "a base colour texture in PNG or JPEG", found);
    let open = || ImageReader::new(std::io::Cursor::new(&texture.bytes)).with_guessed_format();
    let size = open().map_err(|e| fault(e.to_string()))?.into_dimensions().map_err(|e| fault(e.to_string()))?;
    let rest = left.checked_sub(u64::from(size.0) * u64::from(size.1));
    let fits = size.0.min(size.1) > 0 && size.0.max(size.1) <= MAX_SIDE;
    *left = rest.filter(|_| fits).ok_or_else(|| fault(format!("one of {}×{} pixels", size.0, size.1)))?;
    let decoded = open().map_err(|e| fault(e.to_string()))?.decode().map_err(|e| fault(e.to_string()))?;
    Ok(decoded.into_rgba8())
}

/// The colour and alpha at `uv`, bilinear, repeated beyond the edges. Coordinates that are not
/// finite give the corner's.
pub(super) fn sample(texture: &RgbaImage, uv: Vec2) -> Vec4 {
    let size = Vec2::new(texture.width() as f32, texture.height() as f32);
    let uv = if uv.is_finite() { uv - uv.floor() } else { Vec2::ZERO };
    let at = uv * size - Vec2::splat(0.5);
    let (corner, t) = (at.floor(), at - at.floor());
    let texel = |dx: i64, dy: i64| {
        let x = (corner.x as i64 + dx).rem_euclid(i64::from(texture.width())) as u32;
        let y = (corner.y as i64 + dy).rem_euclid(i64::from(texture.height())) as u32;
        Vec4::from(texture.get_pixel(x, y).0.map(f32::from)) / 255.0
    };
    let row = |dy: i64| texel(0, dy).lerp(texel(1, dy), t.x);
    row(0).lerp(row(1), t.y)
}

/// An sRGB colour times a linear factor.
pub(super) fn tinted(color: Vec3, factor: Vec3) -> Vec3 {
    if factor == Vec3::ONE {
        return color;
    }
    let linear = |c: f32| if c <= 0.04045 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) };
    let srgb = |c: f32| if c <= 0.003_130_8 { 12.92 * c } else { 1.055 * c.powf(1.0 / 2.4) - 0.055 };
    (color.map(linear) * factor).map(srgb)
}

/// A pattern for characters without colours: bands of colour that differ from bone to bone. `at`
/// is the place at rest in metres of a person 1.7 m tall, `joint` the bone that moves it most.
pub(super) fn pattern(at: Vec3, joint: usize) -> Vec3 {
    let hue = joint as f32 * 0.618_034;
    let wave = |shift: f32| 0.5 + 0.35 * (std::f32::consts::TAU * (hue + shift)).cos();
    let base = Vec3::new(wave(0.0), wave(0.33), wave(0.67));
    let band = if (at.y * 14.0).rem_euclid(1.0) < 0.35 { 0.55 } else { 1.0 };
    let check = if (at.x * 12.0).rem_euclid(1.0) < 0.5 { 1.0 } else { 0.85 };
    base * (band * check * (0.85 + 0.3 * smooth_noise(at * 25.0)))
}
