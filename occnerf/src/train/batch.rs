//! The rays of a training step: one frame, several square patches.

use crate::capture::PixelReader;
use crate::config::Config;
use crate::scene::labels::{Label, Labels};
use crate::scene::prepared::Scene;
use volrender::RandomStream;

/// Share of patches centred on a pixel of the subject; the rest fall anywhere in the body's box.
const ON_SUBJECT: f32 = 0.8;
const DRAW: u64 = 0x5041_5443;

/// Pixels of a step.
#[derive(Clone, Debug, Default)]
pub(crate) struct Batch {
    /// Index of the training frame.
    pub frame: usize,
    /// Side of the patches after clipping to the image.
    pub size: usize,
    /// Flat pixel index of each ray, patch after patch, row-major.
    pub pixels: Vec<u32>,
    /// Random background of the step.
    pub background: glam::Vec3,
    /// The frames of the current round.
    order: Vec<usize>,
}

impl Batch {
    /// Draws a step's rays from the seed and the step's number alone.
    pub fn draw(&mut self, scene: &Scene, config: &Config, step: u64) {
        let mut random = RandomStream::new(&[config.seed, DRAW, step]);
        self.frame = scene.learnt[frame_of(scene.learnt.len(), config.seed, step, &mut self.order)];
        let frame = &scene.train[self.frame];
        let (width, height) = (frame.view.camera.width, frame.view.camera.height);
        let size = config.patch_size.min(width).min(height);
        self.size = size as usize;
        self.pixels.clear();
        self.background = glam::Vec3::new(random.uniform(), random.uniform(), random.uniform());
        let body = frame.view.body_box();
        for _ in 0..config.patches {
            let on_subject = random.uniform() < ON_SUBJECT && frame.labels.num_subject() > 0;
            let (x, y) = if on_subject {
                let pixel = frame.labels.subject(random.below(frame.labels.num_subject()));
                (pixel % width, pixel / width)
            } else {
                let [x0, y0, x1, y1] = body;
                (x0 + random.below((x1 - x0) as usize) as u32, y0 + random.below((y1 - y0) as usize) as u32)
            };
            self.pixels.extend(volrender::patch((x, y), size, (width, height)));
        }
    }
}

/// A random permutation of the frames each round.
fn frame_of(frames: usize, seed: u64, step: u64, order: &mut Vec<usize>) -> usize {
    let (round, place) = (step / frames as u64, (step % frames as u64) as usize);
    let mut random = RandomStream::new(&[seed, 0x4652_414D, round]);
    order.clear();
    order.extend(0..frames);
    for i in (1..frames).rev() {
        order.swap(i, random.below(i + 1));
    }
    order[place]
}

/// Target of a ray: premultiplied colour over `background`; `None` at an unknown pixel.
pub(crate) fn target(labels: &Labels, shown: &PixelReader, pixel: u32, background: glam::Vec3) -> Option<glam::Vec3> {
    (labels.at(pixel) != Label::Unknown).then(|| {
        let (colour, mask) = shown.at(pixel);
        colour + (1.0 - mask) * background
    })
}

#[cfg(test)]
mod tests {
    use super::frame_of;

    #[test]
    fn every_round_shows_every_frame_once_in_another_order() {
        let round = |r: u64| (0..10).map(|i| frame_of(10, 5, r * 10 + i, &mut Vec::new())).collect::<Vec<_>>();
        let mut sorted = round(3);
        sorted.sort_unstable();
        assert_eq!(sorted, (0..10).collect::<Vec<_>>());
        assert_ne!(round(0), round(1));
    }
}
