//! Live samples of rays: where a ray can meet the subject, and what the surface says of each point.

use glam::{Affine3A, Vec3, Vec4};
use smpl::{Posed, SurfaceMotion, WeightVolume};
use surface_query::MeshDistance;
use volrender::{Occupancy, Ray};

use crate::Error;
use crate::config::{Config, DistanceKind};
use crate::model::extent::Shell;
use crate::random::Stream;
use crate::scene::prepared::Scene;

/// Side of a cell of the occupancy for the rays of a step, of which too few pass through one for a finer grid to pay.
pub(crate) const CELL: f32 = 0.02;
/// The same for those of a picture, a tenth of whose time it saves.
pub(crate) const FINE_CELL: f32 = 0.01;
/// Σ w below which the weight volume says nothing.
const VOLUME_THRESHOLD: f32 = 1e-3;

/// A posed prior ready to be sampled; rebuilt in place for each frame.
pub(crate) struct Stage {
    mesh: MeshDistance,
    pub occupancy: Occupancy,
    cell: f32,
}

impl Stage {
    /// With an occupancy of cells of side `cell`, normalised metres.
    pub fn new(scene: &Scene, cell: f32) -> Result<Self, Error> {
        let mesh = MeshDistance::new(&scene.canonical.vertices, &scene.model.faces)?;
        Ok(Self { mesh, occupancy: Occupancy::default(), cell })
    }

    pub fn set(&mut self, scene: &Scene, posed: &Posed, shell: &Shell, config: &Config) {
        let (margin, depth) = (config.motion.margin + config.motion.falloff, config.motion.depth);
        let Self { mesh, occupancy, cell } = self;
        rayon::join(
            || mesh.refit(&posed.vertices),
            || occupancy.rebuild(&posed.vertices, &scene.model.faces, &shell.faces, margin, depth, *cell),
        );
    }
}

/// Cells near the canonical prior, which are marked once and for all.
pub(crate) fn near_canonical(scene: &Scene, config: &Config) -> Occupancy {
    let (mut occupancy, whole) = (Occupancy::default(), Shell::whole(scene, config));
    let (vertices, faces, motion) = (&scene.canonical.vertices, &scene.model.faces, &config.motion);
    occupancy.rebuild(vertices, faces, &whole.faces, whole.farthest, motion.depth, FINE_CELL);
    occupancy
}

/// Everything that tracing a ray reads.
#[derive(Clone, Copy)]
pub(crate) struct Tracer<'a> {
    pub scene: &'a Scene,
    pub config: &'a Config,
    pub stage: &'a Stage,
    pub posed: &'a Posed,
    pub to_canonical: &'a [Affine3A],
    pub volume: Option<&'a WeightVolume>,
    /// Where the canonical prior is near; asked where there is a volume, of which it is not known from the point in space.
    pub near_canonical: &'a Occupancy,
    pub shell: &'a Shell,
    /// What colours start from at each vertex, before the sigmoid, and the share w of what the perceptron adds; empty where
    /// they start from nothing and it adds all.
    pub base: &'a [Vec4],
    /// Whether neighbours are wanted at all; the point-based methods do without unless v̂ is blended.
    pub neighbours: bool,
    /// Whether [`Samples::faces`] are wanted; the surface motion alone has them.
    pub faces: bool,
}

/// Live samples of consecutive rays, structure of arrays.
#[derive(Clone, Debug, Default)]
pub(crate) struct Samples {
    /// First sample of each ray, and the end of the last.
    pub starts: Vec<usize>,
    /// Depth along the ray.
    pub t: Vec<f32>,
    /// Width of the sample's bin.
    pub delta: Vec<f32>,
    /// Foreground likelihood f.
    pub likelihood: Vec<f32>,
    pub world: Vec<Vec3>,
    /// x̂.
    pub canonical: Vec<Vec3>,
    /// v̂.
    pub closest: Vec<Vec3>,
    /// d.
    pub distance: Vec<f32>,
    /// All levels, finest first; empty where the tracer wants none.
    pub neighbours: Vec<u32>,
    /// What the colour starts from, and the share w of what the perceptron adds, as [`Tracer::base`]; empty where that is.
    pub base: Vec<Vec4>,
    /// Face of the posed prior that each sample is mapped by, with barycentrics; empty where the tracer wants none.
    pub faces: Vec<(u32, [f32; 3])>,
}

/// A ray on its way through the scene, front to back.
#[derive(Clone, Debug)]
pub(crate) struct March {
    ray: Ray,
    /// The first that is not traced yet.
    bin: usize,
    /// The face that was closest to the last sample bounds the search for the next.
    known: Option<u32>,
    /// Places each sample in its bin, the middle without.
    jitter: Option<Stream>,
    /// Whether samples outside the prior are dead.
    inside: bool,
    /// Whether all bins are traced.
    ended: bool,
    /// Of what was traced and evaluated.
    pub transmittance: f32,
}

impl March {
    /// Nothing of the ray is traced yet; `jitter` places each sample in its bin, the middle without.
    pub fn new(ray: Ray, jitter: Option<Stream>) -> Self {
        Self { ray, bin: 0, known: None, jitter, inside: false, ended: false, transmittance: 1.0 }
    }

    /// With samples inside the prior alone, d < 0, if `inside`.
    pub fn only_inside(self, inside: bool) -> Self {
        Self { inside, ..self }
    }

    /// Whether there are bins left that can be seen through what is before them.
    pub fn goes_on(&self, min_transmittance: f32) -> bool {
        !self.ended && self.transmittance > min_transmittance
    }

    /// Takes in how opaque the samples are that were traced last.
    pub fn pass(&mut self, opacity: f32) {
        self.transmittance *= (1.0 - opacity).max(0.0);
    }
}

impl Samples {
    /// What the colour of sample `s` starts from, and the share w of what the perceptron adds.
    pub fn base(&self, s: usize) -> Vec4 {
        self.base.get(s).copied().unwrap_or(Vec4::W)
    }

    pub fn clear(&mut self) {
        self.starts.clear();
        self.starts.push(0);
        self.t.clear();
        self.delta.clear();
        self.likelihood.clear();
        self.world.clear();
        self.canonical.clear();
        self.closest.clear();
        self.distance.clear();
        self.neighbours.clear();
        self.base.clear();
        self.faces.clear();
    }

    pub fn len(&self) -> usize {
        self.t.len()
    }

    /// Appends all live samples of a ray, in the middle of their bins.
    #[cfg(test)]
    pub fn trace(&mut self, tracer: &Tracer<'_>, ray: &Ray) {
        self.trace_on(tracer, usize::MAX, &mut March::new(*ray, None));
    }

    /// Appends the next live samples of a ray, at most `most`, and takes the march to where they end.
    pub fn trace_on(&mut self, tracer: &Tracer<'_>, most: usize, march: &mut March) {
        let ray = march.ray;
        let bins = tracer.config.samples;
        let first = self.len();
        let span = tracer.stage.occupancy.region().and_then(|region| region.intersect(&ray));
        if let Some((near, far)) = span.filter(|(near, far)| far > near) {
            let width = (far - near) / bins as f32;
            while march.bin < bins && self.len() - first < most {
                let bin = march.bin;
                march.bin += 1;
                let place = march.jitter.as_mut().map_or(0.5, Stream::uniform);
                let t = near + (bin as f32 + place) * width;
                let point = ray.origin + t * ray.direction;
                if !tracer.stage.occupancy.is_live(point) {
                    continue;
                }
                let live;
                (live, march.known) = self.push(tracer, point, march.known, march.inside);
                if live {
                    self.t.push(t);
                    self.delta.push(width);
                    self.world.push(point);
                }
            }
            march.ended = march.bin == bins;
        } else {
            march.ended = true;
        }
        self.starts.push(self.t.len());
    }

    /// Appends a point of the canonical space whose surface is known, as of a ray of no length.
    pub fn push_canonical(&mut self, scene: &Scene, at: Vec3, closest: Vec3, distance: f32, neighbours: bool) {
        if neighbours {
            let first = self.neighbours.len();
            self.neighbours.resize(first + scene.query.neighbours_per_query(), 0);
            scene.query.neighbours(at, &mut self.neighbours[first..]);
        }
        self.t.push(0.0);
        self.delta.push(0.0);
        self.likelihood.push(1.0);
        self.world.push(at);
        self.canonical.push(at);
        self.closest.push(closest);
        self.distance.push(distance);
    }

    /// Appends one point of space, if it lives.
    #[cfg(test)]
    pub fn push_point(&mut self, tracer: &Tracer<'_>, point: Vec3) -> bool {
        let live = self.push(tracer, point, None, false).0;
        if live {
            self.world.push(point);
        }
        live
    }

    /// Maps a point and looks up its surface; false, with nothing pushed, if the sample is dead. `near` is a posed face
    /// that is probably close; returns the closest one where it was looked up. `inside`: only d < 0 lives.
    fn push(&mut self, tracer: &Tracer<'_>, point: Vec3, near: Option<u32>, inside: bool) -> (bool, Option<u32>) {
        let motion = &tracer.config.motion;
        let reach = motion.margin + motion.falloff;
        let farthest = reach.max(motion.depth);
        let (mut looked_up, mut mapped_by) = (None, None);
        let exact = tracer.config.surface.distance == DistanceKind::Exact;
        let query = &tracer.scene.query;
        let (sample, on_surface) = if let Some(volume) = tracer.volume {
            let Some(sample) = volume.map(tracer.to_canonical, point, VOLUME_THRESHOLD) else {
                return (false, None);
            };
            if !tracer.near_canonical.is_live(sample.canonical) {
                return (false, None);
            }
            let closest = exact.then(|| tracer.scene.surface.closest(sample.canonical, farthest));
            match closest {
                Some(None) => return (false, None),
                Some(Some(closest)) => (sample, Some((closest.point, closest.signed_distance))),
                None => (sample, None),
            }
        } else {
            let mesh = &tracer.stage.mesh;
            // Rounding may put the face itself a hair beyond its own distance.
            let bound = near.map_or(f32::INFINITY, |face| 1.000_01 * mesh.distance_to_face(point, face) + 1e-6);
            let farthest = tracer.shell.farthest.max(motion.depth);
            let Some(closest) = mesh.closest(point, farthest.min(bound)) else {
                return (false, None);
            };
            looked_up = Some(closest.face);
            mapped_by = Some((closest.face, closest.barycentric));
            if closest.signed_distance > tracer.shell.faces[closest.face as usize]
                || closest.signed_distance < -motion.depth
            {
                return (false, looked_up);
            }
            let field = SurfaceMotion { margin: motion.margin, falloff: motion.falloff };
            let mapped = field.map(
                &tracer.scene.model,
                tracer.posed,
                point,
                closest.face,
                closest.barycentric,
                closest.signed_distance,
            );
            let Some(sample) = mapped else { return (false, looked_up) };
            // The closest point keeps its face and barycentrics in the canonical pose.
            let corners = tracer.scene.model.faces[closest.face as usize];
            let on_canonical = exact.then(|| {
                let weighted = corners.iter().zip(closest.barycentric);
                let sum = weighted.map(|(&v, b)| b * tracer.scene.canonical.vertices[v as usize]).sum();
                (sum, closest.signed_distance)
            });
            (sample, on_canonical)
        };
        let first = self.neighbours.len();
        if tracer.neighbours {
            self.neighbours.resize(first + query.neighbours_per_query(), 0);
            query.neighbours(sample.canonical, &mut self.neighbours[first..]);
        }
        let (closest, distance) = on_surface.unwrap_or_else(|| {
            let finest = &self.neighbours[first..][..tracer.config.surface.k];
            let blended = query.blend(sample.canonical, finest);
            let mean = tracer.config.surface.distance == DistanceKind::Mean;
            let distance = if mean { query.mean_distance(sample.canonical, finest).0 } else { blended.signed_distance };
            (blended.point, distance)
        });
        let within = distance <= reach && distance >= -motion.depth && !(inside && distance >= 0.0);
        if !(within && sample.likelihood > 0.0) {
            self.neighbours.truncate(first);
            return (false, looked_up);
        }
        self.likelihood.push(sample.likelihood);
        self.canonical.push(sample.canonical);
        self.closest.push(closest);
        self.distance.push(distance);
        if let Some((face, barycentric)) = mapped_by.filter(|_| !tracer.base.is_empty()) {
            let corners = tracer.scene.model.faces[face as usize];
            self.base.push(corners.iter().zip(barycentric).map(|(&v, b)| b * tracer.base[v as usize]).sum());
        }
        self.faces.extend(mapped_by.filter(|_| tracer.faces));
        (true, looked_up)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::{DemoConfig, demo};
    use crate::config::{Method, Preset};
    use crate::train::trainer::Trainer;

    #[test]
    fn with_a_volume_a_sample_lives_where_the_canonical_prior_is_near() {
        let body = smpl::BodyModel::embedded();
        let capture = demo(&DemoConfig { size: 32, frames: 2, eval_cameras: 1, ..Default::default() }, &body).unwrap();
        for distance in [DistanceKind::Blended, DistanceKind::Exact] {
            let mut config = Config::preset(Preset::Paper, Method::Occnerf);
            (config.surface.distance, config.encoding.log2_table_size) = (distance, 8);
            let scene = Scene::new(&capture, &body, &config).unwrap();
            let trainer = Trainer::new(&scene, config.clone()).unwrap();
            let frame = &scene.train[1];
            let tracer = trainer.tracer(&trainer.stage, &trainer.shell, frame, &frame.posed);
            let (reach, k) = (config.motion.margin + config.motion.falloff, config.surface.k);
            let low = frame.posed.vertices.iter().copied().reduce(Vec3::min).unwrap() - 2.0 * reach;
            let size = frame.posed.vertices.iter().copied().reduce(Vec3::max).unwrap() + 2.0 * reach - low;
            let mut random = Stream::new(&[5]);
            let (mut counts, mut samples) = ([0; 3], Samples::default());
            for _ in 0..20_000 {
                let point = low + size * Vec3::new(random.uniform(), random.uniform(), random.uniform());
                let Some(mapped) = tracer.volume.unwrap().map(tracer.to_canonical, point, VOLUME_THRESHOLD) else {
                    assert!(!samples.push_point(&tracer, point));
                    continue;
                };
                let exact = scene.surface.closest(mapped.canonical, f32::INFINITY).unwrap().signed_distance;
                let mut neighbours = vec![0; scene.query.neighbours_per_query()];
                scene.query.neighbours(mapped.canonical, &mut neighbours);
                let blended = scene.query.blend(mapped.canonical, &neighbours[..k]).signed_distance;
                let used = if distance == DistanceKind::Exact { exact } else { blended };
                let within = |d: f32| d <= reach && d >= -config.motion.depth;
                let live = samples.push_point(&tracer, point);
                // A little beyond the margin, as far as a cell or the corner of a box, either is right; nobody is as deep as `depth`.
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
