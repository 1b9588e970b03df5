//! Outer end of the field over the prior's surface: samples farther out are skipped, in training
//! and in drawing.
//!
//! An occupancy grid (Müller et al. 2022, section 5.1) in the coordinates that the field has
//! anyway: place on the surface and distance from it.

use rayon::prelude::*;

use crate::config::Config;
use crate::model::body::Body;
use crate::model::field::SampleBatch;

/// Distance between layers, normalised metres.
const LAYER: f32 = 0.005;
/// Opacity below which the field is taken for empty over [`LENGTH`]; a tenth of it costs a quarter
/// more time and changes no score by more than 0.01 dB (`tests/lab/notes/model.md`).
const EMPTY: f32 = 2e-2;
/// Length of ray for the opacity of a layer, normalised metres.
const LENGTH: f32 = 0.04;
/// Vertices that are evaluated together.
const CHUNK: usize = 256;

/// The outer end of the field over each part of the prior's surface, normalised metres.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Extent {
    /// (V)
    pub vertices: Vec<f32>,
    /// (F), the farthest of the corners.
    pub faces: Vec<f32>,
    /// The farthest of all.
    pub farthest: f32,
}

impl Extent {
    /// Everything out to the margin.
    pub fn whole(body: &Body, config: &Config) -> Self {
        Self::new(body, vec![config.motion.reach(); body.canonical.vertices.len()])
    }

    /// From the ends over the vertices (V).
    pub fn new(body: &Body, vertices: Vec<f32>) -> Self {
        let faces = body.model.faces.iter().map(|face| highest(face, &vertices)).collect();
        let farthest = vertices.iter().copied().fold(0.0, f32::max);
        Self { vertices, faces, farthest }
    }

    /// Evaluates the field in layers over every vertex; `evaluate` gives samples their density. The
    /// end is one layer beyond the last opaque one, and the farthest of the adjacent vertices, so
    /// that the field can grow back.
    pub fn measure(body: &Body, config: &Config, evaluate: impl Fn(&mut SampleBatch) + Sync) -> Self {
        let whole = config.motion.reach();
        let layers = (whole / LAYER).ceil() as usize;
        let (normals, positions) = (body.query.normals(), &body.canonical.vertices);
        let chunks: Vec<Vec<f32>> = (0..positions.len().div_ceil(CHUNK))
            .into_par_iter()
            .map_init(SampleBatch::default, |batch, chunk| {
                batch.samples.clear();
                let range = chunk * CHUNK..((chunk + 1) * CHUNK).min(positions.len());
                for v in range {
                    for layer in 0..layers {
                        let distance = layer as f32 * LAYER;
                        let at = positions[v] + distance * normals[v];
                        batch.samples.push_canonical(body, at, positions[v], distance, config.needs_neighbours());
                    }
                }
                evaluate(batch);
                let shows = |sigma: &f32| 1.0 - (-sigma * LENGTH).exp() >= EMPTY;
                // An empty field keeps the skin.
                let last = |sigmas: &[f32]| sigmas.iter().rposition(shows).unwrap_or(0);
                batch.sigma.chunks(layers).map(|sigmas| ((last(sigmas) + 1) as f32 * LAYER).min(whole)).collect()
            })
            .collect();
        let measured = chunks.concat();
        let mut ends = measured.clone();
        for face in &body.model.faces {
            let highest = highest(face, &measured);
            for &v in face {
                ends[v as usize] = ends[v as usize].max(highest);
            }
        }
        Self::new(body, ends)
    }
}

fn highest(face: &[u32; 3], vertices: &[f32]) -> f32 {
    face.iter().map(|&v| vertices[v as usize]).fold(0.0, f32::max)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Method, Preset};
    use crate::model::encoder::VertexCode;
    use crate::scene::prepared::Scene;
    use crate::train::trainer::Trainer;
    use synth::{DemoConfig, demo};

    fn scene(config: &Config) -> Scene {
        let body = smpl::BodyModel::embedded();
        let demo_config = DemoConfig { size: 32, frames: 2, eval_cameras: 1, ..Default::default() };
        Scene::new(&demo(&demo_config, &body).unwrap(), &body, config).unwrap()
    }

    fn extent(scene: &Scene, config: &Config) -> Extent {
        let trainer = Trainer::new(scene, config.clone()).unwrap();
        let mut code = VertexCode::default();
        trainer.model().encode_vertices(&mut code);
        trainer.model().measure_extent(&code)
    }

    #[test]
    fn it_ends_a_layer_behind_the_last_one_that_shows_something() {
        let mut config = Config::preset(Preset::Fast, Method::Occnerf);
        let scene = scene(&config);
        // The table is nearly zero and so are the features: the density falls with the distance
        // alone, and crosses EMPTY where softplus(bias) · scale · LENGTH does, up to what the
        // perceptron's first values add.
        config.field.density_bias_outside = -40.0;
        let end = |density: f32| -(1.0 - density).ln() / (config.field.density_scale * LENGTH);
        let raw = (end(EMPTY).exp() - 1.0).ln();
        let slope = (config.field.density_bias_outside - config.field.density_bias) / 0.06;
        let expected = (raw - config.field.density_bias) / slope;
        let found = extent(&scene, &config);
        assert_eq!(found.faces.len(), scene.body.model.faces.len());
        for end in &found.vertices {
            assert!((expected..expected + 2.0 * LAYER).contains(end), "{end}, density ends at {expected}");
        }
    }

    #[test]
    fn a_field_that_is_dense_everywhere_or_nowhere_keeps_everything_or_the_skin() {
        for (bias, expected) in [(3.0, 0.06), (-60.0, LAYER)] {
            let mut config = Config::preset(Preset::Fast, Method::HashPoint);
            (config.field.density_bias, config.field.density_bias_outside) = (bias, bias);
            let scene = scene(&config);
            let found = extent(&scene, &config);
            assert!(found.vertices.iter().chain(&found.faces).all(|&end| end == expected), "{bias}: {found:?}");
            assert_eq!(found.farthest, expected);
        }
    }
}
