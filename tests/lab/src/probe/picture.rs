//! Functions of `visibility` and `volrender`: what a camera sees, compositing, image metrics.

use anyhow::{Context, Result, ensure};
use glam::{Affine3A, Mat3, Vec2, Vec3};
use occnerf::Lpips;
use rigged::Mesh;
use visibility::{RayMesh, View, visible_vertices};
use volrender::metrics;
use volrender::{RaySamples, SampleGradients, composite_backward};

use super::input::{Input, vec3s};
use super::output::{Output, count};

/// Most pixels along a side of an image.
const MAX_SIDE: i64 = 1 << 24;

pub fn visible(mut input: Input, mesh: &Mesh, output: &mut Output) -> Result<()> {
    let (_, k) = input.floats("K", &[Some(3), Some(3)])?;
    let (_, e) = input.floats("E", &[Some(3), Some(4)])?;
    let is_calibration = k[0] * k[4] != 0.0 && [k[1], k[3]] == [0.0; 2] && k[6..] == [0.0, 0.0, 1.0];
    ensure!(is_calibration, input.wrong("K", "is no calibration matrix: expected fx 0 cx, 0 fy cy, 0 0 1"));
    // Row-major, glam's constructors take columns.
    let column = |c: usize| Vec3::new(e[c], e[4 + c], e[8 + c]);
    let extrinsics = Affine3A::from_mat3_translation(Mat3::from_cols(column(0), column(1), column(2)), column(3));
    let width = input.integer("width", 1..=MAX_SIDE)? as u32;
    let height = input.integer("height", 1..=MAX_SIDE)? as u32;
    let (focal, centre) = (Vec2::new(k[0], k[4]), Vec2::new(k[2], k[5]));
    let view = View { focal, centre, world_to_camera: extrinsics, width, height };
    ensure!(view.centre_of_projection().is_some(), input.wrong("E", "has no inverse"));
    let rays = RayMesh::new(&mesh.vertices, &mesh.faces).context("the mesh")?;
    let visible = visible_vertices(&rays, &mesh.vertices, &view, None);
    output.booleans("visible", &[visible.len()], visible)
}

pub fn composite(mut input: Input, output: &mut Output) -> Result<()> {
    let (shape, sigma) = input.floats_in("sigma", &[None, None], 0.0..=f32::MAX)?;
    let (rays, samples) = (shape[0], shape[1]);
    ensure!(samples > 0, input.wrong("sigma", "has no samples a ray"));
    let (_, rgb) = input.floats("rgb", &[Some(rays), Some(samples), Some(3)])?;
    let (_, edges) = input.floats("edges", &[Some(rays), Some(samples + 1)])?;
    if let Some(ray) = edges.chunks(samples + 1).position(|row| !row.is_sorted()) {
        return Err(input.wrong("edges", &format!("decreases along ray {ray}")));
    }
    let (_, background) = input.floats("background", &[Some(3)])?;
    let background = Vec3::from_slice(&background);
    let d_color = if input.has("d_color") { Some(input.floats("d_color", &[Some(rays), Some(3)])?.1) } else { None };
    let (rgb, d_color) = (vec3s(&rgb), d_color.map(|d| vec3s(&d)));

    count("rgb", &[rays, samples, 3])?;
    let likelihood = vec![1.0; samples];
    let mut weights = vec![0.0; rays * samples];
    let mut d_sigma = vec![0.0; d_color.as_ref().map_or(0, |_| rays * samples)];
    let mut d_rgb = vec![Vec3::ZERO; d_sigma.len()];
    let mut d_likelihood = vec![0.0; samples];
    let mut pixels = Vec::with_capacity(rays);
    for ray in 0..rays {
        let row = ray * samples..(ray + 1) * samples;
        let edges = &edges[ray * (samples + 1)..][..samples + 1];
        let t: Vec<f32> = edges.windows(2).map(|bin| 0.5 * bin[0] + 0.5 * bin[1]).collect();
        let delta: Vec<f32> = edges.windows(2).map(|bin| bin[1] - bin[0]).collect();
        let (sigma, rgb, weights) = (&sigma[row.clone()], &rgb[row.clone()], &mut weights[row.clone()]);
        let samples = RaySamples { sigma, likelihood: &likelihood, delta: &delta, t: &t, rgb };
        pixels.push(volrender::composite(samples, background, weights));
        if let Some(d_color) = &d_color {
            let (d_sigma, d_rgb) = (&mut d_sigma[row.clone()], &mut d_rgb[row]);
            let gradients = SampleGradients { d_sigma, d_rgb, d_likelihood: &mut d_likelihood };
            composite_backward(samples, background, weights, d_color[ray], 0.0, gradients);
        }
    }
    output.vectors("color", &[rays, 3], &pixels.iter().map(|p| p.color).collect::<Vec<_>>())?;
    output.floats("opacity", &[rays], pixels.iter().map(|p| p.opacity).collect())?;
    output.floats("depth", &[rays], pixels.iter().map(|p| p.depth).collect())?;
    output.floats("weights", &[rays, samples], weights)?;
    // Where every alpha is 0 they are all the largest.
    output.indices("termination", &[rays], pixels.iter().map(|p| p.termination.unwrap_or(0)))?;
    if d_color.is_some() {
        output.floats("d_sigma", &[rays, samples], d_sigma)?;
        output.vectors("d_rgb", &[rays, samples, 3], &d_rgb)?;
    }
    Ok(())
}

pub fn metrics(mut input: Input, lpips: Option<&Lpips>, output: &mut Output) -> Result<()> {
    let (shape, a) = input.floats_in("a", &[None, None, Some(3)], 0.0..=1.0)?;
    let (height, width) = (shape[0], shape[1]);
    let (_, b) = input.floats_in("b", &[Some(height), Some(width), Some(3)], 0.0..=1.0)?;
    let mask = input.booleans("mask", height, width)?;
    ensure!(mask.contains(&true), input.wrong("mask", "is true nowhere"));
    let ssim = metrics::ssim(&a, &b, width, height).context("a and b")?;
    let psnr_mask = metrics::psnr_masked(&a, &b, &mask).context("mask")?;
    let ssim_mask = metrics::ssim_masked(&a, &b, &mask, width, height).context("mask")?;
    for (key, value) in
        [("psnr", metrics::psnr(&a, &b)), ("ssim", ssim), ("psnr_mask", psnr_mask), ("ssim_mask", ssim_mask)]
    {
        // The PSNR of equal images is infinite.
        output.numbers(key, &[], vec![value as f32])?;
    }
    if let Some(lpips) = lpips {
        let values = lpips.distance(&a, &b, width, height).context("a and b")?;
        output.numbers("lpips", &[], values.iter().map(|&v| v as f32).collect())?;
    }
    Ok(())
}
