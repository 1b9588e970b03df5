use std::fmt;

use glam::Vec3;

use crate::blend::{self, Blended};
use crate::error::check_mesh;
use crate::grid::CandidateGrid;
use crate::knn::{Level, MAX_K};
use crate::{Error, Pyramid, vertex_normals};

/// Magnitude of coordinates and lengths up to which squared distances stay in the range of `f32`.
const MAX_COORDINATE: f32 = 1e18;
/// Distance of a query, in sizes of the mesh, beyond which the blend is that of its direction.
const FAR: f32 = 1024.0;

/// Settings of a [`SurfaceQuery`]. The default is right for any mesh and unit of length: 5
/// neighbours at 4 scales, without a grid.
///
/// ```
/// use surface_query::SurfaceQueryConfig;
///
/// // The nearest vertex alone.
/// let nearest = SurfaceQueryConfig { k: 1, coarse_levels: 0, ..Default::default() };
/// // A mesh in metres with edges of about 2 cm, queried within 10 cm: several times faster.
/// let fast = SurfaceQueryConfig { cell: 0.02, margin: 0.1, ..nearest };
/// # let _ = fast;
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfaceQueryConfig {
    /// Neighbours a level, 1 to 65536.
    pub k: usize,
    /// Levels beyond the finest, at most 32.
    pub coarse_levels: usize,
    /// Size of a level as a share of the one above it, in (0, 1].
    pub ratio: f32,
    /// Side of the cells of the candidate grid, in the units of the vertices. About the edge length
    /// of the mesh is fast; halving it takes eight times the memory. 0: no grid.
    pub cell: f32,
    /// Distance around the vertices that the grid covers, in the units of the vertices. Farther
    /// queries go through k-d trees: the same result, several times slower. 0: no grid.
    pub margin: f32,
}

impl Default for SurfaceQueryConfig {
    /// k = 5, 3 coarse levels of ratio 0.25, no grid.
    fn default() -> Self {
        Self { k: 5, coarse_levels: 3, ratio: 0.25, cell: 0.0, margin: 0.0 }
    }
}

impl SurfaceQueryConfig {
    fn check(&self) -> Result<(), Error> {
        let lengths = 0.0..=MAX_COORDINATE;
        let fault = if !(1..=MAX_K).contains(&self.k) {
            format!("k: {}, expected 1 to 65536", self.k)
        } else if !(self.ratio > 0.0 && self.ratio <= 1.0) {
            format!("ratio: {}, expected above 0, at most 1", self.ratio)
        } else if self.coarse_levels > 32 {
            format!("coarse_levels: {}, expected at most 32", self.coarse_levels)
        } else if !(lengths.contains(&self.cell) && lengths.contains(&self.margin)) {
            format!("cell, margin: {}, {}, expected 0 to 1e18", self.cell, self.margin)
        } else {
            return Ok(());
        };
        Err(Error(fault))
    }
}

/// Exact nearest vertices of a rigid mesh or point cloud at several scales, and a smooth blend of
/// them with a signed distance. Queries take `&self` and may run on any number of threads.
///
/// ```
/// use glam::Vec3;
/// use surface_query::{SurfaceQuery, SurfaceQueryConfig};
///
/// // A square in the xy plane.
/// let vertices = [Vec3::ZERO, Vec3::X, Vec3::new(1.0, 1.0, 0.0), Vec3::Y];
/// let config = SurfaceQueryConfig { k: 2, coarse_levels: 0, ..Default::default() };
/// let surface = SurfaceQuery::new(&vertices, &[[0, 1, 2], [0, 2, 3]], &config)?;
/// let query = Vec3::new(0.9, 0.2, 0.5);
/// let mut neighbours = [0; 2];
/// surface.neighbours(query, &mut neighbours);
/// assert_eq!(neighbours, [1, 2]);
/// assert_eq!(surface.blend(query, &neighbours).signed_distance, 0.5);
/// # Ok::<(), surface_query::Error>(())
/// ```
pub struct SurfaceQuery {
    vertices: Vec<Vec3>,
    normals: Vec<Vec3>,
    pyramid: Pyramid,
    levels: Vec<Level>,
    k: usize,
    grid: Option<CandidateGrid>,
    /// Largest coordinate, by magnitude.
    size: f32,
}

impl SurfaceQuery {
    /// Builds the search structures of `vertices` (V) and `faces` (F), counter-clockwise seen from
    /// outside. Without faces it is a point cloud whose normals are all +Y.
    ///
    /// # Errors
    /// No vertices, a vertex that is not finite or has a coordinate beyond 10¹⁸, a face with an
    /// index outside `vertices`, a configuration out of range, or a cell too small for the extent
    /// of the vertices.
    pub fn new(vertices: &[Vec3], faces: &[[u32; 3]], config: &SurfaceQueryConfig) -> Result<Self, Error> {
        config.check()?;
        check_mesh(vertices, faces)?;
        if vertices.is_empty() {
            return Err(Error("no vertices".to_owned()));
        }
        if let Some(vertex) = vertices.iter().position(|v| v.abs().max_element() > MAX_COORDINATE) {
            return Err(Error(format!("vertex {vertex} has a coordinate beyond 1e18")));
        }
        let pyramid = Pyramid::new(vertices, config.ratio, config.coarse_levels);
        let levels = (pyramid.levels.iter()).map(|ids| Level::new(vertices, ids)).collect::<Result<Vec<_>, _>>()?;
        let has_grid = config.cell > 0.0 && config.margin > 0.0;
        let grid = has_grid.then(|| CandidateGrid::new(&levels, config.k, config.cell, config.margin)).transpose()?;
        Ok(Self {
            vertices: vertices.to_vec(),
            normals: vertex_normals(vertices, faces),
            pyramid,
            levels,
            k: config.k,
            grid,
            size: vertices.iter().fold(0.0, |size, v| v.abs().max_element().max(size)),
        })
    }

    /// Length of a neighbour list: (coarse levels + 1) · k.
    pub fn neighbours_per_query(&self) -> usize {
        self.levels.len() * self.k
    }

    /// Writes the k nearest vertices of every level into `out` ((coarse levels + 1) · k): finest
    /// level first, nearest first in each, equal distances by lower index. A level of fewer than k
    /// points repeats its list.
    ///
    /// Exact with respect to squared distances computed in `f32` as x² + y² + z². A query that is
    /// not finite, or beyond about 10¹⁹ where squared distances overflow, has the lowest indices
    /// for neighbours.
    ///
    /// # Panics
    /// If `out` has another length.
    #[inline]
    pub fn neighbours(&self, query: Vec3, out: &mut [u32]) {
        let (found, levels, k) = (out.len(), self.levels.len(), self.k);
        assert_eq!(found, levels * k, "neighbours: `out` has {found} entries, expected {levels} levels of k = {k}");
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
    /// The cosine of a zero vector is 1. Where Σ w < 10⁻⁵ (the query lies in all tangent planes)
    /// the weights are inverse distances. Where the normals cancel, n̂ is that of the first vertex.
    /// For a query beyond 1024 times the largest coordinate of the mesh, v̂ and n̂ are those of the
    /// query moved to that distance, which keeps v̂ near the mesh. A query that is not finite gives
    /// NaN.
    ///
    /// # Panics
    /// If `finest` is empty or has an index outside the vertices.
    #[inline]
    pub fn blend(&self, query: Vec3, finest: &[u32]) -> Blended {
        assert!(!finest.is_empty(), "blend: no neighbours");
        let blended = blend::blend(&self.vertices, &self.normals, self.near(query), finest);
        Blended { signed_distance: (query - blended.point).dot(blended.normal), ..blended }
    }

    /// Backward pass of [`SurfaceQuery::blend`]: the gradient of a loss with respect to the query,
    /// from its gradients with respect to the blended point and signed distance. The neighbours,
    /// and the move of a distant query, are constants.
    ///
    /// At the kinks of a weight (a cosine of 0, the query on a vertex) its derivative is 0.
    ///
    /// ```
    /// # use glam::Vec3;
    /// # use surface_query::{SurfaceQuery, SurfaceQueryConfig};
    /// let vertices = [Vec3::ZERO, Vec3::X, Vec3::Y];
    /// let surface = SurfaceQuery::new(&vertices, &[[0, 1, 2]], &SurfaceQueryConfig::default())?;
    /// // The gradient of the distance to a plane is its normal.
    /// let d_query = surface.blend_backward(Vec3::new(0.2, 0.3, 0.4), &[0, 1, 2], Vec3::ZERO, 1.0);
    /// assert!(d_query.distance(Vec3::Z) < 1e-6);
    /// # Ok::<(), surface_query::Error>(())
    /// ```
    ///
    /// # Panics
    /// If `finest` is empty or has an index outside the vertices.
    pub fn blend_backward(&self, query: Vec3, finest: &[u32], d_point: Vec3, d_signed_distance: f32) -> Vec3 {
        assert!(!finest.is_empty(), "blend_backward: no neighbours");
        let query = self.near(query);
        blend::blend_backward(&self.vertices, &self.normals, query, finest, d_point, d_signed_distance)
    }

    /// The query, moved toward the origin to at most [`FAR`] sizes of the mesh.
    fn near(&self, query: Vec3) -> Vec3 {
        let (limit, distance) = (FAR * self.size, query.abs().max_element());
        if distance > limit && distance.is_finite() { query * (limit / distance) } else { query }
    }

    /// Unit normals of the vertices, (V): [`vertex_normals`].
    pub fn normals(&self) -> &[Vec3] {
        &self.normals
    }

    /// The levels of the neighbours.
    pub fn pyramid(&self) -> &Pyramid {
        &self.pyramid
    }
}

impl fmt::Debug for SurfaceQuery {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let levels: Vec<usize> = self.pyramid.levels.iter().map(Vec::len).collect();
        f.debug_struct("SurfaceQuery").field("k", &self.k).field("levels", &levels).finish_non_exhaustive()
    }
}
