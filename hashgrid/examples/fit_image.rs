//! Fits a picture with a 2-D hash grid: `cargo run --release -p hashgrid --example fit_image
//! [OUT.png]`.
//!
//! Three features a level are summed over the levels and are the colour: no network, so that all
//! the detail comes from the grid. Writes the picture beside its fit.

use hashgrid::{HashGrid, HashGridConfig};

const SIDE: usize = 112;
const BATCH: usize = 4096;
const STEPS: usize = 400;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let out = std::env::args().nth(1).unwrap_or_else(|| "fit_image.png".into());
    let config = HashGridConfig { levels: 6, features: 3, log2_table_size: 14, n_min: 4, n_max: 192 };
    let grid = HashGrid::<2>::new(&config)?;
    let width = grid.num_features();
    let mut table = grid.init_table(1);

    let mut features = vec![0.0; BATCH * width];
    let mut d_features = vec![0.0; BATCH * width];
    let (mut d_table, mut first, mut second) =
        (vec![0.0; table.len()], vec![0.0f32; table.len()], vec![0.0f32; table.len()]);
    for step in 1..=STEPS {
        // A low-discrepancy sequence stands in for random points.
        let points: Vec<[f32; 2]> = (step * BATCH..(step + 1) * BATCH)
            .map(|i| [0.754_877_666_246_692_8, 0.569_840_290_998_053_3].map(|g: f64| (i as f64 * g).fract() as f32))
            .collect();
        grid.encode(&table, &points, &mut features);
        let mut loss = 0.0;
        for (i, &point) in points.iter().enumerate() {
            let (color, target) = (sum_levels(&features, i, BATCH), picture(point));
            for level in d_features.chunks_exact_mut(3 * BATCH) {
                for c in 0..3 {
                    level[3 * i + c] = (color[c] - target[c]) / BATCH as f32;
                }
            }
            loss += (0..3).map(|c| (color[c] - target[c]).powi(2)).sum::<f32>() / (3 * BATCH) as f32;
        }
        d_table.fill(0.0);
        grid.encode_backward(&points, &d_features, &mut d_table);
        // Adam with the constants of Müller et al. 2022.
        let (bias_first, bias_second) = (1.0 - 0.9f32.powi(step as i32), 1.0 - 0.99f32.powi(step as i32));
        for i in 0..table.len() {
            first[i] = 0.9 * first[i] + 0.1 * d_table[i];
            second[i] = 0.99 * second[i] + 0.01 * d_table[i] * d_table[i];
            table[i] -= 0.01 * (first[i] / bias_first) / ((second[i] / bias_second).sqrt() + 1e-15);
        }
        if step % 100 == 0 {
            println!("step {step}: {:.2} dB", -10.0 * loss.log10());
        }
    }

    let mut pixels = image::RgbImage::new(2 * SIDE as u32, SIDE as u32);
    let mut line = vec![0.0; SIDE * width];
    for y in 0..SIDE {
        let points: Vec<[f32; 2]> = (0..SIDE).map(|x| [x, y].map(|i| (i as f32 + 0.5) / SIDE as f32)).collect();
        grid.encode(&table, &points, &mut line);
        for x in 0..SIDE {
            let fitted = sum_levels(&line, x, SIDE);
            for (column, color) in [(x, picture(points[x])), (x + SIDE, fitted)] {
                pixels.put_pixel(column as u32, y as u32, image::Rgb(color.map(|c| (c * 255.0 + 0.5) as u8)));
            }
        }
    }
    pixels.save(&out)?;
    println!("{} parameters; wrote {out}", table.len());
    Ok(())
}

/// The colour of point `i`: the sum of its features over the levels.
fn sum_levels(features: &[f32], i: usize, points: usize) -> [f32; 3] {
    let mut color = [0.0; 3];
    for level in features.chunks_exact(3 * points) {
        for c in 0..3 {
            color[c] += level[3 * i + c];
        }
    }
    color
}

/// Rings that get finer towards a corner, on a gradient, with a sharp disc.
fn picture([x, y]: [f32; 2]) -> [f32; 3] {
    let wave = 0.5 + 0.5 * (90.0 * (x * x + y * y)).cos();
    if (x - 0.3).hypot(y - 0.65) < 0.18 {
        return [0.95, 0.75 * y, 0.15];
    }
    [0.15 + 0.5 * x * wave, 0.2 + 0.5 * wave, 0.9 - 0.5 * y]
}
