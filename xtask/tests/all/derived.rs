//! What is made of a run is of that run: nothing stale passes for fresh, and commands side by side
//! come to the results that they come to one after the other.

use crate::common;

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant, SystemTime};

use common::{QUICK, bytes, done, folder, json, limited, refused, rewritten, stderr, text, xtask};
use occnerf::capture::Layout;
use serde_json::Value;

fn trained(folder: &Path, seed: &str) -> (PathBuf, PathBuf) {
    let (capture, run) = (folder.join("capture"), folder.join(seed));
    if !capture.exists() {
        common::capture(&capture, Layout::Wild, 32, 4);
    }
    done(&[&["train", text(&capture), "--out", text(&run), "--steps", "8", "--seed", seed][..], &QUICK].concat());
    (capture, run)
}

#[test]
fn an_avatar_of_an_earlier_training_is_baked_again_whatever_its_time() {
    let folder = folder("stale-avatar");
    let (_, run) = trained(&folder, "1");
    let (avatar, glb, page) = (run.join("avatar.safetensors"), run.join("person.glb"), run.join("person.html"));
    let export = ["export", text(&run), "--out", text(&glb)];
    done(&export);
    done(&["view", text(&run)]);
    let (old, old_scores) = (bytes(&avatar), json(&run.join("metrics.json")));
    done(&["train", "--resume", "--steps", "12", "--stop-after", "11", "--out", text(&run)]);
    let says = |page: &Path, what: &str| String::from_utf8(bytes(page)).unwrap().contains(what);
    // What the report shows is named once training has gone on.
    assert!(says(&run.join("report.html"), "of an earlier training"));
    let future = SystemTime::now() + Duration::from_secs(1 << 20);
    std::fs::File::options().write(true).open(&avatar).unwrap().set_modified(future).unwrap();
    // Scores of the earlier checkpoint are not added to.
    let report = run.join("report.html");
    done(&["eval", text(&run), "--split", "train-view"]);
    let scores = json(&run.join("metrics.json"));
    assert!(scores["of"] != old_scores["of"] && scores["splits"]["novel_view"].is_null(), "{scores}");
    let names = |page: &Path| says(page, "before the last training");
    assert!(
        names(&report) && !says(&report, "of an earlier training") && says(&report, scores["of"].as_str().unwrap())
    );
    assert!(!run.join("renders/novel_views.png").exists());
    done(&export);
    let again = bytes(&avatar);
    assert!(again != old);
    std::fs::remove_file(&avatar).unwrap();
    done(&export);
    assert!(bytes(&avatar) == again);
    done(&["view", text(&run)]);
    assert!(!names(&report));
    done(&["eval", text(&run)]);
    assert!(!names(&report) && says(&page, scores["of"].as_str().unwrap()));
    assert!(run.join("renders/novel_views.png").exists());
    // A checkpoint of another run.
    let (_, other) = trained(&folder, "2");
    std::fs::copy(other.join("checkpoint.safetensors"), run.join("checkpoint.safetensors")).unwrap();
    refused(&["eval", text(&run)], &["checkpoint.safetensors", "of another run"]);
    refused(&export, &["of another run"]);
    // A motion of another skeleton; then a checkpoint that is cut off, and none.
    let motion = folder.join("other.npz");
    crate::export::clip(&motion, 31);
    let drawn = ["render", text(&run), "pose", "--baked", "--motion", text(&motion)];
    refused(
        &["render", text(&other), "pose", "--baked", "--motion", text(&motion)],
        &["other.npz", "another skeleton"],
    );
    let whole = bytes(&other.join("checkpoint.safetensors"));
    std::fs::write(run.join("checkpoint.safetensors"), &whole[..whole.len() / 2]).unwrap();
    std::fs::remove_file(&avatar).unwrap();
    for words in [&["checkpoint.safetensors", "not a whole"][..], &["checkpoint.safetensors"]] {
        refused(&export, words);
        refused(&["view", text(&run)], words);
        refused(&["render", text(&run), "tpose", "--baked"], words);
        refused(&drawn, words);
        let _ = std::fs::remove_file(run.join("checkpoint.safetensors"));
    }
}

#[test]
fn a_run_that_may_not_be_written_is_scored_exported_and_drawn() {
    let folder = folder("read-only");
    let (_, run) = trained(&folder, "1");
    let nobody = ["--reuid", "65534", "--regid", "65534", "--clear-groups"];
    let as_nobody = |arguments: &[&str]| {
        let mut command = Command::new("setpriv");
        command.args(nobody).arg(env!("CARGO_BIN_EXE_xtask")).args(arguments).env_remove("SMPL_MODEL");
        command.output()
    };
    if !as_nobody(&["--version"]).is_ok_and(|output| output.status.success()) {
        println!("skipped: no other user here");
        return;
    }
    use std::os::unix::fs::PermissionsExt;
    let results = folder.join("results");
    std::fs::create_dir(&results).unwrap();
    std::fs::set_permissions(&results, PermissionsExt::from_mode(0o777)).unwrap();
    let before = bytes(&run.join("metrics.json"));
    let (glb, drawn) = (results.join("person.glb"), results.join("drawn"));
    let each: [(&[&str], &str); 4] = [
        (&["export", text(&run), "--out", text(&glb)], "is not kept"),
        (&["eval", text(&run)], "only printed"),
        (&["eval", text(&run), "--baked"], "is not kept"),
        (&["render", text(&run), "tpose", "--baked", "--size", "8x8", "--out", text(&drawn)], "is not kept"),
    ];
    for (arguments, word) in each {
        let output = as_nobody(arguments).unwrap();
        assert!(output.status.success() && stderr(&output).contains(word), "{arguments:?}: {}", stderr(&output));
    }
    assert!(glb.is_file() && drawn.join("0000.png").is_file());
    assert!(bytes(&run.join("metrics.json")) == before && !run.join("avatar.safetensors").exists());
}

#[test]
fn devices_and_pipes_are_read_up_to_a_bound_and_written_to_as_they_are() {
    let folder = folder("devices");
    let (capture, run) = trained(&folder, "1");
    let glb = folder.join("person.glb");
    // 2 GB of address space.
    let limits = "ulimit -v 2000000;";
    let refusal = |arguments: &[&str], word: &str| {
        let output = limited(limits, arguments);
        let said = stderr(&output);
        assert!(output.status.code() == Some(1) && said.matches("error").count() == 1 && said.contains(word), "{said}");
    };
    refusal(&["train", "--list", "/dev/zero", "--out", text(&folder.join("l"))], "/dev/zero: more than 16777216 bytes");
    let motion = folder.join("zero.npz");
    std::os::unix::fs::symlink("/dev/zero", &motion).unwrap();
    refusal(&["export", text(&run), "--out", text(&glb), "--motion", text(&motion)], "zero.npz: more than");
    refusal(&["train", text(&capture), "--body", text(&motion)], "zero.npz: not a plain file");
    // A pipe without a writer is waited for where it is read once, and refused where it is read
    // again.
    let pipe = folder.join("pipe.npz");
    assert!(Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    refusal(&["train", text(&capture), "--body", text(&pipe)], "pipe.npz: not a plain file");
    refusal(&["train", text(&capture), "--lpips", text(&pipe)], "pipe.npz");
    let images = capture.join("images");
    refusal(&["import", "--frames", text(&images), "--fit", text(&pipe), "--out", "x"], "pipe.npz");
    let export = ["export", text(&run), "--out", text(&glb), "--motion", text(&pipe)];
    for waits in [&["train", "--list", text(&pipe), "--out", text(&folder.join("l"))][..], &export] {
        let mut command = Command::new(env!("CARGO_BIN_EXE_xtask"));
        command.args(waits).env_remove("SMPL_MODEL").stdout(Stdio::null()).stderr(Stdio::piped());
        let mut child = command.spawn().unwrap();
        let lines = BufReader::new(child.stderr.take().unwrap()).lines().map(Result::unwrap);
        let first = lines.into_iter().find(|line| line.contains("reading")).unwrap_or_default();
        assert!(first.contains("pipe.npz: 2 s"), "{first}");
        std::fs::write(&pipe, "no-such-capture").unwrap();
        assert_eq!(child.wait().unwrap().code(), Some(1));
    }
    // In a run without a writer.
    let metrics = run.join("train.jsonl");
    std::fs::remove_file(&metrics).unwrap();
    assert!(Command::new("mkfifo").arg(&metrics).status().unwrap().success());
    refusal(&["eval", text(&run)], "train.jsonl: not a plain file");
    for name in ["avatar.safetensors", "config.toml"] {
        let kept = std::fs::read(run.join(name));
        let _ = std::fs::remove_file(run.join(name));
        std::os::unix::fs::symlink("/dev/zero", run.join(name)).unwrap();
        refusal(&["export", text(&run), "--out", text(&glb)], "plain file");
        std::fs::remove_file(run.join(name)).unwrap();
        kept.map_or(Ok(()), |kept| std::fs::write(run.join(name), kept)).unwrap();
    }
    let piped = limited("", &["export", text(&run), "--format", "glb", "--out", "/dev/stdout"]);
    assert!(piped.status.success() && piped.stdout.starts_with(b"glTF"), "{}", stderr(&piped));
    done(&["export", text(&run), "--format", "glb", "--out", "/dev/null"]);
    assert!(!Path::new("/dev/null").is_file());
}

#[test]
fn nothing_is_learnt_of_a_person_who_is_not_where_the_masks_are() {
    let folder = folder("nothing");
    type Edit<'a> = (&'a str, &'a dyn Fn(&mut Value));
    let edits: [Edit<'_>; 3] = [
        ("focal", &|frame| {
            frame["cam_intrinsics"][0][0] = 1.into();
            frame["cam_intrinsics"][1][1] = 1.into();
        }),
        ("far", &|frame| frame["cam_extrinsics"][2][3] = 1000.into()),
        ("beside", &|frame| {
            let x = frame["cam_extrinsics"][0][3].as_f64().unwrap() + 1.0;
            frame["cam_extrinsics"][0][3] = x.into();
        }),
    ];
    for (name, edit) in edits {
        let capture = folder.join(name);
        common::capture(&capture, Layout::Wild, 64, 4);
        rewritten(&capture, edit);
        let run = folder.join(format!("{name}-run"));
        let output = xtask(&["train", text(&capture), "--out", text(&run), "--method", "surface"]);
        let said = stderr(&output);
        assert!(output.status.code() == Some(1) && said.contains("check"), "{name}: {:?} {said}", output.status);
        assert!(!run.join("avatar.safetensors").exists() && !run.join("metrics.json").exists());
        let advice = done(&["check", text(&capture)]);
        assert!(!advice.contains("centimetres") || name == "far", "{name}: {advice}");
    }
}

/// Faces around a camera cover the whole picture, each many times.
#[test]
fn a_camera_inside_the_body_is_drawn_in_seconds() {
    let folder = folder("inside");
    let capture = folder.join("capture");
    common::capture(&capture, Layout::Wild, 64, 4);
    // The body of this layout stands about the origin.
    let mut is_first = true;
    rewritten(&capture, |frame| {
        if std::mem::take(&mut is_first) {
            (0..3).for_each(|row| frame["cam_extrinsics"][row][3] = 0.into());
        }
    });
    let begun = Instant::now();
    done(&["train", text(&capture), "--out", text(&folder.join("run")), "--method", "surface"]);
    assert!(begun.elapsed() < Duration::from_secs(60), "{:?}", begun.elapsed());
}

#[test]
fn limits_of_the_process_are_said_in_a_line() {
    let one_line = |output: &Output, word: &str| {
        let said = stderr(output);
        assert!(output.status.code() == Some(1) && said.lines().count() == 1 && said.contains(word), "{said}");
    };
    for asked in ["1000000", "x"] {
        one_line(&limited(&format!("export RAYON_NUM_THREADS={asked};"), &["view", "x"]), "RAYON_NUM_THREADS");
    }
    // Stacks of 2 MiB each.
    let threads = std::thread::available_parallelism().map_or(16, |cores| 16 * usize::from(cores)).to_string();
    let crowd = ["render", "x", "tpose", "--threads", &threads];
    one_line(&limited("ulimit -v 60000;", &crowd), "threads cannot be started");
    let run = folder("little-memory");
    let train = ["train", "--method", "prior", "--threads", "2", "--out", text(&run)];
    for limit in ["80000", "200000"] {
        one_line(&limited(&format!("ulimit -v {limit};"), &train), "error: memory: ");
    }
    assert!(limited("ulimit -s 64;", &["check", "--out", "/dev/null"]).status.success());
}

#[test]
fn output_that_is_the_result_must_arrive() {
    let full = || std::fs::File::options().write(true).open("/dev/full").unwrap();
    for arguments in [&["check", "--out", "/dev/null"][..], &["train", "--help"]] {
        let mut command = Command::new(env!("CARGO_BIN_EXE_xtask"));
        assert_eq!(command.args(arguments).stdout(full()).status().unwrap().code(), Some(3), "{arguments:?}");
    }
}

#[test]
fn a_signal_before_the_first_step_says_that_nothing_was_made() {
    let folder = folder("early-signal");
    let mut child = Command::new(env!("CARGO_BIN_EXE_xtask"))
        .args(["train", "--out", text(&folder.join("run")), "--steps", "100"])
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    std::thread::sleep(Duration::from_millis(500));
    let sent = Command::new("kill").args(["-TERM", &child.id().to_string()]).status().unwrap();
    assert!(sent.success() && child.try_wait().unwrap().is_none());
    let output = child.wait_with_output().unwrap();
    let said = stderr(&output);
    assert!(output.status.code() == Some(143) && said.contains("had not been made"), "{said}");
}

/// Twenty seconds; `STORM=120 cargo test -p xtask storm` for two minutes.
#[test]
fn after_a_storm_of_commands_on_one_run_everything_is_as_one_alone_would_make_it() {
    let length = std::env::var("STORM").ok().map_or(20, |seconds| seconds.parse().expect("STORM is a number"));
    let folder = folder("storm");
    let (_, run) = trained(&folder, "1");
    let (glb, renders) = (folder.join("person.glb"), folder.join("drawn"));
    let (steps, ends) = (AtomicUsize::new(8), AtomicUsize::new(0));
    let storm = |n: usize| {
        let begun = Instant::now();
        let mut turn = n;
        while begun.elapsed() < Duration::from_secs(length) {
            let more = (steps.fetch_add(1, Ordering::SeqCst) + 1).to_string();
            let train = ["train", "--resume", "--out", text(&run), "--checkpoint-every", "0", "--steps", &more];
            let each: [&[&str]; 6] = [
                &train,
                &["export", text(&run), "--out", text(&glb)],
                &["view", text(&run)],
                &["render", text(&run), "tpose", "--baked", "--size", "8x8", "--out", text(&renders)],
                &["eval", text(&run)],
                &["eval", text(&run), "--baked"],
            ];
            let arguments = each[turn % each.len()];
            turn += 1;
            // A training needs the run alone.
            let patience = if turn % each.len() == 1 { 100 } else { 1 };
            let mut tries = (0..patience).map(|_| xtask(arguments));
            let is_busy = |output: &Output| output.status.code() == Some(4);
            let Some(output) = tries.find(|output| !is_busy(output)) else { continue };
            std::thread::sleep(Duration::from_millis(100));
            // The steps may be fewer than another training has taken.
            let expected = [Some(0), Some(1)];
            let said = stderr(&output);
            assert!(expected.contains(&output.status.code()), "{arguments:?}: {:?} {said}", output.status);
            assert!(output.status.code() != Some(1) || said.contains("steps"), "{arguments:?}: {said}");
            ends.fetch_add(usize::from(output.status.success()), Ordering::SeqCst);
        }
    };
    std::thread::scope(|scope| (0..3).for_each(|n| drop(scope.spawn(move || storm(2 * n)))));
    println!("{} commands came to their ends in {length} s", ends.load(Ordering::SeqCst));
    for arguments in [&["export", text(&run), "--out", text(&glb)][..], &["eval", text(&run)], &["view", text(&run)]] {
        done(arguments);
    }
    let alone = folder.join("alone");
    std::fs::create_dir(&alone).unwrap();
    for name in ["config.toml", "checkpoint.safetensors", "body.safetensors", "person.safetensors", "train.jsonl"] {
        std::fs::copy(run.join(name), alone.join(name)).unwrap();
    }
    let fresh = folder.join("fresh.glb");
    for arguments in
        [&["export", text(&alone), "--out", text(&fresh)][..], &["eval", text(&alone)], &["view", text(&alone)]]
    {
        done(arguments);
    }
    assert!(bytes(&glb) == bytes(&fresh));
    let [ours, theirs] = [&run, &alone].map(|run| json(&run.join("metrics.json")));
    // Seconds are of the machine: a report of the same scores is the same.
    std::fs::copy(run.join("metrics.json"), alone.join("metrics.json")).unwrap();
    std::fs::write(alone.join("report.html"), "stale").unwrap();
    done(&["view", text(&alone)]);
    for name in ["avatar.safetensors", "person.html", "report.html"] {
        assert!(bytes(&run.join(name)) == bytes(&alone.join(name)), "{name}");
    }
    let scores = |metrics: &Value| ["novel_view", "train_view"].map(|split| metrics["splits"][split]["frames"].clone());
    assert!(ours["of"] == theirs["of"] && scores(&ours) == scores(&theirs), "{ours}\n{theirs}");
    assert!(ours["steps"].as_u64().unwrap() > 8, "no training got through: {ours}");
    let left: Vec<_> = std::fs::read_dir(&run).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    assert!(left.iter().all(|name| !name.to_string_lossy().contains("unfinished")), "{left:?}");
}
