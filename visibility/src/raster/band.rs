//! Drawing of a band of rows: depth test of every sample, then barycentrics.

use glam::{DVec3, Vec3};

use super::project::{Projected, Projection, STEP};
use super::triangle::{BAND, Chunk, Triangle};
use super::{Fragment, Pixel};

/// Samples of a row that are tested together.
const LANES: usize = 8;
/// Columns of a block, within which edge functions are stepped in 32 bits.
const BLOCK: i32 = 32;
/// Magnitude from which an edge function keeps its sign within a block: fewer than 64 steps of at
/// most 2²⁴.
const CERTAIN: i64 = 1 << 30;
/// No face.
const NONE: u32 = u32::MAX;

/// Inputs of a band.
pub(super) struct Band<'a> {
    pub projection: &'a Projection,
    pub projected: &'a [Projected],
    pub vertices: &'a [Vec3],
    pub faces: &'a [[u32; 3]],
    pub chunks: &'a [Chunk],
}

/// The samples of a band; what lies outside of its columns is left over from other bands.
#[derive(Debug, Default)]
pub(super) struct Strip {
    /// Reciprocal of the depth, 0 for nothing.
    inverse: Vec<f32>,
    face: Vec<u32>,
    stride: usize,
    /// Range of columns with a triangle.
    columns: [usize; 2],
}

impl Band<'_> {
    pub fn draw<T>(&self, band: usize, strip: &mut Strip, out: &mut [T], shade: &impl Fn(Pixel<'_>) -> T) {
        let side = self.projection.side;
        self.fill(band, strip);
        let columns = strip.columns[0] / side..strip.columns[1].div_ceil(side);
        let width = self.projection.width / side;
        let first = band * BAND / side * width;
        let mut samples = vec![None; side * side];
        for (row, out) in out.chunks_mut(width).enumerate() {
            let faces = |y: usize| &strip.face[(row * side + y) * strip.stride..][..self.projection.width];
            for (column, out) in out.iter_mut().enumerate() {
                let covered = |y: usize| faces(y)[column * side..][..side].iter().any(|&face| face != NONE);
                let any = columns.contains(&column) && (0..side).any(covered);
                if any {
                    for (i, sample) in samples.iter_mut().enumerate() {
                        *sample = self.resolve(strip, [column * side + i % side, row * side + i / side], band);
                    }
                }
                let samples = if any { &samples[..] } else { &[] };
                *out = shade(Pixel { index: first + row * width + column, samples });
            }
        }
    }

    /// Depth-tests all triangles.
    fn fill(&self, band: usize, strip: &mut Strip) {
        strip.stride = self.projection.width.next_multiple_of(LANES) + LANES;
        let bins = || self.chunks.iter().map(|chunk| (chunk, &chunk.bins[band])).filter(|(_, bin)| !bin.is_empty());
        strip.columns = [usize::MAX, 0];
        for (chunk, bin) in bins() {
            for &index in bin {
                let [low, high] = chunk.triangles[index as usize].columns;
                strip.columns = [strip.columns[0].min(low as usize), strip.columns[1].max(high as usize + 1)];
            }
        }
        strip.inverse.resize(strip.stride * BAND, 0.0);
        strip.face.resize(strip.stride * BAND, NONE);
        let [low, high] = [strip.columns[0] / self.projection.side * self.projection.side, strip.columns[1]];
        for start in (0..BAND).map(|row| row * strip.stride).filter(|_| low < high) {
            // Lanes beyond the last column are tested too.
            strip.inverse[start + low..start + high + LANES].fill(0.0);
            strip.face[start + low..start + high + LANES].fill(NONE);
        }
        let first_row = (band * BAND) as i32;
        for (chunk, bin) in bins() {
            arch().dispatch(Fill { strip: &mut *strip, first_row, chunk, bin });
        }
    }

    /// The fragment of a sample.
    #[inline]
    fn resolve(&self, strip: &Strip, [x, y]: [usize; 2], band: usize) -> Option<Fragment> {
        let face = strip.face[y * strip.stride + x];
        let centre = Vec3::new(x as f32 + 0.5, (band * BAND + y) as f32 + 0.5, 0.0);
        (face != NONE).then(|| self.fragment(face, self.faces[face as usize], centre))
    }

    /// Intersection of a triangle with the ray through the `centre` of a sample, by homogeneous
    /// edge functions (Olano and Greer 1997), which hold for corners behind the camera too.
    fn fragment(&self, face: u32, corners: [u32; 3], centre: Vec3) -> Fragment {
        let projected = corners.map(|v| &self.projected[v as usize]);
        if projected.iter().any(|v| v.inverse == 0.0) {
            return self.large_fragment(face, corners, centre.as_dvec3());
        }
        let [a, b, c] = projected.map(|v| v.clip);
        let [p, q, r] = [a, b, c].map(|v| v.truncate() - centre.truncate() * v.z);
        let weights = Vec3::new(q.perp_dot(r), r.perp_dot(p), p.perp_dot(q));
        // Rounded corners also cover samples slightly outside of the triangle.
        let inside = (weights * (weights.x + weights.y + weights.z).signum()).max(Vec3::ZERO);
        let scale = 1.0 / (inside.x + inside.y + inside.z);
        if !scale.is_finite() || scale == 0.0 {
            return self.large_fragment(face, corners, centre.as_dvec3());
        }
        let inside = inside * scale;
        Fragment { face, depth: inside.dot(Vec3::new(a.z, b.z, c.z)), barycentric: inside.to_array() }
    }

    /// [`Band::fragment`] in `f64`, for clipped triangles and where `f32` is not enough.
    #[cold]
    fn large_fragment(&self, face: u32, corners: [u32; 3], centre: DVec3) -> Fragment {
        let [a, b, c] = corners.map(|v| self.projection.exact(self.vertices[v as usize]));
        let [p, q, r] = [a, b, c].map(|v| v.truncate() - centre.truncate() * v.z);
        let weights = DVec3::new(q.perp_dot(r), r.perp_dot(p), p.perp_dot(q));
        let weights = weights / (weights.x + weights.y + weights.z);
        let weights = if weights.is_finite() { weights.max(DVec3::ZERO) } else { DVec3::ONE };
        let weights = weights / (weights.x + weights.y + weights.z);
        let depth = weights.dot(DVec3::new(a.z, b.z, c.z)).max(f64::from(self.projection.near));
        Fragment { face, depth: depth.min(f64::from(f32::MAX)) as f32, barycentric: weights.as_vec3().to_array() }
    }
}

/// AVX2 on x86-64, also where `pulp` is built with AVX-512 and the machine has it: a row is filled
/// eight samples at a time.
fn arch() -> pulp::Arch {
    #[cfg(target_arch = "x86_64")]
    if let Some(simd) = pulp::x86::V3::try_new() {
        return pulp::Arch::V3(simd);
    }
    pulp::Arch::new()
}

/// Fills the triangles of a bin; a struct, since `pulp` compiles closures for the baseline.
struct Fill<'a> {
    strip: &'a mut Strip,
    first_row: i32,
    chunk: &'a Chunk,
    bin: &'a [u32],
}

impl pulp::WithSimd for Fill<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) {
        for &index in self.bin {
            let triangle = &self.chunk.triangles[index as usize];
            for start in (triangle.columns[0]..=triangle.columns[1]).step_by(BLOCK as usize) {
                self.strip.fill(triangle, start, self.first_row);
            }
        }
    }
}

impl Strip {
    /// Draws a block of columns of a triangle, from `start`.
    #[inline(always)]
    fn fill(&mut self, triangle: &Triangle, start: i32, first_row: i32) {
        let end = (triangle.columns[1] + 1).min(start + BLOCK);
        let rows = [triangle.rows[0].max(first_row), triangle.rows[1].min(first_row + BAND as i32 - 1)];
        let (px, py) = (start * STEP + STEP / 2, rows[0] * STEP + STEP / 2);
        let (x, y) = (triangle.x, triangle.y);
        let (mut edges, mut across, mut down) = ([0i32; 3], [0i32; 3], [0i32; 3]);
        for i in 0..3 {
            let j = (i + 1) % 3;
            let (dx, dy) = (x[j] - x[i], y[j] - y[i]);
            let edge = i64::from(dx) * i64::from(py - y[i]) - i64::from(dy) * i64::from(px - x[i]);
            // Top-left rule for samples on an edge.
            let owned = dy < 0 || (dy == 0 && dx > 0);
            // Steps are multiples of STEP: lower bits decide no sign.
            edges[i] = ((edge - i64::from(!owned)) >> STEP.trailing_zeros()).clamp(-CERTAIN, CERTAIN) as i32;
            (across[i], down[i]) = (-dy, dx);
        }
        let [inverse, least, most] = triangle.inverse;
        let slope = triangle.slope.map(|s| (s * f64::from(STEP)) as f32);
        let at_start =
            f64::from(inverse) + triangle.slope[0] * f64::from(px - x[0]) + triangle.slope[1] * f64::from(py - y[0]);
        let mut inverse = at_start as f32;
        for row in rows[0]..=rows[1] {
            let at = (row - first_row) as usize * self.stride + start as usize;
            let span = at..at + ((end - start) as usize).next_multiple_of(LANES);
            let depths = self.inverse[span.clone()].as_chunks_mut::<LANES>().0;
            let faces = self.face[span].as_chunks_mut::<LANES>().0;
            let (mut first, mut edge) = (0.0f32, edges);
            for (depths, faces) in depths.iter_mut().zip(faces) {
                for i in 0..LANES {
                    let lane = i as i32;
                    let outside = edge[0].wrapping_add(across[0].wrapping_mul(lane))
                        | edge[1].wrapping_add(across[1].wrapping_mul(lane))
                        | edge[2].wrapping_add(across[2].wrapping_mul(lane));
                    let depth = inverse + slope[0] * (first + i as f32);
                    let depth = if depth > least { depth } else { least };
                    let depth = if depth < most { depth } else { most };
                    let nearer = (depth > depths[i]) | ((depth == depths[i]) & (triangle.face < faces[i]));
                    let seen = (outside >= 0) & nearer;
                    depths[i] = if seen { depth } else { depths[i] };
                    faces[i] = if seen { triangle.face } else { faces[i] };
                }
                first += LANES as f32;
                for e in 0..3 {
                    edge[e] = edge[e].wrapping_add(across[e].wrapping_mul(LANES as i32));
                }
            }
            for e in 0..3 {
                edges[e] = edges[e].wrapping_add(down[e]);
            }
            inverse += slope[1];
        }
    }
}
