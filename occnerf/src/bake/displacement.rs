//! Displacements of the prior's surface along its normals, from the outlines of the training
//! frames.
//!
//! Gauss-Newton steps over all heights at once. Residuals are those of registration's outlines;
//! each frame sees the outline elsewhere, so their intersection is the visual hull (Laurentini
//! 1994). Thin-plate regularisation couples neighbours; conjugate gradients solve.

use glam::Vec3;
use rayon::prelude::*;

use super::surface::NormalRay;
use crate::Error;
use crate::model::subdivide::{Subdivided, neighbours};
use crate::model::view::PosedView;
use crate::scene::prepared::Scene;
use crate::scene::registration::{Crop, Edge, ObservationOptions, observe, robust, shared_edges};

/// Gauss-Newton steps.
const ROUNDS: usize = 5;
/// Most frames that are observed.
const MOST_FRAMES: usize = 96;
/// Search distance of the mask's edge in the first round and in the last, pixels.
const REACH: [f32; 2] = [10.0, 4.0];
/// Standard deviation of an outline residual, pixels: so small that an outline follows the median
/// of the frames, not the mean.
const OUTLINE: f32 = 0.15;
/// Standard deviation of the heights' Laplacian, in edge lengths.
const BEND: f32 = 0.08;
/// Standard deviation of a height around that of the prior's clothes, normalised metres.
const SPREAD: f32 = 0.05;
/// Lowest and highest surface, normalised metres.
const RANGE: [f32; 2] = [-0.03, 0.12];

/// Heights of the vertices of `mesh` over their `feet` (V) that explain the outlines in the frames,
/// starting from those of `prior` (V).
pub(super) fn displacements(
    scene: &Scene,
    mesh: &Subdivided,
    feet: &[NormalRay],
    prior: &[f32],
) -> Result<Vec<f32>, Error> {
    let stride = scene.learnt.len().div_ceil(MOST_FRAMES).max(1);
    let frames: Vec<usize> = scene.learnt.iter().copied().step_by(stride).collect();
    let crop = |&frame: &usize| {
        let frame = &scene.train[frame];
        Ok(Crop::new(&frame.view.camera, &frame.pixels()?, &frame.view.posed.vertices))
    };
    let crops = frames.par_iter().map(crop).collect::<Result<Vec<_>, Error>>()?;
    let edges = shared_edges(&mesh.faces);
    let places: Vec<Vec3> = feet.iter().map(|foot| foot.foot).collect();
    let plate = Plate::new(&places, &mesh.faces, BEND);
    let mut heights = prior.to_vec();
    for round in 0..ROUNDS {
        let late = round as f32 / (ROUNDS - 1) as f32;
        let options = ObservationOptions { reach: REACH[0] + late * (REACH[1] - REACH[0]), blur: 0.0, unit: 1.0 };
        let look = |(&frame, crop): (&usize, &Option<Crop>)| -> Result<_, Error> {
            let Some(crop) = crop else { return Ok(Vec::new()) };
            let (vertices, up) = raised(scene, &scene.train[frame].view, mesh, feet, &heights);
            let term = |&Edge { vertex, distance, gradient, .. }: &Edge| {
                let slope = gradient.dot(up[vertex as usize]);
                let weight = robust(distance * distance, OUTLINE) / (OUTLINE * OUTLINE);
                (vertex, weight * slope * slope, weight * slope * distance)
            };
            Ok(observe(crop, &vertices, (&mesh.faces, &edges), options)?.edges.iter().map(term).collect())
        };
        let looked = frames.par_iter().zip(&crops).map(look).collect::<Result<Vec<Vec<_>>, Error>>()?;
        let mut sums: Vec<Term> = vec![(0.0, 0.0); heights.len()];
        for (v, precision, pull) in looked.into_iter().flatten() {
            let sum = &mut sums[v as usize];
            *sum = (sum.0 + precision, sum.1 + pull);
        }
        for ((sum, height), prior) in sums.iter_mut().zip(&heights).zip(prior) {
            let precision = (SPREAD * SPREAD).recip();
            *sum = (sum.0 + precision, sum.1 + precision * (prior - height));
        }
        let step = plate.step(&sums, &heights);
        for (height, step) in heights.iter_mut().zip(step) {
            *height = (*height + step).clamp(RANGE[0], RANGE[1]);
        }
    }
    Ok(heights)
}

/// Vertices at `heights` in the pose of a view, and their derivatives by the height, (V).
fn raised(
    scene: &Scene,
    view: &PosedView,
    mesh: &Subdivided,
    feet: &[NormalRay],
    heights: &[f32],
) -> (Vec<Vec3>, Vec<Vec3>) {
    let weights = &scene.body.model.weights;
    let turned = |v: usize| -> Vec3 {
        weights.row(v).map(|(joint, w)| w * (view.posed.bones[joint].matrix3 * feet[v].direction)).sum()
    };
    // The first vertices of the subdivided prior are its own.
    let directions: Vec<Vec3> = (0..view.posed.vertices.len()).map(turned).collect();
    let each = mesh.anchors.iter().zip(heights).map(|(anchor, height)| {
        let up = anchor.mix(&directions).normalize_or_zero();
        (anchor.mix(&view.posed.vertices) + height * up, up)
    });
    each.unzip()
}

/// Iterations of a step's conjugate gradients.
const ITERATIONS: usize = 60;

/// Precision and weighted residual of a height.
type Term = (f32, f32);

/// Thin-plate energy of the heights: the squared deviation of each from the mean of its neighbours.
struct Plate {
    near: Vec<Vec<u32>>,
    /// Precision of each deviation.
    stiffness: f32,
}

impl Plate {
    /// Heights over a mesh; `bend` is the standard deviation of a deviation, in mean edge lengths.
    pub fn new(vertices: &[Vec3], faces: &[[u32; 3]], bend: f32) -> Self {
        let near = neighbours(vertices.len(), faces);
        let length = |v: usize| near[v].iter().map(move |&n| vertices[v].distance(vertices[n as usize]));
        let (sum, count) =
            (0..vertices.len()).flat_map(length).fold((0.0, 0usize), |(s, n), l| (s + f64::from(l), n + 1));
        let edge = (sum / count.max(1) as f64) as f32;
        Self { near, stiffness: (bend * edge).max(f32::MIN_POSITIVE).powi(-2) }
    }

    /// Deviations from the means of the neighbours.
    fn deviations(&self, heights: &[f32]) -> Vec<f32> {
        let deviation = |(near, own): (&Vec<u32>, &f32)| {
            own - near.iter().map(|&n| heights[n as usize]).sum::<f32>() / near.len().max(1) as f32
        };
        self.near.par_iter().zip(heights).map(deviation).collect()
    }

    /// Gradient of half the energy.
    fn gradient(&self, heights: &[f32]) -> Vec<f32> {
        let deviations = self.deviations(heights);
        let own = |(near, own): (&Vec<u32>, &f32)| {
            let others = near.iter().map(|&n| deviations[n as usize] / self.near[n as usize].len() as f32);
            self.stiffness * (own - others.sum::<f32>())
        };
        self.near.par_iter().zip(&deviations).map(own).collect()
    }

    /// The step of all heights that the terms and the energy ask for.
    pub fn step(&self, terms: &[Term], heights: &[f32]) -> Vec<f32> {
        let pulls: Vec<f32> = terms.iter().zip(self.gradient(heights)).map(|(term, bent)| term.1 - bent).collect();
        let diagonal = |(near, term): (&Vec<u32>, &Term)| {
            let others = near.iter().map(|&n| (self.near[n as usize].len() as f32).powi(-2));
            term.0 + self.stiffness * (1.0 + others.sum::<f32>())
        };
        let diagonal: Vec<f32> = self.near.iter().zip(terms).map(diagonal).collect();
        let apply = |x: &[f32]| {
            let bent = self.gradient(x);
            bent.iter().zip(terms).zip(x).map(|((bent, term), x)| bent + term.0 * x).collect()
        };
        conjugate_gradients(apply, &pulls, &diagonal, ITERATIONS)
    }
}

/// An approximate solution of A x = `rhs` after `iterations` steps of conjugate gradients (Hestenes
/// and Stiefel 1952) from 0, preconditioned by the `diagonal` of the symmetric positive definite A.
/// `apply` maps x to A x.
fn conjugate_gradients(
    apply: impl Fn(&[f32]) -> Vec<f32>,
    rhs: &[f32],
    diagonal: &[f32],
    iterations: usize,
) -> Vec<f32> {
    let product = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| f64::from(a * b)).sum::<f64>();
    let precondition = |r: &[f32]| -> Vec<f32> { r.iter().zip(diagonal).map(|(r, d)| r * d.recip()).collect() };
    let mut x = vec![0.0; rhs.len()];
    let mut residual = rhs.to_vec();
    let mut conditioned = precondition(&residual);
    let mut direction = conditioned.clone();
    let mut energy = product(&residual, &conditioned);
    for _ in 0..iterations {
        let image = apply(&direction);
        let curvature = product(&direction, &image);
        // False for NaN.
        if !(curvature > 0.0 && energy > 0.0) {
            break;
        }
        let along = (energy / curvature) as f32;
        for (((x, r), d), image) in x.iter_mut().zip(&mut residual).zip(&direction).zip(&image) {
            (*x, *r) = (*x + *d * along, *r - *image * along);
        }
        conditioned = precondition(&residual);
        let next = product(&residual, &conditioned);
        let share = (next / energy) as f32;
        direction.iter_mut().zip(&conditioned).for_each(|(d, z)| *d = *z + *d * share);
        energy = next;
    }
    x
}

#[cfg(test)]
mod tests {
    use nalgebra::{DMatrix, DVector};
    use proptest::prelude::*;

    use super::*;

    fn ball() -> Plate {
        let ball = testkit::mesh::icosphere(1);
        Plate::new(&ball.vertices, &ball.faces, 0.08)
    }

    proptest! {
        #[test]
        fn the_gradient_of_the_plate_is_that_of_its_energy(
            heights in prop::collection::vec(-0.1f32..0.1, 42), at in 0usize..42,
        ) {
            let plate = ball();
            let energy = |heights: &[f32]| -> f64 {
                let squares = plate.deviations(heights).into_iter().map(|d| f64::from(d).powi(2));
                0.5 * f64::from(plate.stiffness) * squares.sum::<f64>()
            };
            let moved = |by: f32| { let mut moved = heights.clone(); moved[at] += by; energy(&moved) };
            let numeric = (moved(1e-2) - moved(-1e-2)) / 2e-2;
            let exact = f64::from(plate.gradient(&heights)[at]);
            prop_assert!((exact - numeric).abs() < 1e-3 * (1.0 + exact.abs()), "{exact} {numeric}");
        }
    }

    #[test]
    fn a_step_spreads_what_a_few_vertices_say_and_holds_still_where_nothing_is_said() {
        let plate = ball();
        let mut terms = vec![(1.0, 0.0); 42];
        assert!(plate.step(&terms, &[0.0; 42]).iter().all(|step| step.abs() < 1e-6));
        terms[7] = (1e6, 1e6 * 0.05);
        let step = plate.step(&terms, &[0.0; 42]);
        assert!((step[7] - 0.05).abs() < 5e-3, "{}", step[7]);
        assert!(plate.near[7].iter().all(|&n| step[n as usize] > 0.02), "{step:?}");
    }

    proptest! {
        #[test]
        fn the_solution_is_that_of_a_dense_solver(
            entries in prop::collection::vec(-1.0f64..1.0, 64), rhs in prop::collection::vec(-1.0f64..1.0, 8),
        ) {
            let half = DMatrix::from_vec(8, 8, entries);
            let matrix: DMatrix<f64> = &half * half.transpose() + 0.1 * DMatrix::identity(8, 8);
            let vector = DVector::from_vec(rhs);
            let expected = matrix.clone().cholesky().unwrap().solve(&vector);
            let apply = |x: &[f32]| -> Vec<f32> {
                let x = DVector::from_iterator(8, x.iter().map(|x| f64::from(*x)));
                (&matrix * x).iter().map(|y| *y as f32).collect()
            };
            let singles = |v: &DVector<f64>| v.iter().map(|x| *x as f32).collect::<Vec<f32>>();
            let found =
                conjugate_gradients(apply, &singles(&vector), &singles(&matrix.diagonal()), 40);
            let size = expected.amax().max(1.0);
            for (found, expected) in found.iter().zip(expected.iter()) {
                prop_assert!((f64::from(*found) - expected).abs() < 1e-3 * size, "{found} {expected}");
            }
        }
    }

    #[test]
    fn nothing_is_divided_by_zero() {
        let zero = conjugate_gradients(|x| x.to_vec(), &[0.0f32; 3], &[1.0; 3], 5);
        assert_eq!(zero, [0.0; 3]);
        let bad = conjugate_gradients(|x| x.to_vec(), &[f32::NAN, 1.0], &[1.0; 2], 5);
        assert_eq!(bad.len(), 2);
    }
}
