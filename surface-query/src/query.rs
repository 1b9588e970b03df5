use glam::Vec3;

use crate::blend::{self, Blended};
use crate::blend_backward;
use crate::error::check_mesh;
use crate::grid::CandidateGrid;
use crate::knn::{Level, MAX_K};
use crate::{Error, Pyramid, vertex_normals};

/// Settings of a [`SurfaceQuery`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfaceQueryConfig {
    /// Neighbours a level, 1 to 65536.
    pub k: usize,
    /// Levels beyond the finest, at most 32.
    pub coarse_levels: usize,
    /// Size of a level as a share of the one above it, in (0, 1].
    pub ratio: f32,
    /// Side of the cells of the candidate grid, in the units of the vertices. About the distance of
    /// neighbouring vertices is fast; halving it costs eight times the memory. 0: no grid.
    pub cell: f32,
    /// Distance around the vertices that the grid covers, in the units of the vertices. Queries
    /// farther out go through the trees: the same answer, several times slower. 0: no grid.
    pub margin: f32,
}

impl SurfaceQueryConfig {
    /// The paper's neighbourhoods (5 neighbours at 4 scales, ratio 0.25) with a grid for a body of
    /// 6890 vertices in metres: cells of 2 cm to 12 cm from the skin.
    pub const BODY: Self = Self { k: 5, coarse_levels: 3, ratio: 0.25, cell: 0.02, margin: 0.12 };

    /// The paper's neighbourhoods without a grid: right for any unit and size.
    pub const TREES: Self = Self { cell: 0.0, margin: 0.0, ..Self::BODY };

    fn check(&self) -> Result<(), Error> {
        let fail = |name, value, expected| Err(Error::Config { name, value, expected });
        if !(1..=MAX_K).contains(&self.k) {
            return fail("k", self.k as f64, "1 to 65536");
        }
        if !(self.ratio > 0.0 && self.ratio <= 1.0) {
            return fail("ratio", f64::from(self.ratio), "above 0, at most 1");
        }
        if self.coarse_levels > 32 {
            return fail("coarse_levels", self.coarse_levels as f64, "at most 32");
        }
        for (name, value) in [("cell", self.cell), ("margin", self.margin)] {
            if !(value >= 0.0 && value.is_finite()) {
                return fail(name, f64::from(value), "0 or a positive length");
            }
        }
        Ok(())
    }
}

/// Nearest vertices at several scales, their blend, and its signed distance.
///
/// Built once for a mesh at rest; the mesh does not change afterwards. All queries take `&self` and
/// may run on any number of threads.
pub struct SurfaceQuery {
    vertices: Vec<Vec3>,
    normals: Vec<Vec3>,
    pyramid: Pyramid,
    levels: Vec<Level>,
    k: usize,
    grid: Option<CandidateGrid>,
}

impl SurfaceQuery {
    /// Takes a mesh of `vertices` (V) and `faces` (F), counter-clockwise seen from outside. Without
    /// faces it is a point cloud whose normals are all +Y.
    ///
    /// # Errors
    /// No vertices, a vertex that is not finite, a face that names no vertex, a configuration out
    /// of range, or a cell too small for the extent of the vertices.
    pub fn new(vertices: &[Vec3], faces: &[[u32; 3]], config: &SurfaceQueryConfig) -> Result<Self, Error> {
        config.check()?;
        check_mesh(vertices, faces)?;
        if vertices.is_empty() {
            return Err(Error::NoVertices);
        }
        let pyramid = Pyramid::new(vertices, config.ratio, config.coarse_levels);
        let levels = (pyramid.levels.iter()).map(|ids| Level::new(vertices, ids)).collect::<Result<Vec<_>, _>>()?;
        let grid = if config.cell > 0.0 && config.margin > 0.0 {
            CandidateGrid::new(&levels, config.k, config.cell, config.margin)?
        } else {
            None
        };
        Ok(Self {
            vertices: vertices.to_vec(),
            normals: vertex_normals(vertices, faces),
            pyramid,
            levels,
            k: config.k,
            grid,
        })
    }

    /// Length of a neighbour list: (coarse levels + 1) · k.
    #[must_use]
    pub fn neighbours_per_query(&self) -> usize {
        self.levels.len() * self.k
    }

    /// The k nearest vertices of every level into `out` ((coarse levels + 1) · k): finest level
    /// first, nearest first in each, equal distances by lower index. A level of fewer than k points
    /// repeats its list.
    ///
    /// Exact with respect to squared distances computed in `f32` as x² + y² + z². A query that is
    /// not finite, or whose squared distances overflow, is infinitely far from everything: it gets
    /// the lowest indices.
    ///
    /// # Panics
    /// If `out` has another length.
    #[inline]
    pub fn neighbours(&self, query: Vec3, out: &mut [u32]) {
        assert_eq!(
            out.len(),
            self.neighbours_per_query(),
            "neighbours: `out` holds {} indices, {} levels of k = {} were asked for",
            out.len(),
            self.levels.len(),
            self.k
        );
        if let Some(grid) = &self.grid
            && grid.nearest(&self.levels, self.k, query, out)
        {
            return;
        }
        for (level, out) in self.levels.iter().zip(out.chunks_exact_mut(self.k)) {
            level.nearest(query, out);
        }
    }

    /// Blend of the vertices `finest`, usually the first k of [`SurfaceQuery::neighbours`]: w_i =
    /// |cos(x − v_i, n_i)|, v̂ = Σ w_i v_i / Σ w_i, n̂ = normalise(Σ w_i n_i), d = (x − v̂) · n̂.
    ///
    /// The cosine of a zero vector is 1, so a query on a vertex is defined. Where Σ w < 1e-5 (the
    /// query lies in all tangent planes) the weights are inverse distances. Where the normals
    /// cancel, n̂ is that of the first vertex. A query that is not finite gives values that are
    /// not.
    ///
    /// # Panics
    /// If `finest` is empty or names no vertex.
    #[must_use]
    #[inline]
    pub fn blend(&self, query: Vec3, finest: &[u32]) -> Blended {
        assert!(!finest.is_empty(), "blend: no neighbours");
        blend::blend(&self.vertices, &self.normals, query, finest)
    }

    /// Gradient with respect to the query of a loss of [`SurfaceQuery::blend`]'s point and signed
    /// distance, given the loss's gradient with respect to those. The set of neighbours is a
    /// constant.
    ///
    /// At its kinks (a cosine of 0, the query on a vertex) the weight's derivative counts as 0.
    ///
    /// # Panics
    /// If `finest` is empty or names no vertex.
    #[must_use]
    pub fn blend_backward(&self, query: Vec3, finest: &[u32], d_point: Vec3, d_signed_distance: f32) -> Vec3 {
        assert!(!finest.is_empty(), "blend_backward: no neighbours");
        blend_backward::blend_backward(&self.vertices, &self.normals, query, finest, d_point, d_signed_distance)
    }

    /// The vertices, (V).
    #[must_use]
    pub fn vertices(&self) -> &[Vec3] {
        &self.vertices
    }

    /// Their unit normals, (V).
    #[must_use]
    pub fn normals(&self) -> &[Vec3] {
        &self.normals
    }

    /// The levels.
    #[must_use]
    pub fn pyramid(&self) -> &Pyramid {
        &self.pyramid
    }
}
