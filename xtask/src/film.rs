//! Films: pictures one after another as a GIF or, with the feature `mp4`, as H.264 in MP4.

use std::fs::File;
use std::io::BufWriter;
use std::path::Path;

use anyhow::{Context, Result};
use clap::ValueEnum;
use image::codecs::gif::{GifEncoder, Repeat};
use image::{Delay, Frame, RgbImage};

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum FilmFormat {
    /// H.264, plays in every browser.
    Mp4,
    /// Pictures alone.
    Png,
    /// 256 colours, for pages that take no video.
    Gif,
}

impl FilmFormat {
    /// The extension of the film's file; none where there is no film.
    pub fn extension(self) -> Option<&'static str> {
        match self {
            Self::Mp4 => Some("mp4"),
            Self::Png => None,
            Self::Gif => Some("gif"),
        }
    }
}

/// A film in the making: its pictures are not kept.
pub enum Film {
    None,
    Gif(Box<GifEncoder<BufWriter<File>>>, u32),
    #[cfg(feature = "mp4")]
    Mp4(Box<h264::Mp4>),
}

impl Film {
    /// Begins a film of `size` pixels at `fps` pictures a second. A GIF plays endlessly.
    pub fn create(path: &Path, format: FilmFormat, size: (u32, u32), fps: u32) -> Result<Self> {
        let create = || File::create(path).map(BufWriter::new).with_context(|| path.display().to_string());
        match format {
            FilmFormat::Png => Ok(Self::None),
            FilmFormat::Gif => {
                anyhow::ensure!(size.0.max(size.1) <= 65535, "a GIF has at most 65535 pixels a side");
                let mut encoder = GifEncoder::new_with_speed(create()?, 10);
                encoder.set_repeat(Repeat::Infinite)?;
                Ok(Self::Gif(Box::new(encoder), fps))
            }
            #[cfg(feature = "mp4")]
            FilmFormat::Mp4 => {
                h264::check(size)?;
                Ok(Self::Mp4(Box::new(h264::Mp4::new(create()?, size, fps)?)))
            }
            #[cfg(not(feature = "mp4"))]
            FilmFormat::Mp4 => anyhow::bail!("--format mp4: this program was built without the feature mp4"),
        }
    }

    /// Appends a picture of the film's size.
    pub fn push(&mut self, picture: &RgbImage) -> Result<()> {
        match self {
            Self::None => Ok(()),
            Self::Gif(encoder, fps) => {
                let rgba = image::DynamicImage::ImageRgb8(picture.clone()).into_rgba8();
                let delay = Delay::from_numer_denom_ms(1000, *fps);
                Ok(encoder.encode_frame(Frame::from_parts(rgba, 0, 0, delay))?)
            }
            #[cfg(feature = "mp4")]
            Self::Mp4(film) => film.push(picture),
        }
    }

    /// Writes what is left.
    pub fn finish(self) -> Result<()> {
        match self {
            Self::None | Self::Gif(..) => Ok(()),
            #[cfg(feature = "mp4")]
            Self::Mp4(film) => film.finish(),
        }
    }
}

#[cfg(feature = "mp4")]
mod h264 {
    use std::fs::File;
    use std::io::BufWriter;

    use anyhow::{Result, ensure};
    use image::RgbImage;
    use muxide::api::{Muxer, MuxerBuilder, VideoCodec};
    use rusty_h264_common::YuvFrame;
    use rusty_h264_encoder::{Encoder, EncoderConfig, Preset};

    /// Pictures from one that stands alone to the next.
    const KEY_INTERVAL: u32 = 30;
    /// Quantisation: about 42 dB on pictures of a person.
    const QP: u8 = 20;
    /// Levels of H.264 and the macroblocks of 16 × 16 pixels that a picture of theirs has at most.
    const LEVELS: [(u8, usize); 6] = [(31, 3600), (40, 8192), (42, 8704), (50, 22080), (51, 36864), (60, 139_264)];
    /// From this height on players take the colours for BT.709, below it for BT.601, where a film does not say.
    const HIGH_DEFINITION: usize = 720;

    pub struct Mp4 {
        encoder: Encoder,
        muxer: Muxer<BufWriter<File>>,
        fps: u32,
        pictures: u64,
    }

    fn macroblocks((width, height): (u32, u32)) -> usize {
        width.div_ceil(16) as usize * height.div_ceil(16) as usize
    }

    fn level(size: (u32, u32)) -> Option<u8> {
        LEVELS.iter().find(|level| macroblocks(size) <= level.1).map(|level| level.0)
    }

    /// Errors for a size that no player would take.
    pub fn check(size: (u32, u32)) -> Result<()> {
        let (width, height) = size;
        let most = LEVELS[LEVELS.len() - 1].1;
        ensure!(
            level(size).is_some(),
            "--format mp4: {width}x{height} is more than H.264's {most} blocks of 16x16 pixels"
        );
        Ok(())
    }

    impl Mp4 {
        pub fn new(to: BufWriter<File>, size: (u32, u32), fps: u32) -> Result<Self> {
            // Chroma is shared by 2 × 2 pixels: an odd side grows by its last row or column.
            let [width, height] = [size.0, size.1].map(|side| side.next_multiple_of(2));
            let mut config = EncoderConfig::baseline(width as usize, height as usize);
            config.preset = Preset::Balanced;
            config.gop_size = KEY_INTERVAL;
            config.qp = QP;
            config.framerate = fps as f32;
            config.level_idc = level(size).unwrap_or(LEVELS[0].0);
            let encoder = Encoder::new(config).map_err(|error| anyhow::anyhow!("H.264: {error:?}"))?;
            let muxer = MuxerBuilder::new(to).video(VideoCodec::H264, width, height, f64::from(fps)).build()?;
            Ok(Self { encoder, muxer, fps, pictures: 0 })
        }

        pub fn push(&mut self, picture: &RgbImage) -> Result<()> {
            let unit = self.encoder.encode(&planes(picture));
            self.write(&unit)
        }

        pub fn finish(mut self) -> Result<()> {
            let rest = self.encoder.flush();
            self.write(&rest)?;
            Ok(self.muxer.finish()?)
        }

        fn write(&mut self, unit: &[u8]) -> Result<()> {
            if !unit.is_empty() {
                let key = has_key_picture(unit);
                self.muxer.write_video(self.pictures as f64 / f64::from(self.fps), unit, key)?;
                self.pictures += 1;
            }
            Ok(())
        }
    }

    /// Whether a byte stream has a slice of a picture that stands alone (NAL unit type 5).
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

    fn write(format: FilmFormat, size: (u32, u32)) -> Vec<u8> {
        let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../target/film-test");
        std::fs::create_dir_all(&folder).unwrap();
        let path = folder.join(format!("{}x{}.{}", size.0, size.1, format.extension().unwrap_or("none")));
        let mut film = Film::create(&path, format, size, 15).unwrap();
        pictures(size).iter().for_each(|picture| film.push(picture).unwrap());
        film.finish().unwrap();
        if format == FilmFormat::Png { Vec::new() } else { std::fs::read(path).unwrap() }
    }

    #[test]
    fn films_begin_as_their_formats_do() {
        assert!(write(FilmFormat::Gif, (40, 30)).starts_with(b"GIF89a"));
        assert!(write(FilmFormat::Png, (40, 30)).is_empty());
    }

    #[cfg(feature = "mp4")]
    #[test]
    fn an_mp4_is_playable_before_it_is_whole_and_the_same_every_time() {
        for size in [(64, 48), (33, 17), (1, 1)] {
            let film = write(FilmFormat::Mp4, size);
            let place = |name: &[u8]| film.windows(4).position(|w| w == name);
            assert_eq!(place(b"ftyp"), Some(4), "{size:?}");
            assert!(place(b"avc1").is_some() && place(b"moov") < place(b"mdat"), "{size:?}");
            assert_eq!(film, write(FilmFormat::Mp4, size), "{size:?}");
        }
    }

    #[cfg(feature = "mp4")]
    #[test]
    fn a_size_that_no_player_takes_is_refused() {
        let path = std::env::temp_dir().join("never-written.mp4");
        let error = Film::create(&path, FilmFormat::Mp4, (8192, 8192), 15).err().unwrap().to_string();
        assert!(error.contains("8192x8192") && !path.exists(), "{error}");
    }
}
