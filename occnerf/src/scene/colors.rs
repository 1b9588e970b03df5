//! Albedo of the prior from the training frames, and colours of unobserved vertices by inverse
//! distance weighting (Shepard 1968).
//!
//! Those distances are anisotropic about the bone, since hems, belts, cuffs and stripes go around
//! trunk and limbs more often than along them. The unobserved vertices of each joint choose the
//! anisotropy that predicts the observed vertices around them best, one along the bone by a margin.
//! Unseen hair takes the colours of hair.

use std::sync::Arc;

use glam::{DVec3, Vec3};
use rayon::prelude::*;
use smpl::BoneNames;
use volrender::Aabb;

use crate::Error;
use crate::model::body::Body;
use crate::model::colors::PriorColors;
use crate::model::subdivide::{Subdivided, most_times, times_until};
use crate::model::view::pixel_width;
use crate::scene::hands::is_arm;
use crate::scene::prepared::Scene;
use crate::scene::seen::ColorObservation;

/// Target edge length of the subdivided prior, pixels of the training frames, and most
/// subdivisions.
const EDGE: f32 = 0.5;
const MOST: u32 = 2;
/// Least foreshortening weight of an observation.
const SLANT: f32 = 0.05;
/// Least mean foreshortening of an observed point, and least foreshortening of a pixel that the
/// texture is fitted to: at the rims of masks, grazing surface shows the background.
pub(crate) const GRAZING: f32 = 0.3;
/// Least sum of the reliabilities of an observed point where frames disagree, frames.
const EVIDENCE: f32 = 4.0;
/// Frames in flight, at some megabytes of observations each.
const TOGETHER: usize = 8;

impl PriorColors {
    /// Least-squares albedo over the visible training pixels of each point of the subdivided prior,
    /// or of its clothes if registered, weighted by foreshortening and reliability, under the light
    /// of the scene if the configuration asks for one. Contaminated edge pixels of masks are left
    /// out. Vertices that are not observed reliably, or at grazing angles alone, are completed by
    /// inverse distance weighting, other such points interpolated from their vertices.
    ///
    /// # Errors
    /// Pictures that cannot be read.
    pub fn measure(scene: &Scene) -> Result<Self, Error> {
        let (prior, faces) = (&scene.body.canonical.vertices, &scene.body.model.faces);
        let &(light, ref reliability, ref hands) = scene.lighting()?;
        let pixel = pixel_width(scene.train.iter().map(|frame| &*frame.view));
        let most = MOST.min(most_times(faces.len()));
        let times = pixel.map_or(0, |pixel| times_until(prior, faces, EDGE * pixel, most));
        let mesh = Subdivided::new(prior.len(), faces, times);
        // Terms of Σ s c for colours c under the light s, and of Σ s², the reliabilities times the
        // foreshortening, and the reliabilities.
        let shown = |frame: usize| -> Result<Vec<(usize, Vec3, Vec3)>, Error> {
            let seen = scene.seen_in(frame, &mesh.anchors)?;
            let view = &scene.train[frame].view;
            let eye = view.camera.centre_of_projection();
            let term = |&((v, color, normal), depth): &(ColorObservation, usize)| {
                let place = mesh.anchors[v as usize].mix(&view.posed.vertices);
                let cosine = normal.dot((eye - place).normalize_or_zero());
                let trust = reliability.at(depth as f32, cosine);
                let (size, shade) = (trust * cosine.max(SLANT), light.on(normal));
                (v as usize, size * shade * color, Vec3::new(size * shade * shade, size, trust))
            };
            let hands = hands.as_ref().map(|color| color.in_frame(&scene.body.model, view));
            let is_hand_beside = |v: u32, color: Vec3| {
                let (Some(hands), anchor) = (&hands, &mesh.anchors[v as usize]) else { return false };
                let at = view.camera.project(anchor.mix(&view.posed.vertices));
                let pixel = at.map(|at| at.y as usize * view.camera.width as usize + at.x as usize);
                pixel.is_some_and(|pixel| hands.may_show(pixel, color))
                    && !is_arm(scene.body.model.weights.row(anchor.corners[0] as usize))
            };
            let is_allowed =
                |&&((v, color, _), depth): &&(ColorObservation, usize)| depth > scene.edge && !is_hand_beside(v, color);
            Ok(seen.iter().filter(is_allowed).map(term).collect())
        };
        let mut sums = vec![(Vec3::ZERO, Vec3::ZERO); mesh.anchors.len()];
        for first in (0..scene.train.len()).step_by(TOGETHER) {
            let frames = first..(first + TOGETHER).min(scene.train.len());
            let found: Result<Vec<_>, Error> = frames.into_par_iter().map(shown).collect();
            for (v, sum, weights) in found?.into_iter().flatten() {
                sums[v] = (sums[v].0 + sum, sums[v].1 + weights);
            }
        }
        let least = reliability.disagreement * EVIDENCE;
        let is_seen = |weights: Vec3| weights.x > 0.0 && weights.y > GRAZING * weights.z && weights.z >= least;
        let seen: Vec<bool> = sums.iter().map(|sum| is_seen(sum.1)).collect();
        let mut colors: Vec<Vec3> = sums.iter().map(|(sum, weights)| *sum / weights.x.max(f32::MIN_POSITIVE)).collect();
        let (vertices, between) = colors.split_at_mut(prior.len());
        let foreshortening = |v: usize| if seen[v] { sums[v].1.y / sums[v].1.z } else { 0.0 };
        complete(&scene.body, vertices, &(0..prior.len()).map(foreshortening).collect::<Vec<_>>());
        let rest = between.iter_mut().zip(&mesh.anchors[prior.len()..]).zip(&seen[prior.len()..]);
        rest.filter(|(_, seen)| !**seen).for_each(|((color, anchor), _)| *color = anchor.mix(vertices));
        Ok(Self { colors, seen, light, mesh: Arc::new(mesh) })
    }
}

/// Length of a metre around the bone relative to one along it, where distances are anisotropic:
/// shorter, or longer.
const AROUND: f32 = 0.1;
const ALONG: f32 = 10.0;
/// Largest error of [`ALONG`] relative to the others': noise of dirty colours chooses it at random.
const SURE: f32 = 0.8;
/// Distance from unobserved vertices of the validation vertices, metres of a body 1.7 high.
const RIM: f32 = 0.08;
/// Most validation vertices of a piece.
const MOST_HELD: usize = 256;
/// Least vertices of a joint's piece that chooses.
const FEW: usize = 16;
/// Least distance of a limb's joint from the plane of symmetry, x = 0, metres of such a body.
const ASIDE: f32 = 0.03;
/// Angle of the nape from the whorl of the hair about the centre of the head, and the width of the
/// ring about the whorl that gives unseen hair its colour, radians.
const NAPE: f32 = 1.4;
const RING: f32 = 0.35;

/// Fills the `colors` (V) of the unobserved vertices of the canonical `body`; grey where none is
/// observed. `foreshortening` (V) is the mean of the observations of each vertex, 0 without any:
/// colours of grazing surface, which borders on what is unobserved, are mixed with the background.
fn complete(body: &Body, colors: &mut [Vec3], foreshortening: &[f32]) {
    let (known, unseen): (Vec<usize>, Vec<usize>) = (0..foreshortening.len()).partition(|&v| foreshortening[v] > 0.0);
    if known.is_empty() {
        colors.fill(Vec3::splat(0.5));
        return;
    }
    let joints = strongest(body);
    let guesses = Guesses::new(body, &joints, colors, foreshortening);
    let (hair, shown) = hair(body, &joints, &known);
    let (shown, all) = (guesses.of(&shown), guesses.of(&known));
    let choice = |joint: usize| {
        let piece: Vec<usize> = unseen.iter().copied().filter(|&v| joints[v] == joint).collect();
        if piece.len() < FEW { 1.0 } else { guesses.choose(&known, &piece) }
    };
    let choices: Vec<f32> = (0..body.model.num_joints()).map(choice).collect();
    let guess = |&v: &usize| {
        if hair[v] && !shown.is_empty() {
            return (v, guesses.guess(v, &shown, 1.0));
        }
        // Choices are blended as joints are.
        let mixed = |around: f32| {
            let weights = body.model.weights.row(v).filter(|(joint, _)| choices[*joint] == around);
            let weight: f32 = weights.map(|(_, weight)| weight).sum();
            if weight > 0.0 { (weight * guesses.guess(v, &all, around), weight) } else { (Vec3::ZERO, 0.0) }
        };
        let mixed = [1.0, AROUND, ALONG].map(mixed);
        let weight: f32 = mixed.iter().map(|mixed| mixed.1).sum();
        let sum: Vec3 = mixed.iter().map(|mixed| mixed.0).sum();
        (v, if weight > 0.0 { sum / weight } else { guesses.guess(v, &all, 1.0) })
    };
    let found: Vec<(usize, Vec3)> = unseen.par_iter().map(guess).collect();
    found.into_iter().for_each(|(v, color)| colors[v] = color);
}

/// Whether each vertex (V) lies where heads have hair, and the vertices of `known` that give it its
/// colour: those nearest to the whorl, since hair, caps and bald heads go on from there. None of a
/// body without SMPL's joints.
fn hair(body: &Body, joints: &[usize], known: &[usize]) -> (Vec<bool>, Vec<usize>) {
    let vertices = &body.canonical.vertices;
    let head = BoneNames::Smpl.of_body(body.model.num_joints()).iter().position(|name| name == "head");
    let of_head = |v: usize| Some(joints[v]) == head;
    let skull =
        Aabb::from_points(&(0..vertices.len()).filter(|&v| of_head(v)).map(|v| vertices[v]).collect::<Vec<_>>());
    let whorl = Vec3::new(0.0, 1.0, -1.0);
    let angle = |v: usize| (vertices[v] - 0.5 * (skull.min + skull.max)).angle_between(whorl);
    let hair: Vec<bool> = (0..vertices.len()).map(|v| of_head(v) && angle(v) < NAPE).collect();
    let shown: Vec<usize> = known.iter().copied().filter(|&v| hair[v]).collect();
    let nearest = shown.iter().map(|&v| angle(v)).fold(f32::INFINITY, f32::min);
    let shown = shown.into_iter().filter(|&v| angle(v) < nearest + RING).collect();
    (hair, shown)
}

/// Vertices of a [`Group`].
const LANES: usize = 8;

/// Some vertices, coordinate by coordinate; those that fill the last group up have no area.
#[derive(Default)]
struct Group {
    places: [[f32; LANES]; 3],
    areas: [f32; LANES],
    colors: [[f32; LANES]; 3],
}

struct Guesses<'a> {
    vertices: &'a [Vec3],
    /// Surface area of each vertex times its squared foreshortening, (V).
    areas: Vec<f32>,
    /// Unit direction of each vertex's bone, (V).
    axes: Vec<Vec3>,
    colors: &'a [Vec3],
}

impl<'a> Guesses<'a> {
    fn new(body: &'a Body, joints: &[usize], colors: &'a [Vec3], foreshortening: &[f32]) -> Self {
        let vertices = &body.canonical.vertices;
        let mut areas = vec![1e-12; vertices.len()];
        for corners in &body.model.faces {
            let [a, b, c] = corners.map(|v| vertices[v as usize]);
            let area = (b - a).cross(c - a).length() / 6.0;
            corners.iter().for_each(|&v| areas[v as usize] += area);
        }
        // Weights of grazing surface alone stay above 0.
        let squared = foreshortening.iter().map(|f| f.max(1e-3).powi(2));
        areas.iter_mut().zip(squared).for_each(|(area, squared)| *area *= squared);
        Self { vertices, areas, axes: axes(body, joints), colors }
    }

    /// The vertices `known` and their colours.
    fn of(&self, known: &[usize]) -> Vec<Group> {
        let group = |known: &[usize]| {
            let mut group = Group::default();
            for (i, &k) in known.iter().enumerate() {
                group.areas[i] = self.areas[k];
                (0..3).for_each(|c| group.places[c][i] = self.vertices[k][c]);
                (0..3).for_each(|c| group.colors[c][i] = self.colors[k][c]);
            }
            group
        };
        known.chunks(LANES).map(group).collect()
    }

    /// Mean colour of vertices, weighted by area and distance⁻⁴.
    fn guess(&self, v: usize, known: &[Group], around: f32) -> Vec3 {
        let ([x, y, z], axis) = (self.vertices[v].to_array(), self.axes[v]);
        let (mut sums, mut weights) = ([[0.0; LANES]; 3], [0.0; LANES]);
        for Group { places, areas, colors } in known {
            for i in 0..LANES {
                let way = [places[0][i] - x, places[1][i] - y, places[2][i] - z];
                let along = way[0] * axis.x + way[1] * axis.y + way[2] * axis.z;
                let length = way[0] * way[0] + way[1] * way[1] + way[2] * way[2];
                let across = (length - along * along).max(0.0);
                // Vertices of a seam may coincide.
                let squared = (along * along + around * around * across).max(1e-12);
                let weight = areas[i] / (squared * squared);
                weights[i] += weight;
                (0..3).for_each(|c| sums[c][i] += weight * colors[c][i]);
            }
        }
        let total = |lanes: &[f32; LANES]| lanes.iter().map(|lane| f64::from(*lane)).sum::<f64>();
        (DVec3::from_array(sums.each_ref().map(total)) / total(&weights)).as_vec3()
    }

    /// Anisotropy of the vertices `unseen`: [`AROUND`], [`ALONG`] or 1 (isotropic), by the error of
    /// predicting the vertices of `known` around them from the others.
    fn choose(&self, known: &[usize], unseen: &[usize]) -> f32 {
        let is_near = |v: usize| unseen.iter().any(|&u| self.vertices[u].distance(self.vertices[v]) < RIM);
        let (held, rest): (Vec<usize>, Vec<usize>) = known.par_iter().partition(|&&v| is_near(v));
        if rest.is_empty() {
            return 1.0;
        }
        let rest = self.of(&rest);
        let every = held.len().div_ceil(MOST_HELD).max(1);
        let error = |around: f32| -> f32 {
            let error = |&v: &usize| self.guess(v, &rest, around).distance_squared(self.colors[v]);
            held.par_iter().step_by(every).map(error).collect::<Vec<f32>>().iter().sum()
        };
        let [isotropic, around, along] = [1.0, AROUND, ALONG].map(error);
        match along < SURE * isotropic.min(around) {
            true => ALONG,
            false if around < isotropic => AROUND,
            false => 1.0,
        }
    }
}

/// Direction of the bone with the largest weight at each vertex, (V): upright in the trunk, along
/// the limb in a limb.
fn axes(body: &Body, strongest: &[usize]) -> Vec<Vec3> {
    let (joints, parents) = (&body.canonical.joints, &body.model.parents);
    let is_aside = |j: usize| joints[j].x.abs() > ASIDE;
    let mut of_joints = vec![Vec3::Y; joints.len()];
    for (j, parent) in parents.iter().enumerate() {
        let Some(p) = *parent else { continue };
        let child = (j + 1..joints.len()).find(|&child| parents[child] == Some(j));
        let bone = child.map_or(joints[j] - joints[p], |child| joints[child] - joints[j]);
        // A bone that begins in the trunk belongs to it.
        of_joints[j] = if is_aside(j) && is_aside(p) { bone.normalize_or(of_joints[p]) } else { of_joints[p] };
    }
    strongest.iter().map(|&j| of_joints[j]).collect()
}

/// Joint with the largest weight at each vertex, (V).
fn strongest(body: &Body) -> Vec<usize> {
    let strongest = |v| body.model.weights.row(v).reduce(|a, b| if b.1 > a.1 { b } else { a });
    (0..body.canonical.vertices.len()).map(|v| strongest(v).map_or(0, |(joint, _)| joint)).collect()
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use smpl::BodyModel;
    use synth::{DemoConfig, demo};
    use volrender::RandomStream;

    use super::*;
    use crate::config::{Config, Method, Preset};
    use crate::scene::prepared::PreparedFrame;

    /// Where the segment from `from` to `to` crosses a triangle, as a part of its length.
    fn crossing(from: DVec3, to: DVec3, [a, b, c]: [DVec3; 3]) -> Option<f64> {
        let way = to - from;
        // Volumes of the tetrahedra that the segment's line makes with the edges.
        let volume = |p: DVec3, q: DVec3| (p - from).cross(q - from).dot(way);
        let sides = [volume(a, b), volume(b, c), volume(c, a)];
        let same = sides.iter().all(|s| *s >= 0.0) || sides.iter().all(|s| *s <= 0.0);
        let normal = (b - a).cross(c - a);
        same.then(|| (a - from).dot(normal) / way.dot(normal)).filter(|t| t.is_finite())
    }

    #[test]
    fn colours_are_the_means_of_what_frames_show_of_places_between_the_vertices() {
        let body = smpl::BodyModel::embedded();
        let demo_config = DemoConfig { size: 96, frames: 6, eval_cameras: 0, ..DemoConfig::default() };
        let mut config = Config::preset(Preset::Fast, Method::Prior);
        (config.registration.rounds, config.field.prior_light) = (0, false);
        let mut scene = Scene::new(&demo(&demo_config, &body).unwrap(), &body, &config).unwrap();
        assert!(scene.clothes.is_empty());
        compare(&scene, &vec![0.0; body.num_vertices()]);
        // Clothes stand off up to 3 cm, and some of what the body shows is hidden behind them.
        let mut random = RandomStream::new(&[9]);
        scene.clothes = (0..body.num_vertices()).map(|_| 0.03 * random.uniform()).collect();
        compare(&scene, &scene.clothes);
    }

    /// Compares the colours of some places with those that a loop over all pictures and faces
    /// finds.
    fn compare(scene: &Scene, clothes: &[f32]) {
        let found = PriorColors::measure(scene).unwrap();
        assert!(found.mesh.times() > 0 && found.colors.len() == found.mesh.anchors.len());
        let mut random = RandomStream::new(&[8]);
        let dressed = |frame: &PreparedFrame| -> (Vec<Vec3>, Vec<Vec3>) {
            let normals = surface_query::vertex_normals(&frame.view.posed.vertices, &scene.body.model.faces);
            let moved = |v: usize| frame.view.posed.vertices[v] + clothes[v] * normals[v].normalize_or_zero();
            ((0..normals.len()).map(moved).collect(), normals)
        };
        let frames: Vec<_> = scene.train.iter().map(|frame| (frame, dressed(frame))).collect();
        let (mut wrong, mut shown, mut hidden) = (0, 0, 0);
        for _ in 0..150 {
            let v = random.below(found.colors.len());
            let anchor = &found.mesh.anchors[v];
            let (mut sum, mut weights, mut count) = (DVec3::ZERO, 0.0, 0);
            for (frame, (vertices, normals)) in &frames {
                let (view, pixels) = (&frame.view, frame.pixels().unwrap());
                let place = anchor.mix(vertices);
                let Some(at) = view.camera.project(place) else { continue };
                let pixel = at.y as usize * view.camera.width as usize + at.x as usize;
                let coverage = pixels.mask.get(pixel).copied().unwrap_or(0.0);
                let eye = view.camera.centre_of_projection();
                let corner = |&v: &u32| vertices[v as usize].as_dvec3();
                let before = |face: &[u32; 3]| {
                    let crossing = crossing(eye.as_dvec3(), place.as_dvec3(), face.each_ref().map(corner));
                    crossing.is_some_and(|t| t > 0.0 && t < 1.0 - 1e-4)
                };
                if coverage <= 0.5 || scene.body.model.faces.iter().any(before) {
                    continue;
                }
                let towards = (eye - anchor.mix(&view.posed.vertices)).normalize_or_zero();
                let slant = anchor.mix(normals).normalize_or_zero().dot(towards).max(SLANT);
                let color = Vec3::from_slice(&pixels.image.pixels[3 * pixel..]) / coverage;
                (sum, weights) = (sum + f64::from(slant) * color.as_dvec3(), weights + f64::from(slant));
                count += 1;
            }
            if weights > f64::from(GRAZING) * f64::from(count) {
                shown += 1;
                let error = (sum / weights - found.colors[v].as_dvec3()).length();
                wrong += usize::from(!found.seen[v] || error > 1e-3);
            } else {
                hidden += 1;
                wrong += usize::from(found.seen[v]);
            }
        }
        // Places that a face all but grazes, or whose pixel is the next, are told differently by
        // f32.
        assert!(shown > 50 && hidden > 5 && wrong <= 3, "{wrong} wrong of {shown} and {hidden}");
    }

    fn body() -> Body {
        Body::new(&BodyModel::embedded(), &[], &Config::preset(Preset::Fast, Method::Occnerf)).unwrap()
    }

    /// A trunk in stripes, its back unseen in the middle: the mean error of the completed colours,
    /// and that of the smooth mean alone.
    fn errors(stripe: impl Fn(Vec3) -> f32) -> [f32; 2] {
        let body = body();
        let vertices = &body.canonical.vertices;
        let truth: Vec<Vec3> = vertices.iter().map(|v| Vec3::splat(0.5 + 0.4 * stripe(*v))).collect();
        let hips = body.canonical.joints[0].y;
        let hidden = |v: Vec3| v.x.abs() < 0.08 && v.z < -0.02 && v.y > hips && v.y < hips + 0.45;
        let seen: Vec<bool> = vertices.iter().map(|v| !hidden(*v)).collect();
        let unseen: Vec<usize> = (0..seen.len()).filter(|&v| !seen[v]).collect();
        assert!(unseen.len() > 50, "{}", unseen.len());
        let mut colors = truth.clone();
        unseen.iter().for_each(|&v| colors[v] = Vec3::ONE);
        complete(&body, &mut colors, &frontal(&seen));
        let known: Vec<usize> = (0..seen.len()).filter(|&v| seen[v]).collect();
        assert!(known.iter().all(|&v| colors[v] == truth[v]));
        let smooth = Guesses::new(&body, &strongest(&body), &truth, &frontal(&seen));
        let mean = |of: &dyn Fn(usize) -> Vec3| {
            unseen.iter().map(|&v| (of(v).x - truth[v].x).abs()).sum::<f32>() / unseen.len() as f32
        };
        [mean(&|v| colors[v]), mean(&|v| smooth.guess(v, &smooth.of(&known), 1.0))]
    }

    /// Any number of vertices, one of them in two places of the list.
    #[test]
    fn lanes_sum_as_a_plain_loop() {
        let body = body();
        let joints = strongest(&body);
        let mut random = RandomStream::new(&[12]);
        let vertices = body.canonical.vertices.len();
        let colors: Vec<Vec3> =
            (0..vertices).map(|_| Vec3::new(random.uniform(), random.uniform(), random.uniform())).collect();
        let guesses = Guesses::new(&body, &joints, &colors, &vec![0.7; vertices]);
        for count in [1, 7, 8, 9, 500] {
            let mut known: Vec<usize> = (0..count).map(|_| random.below(vertices)).collect();
            known.push(known[0]);
            let (v, around) = (random.below(vertices), [AROUND, 1.0, ALONG][count % 3]);
            let (mut sum, mut weights) = (DVec3::ZERO, 0.0);
            for &k in &known {
                let way = (body.canonical.vertices[k] - body.canonical.vertices[v]).as_dvec3();
                let along = way.dot(guesses.axes[v].as_dvec3());
                let across = (way - along * guesses.axes[v].as_dvec3()).length_squared();
                let squared = (along * along + f64::from(around).powi(2) * across).max(1e-12);
                let weight = f64::from(guesses.areas[k]) / squared.powi(2);
                (sum, weights) = (sum + weight * colors[k].as_dvec3(), weights + weight);
            }
            let found = guesses.guess(v, &guesses.of(&known), around).as_dvec3();
            assert!(found.distance(sum / weights) < 1e-3, "{count}: {found} for {}", sum / weights);
        }
    }

    #[test]
    fn stripes_go_on_the_way_that_they_go_where_they_are_seen() {
        let [rings, smooth] = errors(|v| (60.0 * v.y).sin());
        assert!(rings < 0.6 * smooth, "{rings} against {smooth}");
        let [lengthwise, smooth] = errors(|v| (60.0 * v.x).sin());
        assert!(lengthwise < smooth, "{lengthwise} against {smooth}");
    }

    /// Observed frontally or not at all.
    fn frontal(seen: &[bool]) -> Vec<f32> {
        seen.iter().map(|seen| if *seen { 1.0 } else { 0.0 }).collect()
    }

    #[test]
    fn background_on_grazing_surface_does_not_spread_to_the_unseen_back() {
        let body = body();
        let vertices = &body.canonical.vertices;
        // Grey in front, white where the surface turns away, unseen behind.
        let facing = |v: &Vec3| (5.0 * v.z).clamp(0.0, 1.0);
        let foreshortening: Vec<f32> = vertices.iter().map(facing).collect();
        let shown: Vec<Vec3> = foreshortening.iter().map(|f| Vec3::splat(if *f < 0.2 { 1.0 } else { 0.3 })).collect();
        let mean = |foreshortening: &[f32]| {
            let mut colors = shown.clone();
            complete(&body, &mut colors, foreshortening);
            let unseen: Vec<f32> =
                (0..colors.len()).filter(|&v| foreshortening[v] == 0.0).map(|v| colors[v].x).collect();
            unseen.iter().sum::<f32>() / unseen.len() as f32
        };
        let seen: Vec<bool> = foreshortening.iter().map(|f| *f > 0.0).collect();
        let [weighted, alike] = [mean(&foreshortening), mean(&frontal(&seen))];
        assert!(weighted < 0.45 && alike > 0.6, "{weighted} against {alike}");
    }

    #[test]
    fn unseen_hair_is_as_the_hair_that_is_seen() {
        let body = body();
        let (vertices, joints) = (&body.canonical.vertices, strongest(&body));
        let head = body.canonical.joints[15];
        let of_hair = |v: Vec3| v.y > head.y + 0.08 || v.z < head.z - 0.03;
        let seen: Vec<bool> = vertices.iter().map(|v| v.z > head.z).collect();
        let truth: Vec<Vec3> =
            vertices.iter().map(|v| if of_hair(*v) { Vec3::ZERO } else { Vec3::new(0.8, 0.6, 0.5) }).collect();
        let mut colors = truth.clone();
        complete(&body, &mut colors, &frontal(&seen));
        let back = |v: &usize| {
            joints[*v] == 15 && !seen[*v] && vertices[*v].y > head.y + 0.06 && vertices[*v].z < head.z - 0.06
        };
        let back: Vec<usize> = (0..vertices.len()).filter(back).collect();
        let dark = back.iter().filter(|&&v| colors[v].max_element() < 0.3).count();
        assert!(back.len() > 20 && dark * 10 > back.len() * 8, "{dark} of {}", back.len());
    }

    #[test]
    fn guesses_lie_between_what_was_seen_and_are_grey_where_nothing_was() {
        let body = body();
        let mut stream = RandomStream::new(&[11]);
        let mut random = || stream.uniform();
        let seen: Vec<bool> = body.canonical.vertices.iter().map(|_| random() < 0.3).collect();
        let mut colors: Vec<Vec3> = seen.iter().map(|_| 0.2 + 0.5 * Vec3::new(random(), random(), random())).collect();
        for (color, seen) in colors.iter_mut().zip(&seen) {
            *color = if *seen { *color } else { Vec3::splat(9.0) };
        }
        complete(&body, &mut colors, &frontal(&seen));
        assert!(colors.iter().all(|c| c.min_element() >= 0.199 && c.max_element() <= 0.701));
        let mut weightless = self::body();
        weightless.model.weights = smpl::SparseRows::from_rows(vec![Vec::new(); seen.len()]);
        complete(&weightless, &mut colors, &frontal(&seen));
        assert!(colors.iter().all(|c| c.min_element() >= 0.199 && c.max_element() <= 0.701));
        complete(&body, &mut colors, &vec![0.0; seen.len()]);
        assert!(colors.iter().all(|c| *c == Vec3::splat(0.5)));
    }

    #[test]
    fn bones_are_upright_in_trunk_and_legs_and_level_in_arms() {
        let body = body();
        let axes = axes(&body, &strongest(&body));
        let joints = &body.canonical.joints;
        let near = |place: Vec3| {
            let distance = |v: &usize| body.canonical.vertices[*v].distance_squared(place);
            axes[(0..axes.len()).min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap()]
        };
        // Chest, thigh and shin, forearm of SMPL.
        assert!(
            [joints[9], 0.5 * (joints[1] + joints[4]), 0.5 * (joints[4] + joints[7])]
                .iter()
                .all(|p| near(*p).y.abs() > 0.9)
        );
        assert!(near(0.5 * (joints[18] + joints[20])).x.abs() > 0.9);
    }
}
