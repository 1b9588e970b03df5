//! Colours of the prior's surface: a baseline, and the field's initial colours.

use std::sync::Arc;

use glam::{Vec3, Vec4};

use crate::capture::Light;
use crate::model::subdivide::Subdivided;

/// Colours of the prior at the vertices of its surface, subdivided until they lie closer than the
/// pixels of the video, at most twice, and the light that falls on it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PriorColors {
    /// sRGB under even light, those of the V vertices of the prior first.
    pub colors: Vec<Vec3>,
    /// Whether some training frame saw each of them: its colour is inferred where none did.
    pub seen: Vec<bool>,
    /// What the colours are multiplied by.
    pub light: Light,
    /// The surface that they are of.
    pub(crate) mesh: Arc<Subdivided>,
}

impl PriorColors {
    /// One colour for each vertex of a prior with these `faces`, all of them seen under even light.
    pub fn of_vertices(colors: Vec<Vec3>, faces: &[[u32; 3]]) -> Self {
        let mesh = Arc::new(Subdivided::new(colors.len(), faces, 0));
        Self { seen: vec![true; colors.len()], colors, light: Light::default(), mesh }
    }

    /// The colour of a point of a `face` of the prior and, as w, the weight of its seen corners.
    pub(crate) fn at(&self, face: u32, barycentric: [f32; 3]) -> Vec4 {
        let (fine, weights) = self.mesh.locate(face, barycentric);
        let corners = self.mesh.faces[fine as usize].into_iter().zip(weights);
        let weighted =
            corners.map(|(v, b)| b * self.colors[v as usize].extend(f32::from(u8::from(self.seen[v as usize]))));
        weighted.sum()
    }

    /// Logit of the colour of [`PriorColors::at`] times `shade`, clamped away from black and white,
    /// and, as w, the weight of the perceptron's output: 0 where no frame saw the point.
    pub(crate) fn logit(&self, face: u32, barycentric: [f32; 3], shade: f32) -> Vec4 {
        /// 5 levels of 255.
        const LEAST: f32 = 0.02;
        let color = self.at(face, barycentric);
        let between = (shade * color.truncate()).clamp(Vec3::splat(LEAST), Vec3::splat(1.0 - LEAST));
        between.map(|x| (x / (1.0 - x)).ln()).extend(color.w)
    }
}

/// Shading of a point of the face with these `corners`, interpolated from its vertices' (V, or
/// empty for 1; see [`Light::on_surface`]).
pub(crate) fn shade(shades: &[f32], corners: [u32; 3], barycentric: [f32; 3]) -> f32 {
    if shades.is_empty() {
        return 1.0;
    }
    corners.into_iter().zip(barycentric).map(|(v, b)| b * shades[v as usize]).sum()
}
