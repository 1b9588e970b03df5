//! What the person wears: how far each garment reaches, and how far it stands off the body.
//!
//! Every `…_inside` function tells how deep a point of the rest pose (figure metres) lies within a
//! garment: positive inside, 0 at the hem, falling outward.

use glam::Vec3;

use super::landmarks::Landmarks;
use crate::film::noise::{smooth_noise, smoothstep};

/// Width of the step at a hem.
const HEM: f32 = 0.010;

/// The parts of the outer surface, from the outside in.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Garment {
    Hair,
    Shirt,
    Belt,
    Trousers,
    Shoe,
    Sock,
    Skin,
}

impl Landmarks {
    /// Height of the shirt's lower edge.
    fn shirt_hem(&self) -> f32 {
        0.078
    }

    /// Where along the arm the sleeve ends.
    fn sleeve_hem(&self) -> f32 {
        self.shoulder_x + 0.62 * (self.elbow_x - self.shoulder_x)
    }

    pub fn hair_inside(&self, q: Vec3) -> f32 {
        let p = (q - self.head) / self.face;
        // Forehead, then the sideburns, then the nape.
        let back = smoothstep(0.085, 0.055, p.z) * 0.062 + smoothstep(0.035, -0.02, p.z) * 0.085;
        p.y - (0.142 + 0.004 * (p.x * 90.0).sin() - back)
    }

    pub fn shirt_inside(&self, q: Vec3) -> f32 {
        // The collar is a ball around the root of the neck, carried upward, lower in front.
        let root = self.neck + Vec3::new(0.0, 0.066, 0.024);
        let mut from_root = q - root;
        from_root.y = from_root.y.min(0.0);
        // The chin hangs over the chest: what is far in front of the neck is cloth only lower down.
        let chin = 2.0 * (q.z - self.neck.z - 0.085).max(0.0);
        let collar = (from_root.length() - 0.088).min(self.neck.y + 0.060 - q.y - chin);
        let wave = 0.004 * (q.x * 38.0).sin();
        (q.y - self.shirt_hem() - wave).min(self.sleeve_hem() - q.x.abs()).min(collar)
    }

    pub fn belt_inside(&self, q: Vec3) -> f32 {
        0.024 - (q.y - (self.shirt_hem() - 0.020)).abs()
    }

    pub fn trousers_inside(&self, q: Vec3) -> f32 {
        (self.shirt_hem() + 0.02 - q.y).min(q.y - (self.ankle.y + 0.058))
    }

    /// The trousers' turn-ups end this far above the hem.
    pub fn turn_up(&self, q: Vec3) -> f32 {
        q.y - (self.ankle.y + 0.058)
    }

    pub fn shoe_inside(&self, q: Vec3) -> f32 {
        self.ankle.y + 0.005 - q.y
    }

    /// Height above the ground that the figure's soles reach, as a figure height.
    pub fn sole_top(&self) -> f32 {
        self.ankle.y - 0.045
    }

    /// What is seen at a point of the rest pose, and how far below the next garment's hem it lies
    /// (large where there is none near), for the shade that hems cast.
    pub fn garment(&self, q: Vec3) -> (Garment, f32) {
        let (hair, shirt) = (self.hair_inside(q), self.shirt_inside(q));
        let (belt, trousers, shoe) = (self.belt_inside(q), self.trousers_inside(q), self.shoe_inside(q));
        if hair > 0.0 {
            (Garment::Hair, 1.0)
        } else if shirt > 0.0 {
            (Garment::Shirt, 1.0)
        } else if belt > 0.0 {
            (Garment::Belt, -shirt)
        } else if trousers > 0.0 {
            (Garment::Trousers, -shirt.max(belt))
        } else if shoe > 0.0 {
            (Garment::Shoe, -trousers)
        } else if q.y < 0.5 * (self.knee.y + self.ankle.y) {
            (Garment::Sock, -trousers)
        } else {
            (Garment::Skin, -shirt.max(hair))
        }
    }

    /// How far the outer surface stands off the body along its normal, in figure metres.
    pub fn thickness(&self, q: Vec3) -> f32 {
        let step = |inside: f32| smoothstep(0.0, HEM, inside);
        let folds = smooth_noise(q * Vec3::new(22.0, 14.0, 22.0)) - 0.5;

        // Wider toward the lower edge and around the upper arm.
        let low = smoothstep(0.30, 0.02, q.y - self.shirt_hem());
        let sleeve = smoothstep(self.shoulder_x + 0.02, self.sleeve_hem(), q.x.abs());
        let drape = (q.x * 55.0 + 5.0 * q.y).sin() * (q.z * 21.0).cos();
        let shirt = 0.013 + 0.010 * low + 0.009 * sleeve + 0.008 * folds + 0.003 * low * drape;

        // Straight legs: what the calf lacks in width, the cloth makes up for.
        let down = smoothstep(self.hip.y - 0.05, self.ankle.y + 0.06, q.y);
        let knee = smoothstep(0.14, 0.02, (q.y - self.knee.y).abs());
        let crease = (q.y * 75.0 + 9.0 * (q.z * 12.0).sin()).sin();
        let turn_up = 0.005 * smoothstep(0.040, 0.034, self.turn_up(q));
        let trousers = 0.010 + 0.016 * down + 0.008 * folds + 0.003 * (knee + 0.6 * down) * crease + turn_up;

        let sole = smoothstep(self.sole_top() + 0.006, self.sole_top(), q.y);
        let shoe = 0.009 + 0.006 * sole;

        let p = (q - self.head) / self.face;
        let parting = smoothstep(0.0, 0.012, (p.x - 0.022).abs());
        let strands = (p.x * 130.0 + 22.0 * p.z).sin();
        let hair = (0.014 + 0.012 * smoothstep(0.10, 0.18, p.y)) * (0.6 + 0.4 * parting) + 0.002 * strands;

        let belt = 0.013;
        let mut thickness: f32 = 0.0;
        for (inside, amount) in [
            (self.hair_inside(q), hair),
            (self.shirt_inside(q), shirt),
            (self.belt_inside(q), belt),
            (self.trousers_inside(q), trousers),
            (self.shoe_inside(q), shoe),
        ] {
            thickness = thickness.max(step(inside) * amount);
        }
        thickness
    }
}
