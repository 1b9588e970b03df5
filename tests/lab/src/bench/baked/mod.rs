//! `bench baked`: the baked people of runs against their fields.

mod agreement;
mod baking;
mod charts;
mod scores;
mod speed;

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, Result, ensure};
use clap::Args;
use occnerf::bake::bake;
use occnerf::{FieldRenderer, Lpips, Model, SplitMetrics};

pub use self::baking::Baking;
use self::charts::charted;
use self::scores::{FIELD, Pick, Scores};
use self::speed::{growth, rates, speeds};
use crate::results::{self, Section};
use xtask::network::load_lpips;
use xtask::process::say;
use xtask::run::{peak_rss_bytes, use_threads, write};
use xtask::{pictures, table, train};

const MADE: [&str; 6] = ["baked", "seconds", "vertices", "faces", "holes", "peak MiB"];
/// What the default must not lose.
const KEPT: [(&str, Pick, usize); 4] = [
    ("psnr_mask", |m| m.psnr_mask, 3),
    ("psnr_hidden", |m| m.psnr_hidden, 3),
    ("ssim_mask", |m| m.ssim_mask, 3),
    ("lpips", |m| m.lpips_full, 4),
];

#[derive(Args)]
pub struct BakedArguments {
    /// Run directories: the first is baked in all ways and timed, the others as by default
    #[arg(required = true)]
    runs: Vec<PathBuf>,
    /// Where tables, charts and pictures go
    #[arg(long, default_value = "bench")]
    out: PathBuf,
    /// Longest sides of the atlas, texels
    #[arg(long, value_delimiter = ',', default_value = "2048,256")]
    atlas: Vec<u32>,
    /// Passes of refinement to bake with
    #[arg(long, value_delimiter = ',', default_value = "0,4")]
    refinements: Vec<u32>,
    /// Weights of LPIPS, .safetensors; not measured without
    #[arg(long)]
    lpips: Option<PathBuf>,
    /// Threads [default: all cores]
    #[arg(long)]
    threads: Option<usize>,
    /// Make what is found a section of tests/lab/RESULTS.md
    #[arg(long)]
    publish: bool,
}

/// Runs the bench.
pub fn baked(arguments: &BakedArguments) -> Result<()> {
    let BakedArguments { runs, out, .. } = arguments;
    use_threads(arguments.threads)?;
    let lpips = load_lpips(arguments.lpips.as_deref())?;
    std::fs::create_dir_all(out).with_context(|| out.display().to_string())?;
    let titles = ["capture", "steps"].into_iter().chain(KEPT.map(|kept| kept.0)).map(str::to_owned);
    let mut kept = vec![titles.collect::<Vec<_>>()];
    let mut details = String::new();
    for (at, run) in runs.iter().enumerate() {
        let found = of_run(run, arguments, lpips.as_ref(), at == 0)?;
        kept.extend(found.kept());
        details.push_str(&found.text);
    }
    let text = format!(
        "The field's scores, and from them to those of the person as `render RUN … --baked` draws them, on unseen \
         views:\n\n{}\n{details}",
        table::aligned(&kept, 2)
    );
    write(&out.join("baked.md"), &text)?;
    say!("{text}");
    if arguments.publish {
        let charts = results::charts(out, "baked-")?;
        results::publish(&Section { name: "baked", title: "The baked person", body: &text, charts: &charts })?;
    }
    Ok(())
}

/// What was found of a run.
struct Found {
    name: String,
    steps: String,
    points: Vec<(String, SplitMetrics)>,
    /// Of the points, the one with the default's options.
    default: Option<usize>,
    /// Markdown.
    text: String,
}

impl Found {
    /// What the default keeps of the field's scores.
    fn kept(&self) -> Option<Vec<String>> {
        let (field, baked) = (&self.points.first()?.1, &self.points.get(self.default?)?.1);
        let cell = |&(_, pick, digits): &(&str, Pick, usize)| match (pick(field), pick(baked)) {
            (Some(from), Some(to)) => format!("{from:.digits$} → {to:.digits$}"),
            _ => "–".to_owned(),
        };
        Some([self.name.clone(), self.steps.clone()].into_iter().chain(KEPT.iter().map(cell)).collect())
    }
}

fn of_run(path: &Path, arguments: &BakedArguments, lpips: Option<&Lpips>, timed: bool) -> Result<Found> {
    let (run, source) = crate::scene::of_run(path)?;
    let scene = source.scene(&run.train)?;
    ensure!(!scene.eval.is_empty(), "{}: the capture keeps no views back", run.scene);
    let model = Model::load(path)?;
    let mut scores = Scores::new(&scene, lpips);
    scores.add(FIELD, &mut FieldRenderer::new(&model)?)?;
    let (mut made, mut drawn, mut default) = (vec![MADE.map(str::to_owned).to_vec()], Vec::new(), None);
    let ways = if timed { all(arguments) } else { vec![Baking::default()] };
    for baking in ways {
        let start = Instant::now();
        let (avatar, report) = bake(&model, Some(&scene), &baking.options())?;
        let seconds = start.elapsed().as_secs_f64();
        let name = baking.name(Some(report.side));
        made.push(vec![
            name.rsplit_once(',').map_or(&*name, |(baked, _)| baked).to_owned(),
            format!("{seconds:.1}"),
            report.vertices.to_string(),
            avatar.faces.len().to_string(),
            report.holes.to_string(),
            format!("{:.0}", peak_rss_bytes() as f64 / f64::from(1 << 20)),
        ]);
        let whole = Some(&baking.atlas) == arguments.atlas.first();
        let refined = Some(&baking.refinements) == arguments.refinements.last();
        for smooth in [false, true] {
            let baking = Baking { smooth, ..baking };
            if baking == Baking::default() {
                default = Some(scores.points.len());
            }
            scores.add(&baking.name(Some(report.side)), &mut baking.renderer(&model, &avatar))?;
            if whole && refined && timed {
                drawn.extend(speeds(&model, &avatar, &scene.train[0].view, baking)?);
            }
        }
    }
    let (capture, out) = (&source.capture.name, &arguments.out);
    let name = train::scene_name(Some(capture));
    charted(capture, &scores.points).write(&out.join(format!("baked-frame-{name}")))?;
    pictures::save(&pictures::sheet(&scores.rows), &out.join(format!("views-{name}.png")))?;
    let steps = format!("{} of {}", model.steps_done(), run.train.preset.name());
    let mut text = format!(
        "## {capture}\n\n{}. {steps}, seed {}. Against the truth, and against the field, on unseen views:\n\n{}\n\
         Baking:\n\n{}\n",
        results::set_of(&name),
        run.train.seed,
        table::aligned(&scores.table, 1),
        table::aligned(&made, 1),
    );
    if timed {
        growth(capture, &drawn).write(&out.join("baked-growth"))?;
        let rates = table::aligned(&rates(&drawn), 1);
        text.push_str(&format!(
            "Pictures a second, skinning and light included, fastest of three rounds{}:\n\n{rates}\n",
            busy()
        ));
    }
    Ok(Found { name: capture.clone(), steps, points: scores.points, default, text })
}

/// What else the machine had to do, where the system says so.
fn busy() -> String {
    let load = std::fs::read_to_string("/proc/loadavg").unwrap_or_default();
    load.split(' ').nth(1).map_or(String::new(), |load| format!("; {load} processes ran or waited at a time"))
}

/// Every number of refinements, and smaller atlases.
fn all(arguments: &BakedArguments) -> Vec<Baking> {
    let BakedArguments { refinements, atlas, .. } = arguments;
    let of = |refinements, atlas| Baking { refinements, atlas, ..Baking::default() };
    let whole = refinements.iter().flat_map(|&passes| atlas.first().map(|&side| of(passes, side)));
    let smaller =
        refinements.last().into_iter().flat_map(|&passes| atlas.iter().skip(1).map(move |&side| of(passes, side)));
    whole.chain(smaller).collect()
}
