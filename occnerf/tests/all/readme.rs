//! The README's table of presets is made from the presets.

use occnerf::{Config, DistanceKind, Method, MotionKind, Preset};

fn row(name: &str, cell: impl Fn(&Config) -> String) -> String {
    let presets = [Preset::Fast, Preset::Balanced, Preset::Paper];
    let cells = presets.map(|preset| cell(&Config::preset(preset, Method::Occnerf)));
    format!("| {name} | {} |\n", cells.join(" | "))
}

fn centimetres(metres: f32) -> f32 {
    (metres * 1000.0).round() / 10.0
}

fn table() -> String {
    let head = "| | `fast` | `balanced` | `paper` |\n| --- | --- | --- | --- |\n".to_owned();
    let rows = [
        row("steps", |c| c.steps.to_string()),
        row("patches a step, side in pixels, samples a ray", |c| {
            format!("{}, {}, {}", c.patches, c.patch_size, c.samples)
        }),
        row("hidden layers of F × width", |c| format!("{} × {}", c.field.depth, c.field.width)),
        row("hash grid: levels × features, table, cells an axis", |c| {
            let e = &c.encoding;
            format!("{} × {}, 2^{}, {} to {}", e.levels, e.features, e.log2_table_size, e.n_min, e.n_max)
        }),
        row("d is told apart in, m", |c| format!("{} to {}", c.encoding.distance_min, c.encoding.distance_max)),
        row("neighbours × levels of the surface term", |c| match c.surface.surface_term {
            true => format!("{} × {}", c.surface.k, c.surface.coarse_levels + 1),
            false => "none".to_owned(),
        }),
        row("[v̂, d]", |c| {
            let name = match c.surface.distance {
                DistanceKind::Blended => "blend of vertices",
                DistanceKind::Exact => "closest point",
            };
            name.to_owned()
        }),
        row("motion field", |c| {
            let name = match c.motion.kind {
                MotionKind::Volume => "Gaussian volume",
                MotionKind::Surface => "nearest surface",
            };
            name.to_owned()
        }),
        row("reach outside, depth inside, cm", |c| {
            let [reach, depth] = [c.motion.reach(), c.motion.depth].map(centimetres);
            format!("{reach}, {depth}")
        }),
        row("colours start from", |c| if c.field.prior_colors { "the prior's" } else { "grey" }.to_owned()),
        row("transmittance behind which samples are left out", |c| match c.min_transmittance {
            0.0 => "none".to_owned(),
            t if t < 1e-4 => format!("{t:.0e}"),
            t => t.to_string(),
        }),
        row("steps between looks at where the field is empty", |c| match c.motion.shell_interval {
            0 => "none".to_owned(),
            steps => steps.to_string(),
        }),
        row("λ of squared error, perceptual, completeness", |c| {
            format!("{}, {}, {}", c.loss.mse, c.loss.perceptual, c.loss.completeness)
        }),
        row("rounds of registration, light", |c| format!("{}, {}", c.registration.rounds, c.field.prior_light)),
        row("rates of F, vertices, table, motion", |c| {
            let r = &c.rates;
            format!("{:e}, {:e}, {:e}, {:e}", r.field, r.vertices, r.table, r.motion)
        }),
        row("rates fall to", |c| c.rates.final_fraction.to_string()),
    ];
    head + &rows.concat()
}

#[test]
fn the_readme_shows_the_presets_as_they_are() {
    let readme = include_str!("../../README.md");
    assert!(readme.contains(&table()), "the table should be\n\n{}", table());
}
