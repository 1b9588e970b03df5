//! A software rasteriser: which triangle every pixel sees, where on the triangle, and how far away.
//!
//! Vertices are projected, triangles are set up and sorted into bands of rows, and every band is drawn by one task:
//! first depth and face of every sample, then the barycentrics of the faces that won.

mod band;
mod clip;
mod options;
mod pixel;
mod project;
mod triangle;

use glam::Vec3;
use rayon::prelude::*;

use crate::{Error, View};
use band::Band;
use project::{Projected, Projection};
use triangle::{BAND, Chunk};

pub use options::{RasterOptions, Samples};
pub use pixel::{Fragment, Pixel};

/// Most samples a row or column of the image.
const MOST_SAMPLES: u32 = 1 << 14;

/// Draws triangle meshes; keeps its buffers from picture to picture.
#[derive(Debug, Default)]
pub struct Rasterizer {
    projected: Vec<Projected>,
    chunks: Vec<Chunk>,
}

impl Rasterizer {
    /// Draws `layers` of faces over the same `vertices` (V) as `view` sees them, and writes what `shade` makes of each pixel into
    /// `out` (H·W, row-major).
    ///
    /// Every layer has a depth buffer of its own, so that a sample sees the nearest face of each: nested shells can be
    /// composited. With one layer it is a plain visibility buffer; see [`Rasterizer::faces`].
    ///
    /// A sample is inside a triangle by exact arithmetic on corners rounded to 1/256 of a sample's spacing, one on
    /// an edge or corner by the top-left rule: an edge that two triangles share belongs to one of them. Of faces at
    /// the same depth the first is seen. Triangles without area are not drawn, nor are those with a corner that is
    /// not finite; those that reach behind the camera are clipped. Triangles 10¹² times as large as they are far
    /// are clipped imprecisely. Work is spread over the current rayon pool; the result does
    /// not depend on its size.
    ///
    /// # Errors
    /// [`Error::FaceIndex`]; [`Error::ImageSize`] for more than 16384 samples a row or column; [`Error::TooMany`].
    ///
    /// # Panics
    /// If `out` has not `width · height` entries.
    pub fn draw<T: Send>(
        &mut self,
        vertices: &[Vec3],
        layers: &[&[[u32; 3]]],
        view: &View,
        options: &RasterOptions,
        out: &mut [T],
        shade: impl Fn(Pixel<'_>) -> T + Sync,
    ) -> Result<(), Error> {
        let (width, height) = (view.width as usize, view.height as usize);
        assert_eq!(out.len(), width * height, "draw: {} values for {width} × {height} pixels", out.len());
        let side = options.samples.per_side();
        let most = MOST_SAMPLES / side;
        if view.width > most || view.height > most {
            return Err(Error::ImageSize { width: view.width, height: view.height, most });
        }
        let count = layers.iter().map(|faces| faces.len()).fold(vertices.len(), usize::saturating_add);
        if count > 1 << 31 {
            return Err(Error::TooMany { count });
        }
        if out.is_empty() {
            return Ok(());
        }
        let projection = Projection::new(view, options);
        projection.project(vertices, &mut self.projected);
        let bands = projection.height.div_ceil(BAND);
        self.set_up(vertices, layers, &projection, bands)?;
        let drawing =
            Band { projection: &projection, projected: &self.projected, vertices, layers, chunks: &self.chunks };
        out.par_chunks_mut(width * BAND / side as usize)
            .enumerate()
            .with_max_len(1)
            .for_each_init(Default::default, |strip, (band, out)| drawing.draw(band, strip, out, &shade));
        Ok(())
    }

    /// The nearest face of a single mesh at every pixel's centre (H·W, row-major): a visibility buffer.
    ///
    /// # Errors
    /// As [`Rasterizer::draw`].
    pub fn faces(
        &mut self,
        vertices: &[Vec3],
        faces: &[[u32; 3]],
        view: &View,
        options: &RasterOptions,
    ) -> Result<Vec<Option<Fragment>>, Error> {
        let options = RasterOptions { samples: Samples::One, ..*options };
        let mut out = vec![None; view.width as usize * view.height as usize];
        let first = |pixel: Pixel<'_>| pixel.samples().next().and_then(|sample| sample.first().copied());
        self.draw(vertices, &[faces], view, &options, &mut out, first)?;
        Ok(out)
    }

    fn set_up(
        &mut self,
        vertices: &[Vec3],
        layers: &[&[[u32; 3]]],
        projection: &Projection,
        bands: usize,
    ) -> Result<(), Error> {
        let mut used = 0;
        let mut first = 0;
        for (layer, faces) in layers.iter().enumerate() {
            for start in (0..faces.len()).step_by(triangle::CHUNK) {
                if used == self.chunks.len() {
                    self.chunks.push(Chunk::default());
                }
                let end = (start + triangle::CHUNK).min(faces.len());
                self.chunks[used].begin(layer, first + start, start..end, bands);
                used += 1;
            }
            first += faces.len();
        }
        self.chunks.truncate(used);
        let projected = &self.projected;
        self.chunks.par_iter_mut().with_max_len(1).try_for_each(|chunk| {
            let faces = &layers[chunk.layer][chunk.range.clone()];
            chunk.set_up(faces, projected, vertices, projection)
        })
    }
}
