//! What the surroundings do to a run: closed pipes, full disks, folders in use, signals. Nothing is
//! lost.

use crate::common;

use std::collections::BTreeMap;
use std::fs::File;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use common::{QUICK, bytes, done, folder, limited, refused, stderr, text, xtask};
use occnerf::bake::Avatar;
use occnerf::capture::Layout;
use serde_json::Value;

/// A capture that trains at a thousand steps a minute or more.
fn capture() -> &'static Path {
    static MADE: OnceLock<PathBuf> = OnceLock::new();
    MADE.get_or_init(|| {
        let path = folder("faults").join("capture");
        common::capture(&path, Layout::HumanNerf, 32, 4);
        path
    })
}

fn training<'a>(out: &'a Path, steps: &'a str) -> Vec<&'a str> {
    [&["train", text(capture()), "--out", text(out), "--steps", steps][..], &QUICK].concat()
}

fn start(arguments: &[&str]) -> Child {
    Command::new(env!("CARGO_BIN_EXE_xtask"))
        .args(arguments)
        .env_remove("SMPL_MODEL")
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap()
}

fn wait_for(path: &Path) {
    let begun = Instant::now();
    while !path.exists() {
        assert!(begun.elapsed() < Duration::from_secs(120), "{}", path.display());
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// Whether this process was started to ignore a signal, as in the background of a script: what it
/// starts does so too.
fn ignored(signal: u32) -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:")).unwrap();
    u64::from_str_radix(mask.trim(), 16).unwrap() >> (signal - 1) & 1 == 1
}

/// Sends a signal, and returns the exit code, none of a program that died, and what was said.
fn stopped(child: Child, signal: &str) -> (Option<i32>, String) {
    let sent = Command::new("kill").args([signal, &child.id().to_string()]).status().unwrap();
    assert!(sent.success());
    let output = child.wait_with_output().unwrap();
    (output.status.code(), stderr(&output))
}

#[test]
fn a_training_that_nobody_listens_to_is_trained_and_scored() {
    let folder = folder("deaf");
    let full = || File::options().write(true).open("/dev/full").unwrap();
    let closed = || {
        let (reader, writer) = std::io::pipe().unwrap();
        drop(reader);
        writer
    };
    let places: [(&str, Stdio, Stdio); 3] = [
        ("full", full().into(), full().into()),
        ("closed", closed().into(), closed().into()),
        ("half", closed().into(), Stdio::null()),
    ];
    for (name, out, err) in places {
        let run = folder.join(name);
        let mut command = Command::new(env!("CARGO_BIN_EXE_xtask"));
        let status = command.args(training(&run, "12")).stdout(out).stderr(err).status().unwrap();
        assert_eq!(status.code(), Some(0), "{name}");
        assert!(run.join("metrics.json").is_file() && run.join("report.html").is_file(), "{name}");
    }
}

#[test]
fn a_folder_in_use_is_refused_until_its_process_has_died() {
    let run = folder("in-use").join("run");
    let long = [training(&run, "100000"), vec!["--checkpoint-every", "0.01"]].concat();
    let mut first = start(&long);
    wait_for(&run.join("checkpoint.safetensors"));
    let other = xtask(&training(&run, "5"));
    let said = stderr(&other);
    assert_eq!(other.status.code(), Some(4), "{said}");
    assert!(said.contains("in use by another process") && said.matches("error").count() == 1, "{said}");
    assert_eq!(xtask(&["eval", text(&run)]).status.code(), Some(4));
    let export = ["export", text(&run), "--out", "/dev/null", "--format", "glb"];
    for reader in [&export[..], &["view", text(&run)], &["render", text(&run), "tpose"]] {
        assert_eq!(xtask(reader).status.code(), Some(4), "{reader:?}");
    }
    first.kill().unwrap();
    first.wait().unwrap();
    refused(&training(&run, "5"), &["already holds a run", "--resume"]);
    let config = std::fs::read_to_string(run.join("config.toml")).unwrap();
    assert!(config.contains("steps = 100000"), "{config}");
}

#[test]
fn signals_save_first_and_the_end_is_the_same_to_the_bit_after_a_death_too() {
    let folder = folder("signals");
    let whole = folder.join("whole");
    done(&training(&whole, "80"));
    // Who is killed saves nothing: nearly always writing a checkpoint.
    let cases =
        [("-INT", Some(130), "30"), ("-TERM", Some(143), "30"), ("-HUP", Some(129), "30"), ("-KILL", None, "0")];
    for (signal, code, every) in cases {
        if code.is_some_and(|code| ignored(code as u32 - 128)) {
            println!("skipped: {signal} is ignored here");
            continue;
        }
        let run = folder.join(signal);
        let child = start(&[training(&run, "80"), vec!["--checkpoint-every", every]].concat());
        wait_for(&run.join(if code.is_some() { "train.jsonl" } else { "checkpoint.safetensors" }));
        let (ended, said) = stopped(child, signal);
        assert_eq!(ended, code, "{said}");
        let advice = said.contains("is saved") && said.contains("--resume --out") && !said.contains("error");
        assert!(advice || code.is_none(), "{said}");
        assert!(!run.join("metrics.json").exists());
        done(&["train", "--resume", "--out", text(&run)]);
        let [ours, theirs] = [&run, &whole].map(|run| bytes(&run.join("checkpoint.safetensors")));
        assert!(ours == theirs, "{signal}");
    }
}

/// A second signal does not wait for a save; so short that the first may have done it.
#[test]
fn a_second_signal_ends_at_once_and_leaves_the_last_checkpoint() {
    if ignored(15) {
        println!("skipped: SIGTERM is ignored here");
        return;
    }
    let run = folder("twice").join("run");
    let child = start(&[training(&run, "100000"), vec!["--checkpoint-every", "0"]].concat());
    wait_for(&run.join("checkpoint.safetensors"));
    let kill = format!("kill -TERM {0}; kill -TERM {0}", child.id());
    assert!(Command::new("sh").args(["-c", &kill]).status().unwrap().success());
    let begun = Instant::now();
    let output = child.wait_with_output().unwrap();
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(143), "{said}");
    assert!(begun.elapsed() < Duration::from_secs(5) && said.contains("stopped by SIGTERM"), "{said}");
    done(&["train", "--resume", "--stop-after", "1", "--out", text(&run)]);
}

#[test]
fn what_the_program_was_started_to_ignore_stays_ignored() {
    let run = folder("nohup").join("run");
    let mut command = Command::new("nohup");
    let child = command.arg(env!("CARGO_BIN_EXE_xtask")).args(training(&run, "80"));
    let mut child = child.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    wait_for(&run.join("train.jsonl"));
    assert!(Command::new("kill").args(["-HUP", &child.id().to_string()]).status().unwrap().success());
    assert_eq!(child.wait().unwrap().code(), Some(0));
    assert!(run.join("metrics.json").is_file());
}

/// A directory is in the place of the checkpoint for a while.
#[test]
fn a_periodic_save_that_fails_is_tried_again() {
    let run = folder("save-again").join("run");
    let child = start(&[training(&run, "150"), vec!["--checkpoint-every", "0.01"]].concat());
    let checkpoint = run.join("checkpoint.safetensors");
    wait_for(&checkpoint);
    while std::fs::remove_file(&checkpoint).and_then(|()| std::fs::create_dir(&checkpoint)).is_err() {}
    std::thread::sleep(Duration::from_millis(300));
    std::fs::remove_dir(&checkpoint).unwrap();
    let output = child.wait_with_output().unwrap();
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(0), "{said}");
    assert!(said.contains("tries again") && said.contains("is a directory"), "{said}");
    assert!(run.join("metrics.json").is_file() && run.join("checkpoint.safetensors").is_file());
}

#[test]
fn a_result_that_cannot_be_written_has_an_exit_code_and_leaves_the_old_one() {
    let run = folder("unwritable").join("run");
    done(&training(&run, "10"));
    let refusal = |arguments: &[&str], word: &str| {
        let output = xtask(arguments);
        let said = stderr(&output);
        assert_eq!(output.status.code(), Some(3), "{said}");
        assert!(said.contains(word) && said.contains("cannot be written"), "{said}");
        assert_eq!(said.matches("os error").count(), 1, "{said}");
    };
    for name in ["report.html", "metrics.json"] {
        std::fs::remove_file(run.join(name)).unwrap();
        symlink("/dev/full", run.join(name)).unwrap();
        refusal(&["eval", text(&run)], name);
    }
    refusal(&training(Path::new("/dev/null/run"), "5"), "/dev/null/run");
}

/// Whether a file that may be replaced has all of its bytes.
fn is_whole(path: &Path) -> bool {
    let bytes = bytes(path);
    match path.extension().and_then(|extension| extension.to_str()) {
        Some("safetensors") => path.ends_with("person.safetensors") || Avatar::load(path).is_ok(),
        Some("json") => serde_json::from_slice::<Value>(&bytes).is_ok(),
        Some("png") => bytes.ends_with(b"IEND\xaeB`\x82"),
        Some("html") => bytes.ends_with(b"</html>\n"),
        _ => true,
    }
}

/// Every file below a folder, with its content.
fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    for entry in std::fs::read_dir(folder).into_iter().flatten() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            found.append(&mut files(&path));
        } else {
            found.insert(path.clone(), bytes(&path));
        }
    }
    found
}

#[test]
fn where_the_disk_is_full_every_command_says_so_in_one_line_and_leaves_what_was_there() {
    let folder = folder("full-disk");
    let run = folder.join("run");
    done(&training(&run, "10"));
    let glb = folder.join("person.glb");
    let export = ["export", text(&run), "--format", "glb", "--out", text(&glb)];
    let fresh = folder.join("fresh");
    let fresh = training(&fresh, "10");
    let resumed = ["train", "--resume", "--steps", "12", "--out", text(&run)];
    let view = ["view", text(&run)];
    let nowhere = training(Path::new("/dev/null/run"), "10");
    let cases: [(u32, &[&str]); 6] = [
        (1, &nowhere),
        (1, &fresh),
        (64, &resumed),
        (1, &["eval", text(&run)]),
        // The baked person itself.
        (16, &export),
        (16, &view),
    ];
    for (kib, arguments) in cases {
        let before = files(&run);
        // No file may have more than this many KiB, in blocks of 512 bytes, which ends a write as a
        // full disk does.
        let output = limited(&format!("trap '' XFSZ; ulimit -f {};", 2 * kib), arguments);
        let said = stderr(&output);
        assert_eq!(output.status.code(), Some(3), "{arguments:?}: {said}");
        let errors: Vec<&str> = said.lines().filter(|line| line.starts_with("error: ")).collect();
        assert!(errors.len() == 1 && errors[0].contains("cannot be written"), "{arguments:?}: {said}");
        assert!(!said.contains("panicked") && errors[0].matches("os error").count() == 1, "{arguments:?}: {said}");
        // What can be made again may be gone or new, never half.
        let kept = ["checkpoint.safetensors", "body.safetensors", "metrics.json"];
        for (path, old) in before.iter().filter(|(path, _)| kept.iter().any(|name| path.ends_with(name))) {
            assert!(path.is_file() && bytes(path) == *old, "{arguments:?}: {}", path.display());
        }
        for path in files(&run).keys().filter(|path| before.get(*path) != Some(&bytes(path))) {
            assert!(!text(path).contains("unfinished") && is_whole(path), "{arguments:?}: {}", path.display());
        }
    }
    done(&resumed);
    done(&export);
}

#[test]
fn a_training_whose_folder_vanishes_says_so_at_its_end() {
    let run = folder("vanishing").join("run");
    let child = start(&[training(&run, "300"), vec!["--checkpoint-every", "0.2"]].concat());
    wait_for(&run.join("checkpoint.safetensors"));
    while run.exists() {
        // What is written meanwhile is in the way.
        let _ = std::fs::remove_dir_all(&run);
    }
    let output = child.wait_with_output().unwrap();
    let said = stderr(&output);
    assert_eq!(output.status.code(), Some(3), "{said}");
    assert!(said.contains("cannot be written") && !said.contains("panicked"), "{said}");
}

#[test]
fn a_run_that_died_before_its_first_checkpoint_is_resumed_from_its_start() {
    let folder = folder("early");
    let (run, whole) = (folder.join("run"), folder.join("whole"));
    done(&training(&whole, "10"));
    std::fs::create_dir(&run).unwrap();
    std::fs::copy(whole.join("config.toml"), run.join("config.toml")).unwrap();
    let said = done(&["train", "--resume", "--out", text(&run)]);
    assert!(said.contains("no checkpoint to go on from; from the start"), "{said}");
    let [ours, theirs] = [&run, &whole].map(|run| bytes(&run.join("checkpoint.safetensors")));
    assert!(ours == theirs);
}

#[test]
fn numbers_on_the_command_line_are_blamed_by_their_own_name() {
    let said = |arguments: &[&str]| {
        let output = xtask(arguments);
        assert!(!output.status.success());
        stderr(&output)
    };
    let seed = said(&["train", "--seed", "18446744073709551615", "--set", "samples=8"]);
    assert!(seed.contains("--seed") && !seed.contains("--set samples"), "{seed}");
    for command in [&["train"][..], &["eval", "x"], &["render", "x", "tpose"]] {
        let begun = Instant::now();
        let threads = said(&[command, &["--threads", "1000000"]].concat());
        assert!(threads.contains("--threads 1000000: expected 1 to ") && threads.lines().count() == 1, "{threads}");
        assert!(begun.elapsed() < Duration::from_secs(20));
    }
    let begun = Instant::now();
    let weights = said(&["train", "--set", "loss.perceptual_weights=x"]);
    assert!(weights.contains("x: no such weights") && begun.elapsed() < Duration::from_secs(5), "{weights}");
    let every = said(&["train", "--checkpoint-every", "nan"]);
    assert!(every.contains("--checkpoint-every"), "{every}");
}

#[test]
fn names_do_not_steer_the_terminal() {
    for hostile in ["a\u{1b}]0;title\u{7}.glb", "b\u{1b}[2J", "c\r\u{9b}31m", "d\u{202e}gpj"] {
        let output = xtask(&["train", hostile]);
        let said = stderr(&output);
        assert!(!said.trim_end().chars().any(|c| c.is_control() || c == '\u{202e}'), "{said:?}");
    }
    let long = "x".repeat(100_000);
    assert!(xtask(&["train", &long]).stderr.len() < 10_000);
}
