//! The networks: SqueezeNet 1.1, VGG16 and AlexNet up to their last tap, with torchvision's names.

use ndarray::Axis;

use crate::conv::Conv;
use crate::error::Error;
use crate::maps::{Maps, Window, max_pool, max_pool_backward, rectify_backward};

/// Returns the tensor of a name and shape.
pub(crate) type Reader<'a> = dyn FnMut(&str, &[usize]) -> Result<Vec<f32>, Error> + 'a;

/// Network whose features are compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Trunk {
    /// VGG16: 59 MB of weights; images of at least 16 pixels a side.
    Vgg16,
    /// AlexNet: 10 MB of weights; images of at least 31 pixels a side.
    AlexNet,
    /// SqueezeNet 1.1: 3 MB of weights; images of at least 17 pixels a side.
    SqueezeNet,
}

impl Trunk {
    /// Name for results and messages: `vgg16`, `alexnet` or `squeezenet`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Vgg16 => "vgg16",
            Self::AlexNet => "alexnet",
            Self::SqueezeNet => "squeezenet",
        }
    }

    /// Channels at each tap.
    pub(crate) fn taps(self) -> &'static [usize] {
        match self {
            Self::Vgg16 => &[64, 128, 256, 512, 512],
            Self::AlexNet => &[64, 192, 384, 256, 256],
            Self::SqueezeNet => &[64, 128, 256, 384, 384, 512, 512],
        }
    }

    fn plan(self) -> &'static [Plan] {
        match self {
            Self::Vgg16 => &VGG16,
            Self::AlexNet => &ALEXNET,
            Self::SqueezeNet => &SQUEEZENET,
        }
    }
}

/// A layer of torchvision's `features`; the first number is its index there.
enum Plan {
    /// Index, outputs, kernel size, stride, padding.
    Conv(usize, usize, usize, usize, usize),
    /// Kernel size, stride, `ceil_mode`.
    Pool(usize, usize, bool),
    /// Index, outputs of `squeeze`, outputs of each `expand`.
    Fire(usize, usize, usize),
    /// The output of the layer before is compared.
    Tap,
}
use Plan::{Conv as C, Fire as F, Pool as P, Tap as T};

#[rustfmt::skip]
const VGG16: [Plan; 22] = [
    C(0, 64, 3, 1, 1), C(2, 64, 3, 1, 1), T, P(2, 2, false),
    C(5, 128, 3, 1, 1), C(7, 128, 3, 1, 1), T, P(2, 2, false),
    C(10, 256, 3, 1, 1), C(12, 256, 3, 1, 1), C(14, 256, 3, 1, 1), T, P(2, 2, false),
    C(17, 512, 3, 1, 1), C(19, 512, 3, 1, 1), C(21, 512, 3, 1, 1), T, P(2, 2, false),
    C(24, 512, 3, 1, 1), C(26, 512, 3, 1, 1), C(28, 512, 3, 1, 1), T,
];
#[rustfmt::skip]
const ALEXNET: [Plan; 12] = [
    C(0, 64, 11, 4, 2), T, P(3, 2, false),
    C(3, 192, 5, 1, 2), T, P(3, 2, false),
    C(6, 384, 3, 1, 1), T, C(8, 256, 3, 1, 1), T, C(10, 256, 3, 1, 1), T,
];
#[rustfmt::skip]
const SQUEEZENET: [Plan; 19] = [
    C(0, 64, 3, 2, 0), T, P(3, 2, true),
    F(3, 16, 64), F(4, 16, 64), T, P(3, 2, true),
    F(6, 32, 128), F(7, 32, 128), T, P(3, 2, true),
    F(9, 48, 192), T, F(10, 48, 192), T, F(11, 64, 256), T, F(12, 64, 256), T,
];

/// A step of the computation.
enum Layer {
    Pool(Window),
    /// Convolutions of the same input, their outputs side by side.
    Conv(Vec<Conv>),
}

/// A trunk with its weights.
pub(crate) struct Network {
    layers: Vec<Layer>,
    /// Index of the layer before each tap.
    taps: Vec<usize>,
}

impl Network {
    /// Builds `trunk` from the tensors that `read` returns.
    pub fn new(trunk: Trunk, read: &mut Reader<'_>) -> Result<Self, Error> {
        let mut network = Self { layers: Vec::new(), taps: Vec::new() };
        let mut channels = 3;
        let mut conv = |name: String, inputs: usize, outputs: usize, [size, stride, padding]: [usize; 3]| {
            let weight = read(&format!("{name}.weight"), &[outputs, inputs, size, size])?;
            let bias = read(&format!("{name}.bias"), &[outputs])?;
            Ok::<_, Error>(Conv::new(Window { size, stride, padding, ceil: false }, inputs, &weight, bias))
        };
        for step in trunk.plan() {
            match *step {
                C(index, outputs, size, stride, padding) => {
                    let only = conv(format!("features.{index}"), channels, outputs, [size, stride, padding])?;
                    network.layers.push(Layer::Conv(vec![only]));
                    channels = outputs;
                }
                F(index, squeeze, expand) => {
                    let name = |part: &str| format!("features.{index}.{part}");
                    network.layers.push(Layer::Conv(vec![conv(name("squeeze"), channels, squeeze, [1, 1, 0])?]));
                    let one = conv(name("expand1x1"), squeeze, expand, [1, 1, 0])?;
                    let three = conv(name("expand3x3"), squeeze, expand, [3, 1, 1])?;
                    network.layers.push(Layer::Conv(vec![one, three]));
                    channels = 2 * expand;
                }
                P(size, stride, ceil) => network.layers.push(Layer::Pool(Window { size, stride, padding: 0, ceil })),
                T => network.taps.push(network.layers.len() - 1),
            }
        }
        Ok(network)
    }

    /// Whether an image is large enough for every layer to have an output.
    pub fn takes(&self, height: usize, width: usize) -> bool {
        let step = |size: Option<[usize; 2]>, layer: &Layer| layer.size(size?);
        self.layers.iter().fold(Some([height, width]), step).is_some()
    }

    /// Runs all layers; `at_tap` gets each tap's number and output. Returns the outputs of all
    /// layers if `keep` is set, else only that of the last.
    pub fn forward(&self, input: &Maps, mut at_tap: impl FnMut(usize, &Maps), keep: bool) -> Vec<Maps> {
        let mut outputs: Vec<Maps> = Vec::new();
        for (index, layer) in self.layers.iter().enumerate() {
            let out = layer.forward(outputs.last().unwrap_or(input));
            if let Some(tap) = self.tap(index) {
                at_tap(tap, &out);
            }
            if !keep {
                outputs.clear();
            }
            outputs.push(out);
        }
        outputs
    }

    /// Gradient by the first `count` images of `input`. `outputs` are those of all layers; `at_tap`
    /// gets a tap's number and output and adds the gradient by that output.
    pub fn backward(
        &self,
        input: &Maps,
        outputs: &[Maps],
        count: usize,
        mut at_tap: impl FnMut(usize, &Maps, &mut Maps),
    ) -> Maps {
        let mut d_out = Maps::default();
        for (index, layer) in self.layers.iter().enumerate().rev() {
            let out = &outputs[index];
            if d_out.data.is_empty() {
                d_out = Maps::zeros(count, [out.height, out.width], out.channels);
            }
            if let Some(tap) = self.tap(index) {
                at_tap(tap, out, &mut d_out);
            }
            let before = if index == 0 { input } else { &outputs[index - 1] };
            d_out = layer.backward(before, out, d_out);
        }
        d_out
    }

    /// Number of the tap after a layer.
    fn tap(&self, layer: usize) -> Option<usize> {
        self.taps.iter().position(|&before| before == layer)
    }
}

impl Layer {
    /// Height and width of the output; `None` for an input that is too small.
    fn size(&self, [height, width]: [usize; 2]) -> Option<[usize; 2]> {
        let window = match self {
            Self::Pool(window) => window,
            Self::Conv(convs) => &convs.first()?.window,
        };
        Some([window.positions(height)?, window.positions(width)?])
    }

    fn forward(&self, input: &Maps) -> Maps {
        let size = self.size([input.height, input.width]).expect("`Network::takes` was asked");
        let convs = match self {
            Self::Pool(window) => return max_pool(input, *window, size),
            Self::Conv(convs) => convs,
        };
        let mut out = Maps::zeros(input.count, size, convs.iter().map(Conv::outputs).sum());
        let mut rest = out.pixels_mut();
        for conv in convs {
            let (own, right) = rest.split_at(Axis(1), conv.outputs());
            conv.forward(input, size, own);
            rest = right;
        }
        out
    }

    fn backward(&self, input: &Maps, out: &Maps, mut d_out: Maps) -> Maps {
        let convs = match self {
            Self::Pool(window) => return max_pool_backward(input, out, *window, &d_out),
            Self::Conv(convs) => convs,
        };
        rectify_backward(out, &mut d_out);
        let mut d_input = Maps::zeros(d_out.count, [input.height, input.width], input.channels);
        let mut rest = d_out.pixels_mut();
        for conv in convs {
            let (own, right) = rest.split_at(Axis(1), conv.outputs());
            conv.backward(own.view(), [out.height, out.width], &mut d_input);
            rest = right;
        }
        d_input
    }
}
