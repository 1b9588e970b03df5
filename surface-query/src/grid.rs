//! Grid of cells around the vertices. Each cell lists, per level, every point that can be among the
//! k nearest of a query in it.

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use crate::Error;
use crate::knn::Level;

/// Most lists of the grid: 256 MiB of offsets.
const MAX_LISTS: f64 = (1 << 26) as f64;
/// Levels of at most this many points are searched whole when the lists are built.
const SMALL_LEVEL: usize = 128;

pub(crate) struct CandidateGrid {
    origin: Vec3,
    per_cell: f32,
    /// Number of cells along the axes, as floats for the bounds check.
    size: Vec3,
    /// End of the list of each (cell, level), after a 0. Cells outside the margin have empty lists.
    offsets: Vec<u32>,
    lists: Vec<u32>,
}

impl CandidateGrid {
    /// Cells of side `cell` wherever a query may be within `margin` of a vertex.
    pub fn new(levels: &[Level], k: usize, cell: f32, margin: f32) -> Result<Self, Error> {
        let points = &levels[0].points;
        let (min, max) = points.iter().fold((Vec3::MAX, Vec3::MIN), |(min, max), &p| (min.min(p), max.max(p)));
        let (reach, per_cell) = (margin + cell, 1.0 / cell);
        let origin = min - Vec3::splat(reach);
        let extent = max.as_dvec3() + f64::from(reach) - origin.as_dvec3();
        let size = (extent / f64::from(cell)).ceil().max(DVec3::ONE);
        let count = size.element_product() * levels.len() as f64;
        let too_large = || Error(format!("cell: {cell} gives a grid of {count:.3e} lists, choose larger cells"));
        if count > MAX_LISTS {
            return Err(too_large());
        }
        // Cell size of the lookup, after the rounding of its reciprocal.
        let cell = 1.0 / f64::from(per_cell);
        // Rounding of the lookup's offset from the origin: three operations of half an ulp each, so
        // four whole ulps are ample.
        let rounding = 4.0 * f64::from(f32::EPSILON) * (size.max_element() * cell + f64::from(reach));
        let shape = Shape { origin: origin.as_dvec3(), cell, half: cell / 2.0 + rounding, margin: margin.into(), k };
        let [nx, ny, nz] = size.to_array().map(|n| n as usize);
        let rows: Vec<Row> =
            (0..ny * nz).into_par_iter().map(|row| shape.row(levels, nx, [row % ny, row / ny])).collect();
        let (mut offsets, mut lists) = (vec![0u32], Vec::new());
        for row in rows {
            let base = u32::try_from(lists.len() + row.list.len()).map_err(|_| too_large())? - row.list.len() as u32;
            offsets.extend(row.ends.iter().map(|end| base + end));
            lists.extend(row.list);
        }
        Ok(Self { origin, per_cell, size: size.as_vec3(), offsets, lists })
    }

    /// Writes the k nearest of every level, level after level, into `out`; false if the query's
    /// cell has no lists.
    #[inline(always)]
    pub fn nearest(&self, levels: &[Level], k: usize, q: Vec3, out: &mut [u32]) -> bool {
        let f = (q - self.origin) * self.per_cell;
        // False for NaN too.
        if !(f.cmpge(Vec3::ZERO) & f.cmplt(self.size)).all() {
            return false;
        }
        let [x, y, z] = f.to_array().map(|c| c as usize);
        let first = (x + self.size.x as usize * (y + self.size.y as usize * z)) * levels.len();
        let offsets = &self.offsets[first..=first + levels.len()];
        if offsets[0] == offsets[1] {
            return false;
        }
        for ((level, ends), out) in levels.iter().zip(offsets.windows(2)).zip(out.chunks_exact_mut(k)) {
            level.nearest_of(&self.lists[ends[0] as usize..ends[1] as usize], q, out);
        }
        true
    }
}

/// The lists of a row of cells along x: local indices, and the end of the list of each (cell,
/// level).
#[derive(Default)]
struct Row {
    list: Vec<u32>,
    ends: Vec<u32>,
}

struct Shape {
    origin: DVec3,
    cell: f64,
    /// Half the side of a cell, and an allowance for rounding.
    half: f64,
    margin: f64,
    k: usize,
}

impl Shape {
    fn row(&self, levels: &[Level], cells: usize, [y, z]: [usize; 2]) -> Row {
        let mut row = Row::default();
        let mut scratch = Vec::new();
        for x in 0..cells {
            let centre = self.origin + (DVec3::from([x, y, z].map(|i| i as f64)) + 0.5) * self.cell;
            let rounded = centre.as_vec3();
            // The centre is rounded: the cell reaches further from it than from the true one.
            let radius = self.half * 3f64.sqrt() + rounded.as_dvec3().distance(centre);
            let is_near = f64::from(levels[0].kth_distance(rounded, 1)) - radius <= self.margin;
            for level in levels {
                if is_near {
                    self.candidates(
                        level,
                        &superset(level, rounded, radius, self.k),
                        centre,
                        &mut scratch,
                        &mut row.list,
                    );
                }
                row.ends.push(row.list.len() as u32);
            }
        }
        row
    }

    /// Appends every point that can be among the k nearest of a query in the cell; `near` is a
    /// superset of them.
    ///
    /// A point is left out only where k others are closer for certain. Queries compare squared
    /// distances in `f32`, off by at most 4 ulp relative (2.4e-7) and, near underflow, by a few
    /// denormals: the margins `RELATIVE` and `ABSOLUTE` are far above that.
    fn candidates(
        &self,
        level: &Level,
        near: &[u32],
        centre: DVec3,
        scratch: &mut Vec<Candidate>,
        list: &mut Vec<u32>,
    ) {
        const RELATIVE: f64 = 1e-5;
        const ABSOLUTE: f64 = f32::MIN_POSITIVE as f64;
        scratch.clear();
        scratch.extend(near.iter().map(|&local| {
            let p = level.points[local as usize].as_dvec3() - centre;
            let min = (p.abs() - self.half).max(DVec3::ZERO).length_squared();
            Candidate { local, p, min, max: (p.abs() + self.half).length_squared() }
        }));
        // First sieve: k points are certainly within `bound`; points certainly beyond it are
        // dropped.
        if scratch.len() > self.k {
            scratch.select_nth_unstable_by(self.k - 1, |a, b| a.max.total_cmp(&b.max));
            let bound = scratch[self.k - 1].max * (1.0 + RELATIVE) + ABSOLUTE;
            scratch.retain(|c| c.min <= bound);
        }
        // Nearest to the centre first: the strongest rivals here, and well predicted branches in
        // the query.
        let distance = |c: &Candidate| c.p.length_squared();
        scratch.sort_unstable_by(|a, b| distance(a).total_cmp(&distance(b)).then(a.local.cmp(&b.local)));
        // Second sieve: j is closer than p everywhere in the cell if |q−p|² − |q−j|², which is
        // linear in q, is positive at its lowest corner. Of equal points the lower index wins every
        // tie.
        for c in scratch.iter() {
            let certain = c.max * RELATIVE + ABSOLUTE;
            let wins = |other: &&Candidate| {
                let difference = c.p - other.p;
                let spread = 2.0 * self.half * difference.abs().element_sum();
                distance(c) - distance(other) - spread > certain || difference == DVec3::ZERO && other.local < c.local
            };
            if scratch.iter().filter(wins).take(self.k).count() < self.k {
                list.push(c.local);
            }
        }
    }
}

/// At least all points that are among the k nearest of a query within `radius` of `centre`.
fn superset(level: &Level, centre: Vec3, radius: f64, k: usize) -> Vec<u32> {
    let n = level.points.len();
    if n <= SMALL_LEVEL {
        return (0..n as u32).collect();
    }
    // The k-th nearest distance changes by at most the way the query moves, and a candidate is at
    // most that far from the query.
    let kth = f64::from(level.kth_distance(centre, k.min(n)));
    level.within(centre, ((kth + 2.0 * radius) * (1.0 + 1e-6)) as f32)
}

/// A point as seen from the centre of a cell.
struct Candidate {
    local: u32,
    p: DVec3,
    /// Smallest and largest squared distance to the cell.
    min: f64,
    max: f64,
}
