//! Functions of `surface-query`.

use anyhow::{Context, Result, ensure};
use glam::Vec3;
use rayon::prelude::*;
use rigged::Mesh;
use surface_query::{MeshDistance, Pyramid, SurfaceQuery, SurfaceQueryConfig};

use super::input::Input;
use super::output::{Output, count};

/// Most levels of a pyramid.
const MAX_LEVELS: i64 = 32;

/// Points, at least one.
fn some_points(input: &mut Input) -> Result<Vec<Vec3>> {
    let points = input.points("points")?;
    ensure!(!points.is_empty(), input.wrong("points", "holds no points"));
    Ok(points)
}

pub fn fps(mut input: Input, output: &mut Output) -> Result<()> {
    let points = some_points(&mut input)?;
    let ratio = input.float("ratio")?;
    ensure!(ratio > 0.0 && ratio <= 1.0, input.wrong("ratio", &format!("is {ratio}, expected above 0, at most 1")));
    let levels = input.integer("levels", 1..=MAX_LEVELS)?;
    count("level_1 and the others", &[points.len(), levels])?;
    let pyramid = Pyramid::new(&points, ratio, levels);
    for (l, level) in pyramid.levels.into_iter().enumerate().skip(1) {
        output.indices(&format!("level_{l}"), &[level.len()], level)?;
    }
    Ok(())
}

pub fn knn(mut input: Input, output: &mut Output) -> Result<()> {
    let points = some_points(&mut input)?;
    let queries = input.points("queries")?;
    let k = input.integer("k", 1..=points.len() as i64)?;
    let shape = [queries.len(), k];
    let config = SurfaceQueryConfig { k, coarse_levels: 0, ..Default::default() };
    let mut indices = vec![0; count("indices", &shape)?];
    let search = SurfaceQuery::new(&points, &[], &config).context("k")?;
    indices.par_chunks_mut(k).zip(&queries).for_each(|(indices, &q)| search.neighbours(q, indices));
    // From the squares that the search ranks by, so that equal ones stay equal.
    let distance = |i: u32, q: Vec3| f64::from((q - points[i as usize]).length_squared()).sqrt() as f32;
    let distances = (indices.chunks(k).zip(&queries)).flat_map(|(row, &q)| row.iter().map(move |&i| (i, q)));
    let distances = distances.map(|(i, q)| distance(i, q)).collect();
    output.floats("distances", &shape, distances)?;
    output.indices("indices", &shape, indices)
}

pub fn surface(mut input: Input, mesh: &Mesh, output: &mut Output) -> Result<()> {
    let queries = input.points("queries")?;
    // The paper's neighbourhoods: ratio 0.25, k = 5, 4 levels.
    let config = SurfaceQueryConfig::default();
    let search = SurfaceQuery::new(&mesh.vertices, &mesh.faces, &config).context("the mesh")?;
    let exact = MeshDistance::new(&mesh.vertices, &mesh.faces).context("the mesh")?;
    let levels = config.coarse_levels + 1;
    let mut indices = vec![0; count("indices", &[queries.len(), levels, config.k])?];
    indices
        .par_chunks_mut(search.neighbours_per_query())
        .zip(&queries)
        .for_each(|(indices, &q)| search.neighbours(q, indices));
    let rows = indices.chunks(search.neighbours_per_query());
    let blended: Vec<_> = queries.iter().zip(rows).map(|(&q, row)| search.blend(q, &row[..config.k])).collect();
    let closest: Vec<_> = queries.par_iter().map(|&q| exact.closest(q)).collect();
    let n = queries.len();
    let points = |of: &dyn Fn(usize) -> Vec3| (0..n).map(of).collect::<Vec<_>>();
    output.vectors("blended", &[n, 3], &points(&|i| blended[i].point))?;
    output.floats("signed_distance", &[n], blended.iter().map(|b| b.signed_distance).collect())?;
    output.vectors("closest_point", &[n, 3], &points(&|i| closest[i].point))?;
    output.floats("exact_signed_distance", &[n], closest.iter().map(|c| c.signed_distance).collect())?;
    output.indices("indices", &[n, levels, config.k], indices)
}
