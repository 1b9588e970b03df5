//! Fits a picture with a 2-D hash grid alone: three features per level, summed to a colour.
//! `cargo run --release -p hashgrid --example fit_image [OUT.png]` writes the picture and its fit.

use hashgrid::{HashGrid, HashGridConfig};

const SIDE: usize = 112;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let config = HashGridConfig { levels: 6, features: 3, log2_table_size: 14, n_min: 4, n_max: 192 };
    let grid = HashGrid::<2>::new(&config)?;
    let points: Vec<_> =
        (0..SIDE * SIDE).map(|i| [i % SIDE, i / SIDE].map(|x| (x as f32 + 0.5) / SIDE as f32)).collect();
    let target: Vec<f32> = points.iter().flat_map(|&point| picture(point)).collect();
    let mut table = grid.init_table(1);
    let (mut d_table, mut m, mut v) = (vec![0.0; table.len()], vec![0.0f32; table.len()], vec![0.0f32; table.len()]);
    let mut features = vec![0.0; points.len() * grid.num_features()];
    let (mut d_features, mut fit) = (features.clone(), target.clone());
    for step in 1..=200 {
        grid.encode(&table, &points, &mut features);
        // Features are (L, Q, F): one image per level.
        let levels: Vec<&[f32]> = features.chunks_exact(fit.len()).collect();
        (fit.iter_mut().enumerate()).for_each(|(i, color)| *color = levels.iter().map(|level| level[i]).sum());
        let mse = fit.iter().zip(&target).map(|(f, t)| (f - t).powi(2)).sum::<f32>() / fit.len() as f32;
        (d_features.iter_mut().enumerate()).for_each(|(i, d)| *d = fit[i % fit.len()] - target[i % fit.len()]);
        d_table.fill(0.0);
        grid.encode_backward(&points, &d_features, &mut d_table);
        // Adam.
        let (m_scale, v_scale) = (1.0 - 0.9f32.powi(step), 1.0 - 0.99f32.powi(step));
        for (i, &d) in d_table.iter().enumerate() {
            (m[i], v[i]) = (0.9 * m[i] + 0.1 * d, 0.99 * v[i] + 0.01 * d * d);
            table[i] -= 0.01 * (m[i] / m_scale) / ((v[i] / v_scale).sqrt() + 1e-12);
        }
        if step % 50 == 0 {
            println!("step {step}: PSNR {:.1} dB", -10.0 * mse.log10());
        }
    }

    let rows = target.chunks_exact(3 * SIDE).zip(fit.chunks_exact(3 * SIDE));
    let bytes = rows.flat_map(|(target, fit)| target.iter().chain(fit)).map(|c| (c * 255.0 + 0.5) as u8).collect();
    let out = std::env::args().nth(1).unwrap_or_else(|| "fit_image.png".into());
    image::RgbImage::from_raw(2 * SIDE as u32, SIDE as u32, bytes).ok_or("no image")?.save(out)?;
    Ok(())
}

/// Disc over rings whose frequency grows with the distance from a corner.
fn picture([x, y]: [f32; 2]) -> [f32; 3] {
    let wave = 0.5 + 0.5 * (90.0 * (x * x + y * y)).cos();
    let rings = [0.15 + 0.5 * x * wave, 0.2 + 0.5 * wave, 0.9 - 0.5 * y];
    if (x - 0.3).hypot(y - 0.65) < 0.18 { [0.95, 0.75 * y, 0.15] } else { rings }
}
