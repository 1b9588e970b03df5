//! Ways to bake a person and to draw them, by name.

use occnerf::Model;
use occnerf::bake::{Avatar, BakeOptions, BakedRenderer};
use serde::{Deserialize, Serialize};
use visibility::Samples;

/// How a person is baked, and drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Baking {
    /// Longest side of the atlas, texels; smaller where the training pictures ask for less.
    pub atlas: u32,
    pub refinements: u32,
    /// Four samples a pixel instead of one.
    pub smooth: bool,
}

impl Default for Baking {
    /// As `render RUN … --baked` bakes and draws.
    fn default() -> Self {
        let BakeOptions { atlas, refinements, .. } = BakeOptions::default();
        Self { atlas, refinements, smooth: true }
    }
}

impl Baking {
    /// What charts and tables call it; `side` is what the atlas's came to, where that is known.
    pub fn name(self, side: Option<u32>) -> String {
        let atlas = side.map_or_else(|| format!("≤ {}", self.atlas), |side| side.to_string());
        format!("atlas {atlas}, {} refinements, {} a pixel", self.refinements, self.count())
    }

    /// Samples a pixel.
    pub fn count(self) -> usize {
        if self.smooth { 4 } else { 1 }
    }

    pub fn samples(self) -> Samples {
        if self.smooth { Samples::Four } else { Samples::One }
    }

    pub fn options(self) -> BakeOptions {
        let Self { atlas, refinements, .. } = self;
        BakeOptions { atlas, refinements, ..BakeOptions::default() }
    }

    /// Draws an avatar that was baked with [`Baking::options`].
    pub fn renderer<'a>(self, model: &Model, avatar: &'a Avatar) -> BakedRenderer<'a> {
        BakedRenderer::new(avatar, model.body().scale, model.light(), self.samples())
    }
}
