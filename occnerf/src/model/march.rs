//! The march along rays: samples are traced, each with its canonical point and its surface
//! coordinates, and evaluated front to back, a segment of every ray at a time, with early
//! termination.

use glam::Vec3;
use smpl::{MotionField, MotionFrame, Posed};
use surface_query::MeshDistance;
use volrender::{Bins, Composite, Occupancy, OccupancyConfig, RandomStream, Ray, RaySamples, composite};

use crate::Error;
use crate::capture::Light;
use crate::config::Config;
use crate::model::body::{Body, SurfacePoint, surface_point};
use crate::model::colors::shade;
use crate::model::extent::Extent;
use crate::model::field::SampleBatch;
use crate::model::samples::Samples;
use crate::model::trained::Model;

/// How far rays are marched.
#[derive(Clone, Copy, Debug)]
pub(crate) struct MarchOptions {
    /// Live samples of a ray between two tests for termination.
    pub segment: usize,
    /// Transmittance behind which a ray ends; with 0 none does, and all samples are one segment.
    pub min_transmittance: f32,
}

impl MarchOptions {
    /// Segments for training: the samples across a surface. Where few rays terminate, longer
    /// segments make larger batches, which read a table larger than the cache faster.
    pub fn training(min_transmittance: f32) -> Self {
        Self { segment: if min_transmittance < 1e-6 { 24 } else { 6 }, min_transmittance }
    }
}

/// The next samples of some rays.
#[derive(Default)]
pub(crate) struct Segment {
    /// Which of the rays these are, in order.
    pub rays: Vec<usize>,
    pub batch: SampleBatch,
    weights: Vec<f32>,
    composites: Vec<Composite>,
}

impl Segment {
    /// Traces the next samples of every ray that goes on; `evaluate` gives them density and colour.
    /// False where no ray goes on.
    pub fn advance(
        &mut self,
        tracer: &Tracer<'_>,
        marches: &mut [March],
        options: MarchOptions,
        mut evaluate: impl FnMut(&mut SampleBatch),
    ) -> bool {
        let Self { rays, batch, weights, composites } = self;
        let MarchOptions { segment, min_transmittance } = options;
        rays.clear();
        rays.extend((0..marches.len()).filter(|&ray| marches[ray].goes_on(min_transmittance)));
        if rays.is_empty() {
            return false;
        }
        let most = if min_transmittance > 0.0 { segment } else { usize::MAX };
        batch.samples.clear();
        for &ray in &*rays {
            tracer.trace(&mut batch.samples, most, &mut marches[ray]);
        }
        evaluate(batch);
        if min_transmittance > 0.0 {
            composite_batch(batch, Vec3::ZERO, weights, composites);
            for (&ray, composite) in rays.iter().zip(&*composites) {
                marches[ray].pass(composite);
            }
        }
        true
    }
}

/// The segments of rays that have been marched to their ends, kept for the backward pass.
#[derive(Default)]
pub(crate) struct Segments {
    /// Those of this step come first; the others are room for steps that need more.
    all: Vec<Segment>,
    count: usize,
    marches: Vec<March>,
}

impl Segments {
    /// Marches `rays` until all of them have ended.
    pub fn march(
        &mut self,
        tracer: &Tracer<'_>,
        rays: impl Iterator<Item = March>,
        options: MarchOptions,
        mut evaluate: impl FnMut(&mut SampleBatch),
    ) {
        self.count = 0;
        self.marches.clear();
        self.marches.extend(rays);
        loop {
            if self.count == self.all.len() {
                self.all.push(Segment::default());
            }
            if !self.all[self.count].advance(tracer, &mut self.marches, options, &mut evaluate) {
                return;
            }
            self.count += 1;
        }
    }

    /// Number of rays.
    pub fn num_rays(&self) -> usize {
        self.marches.len()
    }

    /// Front to back.
    pub fn all(&self) -> &[Segment] {
        &self.all[..self.count]
    }

    /// [`Segments::all`], to be changed.
    pub fn all_mut(&mut self) -> &mut [Segment] {
        &mut self.all[..self.count]
    }
}

/// Composites every ray of a batch.
pub(crate) fn composite_batch(
    batch: &SampleBatch,
    background: Vec3,
    weights: &mut Vec<f32>,
    composites: &mut Vec<Composite>,
) {
    let Samples { starts, likelihood, delta, t, .. } = &batch.samples;
    let samples = RaySamples { sigma: &batch.sigma, likelihood, delta, t, rgb: &batch.rgb };
    composite_rays(starts, samples, background, weights, composites);
}

/// Composites rays whose samples stand ray by ray; `starts` has the first sample of each ray, and
/// the end of the last.
pub(crate) fn composite_rays(
    starts: &[usize],
    samples: RaySamples<'_>,
    background: Vec3,
    weights: &mut Vec<f32>,
    composites: &mut Vec<Composite>,
) {
    weights.resize(samples.t.len(), 0.0);
    composites.clear();
    for ends in starts.windows(2) {
        let range = ends[0]..ends[1];
        composites.push(composite(samples.slice(range.clone()), background, &mut weights[range]));
    }
}

/// Side of an occupancy cell in training, normalised metres: a step has too few rays for a finer
/// grid to pay.
pub(crate) const CELL: f32 = 0.02;
/// Side of an occupancy cell in drawing, normalised metres: saves a tenth of the time.
pub(crate) const FINE_CELL: f32 = 0.01;

/// A posed prior ready to be sampled; refitted in place for each frame.
pub(crate) struct PosedSurface {
    mesh: MeshDistance,
    pub occupancy: Occupancy,
    /// How bright each vertex is, see [`Light::on_surface`].
    shades: Vec<f32>,
    cell: f32,
}

impl PosedSurface {
    /// The canonical body, with an occupancy of cells of side `cell`, normalised metres.
    pub fn new(body: &Body, cell: f32) -> Result<Self, Error> {
        let mesh = MeshDistance::new(&body.canonical.vertices, &body.model.faces)?;
        Ok(Self { mesh, occupancy: Occupancy::default(), shades: Vec::new(), cell })
    }

    /// Refits to another pose, out to `extent`, under this light.
    pub fn refit(&mut self, body: &Body, posed: &Posed, extent: &Extent, config: &Config, light: Light) {
        let Self { mesh, occupancy, shades, cell } = self;
        *shades = light.on_surface(&posed.vertices, &body.model.faces);
        let size = OccupancyConfig { margin: config.motion.reach(), depth: config.motion.depth, cell: *cell };
        rayon::join(
            || mesh.refit(&posed.vertices),
            || occupancy.rebuild(&posed.vertices, &body.model.faces, &extent.faces, size),
        );
    }
}

/// Everything that tracing a ray reads.
#[derive(Clone, Copy)]
pub(crate) struct Tracer<'a> {
    pub model: &'a Model,
    pub surface: &'a PosedSurface,
    pub extent: &'a Extent,
    pub frame: &'a MotionFrame<'a>,
}

/// State of the march along a ray, front to back.
#[derive(Clone, Debug)]
pub(crate) struct March {
    ray: Ray,
    /// The first bin that is not traced yet.
    bin: usize,
    /// The face that was closest to the last sample bounds the search for the next.
    known: Option<u32>,
    /// Places each sample in its bin, the middle without.
    jitter: Option<RandomStream>,
    /// Whether samples outside the prior are dead.
    inside: bool,
    /// Whether all bins are traced.
    ended: bool,
    /// Colour, over black, and transmittance so far.
    pub color: Vec3,
    pub transmittance: f32,
}

impl March {
    /// The start of a ray; `jitter` places each sample in its bin, the middle without.
    pub fn new(ray: Ray, jitter: Option<RandomStream>) -> Self {
        let (color, transmittance) = (Vec3::ZERO, 1.0);
        Self { ray, bin: 0, known: None, jitter, inside: false, ended: false, color, transmittance }
    }

    /// With samples inside the prior alone, d < 0, if `inside`.
    pub fn only_inside(self, inside: bool) -> Self {
        Self { inside, ..self }
    }

    /// Whether there are visible bins left.
    pub fn goes_on(&self, min_transmittance: f32) -> bool {
        !self.ended && self.transmittance > min_transmittance
    }

    /// Accumulates the last samples, composited over black.
    pub fn pass(&mut self, composite: &Composite) {
        self.color += self.transmittance * composite.color;
        self.transmittance *= (1.0 - composite.opacity).max(0.0);
    }
}

/// The closest point of the posed prior.
type Nearest = smpl::SurfacePoint;

impl Tracer<'_> {
    /// Appends the next live samples of a ray, at most `most`, and advances the march.
    pub fn trace(&self, samples: &mut Samples, most: usize, march: &mut March) {
        let ray = march.ray;
        let count = self.model.config.samples;
        let first = samples.len();
        let span = self.surface.occupancy.region().intersect(&ray);
        if let Some((near, far)) = span.filter(|(near, far)| far > near) {
            let bins = Bins::new(near, far, count);
            while march.bin < count && samples.len() - first < most {
                let bin = march.bin;
                march.bin += 1;
                let place = march.jitter.as_mut().map_or(0.5, RandomStream::uniform);
                let t = bins.at(bin, place);
                let point = ray.origin + t * ray.direction;
                if !self.surface.occupancy.is_occupied(point) {
                    continue;
                }
                let live;
                (live, march.known) = self.push(samples, point, march.known, march.inside);
                if live {
                    samples.t.push(t);
                    samples.delta.push(bins.width());
                    samples.world.push(point);
                }
            }
            march.ended = march.bin == count;
        } else {
            march.ended = true;
        }
        samples.starts.push(samples.t.len());
    }

    /// The closest point of the posed prior within the live range; `near` is a face that is
    /// probably close.
    fn nearest(&self, point: Vec3, near: Option<u32>) -> Option<Nearest> {
        let mesh = &self.surface.mesh;
        // Rounding may put the face itself a hair beyond its own distance.
        let bound = near.map_or(f32::INFINITY, |face| 1.000_01 * mesh.distance_to_face(point, face) + 1e-6);
        let farthest = self.extent.farthest.max(self.model.config.motion.depth);
        let found = mesh.closest_within(point, farthest.min(bound))?;
        let (face, barycentric, signed_distance) = (found.face, found.barycentric, found.signed_distance);
        Some(Nearest { face, barycentric, signed_distance })
    }

    /// Maps a point, looks up its surface and appends it if it is live, which is returned with the
    /// closest posed face. `near` is a face that is probably close; `inside` keeps d < 0 alone.
    fn push(&self, samples: &mut Samples, point: Vec3, near: Option<u32>, inside: bool) -> (bool, Option<u32>) {
        let Model { body, config, motion, base, near_canonical, .. } = self.model;
        let (reach, depth) = (config.motion.reach(), config.motion.depth);
        let mut nearest = None;
        if let MotionField::Surface(_) = motion {
            let Some(found) = self.nearest(point, near) else { return (false, None) };
            if found.signed_distance > self.extent.faces[found.face as usize] || found.signed_distance < -depth {
                return (false, Some(found.face));
            }
            nearest = Some(found);
        }
        let looked_up = nearest.map(|found| found.face);
        let Some(mapped) = motion.map(self.frame, point, || nearest) else { return (false, looked_up) };
        if nearest.is_none() && !near_canonical.is_occupied(mapped.canonical) {
            return (false, None);
        }
        let corner = |v: u32| body.canonical.vertices[v as usize];
        let exact = !config.surface.distance.needs_neighbours();
        // The closest point keeps its face and barycentrics in the canonical pose.
        let mut at = nearest.filter(|_| exact).map(|found| {
            let weighted = body.model.faces[found.face as usize].into_iter().zip(found.barycentric);
            let closest = weighted.map(|(v, b)| b * corner(v)).sum();
            SurfacePoint { closest, distance: found.signed_distance }
        });
        let look =
            |neighbours: &[u32]| surface_point(body, &config.surface, mapped.canonical, neighbours, reach.max(depth));
        if exact && at.is_none() {
            at = look(&[]);
            if at.is_none() {
                return (false, looked_up);
            }
        }
        let first = samples.neighbours.len();
        if config.needs_neighbours() {
            samples.neighbours.resize(first + body.query.neighbours_per_query(), 0);
            body.query.neighbours(mapped.canonical, &mut samples.neighbours[first..]);
        }
        let within =
            |at: &SurfacePoint| at.distance <= reach && at.distance >= -depth && !(inside && at.distance >= 0.0);
        let at = at.or_else(|| look(&samples.neighbours[first..])).filter(within);
        let Some(at) = at.filter(|_| mapped.likelihood > 0.0) else {
            samples.neighbours.truncate(first);
            return (false, looked_up);
        };
        samples.likelihood.push(mapped.likelihood);
        samples.canonical.push(mapped.canonical);
        samples.closest.push(at.closest);
        samples.distance.push(at.distance);
        if let Some(found) = nearest.filter(|_| !base.colors.is_empty()) {
            let corners = body.model.faces[found.face as usize];
            let shade = shade(&self.surface.shades, corners, found.barycentric);
            samples.base.push(base.logit(found.face, found.barycentric, shade));
        }
        (true, looked_up)
    }
}

#[cfg(test)]
mod tests {
    use synth::{DemoConfig, demo};

    use super::*;
    use crate::config::{DistanceKind, Method, MotionKind, Preset};
    use crate::model::view::PosedView;
    use crate::scene::prepared::Scene;
    use crate::train::trainer::Trainer;

    /// Appends one point of space, if it lives.
    fn push_point(tracer: &Tracer<'_>, samples: &mut Samples, point: Vec3) -> bool {
        let live = tracer.push(samples, point, None, false).0;
        if live {
            samples.world.push(point);
        }
        live
    }

    #[test]
    fn with_a_volume_a_sample_lives_where_the_canonical_prior_is_near() {
        let body = smpl::BodyModel::embedded();
        let capture = demo(&DemoConfig { size: 32, frames: 2, eval_cameras: 1, ..Default::default() }, &body).unwrap();
        for distance in [DistanceKind::Blended, DistanceKind::Exact] {
            let mut config = Config::preset(Preset::Paper, Method::Occnerf);
            config.motion.kind = MotionKind::Volume;
            (config.field.prior_colors, config.field.prior_light) = (false, false);
            (config.surface.distance, config.encoding.log2_table_size) = (distance, 8);
            let scene = Scene::new(&capture, &body, &config).unwrap();
            let trainer = Trainer::new(&scene, config.clone()).unwrap();
            let frame: &PosedView = &scene.train[1].view;
            let motion = MotionFrame::new(&body, &frame.posed);
            let tracer = Tracer {
                model: trainer.model(),
                surface: &trainer.buffers.surface,
                extent: &trainer.model().extent,
                frame: &motion,
            };
            let MotionField::Volume { weights, threshold } = &tracer.model.motion else {
                panic!("a volume was asked for")
            };
            let (reach, k) = (config.motion.reach(), config.surface.k);
            let low = frame.posed.vertices.iter().copied().reduce(Vec3::min).unwrap() - 2.0 * reach;
            let size = frame.posed.vertices.iter().copied().reduce(Vec3::max).unwrap() + 2.0 * reach - low;
            let mut random = RandomStream::new(&[5]);
            let (mut counts, mut samples) = ([0; 3], Samples::default());
            for _ in 0..20_000 {
                let point = low + size * Vec3::new(random.uniform(), random.uniform(), random.uniform());
                let Some(mapped) = weights.map(&motion.to_canonical, point, *threshold) else {
                    assert!(!push_point(&tracer, &mut samples, point));
                    continue;
                };
                let exact = scene.body.surface.closest(mapped.canonical).signed_distance;
                let mut neighbours = vec![0; scene.body.query.neighbours_per_query()];
                scene.body.query.neighbours(mapped.canonical, &mut neighbours);
                let blended = scene.body.query.blend(mapped.canonical, &neighbours[..k]).signed_distance;
                let used = if distance == DistanceKind::Exact { exact } else { blended };
                let within = |d: f32| d <= reach && d >= -config.motion.depth;
                let live = push_point(&tracer, &mut samples, point);
                // A little beyond the margin, as far as a cell or the corner of a box, either is
                // right; no point is as deep as `depth`.
                if within(exact) {
                    assert_eq!(live, within(used), "{point}: {exact}, {used}");
                    counts[usize::from(live)] += 1;
                } else if exact > 2.0 * reach {
                    assert!(!live, "{point}: {exact}, {used}");
                    counts[2] += 1;
                }
            }
            assert!(counts[1] > 500 && counts[2] > 100, "{counts:?}");
        }
    }
}
