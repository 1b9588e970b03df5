//! The networks: SqueezeNet 1.1, VGG16 and AlexNet as far as their last tap, with torchvision's
//! names.

use ndarray::{ArrayViewMut2, Axis};

use super::conv::Conv;
use super::maps::{Maps, Window, max_pool, max_pool_backward, rectify_backward};
use crate::Error;

/// Gives the tensor of a name, of exactly a shape.
pub(super) type Reader<'a> = dyn FnMut(&str, &[usize]) -> Result<Vec<f32>, Error> + 'a;

/// Which network's features are compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Trunk {
    /// VGG16, of 59 MB.
    Vgg16,
    /// AlexNet, of 10 MB.
    AlexNet,
    /// SqueezeNet 1.1, of 3 MB.
    SqueezeNet,
}

impl Trunk {
    /// The name used in results.
    pub fn name(self) -> &'static str {
        match self {
            Self::Vgg16 => "vgg16",
            Self::AlexNet => "alexnet",
            Self::SqueezeNet => "squeezenet",
        }
    }
}

/// A layer of torchvision's `features`, under its number there.
enum Plan {
    /// Outputs, kernel size, stride, padding.
    Conv(usize, usize, usize, usize, usize),
    /// Kernel size, stride, whether the last window may hang over.
    Pool(usize, usize, bool),
    /// Outputs of `squeeze`, outputs of each `expand`.
    Fire(usize, usize, usize),
    /// The output so far is compared.
    Tap,
}
use Plan::{Conv as C, Fire as F, Pool as P, Tap as T};

const VGG16: [Plan; 22] = [
    C(0, 64, 3, 1, 1),
    C(2, 64, 3, 1, 1),
    T,
    P(2, 2, false),
    C(5, 128, 3, 1, 1),
    C(7, 128, 3, 1, 1),
    T,
    P(2, 2, false),
    C(10, 256, 3, 1, 1),
    C(12, 256, 3, 1, 1),
    C(14, 256, 3, 1, 1),
    T,
    P(2, 2, false),
    C(17, 512, 3, 1, 1),
    C(19, 512, 3, 1, 1),
    C(21, 512, 3, 1, 1),
    T,
    P(2, 2, false),
    C(24, 512, 3, 1, 1),
    C(26, 512, 3, 1, 1),
    C(28, 512, 3, 1, 1),
    T,
];
const ALEXNET: [Plan; 12] = [
    C(0, 64, 11, 4, 2),
    T,
    P(3, 2, false),
    C(3, 192, 5, 1, 2),
    T,
    P(3, 2, false),
    C(6, 384, 3, 1, 1),
    T,
    C(8, 256, 3, 1, 1),
    T,
    C(10, 256, 3, 1, 1),
    T,
];
const SQUEEZENET: [Plan; 19] = [
    C(0, 64, 3, 2, 0),
    T,
    P(3, 2, true),
    F(3, 16, 64),
    F(4, 16, 64),
    T,
    P(3, 2, true),
    F(6, 32, 128),
    F(7, 32, 128),
    T,
    P(3, 2, true),
    F(9, 48, 192),
    T,
    F(10, 48, 192),
    T,
    F(11, 64, 256),
    T,
    F(12, 64, 256),
    T,
];

/// What is computed, one after the other.
enum Layer {
    Conv(Conv),
    Pool(Window),
    /// Two convolutions of the same input, their outputs side by side.
    Expand(Conv, Conv),
}

/// A trunk with its weights.
pub(super) struct Network {
    layers: Vec<Layer>,
    /// Number of the layer before each tap, and channels there.
    pub taps: Vec<(usize, usize)>,
}

impl Network {
    /// Builds `trunk` from what `read` gives for each name and shape.
    pub fn new(trunk: Trunk, read: &mut Reader<'_>) -> Result<Self, Error> {
        let plan: &[Plan] = match trunk {
            Trunk::SqueezeNet => &SQUEEZENET,
            Trunk::Vgg16 => &VGG16,
            Trunk::AlexNet => &ALEXNET,
        };
        let mut network = Self { layers: Vec::new(), taps: Vec::new() };
        let mut channels = 3;
        let mut conv = |name: String, inputs: usize, outputs: usize, [size, stride, padding]: [usize; 3]| {
            let weight = read(&format!("{name}.weight"), &[outputs, inputs, size, size])?;
            let bias = read(&format!("{name}.bias"), &[outputs])?;
            Ok::<_, Error>(Conv::new(Window { size, stride, padding, ceil: false }, inputs, &weight, bias))
        };
        for step in plan {
            match *step {
                C(number, outputs, size, stride, padding) => {
                    let shape = [size, stride, padding];
                    network.layers.push(Layer::Conv(conv(format!("features.{number}"), channels, outputs, shape)?));
                    channels = outputs;
                }
                F(number, squeeze, expand) => {
                    let name = |part: &str| format!("features.{number}.{part}");
                    network.layers.push(Layer::Conv(conv(name("squeeze"), channels, squeeze, [1, 1, 0])?));
                    let one = conv(name("expand1x1"), squeeze, expand, [1, 1, 0])?;
                    network.layers.push(Layer::Expand(one, conv(name("expand3x3"), squeeze, expand, [3, 1, 1])?));
                    channels = 2 * expand;
                }
                P(size, stride, ceil) => network.layers.push(Layer::Pool(Window { size, stride, padding: 0, ceil })),
                T => network.taps.push((network.layers.len() - 1, channels)),
            }
        }
        Ok(network)
    }

    /// Whether a picture is large enough for every layer to have an output.
    pub fn takes(&self, height: usize, width: usize) -> bool {
        let step = |size, layer: &Layer| layer.size(size?);
        self.layers.iter().fold(Some([height, width]), step).is_some()
    }

    /// Runs the layers up to the last tap; `seen` gets the number and the output of each. Returns
    /// the outputs, of the last layer alone unless `all` are to be kept.
    pub fn forward(&self, input: &Maps, mut seen: impl FnMut(usize, &Maps), all: bool) -> Vec<Maps> {
        let mut outputs: Vec<Maps> = Vec::new();
        for (number, layer) in self.layers.iter().enumerate() {
            let out = layer.forward(outputs.last().unwrap_or(input));
            seen(number, &out);
            if !all {
                outputs.clear();
            }
            outputs.push(out);
        }
        outputs
    }

    /// The gradient by the first images of `input`, as many as the tap gradients are for. `outputs`
    /// are those of every layer; `at_tap` adds the gradient by the output of layer `taps[i].0`.
    pub fn backward(
        &self,
        input: &Maps,
        outputs: &[Maps],
        count: usize,
        mut at_tap: impl FnMut(usize, &Maps, &mut Maps),
    ) -> Maps {
        let mut d_out = Maps::default();
        for (number, layer) in self.layers.iter().enumerate().rev() {
            let out = &outputs[number];
            if d_out.data.is_empty() {
                d_out = Maps::zeros(count, [out.height, out.width], out.channels);
            }
            if let Some(tap) = self.taps.iter().position(|tap| tap.0 == number) {
                at_tap(tap, out, &mut d_out);
            }
            let before = if number == 0 { input } else { &outputs[number - 1] };
            d_out = layer.backward(before, out, d_out);
        }
        d_out
    }
}

impl Layer {
    fn size(&self, [height, width]: [usize; 2]) -> Option<[usize; 2]> {
        let window = match self {
            Self::Conv(conv) | Self::Expand(_, conv) => conv.window,
            Self::Pool(window) => *window,
        };
        Some([window.positions(height)?, window.positions(width)?])
    }

    fn forward(&self, input: &Maps) -> Maps {
        // Sizes are checked before the first layer.
        let size = self.size([input.height, input.width]).unwrap_or_default();
        let channels = match self {
            Self::Pool(window) => return max_pool(input, *window, size),
            Self::Conv(conv) => conv.outputs(),
            Self::Expand(one, three) => one.outputs() + three.outputs(),
        };
        let mut out = Maps::zeros(input.count, size, channels);
        let pixels = out.pixels();
        let Ok(view) = ArrayViewMut2::from_shape((pixels, channels), &mut out.data) else { return out };
        match self {
            Self::Pool(_) => {}
            Self::Conv(conv) => conv.forward(input, size, view),
            Self::Expand(one, three) => {
                let (left, right) = view.split_at(Axis(1), one.outputs());
                one.forward(input, size, left);
                three.forward(input, size, right);
            }
        }
        out
    }

    fn backward(&self, input: &Maps, out: &Maps, mut d_out: Maps) -> Maps {
        if let Self::Pool(window) = self {
            return max_pool_backward(input, out, *window, &d_out);
        }
        rectify_backward(out, &mut d_out);
        let size = [out.height, out.width];
        let mut d_input = Maps::zeros(d_out.count, [input.height, input.width], input.channels);
        let pixels = d_out.pixels();
        let Ok(view) = ArrayViewMut2::from_shape((pixels, d_out.channels), &mut d_out.data) else { return d_input };
        match self {
            Self::Pool(_) => {}
            Self::Conv(conv) => conv.backward(view.view(), size, &mut d_input),
            Self::Expand(one, three) => {
                let (left, right) = view.view().split_at(Axis(1), one.outputs());
                one.backward(left, size, &mut d_input);
                three.backward(right, size, &mut d_input);
            }
        }
        d_input
    }
}
