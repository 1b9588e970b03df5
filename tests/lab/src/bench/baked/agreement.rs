//! How far two renderers draw the same.

use occnerf::Rendering;

/// How far pictures agree with those of the field.
#[derive(Default)]
pub struct Agreement {
    /// Of the colours, over black, where either shows anything.
    squared: f64,
    count: f64,
    /// Opacity of the field's pictures, and of the others.
    pub area: [f64; 2],
    /// Pixels with opacity above one half.
    pub both: f64,
    pub either: f64,
}

impl Agreement {
    pub fn add(&mut self, field: &Rendering, other: &Rendering) {
        let pixels = field.image.pixels.chunks_exact(3).zip(other.image.pixels.chunks_exact(3));
        for ((a, b), (&f, &o)) in pixels.zip(field.opacity.iter().zip(&other.opacity)) {
            if f > 0.0 || o > 0.0 {
                self.squared += a.iter().zip(b).map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>();
                self.count += 3.0;
            }
            self.area[0] += f64::from(f);
            self.area[1] += f64::from(o);
            self.both += f64::from(u8::from(f > 0.5 && o > 0.5));
            self.either += f64::from(u8::from(f > 0.5 || o > 0.5));
        }
    }

    pub fn psnr(&self) -> f64 {
        -10.0 * (self.squared / self.count).log10()
    }
}
