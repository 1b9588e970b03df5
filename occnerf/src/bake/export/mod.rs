//! Exporters of avatars.

mod glb;
mod mesh;
mod motion;
mod splats;

pub use glb::{GlbOptions, VRM_LICENCE, Vrm};
pub use mesh::write_obj;
pub use motion::{fit_motion, write_amass};
pub use splats::{Splats, splats};

use std::io::Cursor;

use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};

use super::Atlas;
use crate::Error;

impl Atlas {
    /// The texture as a PNG.
    ///
    /// # Errors
    /// [`Error::Bake`] of the encoder, as for data that are not (H, W, 3).
    pub fn to_png(&self) -> Result<Vec<u8>, Error> {
        self.encode(&self.rgb, ExtendedColorType::Rgb8)
    }

    /// The texture as a JPEG of `quality` 1 to 100.
    ///
    /// # Errors
    /// As [`Atlas::to_png`].
    pub fn to_jpeg(&self, quality: u8) -> Result<Vec<u8>, Error> {
        let mut bytes = Vec::new();
        self.encode_with(JpegEncoder::new_with_quality(&mut bytes, quality), &self.rgb, ExtendedColorType::Rgb8)?;
        Ok(bytes)
    }

    /// The confidence as a grey PNG.
    ///
    /// # Errors
    /// As [`Atlas::to_png`].
    pub fn confidence_to_png(&self) -> Result<Vec<u8>, Error> {
        self.encode(&self.confidence, ExtendedColorType::L8)
    }

    fn encode(&self, values: &[u8], kind: ExtendedColorType) -> Result<Vec<u8>, Error> {
        let mut bytes = Cursor::new(Vec::new());
        let encoder = PngEncoder::new_with_quality(&mut bytes, CompressionType::Best, FilterType::Adaptive);
        self.encode_with(encoder, values, kind)?;
        Ok(bytes.into_inner())
    }

    fn encode_with(&self, encoder: impl ImageEncoder, values: &[u8], kind: ExtendedColorType) -> Result<(), Error> {
        let fault = |error: image::ImageError| Error::Bake(format!("atlas: {error}"));
        // The encoder asserts the size.
        let channels = usize::from(kind.channel_count());
        if values.len() != self.width as usize * self.height as usize * channels {
            let (w, h) = (self.width, self.height);
            return Err(Error::Bake(format!("atlas: {} values for {w}×{h}×{channels}", values.len())));
        }
        encoder.write_image(values, self.width, self.height, kind).map_err(fault)
    }
}
