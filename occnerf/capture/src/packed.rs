//! Lossless compression of pixels: row spans of non-zero pixels, in 8-bit levels where exact.

use std::sync::LazyLock;

use glam::Vec3;

use super::image::to_byte;
use super::{Image, Pixels};

/// A compressed picture with mask and occluder; [`PackedPixels::pixels`] returns the same bits.
#[derive(Clone, Debug)]
pub struct PackedPixels {
    width: u32,
    spans: Vec<Span>,
    /// 64 pixels of the occluder a word.
    occluder: Option<Vec<u64>>,
    values: Values,
}

/// Non-zero columns of a row, and the index of the first value.
#[derive(Clone, Copy, Debug)]
struct Span {
    start: u32,
    end: u32,
    first: usize,
}

/// Colour and coverage of pixels.
#[derive(Clone, Debug)]
enum Values {
    /// Levels of the picture before it was multiplied by the mask, and of the mask; their scale,
    /// `None` for [`EVEN`].
    Levels(Option<Box<Scale>>, Vec<[u8; 4]>),
    Floats(Vec<[f32; 4]>),
}

/// Floats of the 8-bit levels: level / 255, up to rounding that differs for grey pictures.
#[derive(Clone, Debug, PartialEq)]
struct Scale {
    colour: [f32; 256],
    mask: [f32; 256],
}

/// The scale of most pictures.
static EVEN: LazyLock<Scale> = LazyLock::new(|| {
    let even = std::array::from_fn(|level| level as f32 / 255.0);
    Scale { colour: even, mask: even }
});

impl Scale {
    /// The scale of these values, if they are levels.
    fn of(values: &[[f32; 4]]) -> Self {
        let mut scale = EVEN.clone();
        for [r, g, b, mask] in values {
            scale.mask[usize::from(to_byte(*mask))] = *mask;
            if *mask == 1.0 {
                [r, g, b].iter().for_each(|&&colour| scale.colour[usize::from(to_byte(colour))] = colour);
            }
        }
        scale
    }

    /// The levels that this colour and coverage are made of; `None` if no levels give these very
    /// bits.
    fn levels(&self, [r, g, b, mask]: [f32; 4]) -> Option<[u8; 4]> {
        let coverage = to_byte(mask);
        let of = |colour: f32| if coverage == 0 { 0 } else { to_byte(colour / mask) };
        let found = [of(r), of(g), of(b), coverage];
        let same = self.floats(found).map(f32::to_bits) == [r, g, b, mask].map(f32::to_bits);
        same.then_some(found)
    }

    fn floats(&self, [r, g, b, mask]: [u8; 4]) -> [f32; 4] {
        let mask = self.mask[usize::from(mask)];
        let [r, g, b] = [r, g, b].map(|colour| self.colour[usize::from(colour)] * mask);
        [r, g, b, mask]
    }
}

impl PackedPixels {
    /// Packs pixels, in 8-bit levels where those reproduce all of them.
    #[must_use]
    pub fn new(pixels: &Pixels) -> Self {
        let width = pixels.image.width.max(1) as usize;
        let value = |i: usize| {
            let colour = &pixels.image.pixels[3 * i..3 * i + 3];
            [colour[0], colour[1], colour[2], pixels.mask[i]]
        };
        // −0 is kept.
        let holds = |i: &usize| value(*i).map(f32::to_bits) != [0; 4];
        let (mut spans, mut values) = (Vec::new(), Vec::new());
        for row in 0..pixels.mask.len() / width {
            let all = row * width..(row + 1) * width;
            let start = all.clone().find(holds).unwrap_or(all.end);
            let end = all.clone().rev().find(holds).map_or(start, |last| last + 1);
            let column = |i: usize| (i - all.start) as u32;
            spans.push(Span { start: column(start), end: column(end), first: values.len() });
            values.extend((start..end).map(value));
        }
        let word = |bits: &[bool]| bits.iter().enumerate().fold(0, |word, (i, &bit)| word | u64::from(bit) << i);
        let occluder = pixels.occluder.as_ref().map(|covered| covered.chunks(64).map(word).collect());
        let own = Scale::of(&values);
        let levels: Option<Vec<[u8; 4]>> = values.iter().map(|&value| own.levels(value)).collect();
        let scale = (own != *EVEN).then(|| Box::new(own));
        let values = levels.map_or(Values::Floats(values), |levels| Values::Levels(scale, levels));
        Self { width: width as u32, spans, occluder, values }
    }

    /// Size in bytes.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        let values = match &self.values {
            Values::Levels(scale, values) => {
                scale.as_ref().map_or(0, |_| size_of::<Scale>()) + size_of_val(&values[..])
            }
            Values::Floats(values) => size_of_val(&values[..]),
        };
        let occluder = self.occluder.as_ref().map_or(0, |bits| size_of_val(&bits[..]));
        (values + size_of_val(&self.spans[..]) + occluder) as u64
    }

    /// Premultiplied colour and coverage of a pixel.
    ///
    /// # Panics
    /// Outside the picture.
    #[must_use]
    pub fn at(&self, pixel: u32) -> (Vec3, f32) {
        let (row, column) = (pixel / self.width, pixel % self.width);
        let span = self.spans[row as usize];
        if !(span.start..span.end).contains(&column) {
            return (Vec3::ZERO, 0.0);
        }
        let [r, g, b, mask] = self.value(span.first + (column - span.start) as usize);
        (Vec3::new(r, g, b), mask)
    }

    fn value(&self, at: usize) -> [f32; 4] {
        match &self.values {
            Values::Levels(scale, values) => scale.as_deref().unwrap_or(&EVEN).floats(values[at]),
            Values::Floats(values) => values[at],
        }
    }

    /// The pixels as they were packed.
    #[must_use]
    pub fn pixels(&self) -> Pixels {
        let (width, height) = (self.width as usize, self.spans.len());
        let mut image = Image::new(self.width, height as u32);
        let mut mask = vec![0.0; width * height];
        for (row, span) in self.spans.iter().enumerate() {
            for (at, column) in (span.first..).zip(span.start as usize..span.end as usize) {
                let i = row * width + column;
                let [r, g, b, coverage] = self.value(at);
                image.pixels[3 * i..3 * i + 3].copy_from_slice(&[r, g, b]);
                mask[i] = coverage;
            }
        }
        let bit = |bits: &[u64], i: usize| bits[i / 64] >> (i % 64) & 1 == 1;
        let occluder = self.occluder.as_ref().map(|bits| (0..mask.len()).map(|i| bit(bits, i)).collect());
        Pixels { image, mask, occluder }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn bits(pixels: &Pixels) -> (Vec<u32>, Vec<u32>, &Option<Vec<bool>>) {
        let of = |values: &[f32]| values.iter().map(|v| v.to_bits()).collect();
        (of(&pixels.image.pixels), of(&pixels.mask), &pixels.occluder)
    }

    fn made(width: u32, values: &[[f32; 4]], occluder: Option<Vec<bool>>) -> Pixels {
        let height = values.len() as u32 / width;
        let pixels = values.iter().flat_map(|v| [v[0], v[1], v[2]]).collect();
        Pixels { image: Image { width, height, pixels }, mask: values.iter().map(|v| v[3]).collect(), occluder }
    }

    #[test]
    fn every_product_of_levels_is_kept_in_bytes() {
        let even = &*EVEN;
        for mask in 0..=255 {
            for colour in 0..=255 {
                let value = even.floats([colour, 255 - colour, 7, mask]);
                // Colours of what no mask shows are gone before.
                let found = even.levels(value).unwrap();
                assert_eq!(even.floats(found).map(f32::to_bits), value.map(f32::to_bits), "{colour} {mask}");
            }
        }
    }

    #[test]
    fn pictures_and_masks_of_eight_bits_are_kept_in_bytes() {
        let path = std::env::temp_dir().join(format!("occnerf-packed-{}.png", std::process::id()));
        let ramp = |x: u32| (x % 256) as u8;
        let (colour, grey) = (
            image::RgbImage::from_fn(256, 2, |x, y| image::Rgb([ramp(x), ramp(7 * x + y), 200])),
            image::GrayImage::from_fn(256, 2, |x, y| image::Luma([ramp(x + 90 * y)])),
        );
        for picture in [image::DynamicImage::from(colour), grey.into()] {
            picture.save(&path).unwrap();
            let image = Image::load(&path).unwrap();
            // The first row is seen whole.
            let mask: Vec<f32> = (0..512).map(|i| if i < 256 { 1.0 } else { image.pixels[3 * (i - 256)] }).collect();
            let mut pixels = Pixels { image, mask: mask.clone(), occluder: None };
            pixels.image.multiply(&mask);
            assert!(matches!(PackedPixels::new(&pixels).values, Values::Levels(..)));
        }
        std::fs::remove_file(&path).unwrap();
    }

    proptest! {
        #[test]
        fn what_is_packed_comes_back_to_the_bit(
            (width, height) in (1u32..9, 1u32..9), exact: bool, marked: bool,
            seeds in prop::collection::vec((any::<[u8; 4]>(), any::<u32>(), prop::bool::weighted(0.6)), 64),
        ) {
            let even = &*EVEN;
            let value = |(bytes, odd, empty): &([u8; 4], u32, bool)| match (empty, exact) {
                (true, _) => [0.0; 4],
                (false, true) => even.floats(*bytes),
                // Any bits at all: −0, NaN, infinities.
                (false, false) => [f32::from_bits(*odd), even.colour[usize::from(bytes[0])], -0.0, 0.5],
            };
            let values: Vec<[f32; 4]> = seeds[..(width * height) as usize].iter().map(value).collect();
            let occluder = marked.then(|| seeds[..values.len()].iter().map(|(bytes, ..)| bytes[0] > 99).collect());
            let pixels = made(width, &values, occluder);
            let packed = PackedPixels::new(&pixels);
            let back = packed.pixels();
            prop_assert_eq!(bits(&back), bits(&pixels));
            prop_assert!(!exact || matches!(packed.values, Values::Levels(..)));
            for i in 0..values.len() {
                let (colour, mask) = packed.at(i as u32);
                let found = [colour.x, colour.y, colour.z, mask];
                prop_assert_eq!(found.map(f32::to_bits), values[i].map(f32::to_bits));
            }
        }
    }
}
