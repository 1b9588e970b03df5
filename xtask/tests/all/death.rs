//! Death at any moment: processes are killed, begun again until they end, and must end as if
//! nothing had happened.
//!
//! A few kills by default; `KILLS=200 cargo test -p xtask death:: -- --nocapture` for the
//! table: `KILLS` of `train`, and `KILLS` of all other commands.

use crate::common;

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use common::{QUICK, done, folder, text};
use occnerf::capture::Layout;
use testkit::body::Random;

fn kills() -> usize {
    std::env::var("KILLS").ok().map_or(3, |kills| kills.parse().expect("KILLS is a number"))
}

/// Checks that every result under `folder` is whole: partial ones have names of their own. Returns
/// their number.
fn all_whole(folder: &Path) -> usize {
    let mut count = 0;
    for entry in std::fs::read_dir(folder).into_iter().flatten() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            count += all_whole(&path);
            continue;
        }
        let bytes = std::fs::read(&path).unwrap();
        let whole = match path.extension().and_then(|e| e.to_str()) {
            Some("safetensors") if bytes.len() > 8 => safetensors_is_whole(&bytes),
            Some("json") => serde_json::from_slice::<serde_json::Value>(&bytes).is_ok(),
            Some("toml") => std::str::from_utf8(&bytes).is_ok_and(|text| text.parse::<toml::Table>().is_ok()),
            Some("png") => bytes.ends_with(b"IEND\xaeB`\x82"),
            Some("html") => bytes.ends_with(b"</html>\n"),
            Some("glb") => bytes.get(8..12) == Some(&(bytes.len() as u32).to_le_bytes()[..]),
            Some("md") => bytes.ends_with(b"\n"),
            Some("safetensors") => false,
            _ => continue,
        };
        assert!(whole, "{} is not whole: {} bytes", path.display(), bytes.len());
        count += 1;
    }
    count
}

fn safetensors_is_whole(bytes: &[u8]) -> bool {
    let length = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    let Some(header) = bytes.get(8..8 + length) else { return false };
    let Ok(header) = serde_json::from_slice::<serde_json::Value>(header) else { return false };
    let ends = header.as_object().unwrap().values().filter_map(|entry| entry["data_offsets"][1].as_u64());
    ends.max() == Some((bytes.len() - 8 - length) as u64)
}

/// What is done again and again until it ends by itself.
struct Work<'a> {
    name: &'a str,
    out: PathBuf,
    /// Arguments, given what is in the folder.
    arguments: &'a dyn Fn(&Path) -> Vec<String>,
}

#[derive(Default)]
struct Toll {
    kills: usize,
    ends: usize,
    whole: usize,
    /// Longest that a killed training had gone on after its checkpoint, in seconds.
    lost: f64,
}

/// Runs the work to its end, killing it at random moments up to `longest` milliseconds from its
/// start.
fn until_it_ends(work: &Work<'_>, longest: u64, random: &mut Random, most: usize, toll: &mut Toll) {
    for attempt in 0.. {
        let mut child = Command::new(env!("CARGO_BIN_EXE_xtask"))
            .args((work.arguments)(&work.out))
            .env_remove("SMPL_MODEL")
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let begun = Instant::now();
        let moment = Duration::from_millis(random.below(longest as usize) as u64);
        let kill = attempt < most;
        let ended = loop {
            if let Some(status) = child.try_wait().unwrap() {
                break Some(status);
            }
            if kill && begun.elapsed() >= moment {
                break None;
            }
            std::thread::sleep(Duration::from_millis(1));
        };
        match ended {
            Some(status) => {
                let said = String::from_utf8(child.wait_with_output().unwrap().stderr).unwrap();
                assert!(status.success(), "{}: {said}", work.name);
                toll.ends += 1;
                toll.whole += all_whole(&work.out);
                return;
            }
            None => {
                // SIGKILL.
                child.kill().unwrap();
                child.wait().unwrap();
                toll.kills += 1;
                toll.whole += all_whole(&work.out);
                toll.lost = toll.lost.max(lost(&work.out));
            }
        }
    }
}

/// Seconds from the checkpoint of a run to its last line of log.
fn lost(run: &Path) -> f64 {
    let Ok(log) = std::fs::read_to_string(run.join("train.jsonl")) else { return 0.0 };
    let lines: Vec<serde_json::Value> = log.lines().filter_map(|line| serde_json::from_str(line).ok()).collect();
    let seconds = |line: &serde_json::Value| line["seconds"].as_f64().unwrap_or(0.0);
    let saved = std::fs::read(run.join("checkpoint.safetensors")).map_or(0, |bytes| {
        let length = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
        let header: serde_json::Value = serde_json::from_slice(&bytes[8..8 + length]).unwrap();
        header["__metadata__"]["steps_done"].as_str().unwrap().parse::<u64>().unwrap()
    });
    let kept = lines.iter().rev().find(|line| line["step"].as_u64().is_some_and(|step| step <= saved));
    lines.last().map_or(0.0, seconds) - kept.map_or(0.0, seconds)
}

fn words(text: &[&str]) -> Vec<String> {
    text.iter().map(|word| (*word).to_owned()).collect()
}

fn capture(folder: &Path) -> PathBuf {
    let path = folder.join("capture");
    common::capture(&path, Layout::HumanNerf, 32, 4);
    path
}

#[test]
fn a_training_killed_at_any_moment_ends_the_same_to_the_bit() {
    let folder = folder("killed-training");
    let capture = capture(&folder);
    let of = |out: &Path, more: &[&str]| {
        let run = ["train", text(&capture), "--out", text(out), "--steps", "120"];
        words(&[&run[..], &QUICK, more].concat())
    };
    let whole = folder.join("whole");
    let first = of(&whole, &[]);
    done(&first.iter().map(String::as_str).collect::<Vec<_>>());
    let bytes = |run: &Path| std::fs::read(run.join("checkpoint.safetensors")).unwrap();
    let (mut random, mut lives) = (Random(1), 0);
    // Nearly always writing, and nearly always training.
    for interval in ["0", "0.2"] {
        let mut toll = Toll::default();
        while toll.kills < kills().div_ceil(2) {
            let out = folder.join(format!("life-{lives}"));
            lives += 1;
            let arguments = |out: &Path| {
                let resume = out.join("config.toml").is_file();
                of(out, &[&["--checkpoint-every", interval][..], if resume { &["--resume"] } else { &[] }].concat())
            };
            let work = Work { name: "train", out: out.clone(), arguments: &arguments };
            until_it_ends(&work, 1000, &mut random, 12.min(kills()), &mut toll);
            assert!(bytes(&out) == bytes(&whole), "{}", out.display());
            std::fs::remove_dir_all(&out).unwrap();
        }
        println!(
            "train, a checkpoint every {interval} s: {} kills, {} ends to the same bits, {} files looked at were whole, \
             at most {:.2} s lost",
            toll.kills, toll.ends, toll.whole, toll.lost
        );
        // The log has a line every ten steps, and a save takes its time.
        assert!(toll.lost < 2.0 + interval.parse::<f64>().unwrap());
    }
}

#[test]
fn scores_and_exports_killed_at_any_moment_are_whole_or_absent() {
    let folder = folder("killed-exports");
    let capture = capture(&folder);
    let run = folder.join("run");
    done(&[&["train", text(&capture), "--out", text(&run), "--steps", "10"][..], &QUICK].concat());
    let eval = |run: &Path| words(&["eval", text(run)]);
    let glb = run.join("person.glb");
    let export = |run: &Path| words(&["export", text(run), "--format", "glb", "--out", text(&glb)]);
    let view = |run: &Path| words(&["view", text(run)]);
    let estimators = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data/estimators");
    let (frames, fit) = (estimators.join("frames"), estimators.join("phalp/demo_clip.pkl"));
    let import =
        |out: &Path| words(&["import", "--force", "--frames", text(&frames), "--fit", text(&fit), "--out", text(out)]);
    type Command<'a> = (&'a str, &'a dyn Fn(&Path) -> Vec<String>);
    let mut each: Vec<Command<'_>> = vec![
        ("eval", &eval),
        // Bakes first.
        ("export", &export),
        ("view", &view),
    ];
    if fit.is_file() {
        each.push(("import", &import));
    } else {
        println!("import is skipped: {} is absent", fit.display());
    }
    // Results of commands that are not killed.
    let results = |name: &str, out: &Path| -> Vec<Vec<u8>> {
        let files: &[&str] = match name {
            "export" => &["person.glb", "avatar.safetensors"],
            "view" => &["person.html", "avatar.safetensors"],
            "import" => &["import.json", "metadata.json", "body.safetensors", "masks/000001.png"],
            _ => &[],
        };
        files.iter().map(|file| std::fs::read(out.join(file)).unwrap()).collect()
    };
    let mut random = Random(2);
    for (name, arguments) in &each {
        // Again and again over the old one.
        let out = if *name == "import" { folder.join(name) } else { run.clone() };
        let unbaked = || ["avatar.safetensors", "person.glb", "person.html"].map(|f| std::fs::remove_file(run.join(f)));
        let _ = unbaked();
        let unkilled = arguments(&out);
        let begun = Instant::now();
        done(&unkilled.iter().map(String::as_str).collect::<Vec<_>>());
        // Moments of the whole course on this machine, the last ones of writing included.
        let longest = (begun.elapsed().as_millis() as u64 * 11 / 10).max(20);
        let whole = results(name, &out);
        let mut toll = Toll::default();
        while toll.kills < kills().div_ceil(each.len()) {
            let _ = unbaked();
            until_it_ends(
                &Work { name, out: out.clone(), arguments },
                longest,
                &mut random,
                12.min(kills()),
                &mut toll,
            );
            assert!(results(name, &out) == whole, "{name}: not what it leaves unkilled");
        }
        println!("{name}: {} kills, {} ends, {} files looked at were whole", toll.kills, toll.ends, toll.whole);
    }
}
