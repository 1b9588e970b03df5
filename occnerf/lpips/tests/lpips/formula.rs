//! Weights from a formula: networks to be compared without their files.

use std::collections::BTreeMap;

use lpips::{Lpips, Trunk};
use safetensors::tensor::{Dtype, TensorView, serialize};
use testkit::body::Random;

/// Shape and values of each tensor.
pub type Tensors = BTreeMap<String, (Vec<usize>, Vec<f32>)>;

/// In [−1, 1), a function of its address.
pub fn uniform(address: u64) -> f32 {
    Random(address).unit() * 2.0 - 1.0
}

/// Weight (`bias` false) or bias number `k` of a layer that sees `fan_in` values.
pub fn weight(layer: u64, bias: bool, fan_in: usize, k: usize) -> f32 {
    let u = f64::from(uniform((k as u64).wrapping_add(layer << 32).wrapping_add(u64::from(bias) << 48)));
    (if bias { u * 0.05 } else { u * (6.0 / fan_in as f64).sqrt() }) as f32
}

/// Every tensor of a network: formula weights, and `lin` for the linear layers.
pub fn tensor(name: &str, shape: &[usize], lin: &mut dyn FnMut(&str) -> Vec<f32>) -> Vec<f32> {
    if name.starts_with("lin") {
        return lin(name);
    }
    let number: u64 = name.split('.').nth(1).and_then(|n| n.parse().ok()).unwrap();
    // The parts of a fire module differ.
    let part = u64::from(name.contains("expand1x1")) * 64 + u64::from(name.contains("expand3x3")) * 128;
    let fan_in = shape[1..].iter().product();
    (0..shape.iter().product()).map(|k| weight(number + part, shape.len() == 1, fan_in, k)).collect()
}

/// A network of formula weights, its linear layers all ones.
pub fn network(trunk: Trunk) -> Lpips {
    Lpips::new(trunk, |name, shape| Ok(tensor(name, shape, &mut |_| vec![1.0; shape[0]]))).unwrap()
}

/// Formula weights of SqueezeNet: trunk, and linear layers as the package names and shapes them.
pub fn weights() -> (Tensors, Tensors) {
    let (mut trunk, mut lin) = (Tensors::new(), Tensors::new());
    Lpips::new(Trunk::SqueezeNet, |name, shape| {
        let values = tensor(name, shape, &mut |_| vec![1.0; shape[0]]);
        match name.strip_suffix(".weight").filter(|name| name.starts_with("lin")) {
            Some(layer) => lin.insert(format!("{layer}.model.1.weight"), (vec![1, shape[0], 1, 1], values.clone())),
            None => trunk.insert(name.to_owned(), (shape.to_vec(), values.clone())),
        };
        Ok(values)
    })
    .unwrap();
    (trunk, lin)
}

pub fn bytes(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

pub fn safetensors(tensors: &Tensors) -> Vec<u8> {
    let data: Vec<_> = tensors.iter().map(|(name, (shape, values))| (name, shape, bytes(values))).collect();
    let views =
        data.iter().map(|(name, shape, data)| (name, TensorView::new(Dtype::F32, (*shape).clone(), data).unwrap()));
    serialize(views.collect::<Vec<_>>(), None).unwrap()
}
