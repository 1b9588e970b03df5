//! Tubes of varying superelliptic cross-section.

use glam::Vec3;

/// A cross-section of a tube: position along the axis, centre across (2), radii across (2).
pub(super) type Section = [f32; 5];

/// A tube along a coordinate axis. Across y the coordinates are (x, z), across x (y, z), across z
/// (x, y).
pub(super) struct Tube {
    pub(super) axis: usize,
    /// Exponent of the cross-section: 2 is an ellipse, more is boxier.
    pub(super) power: f32,
    /// How far the rounded ends reach beyond the first and the last section.
    pub(super) caps: [f32; 2],
    pub(super) sections: &'static [Section],
}

impl Tube {
    /// Centre and radii at `t`, by cubic interpolation.
    fn section(&self, t: f32) -> [f32; 4] {
        let s = self.sections;
        let last = s.len() - 1;
        let i = s.partition_point(|section| section[0] <= t).clamp(1, last) - 1;
        let (a, b) = (&s[i], &s[i + 1]);
        let h = b[0] - a[0];
        let u = ((t - a[0]) / h).clamp(0.0, 1.0);
        let slope = |at: usize, value: usize| {
            let (low, high) = (at.saturating_sub(1), (at + 1).min(last));
            (s[high][value] - s[low][value]) / (s[high][0] - s[low][0])
        };
        let mut out = [0.0; 4];
        for (k, out) in out.iter_mut().enumerate() {
            let (p0, p1) = (a[k + 1], b[k + 1]);
            let (m0, m1) = (h * slope(i, k + 1), h * slope(i + 1, k + 1));
            let (u2, u3) = (u * u, u * u * u);
            *out = p0 * (2.0 * u3 - 3.0 * u2 + 1.0)
                + p1 * (3.0 * u2 - 2.0 * u3)
                + m0 * (u3 - 2.0 * u2 + u)
                + m1 * (u3 - u2);
        }
        out
    }

    /// Distance to first order, negative inside: (k − 1)/|∇k| of the norm k whose unit level is the
    /// tube.
    pub(super) fn distance(&self, p: Vec3) -> f32 {
        let (t, u, v) = match self.axis {
            0 => (p.x, p.y, p.z),
            1 => (p.y, p.x, p.z),
            _ => (p.z, p.x, p.y),
        };
        let (first, last) = (self.sections[0][0], self.sections[self.sections.len() - 1][0]);
        let inside = t.clamp(first, last);
        let [cu, cv, ru, rv] = self.section(inside);
        let cap = if t < first { self.caps[0] } else { self.caps[1] };
        let radii = [ru, rv, cap];
        let q = [(u - cu) / ru, (v - cv) / rv, (t - inside) / cap].map(f32::abs);
        let powers = q.map(|q| if q > 0.0 { q.powf(self.power) } else { 0.0 });
        let sum = powers[0] + powers[1] + powers[2];
        let k = sum.powf(1.0 / self.power);
        if k < 1e-3 {
            return -ru.min(rv);
        }
        // ∂k/∂q = (q/k)^(power−1)
        let slope = |i: usize| {
            if q[i] > 0.0 { powers[i] / q[i] * k / (sum * radii[i]) } else { 0.0 }
        };
        let gradient = Vec3::new(slope(0), slope(1), slope(2)).length();
        (k - 1.0) / gradient
    }
}
