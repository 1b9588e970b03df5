//! Functions of `hashgrid`.

use anyhow::{Context, Result, ensure};
use hashgrid::{HashGrid, MAX_RESOLUTION};

use super::input::Input;
use super::output::{Output, count};

pub fn encode(mut input: Input, output: &mut Output) -> Result<()> {
    let (shape, points) = input.floats_in("points", &[None, None], 0.0..=1.0)?;
    match shape[1] {
        2 => encode_in::<2>(input, &points, output),
        3 => encode_in::<3>(input, &points, output),
        4 => encode_in::<4>(input, &points, output),
        _ => Err(input.wrong("points", &format!("has shape {shape:?}, expected [_, 2], [_, 3] or [_, 4]"))),
    }
}

fn encode_in<const D: usize>(mut input: Input, points: &[f32], output: &mut Output) -> Result<()> {
    let points = points.as_chunks::<D>().0;
    let resolutions: Vec<u32> =
        (input.integers("resolutions", 1..=i64::from(MAX_RESOLUTION))?).into_iter().map(|n| n as u32).collect();
    let levels = resolutions.len();
    let (shape, table) = input.floats("table", &[Some(levels), None, None])?;
    let (rows, features) = (shape[1], shape[2]);
    ensure!(rows.is_power_of_two(), input.wrong("table", &format!("has {rows} rows a level, expected a power of two")));
    let grid = HashGrid::<D>::with_resolutions(&resolutions, features, rows.ilog2()).context("table or resolutions")?;
    let width = grid.num_features();
    let mut encoded = vec![0.0; count("features", &[points.len(), width])?];

    // A dense level of the crate's table holds only the rows it has.
    let used: Vec<_> = (0..levels).map(|l| grid.level_range(l)).collect();
    let flat: Vec<f32> = (used.iter().enumerate())
        .flat_map(|(l, range)| &table[l * rows * features..][..range.len()])
        .copied()
        .collect();
    grid.encode(&flat, points, &mut encoded);
    let layout = grid.layout(points.len());
    let mut feature_rows = vec![0.0; encoded.len()];
    layout.to_rows(&encoded, 0..points.len(), &mut feature_rows, width);
    output.floats("features", &[points.len(), width], feature_rows)?;
    if !input.has("d_features") {
        return Ok(());
    }
    let (_, d_rows) = input.floats("d_features", &[Some(points.len()), Some(width)])?;
    let mut d_features = encoded;
    layout.from_rows(&d_rows, width, 0..points.len(), &mut d_features);
    let mut d_flat = vec![0.0; flat.len()];
    grid.encode_backward(points, &d_features, &mut d_flat);
    let mut d_table = vec![0.0; table.len()];
    for (l, range) in used.into_iter().enumerate() {
        d_table[l * rows * features..][..range.len()].copy_from_slice(&d_flat[range]);
    }
    let mut d_points = vec![[0.0; D]; points.len()];
    grid.encode_backward_points(&flat, points, &d_features, &mut d_points);
    output.floats("d_table", &shape, d_table)?;
    output.floats("d_points", &[points.len(), D], d_points.into_flattened())
}
