//! Colour and light told apart: each vertex has a colour, and a light that all frames share falls
//! on it by its normal.

use glam::Vec3;
use nalgebra::{SMatrix, SVector};

use crate::capture::Light;

/// What a frame shows of a vertex: its colour, and its unit normal in the world.
pub(crate) type Seen = (u32, Vec3, Vec3);

/// Most observations that a light is measured from.
const MOST_SEEN: usize = 1 << 20;
/// Rounds of colour for light, then light for colour.
const ROUNDS: usize = 6;
/// Weight of even light against the observations.
const EVEN: f64 = 0.001;
/// The same for what the third band has beside the lamp: it would take the side that no frame shows.
const BOUND: f64 = 0.03;
/// Steepest light.
const MOST_SLOPE: f32 = 0.8;
/// Share of the squared error that a light has to explain, in frames that it was not measured from.
const WORTH: f64 = 0.02;

/// Σ s c and Σ s² of the colours c of each vertex and the light s on them: their quotient is closest
/// to what was seen.
pub(crate) fn albedo<'a>(seen: impl Iterator<Item = &'a Seen>, vertices: usize, light: Light) -> Vec<(Vec3, f32)> {
    let mut sums = vec![(Vec3::ZERO, 0.0f32); vertices];
    for (vertex, color, normal) in seen {
        let (sum, shade) = (&mut sums[*vertex as usize], light.on(*normal));
        *sum = (sum.0 + shade * *color, sum.1 + shade * shade);
    }
    sums
}

type Terms = SVector<f64, 9>;

/// The first three bands of spherical harmonics, each scaled to a convenient size (Ramamoorthi and
/// Hanrahan 2001), the second with what a lamp in this direction has of the third.
fn harmonics(lamp: Vec3, n: Vec3) -> Terms {
    let [along_x, along_y, along_z] = Light::along(lamp, n).as_dvec3().to_array();
    let [x, y, z] = n.as_dvec3().to_array();
    Terms::from([1.0, along_x, along_y, along_z, x * y, y * z, z * x, x * x - y * y, z * z - 1.0 / 3.0])
}

/// The slope that explains best, with the third band beside it, what was seen of colours with these
/// sums (see [`albedo`]); `None` where nothing says which.
fn slope<'a>(seen: impl Iterator<Item = &'a Seen>, sums: &[(Vec3, f32)], lamp: Vec3) -> Option<Vec3> {
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
    // What is bright everywhere is the colour's.
    let terms = terms / terms[0];
    terms.iter().all(|t| t.is_finite()).then(|| Vec3::new(terms[1] as f32, terms[2] as f32, terms[3] as f32))
}

/// The lamp that explains best what was seen, told apart from the colours by alternating least
/// squares. What the third band has beside it is fitted and forgotten.
pub(crate) fn lamp<'a>(seen: impl Iterator<Item = &'a Seen> + Clone, vertices: usize) -> Light {
    let mut found = Light::default();
    for _ in 0..ROUNDS {
        let sums = albedo(seen.clone(), vertices, found);
        let toward = found.slope.normalize_or_zero();
        let Some(slope) = slope(seen.clone(), &sums, toward) else { return Light::default() };
        found = Light { slope: slope.clamp_length_max(MOST_SLOPE) };
    }
    found
}

/// The light on what frames show of the vertices. Even where what is found explains nothing of the
/// frames that it was not found in, every other one.
pub(crate) fn measure_light(frames: &[Vec<Seen>], vertices: usize) -> Light {
    let most = MOST_SEEN.div_ceil(vertices.max(1)).max(4);
    let chosen: Vec<&Vec<Seen>> = frames.iter().step_by(frames.len().div_ceil(most).max(1)).collect();
    let half = |first: usize| chosen.iter().skip(first).step_by(2).flat_map(|frame| frame.iter());
    let error = |light: Light| -> f64 {
        let sums = albedo(half(0), vertices, light);
        let known = half(1).filter(|seen| sums[seen.0 as usize].1 > 0.0);
        let error = |(v, color, normal): &Seen| {
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
    fn turning(light: Light, noise: f32) -> Vec<Vec<Seen>> {
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
