//! The stages of the rasteriser: projection, set-up, bands.

use std::sync::{Mutex, PoisonError};

use glam::Vec3;
use rayon::prelude::*;

use super::band::{Band, Strip};
use super::project::{Projected, Projection};
use super::triangle::{BAND, CHUNK, Chunk};
use super::{Fragment, Pixel, RasterOptions, Samples};
use crate::error::Error;
use crate::view::View;

/// Largest width and height of the image in samples.
const MOST_SAMPLES: u32 = 1 << 14;

/// Draws triangle meshes; its buffers are reused from image to image.
///
/// ```
/// use glam::{Affine3A, Vec2, Vec3};
/// use visibility::{RasterOptions, Rasterizer, Samples, View};
///
/// // A slanted triangle over the left half of the image.
/// let vertices = [(-1.0, -3.0, 1.0), (0.0, 0.0, 1.0), (-1.0, 3.0, 1.0)].map(Vec3::from);
/// let (focal, centre) = (Vec2::splat(4.0), Vec2::splat(4.0));
/// let view = View { focal, centre, world_to_camera: Affine3A::IDENTITY, width: 8, height: 8 };
/// let options = RasterOptions { samples: Samples::Four, ..Default::default() };
/// let mut coverage = vec![0.0; 8 * 8];
/// Rasterizer::default().draw(&vertices, &[[0, 1, 2]], &view, &options, &mut coverage, |pixel| {
///     pixel.samples.iter().flatten().count() as f32 / 4.0
/// })?;
/// assert_eq!((coverage[4 * 8], coverage[4 * 8 + 7]), (1.0, 0.0));
/// # Ok::<(), visibility::Error>(())
/// ```
#[derive(Debug, Default)]
pub struct Rasterizer {
    projected: Vec<Projected>,
    chunks: Vec<Chunk>,
    /// Of the threads.
    strips: Mutex<Vec<Strip>>,
}

impl Rasterizer {
    /// Draws `faces` (F) over `vertices` (V) and writes the result of `shade` for each pixel into
    /// `out` (H·W, row-major).
    ///
    /// Coverage is exact on corners rounded to 1/256 of the sample spacing, by the top-left rule on
    /// edges: an edge shared by two triangles belongs to one of them. Of faces at the same depth
    /// the first is visible. Triangles without area or with a corner that is not finite are
    /// skipped; those that reach behind the near plane are clipped, imprecisely if 10¹² times as
    /// large as they are far. Work is spread over the current rayon pool; the result does not
    /// depend on its size.
    ///
    /// # Errors
    /// A face with an index outside `vertices`; more than 16384 samples a row or column, or 2³¹
    /// vertices and faces.
    ///
    /// # Panics
    /// If `out` does not have `width · height` entries.
    pub fn draw<T: Send>(
        &mut self,
        vertices: &[Vec3],
        faces: &[[u32; 3]],
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
            let (width, height) = (view.width, view.height);
            let limit = format!("at most {most} × {most} are supported");
            return Err(Error(format!("an image of {width} × {height} pixels, {limit}")));
        }
        let count = vertices.len().saturating_add(faces.len());
        if count > 1 << 31 {
            return Err(Error::too_many(count));
        }
        if out.is_empty() {
            return Ok(());
        }
        let projection = Projection::new(view, options);
        projection.project(vertices, &mut self.projected);
        let bands = projection.height.div_ceil(BAND);
        self.set_up(vertices, faces, &projection, bands)?;
        let drawing =
            Band { projection: &projection, projected: &self.projected, vertices, faces, chunks: &self.chunks };
        let strips = || self.strips.lock().unwrap_or_else(PoisonError::into_inner);
        out.par_chunks_mut(width * BAND / side as usize).enumerate().with_max_len(1).for_each(|(band, out)| {
            let mut strip = strips().pop().unwrap_or_default();
            drawing.draw(band, &mut strip, out, &shade);
            strips().push(strip);
        });
        Ok(())
    }

    /// Visibility buffer: the nearest face of a mesh at the centre of every pixel (H·W, row-major).
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
        let first = |pixel: Pixel<'_>| pixel.samples.first().copied().flatten();
        self.draw(vertices, faces, view, &options, &mut out, first)?;
        Ok(out)
    }

    fn set_up(
        &mut self,
        vertices: &[Vec3],
        faces: &[[u32; 3]],
        projection: &Projection,
        bands: usize,
    ) -> Result<(), Error> {
        self.chunks.resize_with(faces.len().div_ceil(CHUNK), Chunk::default);
        for (i, chunk) in self.chunks.iter_mut().enumerate() {
            chunk.begin(i * CHUNK..((i + 1) * CHUNK).min(faces.len()), bands);
        }
        let projected = &self.projected;
        self.chunks.par_iter_mut().with_max_len(1).try_for_each(|chunk| {
            let faces = &faces[chunk.range.clone()];
            chunk.set_up(faces, projected, vertices, projection)
        })
    }
}
