//! The implicit surface: tubes of superelliptic cross-section along limbs and torso, joined by
//! smooth minima.
//!
//! Coordinates are metres with the floor at y = 0, facing +z. Dimensions are rounded from common
//! tables of adult proportions (a body of 7½ heads, arm span equal to height).

use glam::Vec3;

use super::tube::Tube;

const TORSO: Tube = Tube {
    axis: 1,
    power: 2.3,
    caps: [0.05, 0.03],
    sections: &[
        [0.83, 0.0, -0.005, 0.120, 0.090],
        [0.88, 0.0, -0.008, 0.163, 0.110],
        [0.93, 0.0, -0.006, 0.166, 0.113],
        [0.99, 0.0, 0.000, 0.150, 0.107],
        [1.06, 0.0, 0.004, 0.131, 0.099],
        [1.12, 0.0, 0.003, 0.132, 0.100],
        [1.20, 0.0, 0.000, 0.147, 0.108],
        [1.27, 0.0, -0.004, 0.157, 0.109],
        [1.33, 0.0, -0.012, 0.150, 0.096],
        [1.38, 0.0, -0.020, 0.115, 0.074],
        [1.42, 0.0, -0.022, 0.080, 0.058],
    ],
};

const NECK: Tube = Tube {
    axis: 1,
    power: 2.0,
    caps: [0.03, 0.03],
    sections: &[
        [1.38, 0.0, -0.022, 0.066, 0.060],
        [1.43, 0.0, -0.013, 0.056, 0.057],
        [1.48, 0.0, -0.003, 0.053, 0.056],
        [1.54, 0.0, 0.006, 0.054, 0.058],
    ],
};

const HEAD: Tube = Tube {
    axis: 1,
    power: 2.15,
    caps: [0.012, 0.075],
    sections: &[
        [1.484, 0.0, 0.072, 0.031, 0.026],
        [1.497, 0.0, 0.060, 0.044, 0.041],
        [1.52, 0.0, 0.040, 0.056, 0.064],
        [1.55, 0.0, 0.023, 0.064, 0.084],
        [1.585, 0.0, 0.013, 0.071, 0.096],
        [1.61, 0.0, 0.008, 0.075, 0.100],
        [1.627, 0.0, 0.004, 0.076, 0.101],
    ],
};

const LEG: Tube = Tube {
    axis: 1,
    power: 2.1,
    caps: [0.02, 0.11],
    sections: &[
        [0.06, 0.104, -0.026, 0.030, 0.036],
        [0.10, 0.104, -0.024, 0.031, 0.037],
        [0.15, 0.103, -0.022, 0.035, 0.040],
        [0.22, 0.102, -0.022, 0.044, 0.049],
        [0.29, 0.101, -0.021, 0.053, 0.058],
        [0.35, 0.100, -0.017, 0.056, 0.060],
        [0.41, 0.099, -0.009, 0.052, 0.056],
        [0.455, 0.098, -0.002, 0.051, 0.055],
        [0.49, 0.097, 0.002, 0.053, 0.058],
        [0.55, 0.096, 0.004, 0.060, 0.064],
        [0.63, 0.094, 0.004, 0.070, 0.074],
        [0.72, 0.091, 0.002, 0.079, 0.084],
        [0.80, 0.088, -0.002, 0.083, 0.092],
        [0.87, 0.083, -0.004, 0.070, 0.084],
    ],
};

const FOOT: Tube = Tube {
    axis: 2,
    power: 2.2,
    caps: [0.016, 0.014],
    sections: &[
        [-0.068, 0.104, 0.034, 0.024, 0.030],
        [-0.045, 0.104, 0.040, 0.031, 0.040],
        [-0.01, 0.105, 0.046, 0.033, 0.047],
        [0.03, 0.107, 0.041, 0.036, 0.042],
        [0.07, 0.110, 0.031, 0.041, 0.032],
        [0.105, 0.113, 0.023, 0.045, 0.024],
        [0.135, 0.114, 0.018, 0.044, 0.018],
        [0.16, 0.113, 0.015, 0.037, 0.014],
    ],
};

const ARM: Tube = Tube {
    axis: 0,
    power: 2.0,
    caps: [0.04, 0.02],
    sections: &[
        [0.130, 1.362, -0.018, 0.052, 0.052],
        [0.175, 1.372, -0.016, 0.056, 0.055],
        [0.220, 1.376, -0.015, 0.052, 0.052],
        [0.290, 1.378, -0.014, 0.047, 0.047],
        [0.360, 1.379, -0.014, 0.043, 0.043],
        [0.420, 1.380, -0.014, 0.038, 0.038],
        [0.455, 1.380, -0.013, 0.037, 0.038],
        [0.500, 1.380, -0.011, 0.038, 0.041],
        [0.560, 1.380, -0.010, 0.034, 0.038],
        [0.630, 1.380, -0.009, 0.027, 0.032],
        [0.680, 1.380, -0.008, 0.022, 0.028],
        [0.710, 1.379, -0.007, 0.020, 0.030],
    ],
};

const HAND: Tube = Tube {
    axis: 0,
    power: 2.3,
    caps: [0.012, 0.009],
    sections: &[
        [0.700, 1.379, -0.007, 0.019, 0.029],
        [0.730, 1.377, -0.006, 0.019, 0.037],
        [0.765, 1.374, -0.006, 0.017, 0.042],
        [0.795, 1.371, -0.007, 0.0145, 0.041],
        [0.825, 1.367, -0.008, 0.0125, 0.037],
        [0.850, 1.363, -0.008, 0.0105, 0.030],
        [0.866, 1.360, -0.008, 0.0085, 0.021],
    ],
};

fn ellipsoid(p: Vec3, centre: [f32; 3], radii: [f32; 3]) -> f32 {
    let r = Vec3::from(radii);
    let q = (p - Vec3::from(centre)) / r;
    let (k0, k1) = (q.length(), (q / r).length());
    if k0 < 1e-3 { -r.min_element() } else { k0 * (k0 - 1.0) / k1 }
}

/// A cone with round ends.
fn capsule(p: Vec3, a: [f32; 3], b: [f32; 3], ra: f32, rb: f32) -> f32 {
    let (a, b) = (Vec3::from(a), Vec3::from(b));
    let t = ((p - a).dot(b - a) / a.distance_squared(b)).clamp(0.0, 1.0);
    p.distance(a.lerp(b, t)) - (ra + t * (rb - ra))
}

/// Minimum with a fillet about `k` wide.
fn join(a: f32, b: f32, k: f32) -> f32 {
    let h = (k - (a - b).abs()).max(0.0) / k;
    a.min(b) - h * h * k * 0.25
}

/// Takes `b` out of `a`, with a fillet about `k` wide.
fn carve(a: f32, b: f32, k: f32) -> f32 {
    -join(-a, b, k)
}

/// Distances are not told apart beyond this, metres.
const FAR: f32 = 0.3;

/// Joins a part that lies in the box from `low` to `high`, unless that is too far to matter.
fn join_near(d: f32, p: Vec3, low: [f32; 3], high: [f32; 3], k: f32, part: impl Fn() -> f32) -> f32 {
    let outside = p - p.clamp(Vec3::from(low), Vec3::from(high));
    if outside.length() > d + k { d } else { join(d, part(), k) }
}

/// Signed distance to first order, negative inside, symmetric in x.
pub(super) fn distance(p: Vec3) -> f32 {
    let p = Vec3::new(p.x.abs(), p.y, p.z);
    let d = join_near(FAR, p, [0.0, 0.75, -0.2], [0.2, 1.48, 0.2], 0.05, || torso(p));
    let d = join_near(d, p, [0.0, 1.34, -0.1], [0.08, 1.60, 0.1], 0.03, || NECK.distance(p));
    let d = join_near(d, p, [0.0, 0.0, -0.15], [0.2, 0.95, 0.2], 0.035, || legs(p));
    let d = join_near(d, p, [0.08, 1.28, -0.1], [0.9, 1.45, 0.1], 0.055, || arm(p));
    join_near(d, p, [0.0, 1.46, -0.12], [0.1, 1.72, 0.15], 0.022, || head(p))
}

fn torso(p: Vec3) -> f32 {
    let mut d = TORSO.distance(p);
    d = join(d, ellipsoid(p, [0.072, 0.865, -0.062], [0.078, 0.085, 0.068]), 0.05);
    d = join(d, ellipsoid(p, [0.072, 1.265, 0.066], [0.072, 0.055, 0.036]), 0.05);
    join(d, capsule(p, [0.025, 1.455, -0.028], [0.150, 1.392, -0.022], 0.030, 0.038), 0.045)
}

fn legs(p: Vec3) -> f32 {
    let this = leg(p);
    if p.x > 0.06 && p.y < 0.7 {
        return this;
    }
    join(this, leg(Vec3::new(-p.x, p.y, p.z)), 0.02)
}

fn leg(p: Vec3) -> f32 {
    let mut d = LEG.distance(p);
    // Kneecap and ankle bones.
    d = join(d, ellipsoid(p, [0.098, 0.485, 0.036], [0.030, 0.035, 0.026]), 0.03);
    d = join(d, ellipsoid(p, [0.104, 0.088, -0.018], [0.037, 0.018, 0.020]), 0.02);
    let foot = FOOT.distance(p);
    d = join(d, foot, 0.035);
    // Flat sole.
    carve(d, p.y - 0.004, 0.012)
}

fn arm(p: Vec3) -> f32 {
    let mut d = ARM.distance(p);
    d = join(d, ellipsoid(p, [0.185, 1.378, -0.016], [0.060, 0.056, 0.056]), 0.03);
    let mut hand = HAND.distance(p);
    let thumb = capsule(p, [0.722, 1.372, 0.020], [0.752, 1.366, 0.048], 0.015, 0.012);
    let tip = capsule(p, [0.752, 1.366, 0.048], [0.786, 1.361, 0.058], 0.012, 0.0095);
    hand = join(hand, join(thumb, tip, 0.006), 0.012);
    d = join(d, hand, 0.02);
    d
}

fn head(p: Vec3) -> f32 {
    let mut d = HEAD.distance(p);
    // Brow, cheekbones, chin.
    d = join(d, ellipsoid(p, [0.022, 1.605, 0.088], [0.034, 0.011, 0.013]), 0.02);
    d = join(d, ellipsoid(p, [0.040, 1.558, 0.068], [0.024, 0.020, 0.022]), 0.025);
    d = join(d, ellipsoid(p, [0.0, 1.492, 0.089], [0.020, 0.014, 0.014]), 0.02);
    // Eye sockets with eyes.
    d = carve(d, ellipsoid(p, [0.031, 1.587, 0.112], [0.017, 0.010, 0.020]), 0.014);
    d = join(d, ellipsoid(p, [0.031, 1.585, 0.087], [0.013, 0.011, 0.012]), 0.003);
    // Nose and lips.
    d = join(d, capsule(p, [0.0, 1.596, 0.101], [0.0, 1.555, 0.118], 0.007, 0.011), 0.014);
    d = join(d, ellipsoid(p, [0.010, 1.549, 0.108], [0.009, 0.007, 0.009]), 0.008);
    d = join(d, ellipsoid(p, [0.0, 1.524, 0.100], [0.023, 0.012, 0.014]), 0.010);
    d = carve(d, ellipsoid(p, [0.0, 1.524, 0.114], [0.024, 0.003, 0.010]), 0.005);
    join(d, ellipsoid(p, [0.075, 1.572, 0.000], [0.009, 0.029, 0.017]), 0.008)
}
