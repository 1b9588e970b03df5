//! Colours of unobserved vertices by inverse distance weighting (Shepard 1968).
//!
//! Distances are anisotropic about the bone, since hems, belts, cuffs and stripes go around trunk and
//! limbs more often than along them. Each unobserved piece chooses the anisotropy that predicts the
//! observed vertices around it best, one along the bone by a margin.

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use crate::model::body::Body;
use crate::model::subdivide::neighbours;

/// Length of a metre around the bone relative to one along it, where distances are anisotropic: shorter,
/// or longer.
const AROUND: f32 = 0.1;
const ALONG: f32 = 10.0;
/// Largest error of [`ALONG`] relative to the others': noise of dirty colours chooses it at random.
const SURE: f32 = 0.8;
/// Distance from unobserved vertices of the validation vertices, metres of a body 1.7 high.
const RIM: f32 = 0.08;
/// Most validation vertices of a piece.
const MOST_HELD: usize = 1024;
/// Least vertices of a piece; smaller ones are merged.
const FEW: usize = 16;
/// Least distance of a limb's joint from the plane of symmetry, x = 0, metres of such a body.
const ASIDE: f32 = 0.03;

/// Fills the `colors` (V) of the vertices of the canonical `body` that are not `seen` (V); grey
/// where none is.
pub(crate) fn complete(body: &Body, colors: &mut [Vec3], seen: &[bool]) {
    let known: Vec<usize> = (0..seen.len()).filter(|&v| seen[v]).collect();
    if known.is_empty() {
        colors.fill(Vec3::splat(0.5));
        return;
    }
    let guesses = Guesses { vertices: &body.canonical.vertices, axes: axes(body), colors };
    let complete = |region: &Vec<usize>| -> Vec<(usize, Vec3)> {
        let around = guesses.choose(&known, region);
        region.par_iter().map(|&v| (v, guesses.guess(v, &known, around))).collect()
    };
    let found: Vec<(usize, Vec3)> = regions(body, seen).iter().flat_map(complete).collect();
    found.into_iter().for_each(|(v, color)| colors[v] = color);
}

struct Guesses<'a> {
    vertices: &'a [Vec3],
    /// Unit direction of each vertex's bone, (V).
    axes: Vec<Vec3>,
    colors: &'a [Vec3],
}

impl Guesses<'_> {
    /// Mean colour of the vertices `known`, weighted by distance⁻⁴.
    fn guess(&self, v: usize, known: &[usize], around: f32) -> Vec3 {
        let (mut sum, mut weights) = (DVec3::ZERO, 0.0);
        for &k in known {
            let way = self.vertices[k] - self.vertices[v];
            let along = way.dot(self.axes[v]);
            let across = (way.length_squared() - along * along).max(0.0);
            // Vertices of a seam may coincide.
            let squared = f64::from(along * along + around * around * across).max(1e-12);
            let weight = 1.0 / (squared * squared);
            sum += weight * self.colors[k].as_dvec3();
            weights += weight;
        }
        (sum / weights).as_vec3()
    }

    /// Anisotropy of the piece `unseen`: [`AROUND`], [`ALONG`] or 1 (isotropic), by the error of predicting
    /// the vertices of `known` around it from the others.
    fn choose(&self, known: &[usize], unseen: &[usize]) -> f32 {
        let is_near = |v: usize| unseen.iter().any(|&u| self.vertices[u].distance(self.vertices[v]) < RIM);
        let (held, rest): (Vec<usize>, Vec<usize>) = known.par_iter().partition(|&&v| is_near(v));
        if rest.is_empty() {
            return 1.0;
        }
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

/// Connected components of the vertices that are not `seen` (V); components of fewer than [`FEW`]
/// vertices are merged.
fn regions(body: &Body, seen: &[bool]) -> Vec<Vec<usize>> {
    let next = neighbours(seen.len(), &body.model.faces);
    let mut reached = seen.to_vec();
    let (mut pieces, mut small) = (Vec::new(), Vec::new());
    for first in 0..seen.len() {
        let mut piece = Vec::new();
        let mut open = if std::mem::replace(&mut reached[first], true) { Vec::new() } else { vec![first] };
        while let Some(v) = open.pop() {
            piece.push(v);
            open.extend(next[v].iter().map(|&n| n as usize).filter(|&to| !std::mem::replace(&mut reached[to], true)));
        }
        if piece.len() < FEW { small.extend(piece) } else { pieces.push(piece) }
    }
    pieces.extend((!small.is_empty()).then_some(small));
    pieces
}

/// Direction of the bone with the largest weight at each vertex, (V): upright in the trunk, along
/// the limb in a limb.
fn axes(body: &Body) -> Vec<Vec3> {
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
    let strongest = |v: usize| body.model.weights.row(v).reduce(|a, b| if b.1 > a.1 { b } else { a });
    (0..body.canonical.vertices.len()).map(|v| strongest(v).map_or(Vec3::Y, |(j, _)| of_joints[j])).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Config, Method, Preset};
    use smpl::BodyModel;
    use volrender::RandomStream;

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
        complete(&body, &mut colors, &seen);
        let known: Vec<usize> = (0..seen.len()).filter(|&v| seen[v]).collect();
        assert!(known.iter().all(|&v| colors[v] == truth[v]));
        let smooth = Guesses { vertices, axes: axes(&body), colors: &truth };
        let mean = |of: &dyn Fn(usize) -> Vec3| {
            unseen.iter().map(|&v| (of(v).x - truth[v].x).abs()).sum::<f32>() / unseen.len() as f32
        };
        [mean(&|v| colors[v]), mean(&|v| smooth.guess(v, &known, 1.0))]
    }

    #[test]
    fn stripes_go_on_the_way_that_they_go_where_they_are_seen() {
        let [rings, smooth] = errors(|v| (60.0 * v.y).sin());
        assert!(rings < 0.6 * smooth, "{rings} against {smooth}");
        let [lengthwise, smooth] = errors(|v| (60.0 * v.x).sin());
        assert!(lengthwise < smooth, "{lengthwise} against {smooth}");
    }

    #[test]
    fn regions_are_apart_and_hold_every_vertex_that_was_not_seen_once() {
        let body = body();
        let vertices = &body.canonical.vertices;
        let seen: Vec<bool> = vertices.iter().map(|v| v.x.abs() < 0.3).collect();
        let regions = regions(&body, &seen);
        assert!(regions.iter().filter(|region| region.len() >= FEW).count() >= 2);
        let mut count = vec![0; seen.len()];
        regions.iter().flatten().for_each(|&v| count[v] += 1);
        assert!(count.iter().zip(&seen).all(|(count, seen)| *count == usize::from(!seen)));
        // The two arms.
        for region in regions.iter().filter(|region| region.len() >= FEW) {
            assert!(region.iter().all(|&v| vertices[v].x > 0.0) || region.iter().all(|&v| vertices[v].x < 0.0));
        }
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
        complete(&body, &mut colors, &seen);
        assert!(colors.iter().all(|c| c.min_element() >= 0.199 && c.max_element() <= 0.701));
        complete(&body, &mut colors, &vec![false; seen.len()]);
        assert!(colors.iter().all(|c| *c == Vec3::splat(0.5)));
    }

    #[test]
    fn bones_are_upright_in_trunk_and_legs_and_level_in_arms() {
        let body = body();
        let axes = axes(&body);
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
