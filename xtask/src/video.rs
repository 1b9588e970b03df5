//! Video output: GIF or, with the feature `mp4`, H.264 in MP4.

use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use anyhow::Result;
use clap::ValueEnum;
use image::codecs::gif::{GifEncoder, Repeat};
use image::{Delay, Frame, RgbImage};

use crate::run::{replace, unquoted};

/// Video format.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum FilmFormat {
    /// H.264, plays in every browser.
    Mp4,
    /// No film, the pictures alone.
    Png,
    /// 256 colours, for pages that take no video.
    Gif,
}

/// Encoder of lazy pictures at a frame rate.
type Encode = fn(&mut BufWriter<File>, &mut dyn Iterator<Item = Result<RgbImage>>, u32) -> Result<()>;

/// Writes pictures of equal size as a video to `path` with the format's extension, replaced
/// atomically; returns its path, `None` without a video. Pictures are consumed one by one.
pub fn film(
    mut pictures: impl Iterator<Item = Result<RgbImage>>,
    format: FilmFormat,
    fps: u32,
    path: &Path,
) -> Result<Option<PathBuf>> {
    let (extension, encode): (&str, Encode) = match format {
        FilmFormat::Png => {
            pictures.try_for_each(|picture| picture.map(drop))?;
            return Ok(None);
        }
        FilmFormat::Gif => ("gif", gif),
        #[cfg(feature = "mp4")]
        FilmFormat::Mp4 => ("mp4", h264::mp4),
        #[cfg(not(feature = "mp4"))]
        FilmFormat::Mp4 => anyhow::bail!("--format mp4: this program was built without the feature mp4"),
    };
    let path = path.with_extension(extension);
    replace(&path, |to| encode(to, &mut pictures, fps))?;
    Ok(Some(path))
}

/// An endless GIF.
fn gif(to: &mut BufWriter<File>, pictures: &mut dyn Iterator<Item = Result<RgbImage>>, fps: u32) -> Result<()> {
    let mut encoder = GifEncoder::new_with_speed(to, 10);
    encoder.set_repeat(Repeat::Infinite)?;
    for picture in pictures {
        let rgba = image::DynamicImage::ImageRgb8(picture?).into_rgba8();
        let delay = Delay::from_numer_denom_ms(1000, fps);
        encoder.encode_frame(Frame::from_parts(rgba, 0, 0, delay)).map_err(unquoted)?;
    }
    Ok(())
}

#[cfg(feature = "mp4")]
mod h264 {
    use std::fs::File;
    use std::io::BufWriter;

    use anyhow::{Context, Result, anyhow};
    use image::RgbImage;
    use muxide::api::{MuxerBuilder, VideoCodec};
    use rusty_h264_common::YuvFrame;
    use rusty_h264_encoder::{Encoder, EncoderConfig, Preset};

    /// Key frame interval.
    const KEY_INTERVAL: u32 = 30;
    /// Quantisation: 42 dB on synthetic pictures of 512 × 512.
    const QP: u8 = 20;
    /// Levels of H.264 and their most macroblocks of 16 × 16 pixels.
    const LEVELS: [(u8, usize); 6] = [(31, 3600), (40, 8192), (42, 8704), (50, 22080), (51, 36864), (60, 139_264)];
    /// Height from which players assume BT.709 instead of BT.601 in untagged videos.
    const HIGH_DEFINITION: usize = 720;

    /// Writes H.264 (constrained baseline) in MP4 with the index first.
    pub fn mp4(to: &mut BufWriter<File>, pictures: &mut dyn Iterator<Item = Result<RgbImage>>, fps: u32) -> Result<()> {
        let mut pictures = pictures.peekable();
        let Some(Ok(first)) = pictures.peek() else {
            return pictures.next().map_or(Ok(()), |first| first.map(drop));
        };
        // Chroma is subsampled by 2 × 2: an odd side repeats its last row or column.
        let (width, height) = first.dimensions();
        let [even_width, even_height] = [width, height].map(|side| side.next_multiple_of(2));
        let mut config = EncoderConfig::baseline(even_width as usize, even_height as usize);
        config.preset = Preset::Balanced;
        config.gop_size = KEY_INTERVAL;
        config.qp = QP;
        config.framerate = fps as f32;
        let blocks = width.div_ceil(16) as usize * height.div_ceil(16) as usize;
        config.level_idc = LEVELS.iter().find(|level| blocks <= level.1).map(|level| level.0).with_context(|| {
            let most = LEVELS[LEVELS.len() - 1].1;
            format!("--format mp4: {width}x{height} is more than H.264's {most} blocks of 16x16 pixels")
        })?;
        let mut encoder = Encoder::new(config).map_err(|error| anyhow!("H.264: {error:?}"))?;
        let mut muxer =
            MuxerBuilder::new(to).video(VideoCodec::H264, even_width, even_height, f64::from(fps)).build()?;
        let mut written = 0u32;
        let mut write = |unit: Vec<u8>| {
            // Encoders may delay output.
            if unit.is_empty() {
                return Ok(());
            }
            let key = has_key_picture(&unit);
            written += 1;
            muxer.write_video(f64::from(written - 1) / f64::from(fps), &unit, key)
        };
        for picture in pictures {
            write(encoder.encode(&planes(&picture?)))?;
        }
        write(encoder.flush())?;
        Ok(muxer.finish()?)
    }

    /// Whether a byte stream has an IDR slice (NAL unit type 5).
    fn has_key_picture(unit: &[u8]) -> bool {
        unit.windows(4).any(|w| w[..3] == [0, 0, 1] && w[3] & 0x1f == 5)
    }

    /// 4:2:0 in studio range, by BT.601 or BT.709.
    fn planes(picture: &RgbImage) -> YuvFrame {
        let [width, height] = [picture.width(), picture.height()].map(|side| side.next_multiple_of(2) as usize);
        let [kr, kb] = if height >= HIGH_DEFINITION { [0.2126, 0.0722] } else { [0.299, 0.114f32] };
        let byte = |x: f32| (x + 0.5) as u8;
        let at = |x: usize, y: usize| {
            let inside = |at: usize, side: u32| (at as u32).min(side - 1);
            picture.get_pixel(inside(x, picture.width()), inside(y, picture.height())).0.map(|c| f32::from(c) / 255.0)
        };
        let luma = |[r, g, b]: [f32; 3]| kr * r + (1.0 - kr - kb) * g + kb * b;
        let mut out = YuvFrame::black(width, height);
        for (i, y) in out.y.iter_mut().enumerate() {
            *y = byte(16.0 + 219.0 * luma(at(i % width, i / width)));
        }
        for i in 0..out.u.len() {
            let (x, y) = (2 * (i % (width / 2)), 2 * (i / (width / 2)));
            let four = [at(x, y), at(x + 1, y), at(x, y + 1), at(x + 1, y + 1)];
            let mean = [0, 1, 2].map(|c| four.iter().map(|pixel| pixel[c]).sum::<f32>() / 4.0);
            out.u[i] = byte(128.0 + 112.0 * (mean[2] - luma(mean)) / (1.0 - kb));
            out.v[i] = byte(128.0 + 112.0 * (mean[0] - luma(mean)) / (1.0 - kr));
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::Rgb;

    fn pictures(size: (u32, u32)) -> Vec<RgbImage> {
        let at = |t: u32| RgbImage::from_fn(size.0, size.1, |x, y| Rgb([(x * 3 + t * 9) as u8, (y * 5) as u8, 99]));
        (0..35).map(at).collect()
    }

    fn write(format: FilmFormat, size: (u32, u32)) -> Result<Vec<u8>> {
        let folder = testkit::files::Directory::new("film");
        let path = film(pictures(size).into_iter().map(Ok), format, 15, &folder.file("film"))?;
        Ok(path.map(std::fs::read).transpose()?.unwrap_or_default())
    }

    #[test]
    fn films_begin_as_their_formats_do() {
        assert!(write(FilmFormat::Gif, (40, 30)).unwrap().starts_with(b"GIF89a"));
        assert!(write(FilmFormat::Png, (40, 30)).unwrap().is_empty());
    }

    #[cfg(feature = "mp4")]
    #[test]
    fn an_mp4_is_playable_before_it_is_whole_and_the_same_every_time() {
        for size in [(64, 48), (33, 17), (1, 1)] {
            let film = write(FilmFormat::Mp4, size).unwrap();
            let place = |name: &[u8]| film.windows(4).position(|w| w == name);
            assert_eq!(place(b"ftyp"), Some(4), "{size:?}");
            assert!(place(b"avc1").is_some() && place(b"moov") < place(b"mdat"), "{size:?}");
            assert_eq!(film, write(FilmFormat::Mp4, size).unwrap(), "{size:?}");
        }
    }

    #[cfg(feature = "mp4")]
    #[test]
    fn a_size_that_no_player_takes_and_a_picture_that_fails_leave_no_film() {
        let path = std::env::temp_dir().join(format!("xtask-never-written-{}", std::process::id()));
        let large = std::iter::once_with(|| Ok(RgbImage::new(8192, 8192)));
        let error = format!("{:#}", film(large, FilmFormat::Mp4, 15, &path).unwrap_err());
        assert!(error.contains("8192x8192"), "{error}");
        for format in [FilmFormat::Mp4, FilmFormat::Gif, FilmFormat::Png] {
            let broken = [Ok(RgbImage::new(16, 16)), Err(anyhow::anyhow!("a broken picture"))];
            let error = format!("{:#}", film(broken.into_iter(), format, 15, &path).unwrap_err());
            assert!(error.contains("a broken picture"), "{error}");
        }
        assert!(!path.with_extension("mp4").exists() && !path.with_extension("gif").exists());
    }
}
