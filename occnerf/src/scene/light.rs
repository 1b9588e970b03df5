//! Intrinsic decomposition of the vertices' colours: albedo a vertex, and shading by one light of
//! all frames.

use glam::Vec3;
use nalgebra::{SMatrix, SVector};

use crate::capture::Light;

/// A vertex as one frame shows it: index, colour, and unit normal in the world.
pub(crate) type ColorObservation = (u32, Vec3, Vec3);

/// Most observations of a light estimate.
const MOST_SEEN: usize = 1 << 20;
/// Rounds of alternating least squares.
const ROUNDS: usize = 6;
/// Regularisation towards even light.
const EVEN: f64 = 0.001;
/// Regularisation of the free third band, which would otherwise explain unobserved directions.
const BOUND: f64 = 0.03;
/// Steepest light.
const MOST_SLOPE: f32 = 0.8;
/// Least share of the squared error of held-out frames that a light must explain.
const WORTH: f64 = 0.02;

/// Σ s c and Σ s² over the observed colours c of each vertex with shading s, (V). Their quotient is
/// the least-squares albedo.
pub(crate) fn albedo<'a>(
    seen: impl Iterator<Item = &'a ColorObservation>,
    vertices: usize,
    light: Light,
) -> Vec<(Vec3, f32)> {
    let mut sums = vec![(Vec3::ZERO, 0.0f32); vertices];
    for (vertex, color, normal) in seen {
        let (sum, shade) = (&mut sums[*vertex as usize], light.on(*normal));
        *sum = (sum.0 + shade * *color, sum.1 + shade * shade);
    }
    sums
}

type Terms = SVector<f64, 9>;

/// The first three bands of spherical harmonics, scaled (Ramamoorthi and Hanrahan 2001); the second
/// includes the third-band term of a lamp in direction `lamp`.
fn harmonics(lamp: Vec3, n: Vec3) -> Terms {
    let [along_x, along_y, along_z] = Light::along(lamp, n).as_dvec3().to_array();
    let [x, y, z] = n.as_dvec3().to_array();
    Terms::from([1.0, along_x, along_y, along_z, x * y, y * z, z * x, x * x - y * y, z * z - 1.0 / 3.0])
}

/// Least-squares light for the albedo of these sums (see [`albedo`]), with a free third band; `None`
/// for a singular system.
fn slope<'a>(seen: impl Iterator<Item = &'a ColorObservation>, sums: &[(Vec3, f32)], lamp: Vec3) -> Option<Vec3> {
    let (mut matrix, mut vector, mut total) = (SMatrix::<f64, 9, 9>::zeros(), Terms::zeros(), 0.0);
    for (v, color, normal) in seen {
        let (sum, squares) = sums[*v as usize];
        let (albedo, basis) = (sum / squares, harmonics(lamp, *normal));
        let squared = f64::from(albedo.length_squared());
        matrix += squared * basis * basis.transpose();
        vector += f64::from(albedo.dot(*color)) * basis;
        total += squared;
    }
    for i in 0..9 {
        matrix[(i, i)] += total * if i < 4 { EVEN } else { BOUND };
    }
    vector[0] += EVEN * total;
    let terms = matrix.try_inverse()? * vector;
    // The constant band is part of the albedo.
    let terms = terms / terms[0];
    terms.iter().all(|t| t.is_finite()).then(|| Vec3::new(terms[1] as f32, terms[2] as f32, terms[3] as f32))
}

/// Least-squares light, alternating with the albedo. The free third band is fitted and dropped.
pub(crate) fn lamp<'a>(seen: impl Iterator<Item = &'a ColorObservation> + Clone, vertices: usize) -> Light {
    let mut found = Light::default();
    for _ in 0..ROUNDS {
        let sums = albedo(seen.clone(), vertices, found);
        let toward = found.slope.normalize_or_zero();
        let Some(slope) = slope(seen.clone(), &sums, toward) else { return Light::default() };
        found = Light { slope: slope.clamp_length_max(MOST_SLOPE) };
    }
    found
}

/// Light of the observations of each frame. Even light unless the estimate from every other frame
/// explains [`WORTH`] of the squared error in the rest.
pub(crate) fn measure_light(frames: &[Vec<ColorObservation>], vertices: usize) -> Light {
    let most = MOST_SEEN.div_ceil(vertices.max(1)).max(4);
    let chosen: Vec<&Vec<ColorObservation>> = frames.iter().step_by(frames.len().div_ceil(most).max(1)).collect();
    let half = |first: usize| chosen.iter().skip(first).step_by(2).flat_map(|frame| frame.iter());
    let error = |light: Light| -> f64 {
        let sums = albedo(half(0), vertices, light);
        let known = half(1).filter(|seen| sums[seen.0 as usize].1 > 0.0);
        let error = |(v, color, normal): &ColorObservation| {
            let (sum, squares) = sums[*v as usize];
            f64::from((sum / squares * light.on(*normal)).distance_squared(*color))
        };
        known.map(error).sum()
    };
    if error(lamp(half(0), vertices)) > (1.0 - WORTH) * error(Light::default()) {
        return Light::default();
    }
    lamp(chosen.iter().flat_map(|frame| frame.iter()), vertices)
}

#[cfg(test)]
mod tests {
    use super::*;
    use volrender::RandomStream;

    /// Colours of vertices that turn before a camera for some frames.
    fn turning(light: Light, noise: f32) -> Vec<Vec<ColorObservation>> {
        let mut stream = RandomStream::new(&[7]);
        let mut random = || Vec3::new(stream.normal(), stream.normal(), stream.normal());
        let vertices: Vec<(Vec3, Vec3)> =
            (0..400).map(|_| (Vec3::splat(0.5) + 0.1 * random(), random().normalize_or(Vec3::Z))).collect();
        let frame = |f: usize| {
            // About the upright alone, a light from above would be a colour.
            let turn = glam::Quat::from_rotation_y(f as f32 * 0.3) * glam::Quat::from_rotation_x(f as f32 * 0.2);
            let mut seen = Vec::new();
            for (v, (albedo, normal)) in vertices.iter().enumerate() {
                let normal = turn * *normal;
                let color = *albedo * light.on(normal) + noise * random();
                if normal.z > 0.0 {
                    seen.push((v as u32, color, normal));
                }
            }
            seen
        };
        (0..20).map(frame).collect()
    }

    #[test]
    fn a_light_is_found_again_and_none_where_there_is_none() {
        let light = Light { slope: Vec3::new(-0.2, 0.15, 0.1) };
        let found = measure_light(&turning(light, 0.01), 400);
        assert!(found.slope.distance(light.slope) < 0.04, "{found:?}");
        assert_eq!(measure_light(&turning(Light::default(), 0.05), 400), Light::default());
        assert_eq!(measure_light(&[], 400), Light::default());
        assert_eq!(measure_light(&[vec![(0, Vec3::ZERO, Vec3::Z)]], 1), Light::default());
    }
}
