//! Ways to bake a person and to draw them, by name.

use anyhow::Result;
use occnerf::Model;
use occnerf::bake::{Avatar, BakeOptions, BakedRenderer};
use serde::{Deserialize, Serialize};
use visibility::Samples;

/// How a person is baked, and drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Baking {
    pub shells: usize,
    /// Longest side of the atlas, texels; smaller where the training pictures ask for less.
    pub atlas: u32,
    pub refinements: u32,
    /// Whether the surface has the atlas's colours at its vertices alone.
    pub vertex_colours: bool,
    /// Four samples a pixel instead of one.
    pub smooth: bool,
}

impl Default for Baking {
    /// As `render RUN … --baked` bakes and draws.
    fn default() -> Self {
        let BakeOptions { shells, atlas, refinements, .. } = BakeOptions::default();
        Self { shells, atlas, refinements, vertex_colours: false, smooth: true }
    }
}

impl Baking {
    /// What charts and tables call it; `side` is what the atlas's came to, where that is known.
    pub fn name(self, side: Option<u32>) -> String {
        let Self { shells, refinements, vertex_colours, .. } = self;
        let shells = if shells == 1 { "1 shell".to_owned() } else { format!("{shells} shells") };
        let colours = match side {
            _ if vertex_colours => "vertex colours".to_owned(),
            Some(side) => format!("atlas {side}"),
            None => format!("atlas ≤ {}", self.atlas),
        };
        format!("{shells}, {colours}, {refinements} refinements, {} a pixel", self.count())
    }

    /// Samples a pixel.
    pub fn count(self) -> usize {
        if self.smooth { 4 } else { 1 }
    }

    pub fn samples(self) -> Samples {
        if self.smooth { Samples::Four } else { Samples::One }
    }

    pub fn options(self) -> BakeOptions {
        let Self { shells, atlas, refinements, .. } = self;
        BakeOptions { shells, atlas, refinements, ..BakeOptions::default() }
    }

    /// Draws an avatar that was baked with [`Baking::options`].
    pub fn renderer<'a>(self, model: &Model, avatar: &'a Avatar) -> Result<BakedRenderer<'a>> {
        let renderer = BakedRenderer::new(model.body(), model.light(), avatar, self.samples())?;
        Ok(if self.vertex_colours { renderer.in_vertex_colours() } else { renderer })
    }
}
