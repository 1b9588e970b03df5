//! Colours of the prior's vertices: a baseline of their own, and what the field's colours start
//! from.

use glam::{Vec3, Vec4};

use crate::capture::Light;

/// A colour for each vertex of the prior, and the light that falls on it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct VertexColors {
    /// sRGB under even light, V.
    pub colors: Vec<Vec3>,
    /// Whether some training frame saw the vertex, V: its colour is inferred where none did.
    pub seen: Vec<bool>,
    /// What the colours are multiplied by.
    pub light: Light,
}

impl VertexColors {
    /// The colours where each vertex is as bright as `shades` say (V, or nothing for 1; see
    /// [`Light::on_surface`]).
    pub fn lit(&self, shades: &[f32]) -> impl Iterator<Item = Vec3> {
        self.colors.iter().enumerate().map(|(v, color)| shades.get(v).map_or(*color, |shade| shade * *color))
    }

    /// What a sigmoid makes the colours of [`VertexColors::lit`], black and white taken for nearly
    /// so, and as w how much of what a perceptron says is to be added: nothing where no frame saw
    /// the vertex, for there nothing has taught it.
    pub(crate) fn before_sigmoid(&self, shades: &[f32], out: &mut Vec<Vec4>) {
        /// 5 levels of 255.
        const LEAST: f32 = 0.02;
        let inverse = |x: f32| (x / (1.0 - x)).ln();
        let between = |c: Vec3| c.clamp(Vec3::splat(LEAST), Vec3::splat(1.0 - LEAST));
        let each = self.lit(shades).zip(&self.seen);
        out.clear();
        out.extend(each.map(|(c, &seen)| between(c).map(inverse).extend(f32::from(u8::from(seen)))));
    }
}
