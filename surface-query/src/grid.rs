//! Grid of cells around the vertices. Each cell lists, per level, every point that can be among the
//! k nearest of a query in it.

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use crate::Error;
use crate::knn::Level;

/// Cells along an edge of a block; blocks are what the lookup table holds.
const BLOCK: usize = 4;
const BLOCK_CELLS: usize = BLOCK * BLOCK * BLOCK;
/// Largest lookup table: 64 MiB.
const MAX_BLOCKS: f64 = (1 << 24) as f64;
const EMPTY: u32 = u32::MAX;
/// Levels of at most this many points are searched whole when the lists are built.
const SMALL_LEVEL: usize = 128;

/// Candidate lists, in the narrowest integer that holds the indices to save memory traffic.
enum Lists {
    Narrow(Vec<u16>),
    Wide(Vec<u32>),
}

pub(crate) struct CandidateGrid {
    origin: Vec3,
    per_cell: f32,
    /// Extent in cells, as floats for the bounds check.
    cells: Vec3,
    blocks: [usize; 2],
    /// Slot of each block or `EMPTY`.
    table: Vec<u32>,
    /// Start of the list of (slot, cell, level) begins; it ends where the next begins. Cells
    /// outside the margin have empty lists.
    offsets: Vec<u32>,
    lists: Lists,
}

impl CandidateGrid {
    /// Cells of side `cell` wherever a query may be within `margin` of a vertex.
    pub fn new(levels: &[Level], k: usize, cell: f32, margin: f32) -> Result<Self, Error> {
        let points = &levels[0].points;
        let (min, max) = points.iter().fold((Vec3::MAX, Vec3::MIN), |(min, max), &p| (min.min(p), max.max(p)));
        let reach = margin + cell;
        let origin = min - Vec3::splat(reach);
        let block_size = f64::from(cell) * BLOCK as f64;
        let extent = (max.as_dvec3() + f64::from(reach) - origin.as_dvec3()) / block_size;
        let blocks = extent.ceil().max(DVec3::ONE);
        let count = blocks.x * blocks.y * blocks.z;
        if count > MAX_BLOCKS {
            return Err(Error::GridTooLarge {
                cells: count * BLOCK_CELLS as f64,
                limit: MAX_BLOCKS * BLOCK_CELLS as f64,
            });
        }
        let per_cell = 1.0 / cell;
        let shape = Shape {
            origin: origin.as_dvec3(),
            // Cell size of the lookup, after the rounding of its reciprocal.
            cell: 1.0 / f64::from(per_cell),
            // Rounding of the lookup's offset from the origin: three operations of half an ulp
            // each, so four whole ulps are ample.
            rounding: 4.0 * f64::from(f32::EPSILON) * (blocks.max_element() * block_size + f64::from(reach)),
            margin: f64::from(margin),
            k,
        };
        let [nx, ny, nz] = blocks.to_array().map(|n| n as usize);
        let built: Vec<Option<Block>> = (0..nx * ny * nz)
            .into_par_iter()
            .map(|b| shape.block(levels, [b % nx, b / nx % ny, b / (nx * ny)]))
            .collect();

        let mut table = vec![EMPTY; built.len()];
        let mut offsets = vec![0u32];
        let mut wide: Vec<u32> = Vec::new();
        let mut slot = 0;
        for (b, block) in built.into_iter().enumerate() {
            let Some(block) = block else { continue };
            table[b] = slot;
            slot += 1;
            let base = wide.len();
            if base + block.list.len() > u32::MAX as usize {
                return Err(Error::GridTooLarge { cells: count * BLOCK_CELLS as f64, limit: f64::from(u32::MAX) });
            }
            offsets.extend(block.ends.iter().map(|&end| base as u32 + end));
            wide.extend(block.list);
        }
        let lists = if points.len() <= 1 << 16 {
            Lists::Narrow(wide.into_iter().map(|i| i as u16).collect())
        } else {
            wide.shrink_to_fit();
            Lists::Wide(wide)
        };
        let cells = (blocks * BLOCK as f64).as_vec3();
        Ok(Self { origin, per_cell, cells, blocks: [nx, nx * ny], table, offsets, lists })
    }

    /// Row of the query's cell in the offsets, in units of levels; `None` outside every block.
    #[inline(always)]
    fn row(&self, q: Vec3) -> Option<usize> {
        let f = (q - self.origin) * self.per_cell;
        // False for NaN too.
        if !(f.cmpge(Vec3::ZERO) & f.cmplt(self.cells)).all() {
            return None;
        }
        let [x, y, z] = f.to_array().map(|c| c as usize);
        let block = x / BLOCK + y / BLOCK * self.blocks[0] + z / BLOCK * self.blocks[1];
        let slot = *self.table.get(block)?;
        let cell = x % BLOCK + (y % BLOCK + z % BLOCK * BLOCK) * BLOCK;
        (slot != EMPTY).then_some(slot as usize * BLOCK_CELLS + cell)
    }

    /// Writes the k nearest of every level, level after level, into `out`; false if the query's
    /// cell has no lists.
    #[inline(always)]
    pub fn nearest(&self, levels: &[Level], k: usize, q: Vec3, out: &mut [u32]) -> bool {
        let Some(row) = self.row(q) else {
            return false;
        };
        let first = row * levels.len();
        let offsets = &self.offsets[first..=first + levels.len()];
        if offsets[0] == offsets[1] {
            return false;
        }
        match &self.lists {
            Lists::Narrow(lists) => nearest_of_lists(levels, offsets, lists, k, q, out),
            Lists::Wide(lists) => nearest_of_lists(levels, offsets, lists, k, q, out),
        }
        true
    }
}

#[inline(always)]
fn nearest_of_lists<I: Copy + Into<u32>>(
    levels: &[Level],
    offsets: &[u32],
    lists: &[I],
    k: usize,
    q: Vec3,
    out: &mut [u32],
) {
    for ((level, ends), out) in levels.iter().zip(offsets.windows(2)).zip(out.chunks_exact_mut(k)) {
        level.nearest_of(&lists[ends[0] as usize..ends[1] as usize], q, out);
    }
}

/// The lists of one block: local indices, and the end of the list of each (cell, level).
struct Block {
    list: Vec<u32>,
    ends: Vec<u32>,
}

struct Shape {
    origin: DVec3,
    cell: f64,
    rounding: f64,
    margin: f64,
    k: usize,
}

impl Shape {
    fn block(&self, levels: &[Level], at: [usize; 3]) -> Option<Block> {
        let low = self.origin + DVec3::from(at.map(|i| (i * BLOCK) as f64 * self.cell));
        let half = BLOCK as f64 * self.cell / 2.0;
        let centre = (low + half).as_vec3();
        // The centre is rounded: the block reaches further from it than from the true one.
        let radius = (half + self.rounding) * 3f64.sqrt() + (centre.as_dvec3() - (low + half)).length();
        if f64::from(levels[0].kth_distance(centre, 1)) - radius > self.margin {
            return None;
        }
        let near: Vec<Vec<u32>> = levels
            .iter()
            .map(|level| {
                let n = level.points.len();
                if n <= SMALL_LEVEL {
                    return (0..n as u32).collect();
                }
                // The k-th nearest distance changes by at most the way the query moves, and a
                // candidate is at most that far from the query.
                let kth = f64::from(level.kth_distance(centre, self.k.min(n)));
                level.within(centre, ((kth + 2.0 * radius) * (1.0 + 1e-6)) as f32)
            })
            .collect();
        let mut block = Block { list: Vec::new(), ends: Vec::with_capacity(BLOCK_CELLS * levels.len()) };
        let mut scratch = Vec::new();
        for cell in 0..BLOCK_CELLS {
            let offset = [cell % BLOCK, cell / BLOCK % BLOCK, cell / (BLOCK * BLOCK)];
            let centre = low + DVec3::from(offset.map(|i| (i as f64 + 0.5) * self.cell));
            for (l, level) in levels.iter().enumerate() {
                let outside = l == 0 && !self.cell_is_near(level, &near[0], centre);
                if outside {
                    let end = block.list.len() as u32;
                    block.ends.extend(std::iter::repeat_n(end, levels.len()));
                    break;
                }
                self.candidates(level, &near[l], centre, &mut scratch, &mut block.list);
                block.ends.push(block.list.len() as u32);
            }
        }
        Some(block)
    }

    fn half(&self) -> f64 {
        self.cell / 2.0 + self.rounding
    }

    fn cell_is_near(&self, level: &Level, near: &[u32], centre: DVec3) -> bool {
        let margin = self.margin * self.margin;
        near.iter().any(|&i| {
            let p = (level.points[i as usize].as_dvec3() - centre).abs();
            (p - self.half()).max(DVec3::ZERO).length_squared() <= margin
        })
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
        let half = self.half();
        scratch.clear();
        scratch.extend(near.iter().map(|&local| {
            let p = level.points[local as usize].as_dvec3() - centre;
            let far = p.abs() + half;
            let close = (p.abs() - half).max(DVec3::ZERO);
            Candidate {
                local,
                p,
                length_squared: p.length_squared(),
                min: close.length_squared(),
                max: far.length_squared(),
            }
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
        scratch.sort_unstable_by(|a, b| (a.length_squared.total_cmp(&b.length_squared)).then(a.local.cmp(&b.local)));
        // Second sieve: j is closer than p everywhere in the cell if |q−p|² − |q−j|², which is
        // linear in q, is positive at its lowest corner. Of equal points the lower index wins every
        // tie.
        for c in scratch.iter() {
            let certain = c.max * RELATIVE + ABSOLUTE;
            let mut closer = 0;
            for other in scratch.iter() {
                let difference = c.p - other.p;
                let spread = 2.0 * half * difference.abs().element_sum();
                let wins = c.length_squared - other.length_squared - spread > certain
                    || difference == DVec3::ZERO && other.local < c.local;
                closer += usize::from(wins);
                if closer == self.k {
                    break;
                }
            }
            if closer < self.k {
                list.push(c.local);
            }
        }
    }
}

/// A point as seen from the centre of a cell.
struct Candidate {
    local: u32,
    p: DVec3,
    length_squared: f64,
    /// Smallest and largest squared distance to the cell.
    min: f64,
    max: f64,
}
