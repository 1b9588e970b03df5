//! Colours of the prior's vertices: a baseline of their own, and what the field's colours start
//! from.

use glam::{Vec3, Vec4};

/// A colour for each vertex of the prior.
#[derive(Clone, Debug, PartialEq)]
pub struct VertexColors {
    /// sRGB in [0, 1], V.
    pub colors: Vec<Vec3>,
    /// Whether some training frame saw the vertex, V: its colour is inferred where none did.
    pub seen: Vec<bool>,
}

impl VertexColors {
    /// What a sigmoid makes the colours of, black and white taken for nearly so, and as w how much
    /// of what a perceptron says is to be added: nothing where no frame saw the vertex, for there
    /// nothing has taught it.
    pub(crate) fn before_sigmoid(&self) -> Vec<Vec4> {
        /// 5 levels of 255.
        const LEAST: f32 = 0.02;
        let inverse = |x: f32| (x / (1.0 - x)).ln();
        let each = self.colors.iter().zip(&self.seen);
        let between = |c: &Vec3| c.clamp(Vec3::splat(LEAST), Vec3::splat(1.0 - LEAST));
        each.map(|(c, &seen)| between(c).map(inverse).extend(f32::from(u8::from(seen)))).collect()
    }
}
