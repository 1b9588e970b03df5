//! Every reader of other programs' files, on damaged ones: no panic, no hang, and no more memory
//! than is said.
//!
//! 20 000 inputs by default; `FUZZ=1000000 cargo test -p testkit fuzz:: -- --nocapture`
//! for a million and a table. Input number n of a reader is the same on every machine;
//! one that fails is left in `target/tmp`.

mod mutate;
mod seeds;

use std::hint::black_box;
use std::io::Cursor;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::LazyLock;
use std::time::{Duration, Instant};

use array_files::npz::{Npz, read_npy};
use array_files::pickle;
use array_files::torch::TorchFile;
use glam::Vec3;
use mutate::{Form, damaged};
use occnerf::bake::Avatar;
use occnerf::capture::{Image, ImportOptions, LoadOptions, import, load_capture};
use occnerf::{Config, Lpips, Person, Trainer, checkpoint_config};
use rigged::{Character, load_mesh};
use smpl::{BodyModel, MotionClip};
use testkit::body::Random;
use testkit::files::shared;

/// Longest that a reader may take.
const LONGEST: Duration = Duration::from_secs(1);
const MIB: u64 = 1 << 20;

/// A reader under attack.
struct Attack {
    name: &'static str,
    form: Form,
    seeds: Vec<Vec<u8>>,
    /// Part of all inputs, in thousandths.
    share: u64,
    /// Most memory, in bytes, that any of these inputs (at most the seed's size or 1 MiB each) may
    /// take.
    most: u64,
}

fn attack(name: &'static str, form: Form, seeds: Vec<Vec<u8>>, share: u64) -> Attack {
    Attack { name, form, seeds, share, most: 64 * MIB }
}

impl Attack {
    /// Reads damaged files that are put at a path.
    fn at(self, path: &Path, mut read: impl FnMut(&Path) -> bool) {
        self.run(|bytes| {
            std::fs::write(path, bytes).unwrap();
            read(path)
        });
    }

    /// Reads damaged files; `read` says whether one was accepted.
    fn run(self, mut read: impl FnMut(&[u8]) -> bool) {
        let total: u64 = std::env::var("FUZZ").map_or(20_000, |n| n.parse().expect("FUZZ is a number"));
        let inputs = (total * self.share).div_ceil(1000);
        assert!(self.seeds.iter().all(|seed| read(seed)), "{}: a seed is refused", self.name);
        let (mut accepted, mut slowest, mut largest) = (0u64, Duration::ZERO, 0);
        let begun = Instant::now();
        for number in 0..inputs {
            let mut random = Random(number.wrapping_mul(0x2545_f491_4f6c_dd1d) ^ self.name.len() as u64);
            let bytes = damaged(&mut random, self.form, &self.seeds);
            let mut outcome = Ok(false);
            let (mut seconds, mut memory) = (Duration::MAX, 0);
            // What other processes kept waiting all the same is tried again.
            for _ in 0..3 {
                let start = busy();
                memory = allocation_counter::measure(|| {
                    outcome = catch_unwind(AssertUnwindSafe(|| read(&bytes)));
                })
                .bytes_max;
                seconds = seconds.min(busy().saturating_sub(start));
                if seconds < LONGEST {
                    break;
                }
            }
            if outcome.is_err() || seconds >= LONGEST || memory > self.most {
                let path = PathBuf::from(env!("CARGO_TARGET_TMPDIR"))
                    .join(format!("fuzz-{}-{number}", self.name.replace('/', "-")));
                std::fs::write(&path, &bytes).unwrap();
                let panicked = if outcome.is_err() { "panicked" } else { "no panic" };
                panic!("{}: {panicked}, {seconds:?}, {} MiB: {}", self.name, memory / MIB, path.display());
            }
            accepted += u64::from(outcome.unwrap_or(false));
            (slowest, largest) = (slowest.max(seconds), largest.max(memory));
        }
        println!(
            "| {} | {inputs} | {accepted} | {} ms | {:.1} MiB | {:.0} s |",
            self.name,
            slowest.as_millis(),
            largest as f64 / MIB as f64,
            begun.elapsed().as_secs_f64()
        );
        // A fuzzer that gets nothing in tests the first line of a reader.
        assert!(inputs < 100 || accepted > 0, "{}: nothing was accepted", self.name);
    }
}

/// Time that this thread has had a core, as far as the system tells; else time.
fn busy() -> Duration {
    static START: LazyLock<Instant> = LazyLock::new(Instant::now);
    let found = std::fs::read_to_string("/proc/thread-self/schedstat").ok();
    let nanoseconds = found.and_then(|text| text.split(' ').next()?.parse().ok());
    nanoseconds.map_or_else(|| START.elapsed(), Duration::from_nanos)
}

/// Where the damaged file of a reader of paths is put.
fn place(name: &str) -> PathBuf {
    let shared = PathBuf::from("/dev/shm");
    let folder = if shared.is_dir() { shared } else { std::env::temp_dir() };
    let folder = folder.join(format!("fuzz-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    folder.join(name)
}

#[test]
fn pickles() {
    attack("pickle", Form::Plain, seeds::pickles(), 80).run(|bytes| pickle::parse("a.pkl", bytes).is_ok());
    let joblib = attack("joblib", Form::Plain, seeds::joblibs(), 80);
    joblib.run(|bytes| pickle::from_bytes("a.pkl", bytes.to_vec()).is_ok());
}

#[test]
fn arrays() {
    attack("npz", Form::Zip, seeds::archives(), 106).run(|bytes| {
        let Ok(mut npz) = Npz::from_bytes("a.npz", bytes.to_vec()) else { return false };
        let keys: Vec<String> = npz.keys().iter().take(50).cloned().collect();
        // The seed of numpy's has an array of a type that is refused.
        keys.iter().filter(|key| npz.array(key).is_ok()).count() > 1
    });
    attack("npy", Form::Plain, seeds::arrays(), 80).at(&place("a.npy"), |path| read_npy(path).is_ok());
}

#[test]
fn bodies() {
    let read = |path: &Path| {
        let Ok(body) = BodyModel::load(path) else { return false };
        let pose = vec![glam::Vec3::splat(0.1); body.num_joints()];
        black_box(body.pose(&body.shaped(&[]), &pose, smpl::Placement::default()));
        true
    };
    attack("body npz", Form::Zip, seeds::body_archives(), 60).at(&place("body.npz"), read);
    attack("body safetensors", Form::Safetensors, seeds::saved_bodies(), 60).at(&place("body.npz"), read);
}

#[test]
fn clips() {
    attack("motion clip", Form::Zip, seeds::clips(), 50).at(&place("clip.npz"), |path| {
        let Ok(clip) = MotionClip::load(path) else { return false };
        black_box(clip.at(clip.duration() * 0.4, 24));
        true
    });
}

#[test]
fn characters_and_meshes() {
    attack("glTF", Form::Glb, seeds::characters(), 100).run(|bytes| {
        let Ok(character) = Character::from_bytes("a.glb", bytes) else { return false };
        black_box(character.rest());
        for animation in 0..character.animations.len().min(4) {
            black_box(character.pose(animation, 0.3));
        }
        black_box(character.joint_parents());
        true
    });
    let obj = Attack { most: 128 * MIB, ..attack("OBJ", Form::Plain, seeds::meshes(), 70) };
    obj.at(&place("a.obj"), |path| load_mesh(path).is_ok());
}

#[test]
fn pictures() {
    // 8192 pixels a side is the bound: 16 bytes a pixel of a header that lies, 18 with what is
    // read.
    let most = 8192 * 8192 * 18;
    for form in [attack("PNG", Form::Png, seeds::pngs(), 60), attack("JPEG", Form::Plain, seeds::jpegs(), 30)] {
        Attack { most, ..form }.at(&place("a.png"), |path| Image::load(path).is_ok());
    }
}

#[test]
fn metadata_of_captures() {
    let (dir, body, seed) = seeds::wild_capture(&place("wild"));
    let read = |_: &Path| load_capture(&dir, &body, &LoadOptions::default()).is_ok();
    attack("metadata.json", Form::Plain, vec![seed], 30).at(&dir.join("metadata.json"), read);
}

#[test]
fn configurations() {
    attack("TOML", Form::Plain, seeds::configurations(), 30).run(|bytes| {
        let Ok(text) = std::str::from_utf8(bytes) else { return false };
        toml::from_str::<Config>(text).is_ok_and(|config| config.validate().is_ok())
    });
}

/// Sizes are those of the configuration in the file, which is bounded by itself: only the sizes of
/// the seed are opened.
#[test]
fn checkpoints() {
    let (scene, seed, config) = seeds::checkpoint();
    attack("checkpoint", Form::Safetensors, vec![seed], 4).at(&place("checkpoint.safetensors"), |path| {
        match checkpoint_config(path) {
            Ok(found) if found == config => Trainer::resume(scene, path).is_ok(),
            other => other.is_ok(),
        }
    });
}

#[test]
fn weights_of_networks() {
    let [zip, _] = seeds::tensors(["features.0.weight", "features.0.bias"]);
    // The network that is wanted is not there: everything up to the names of the tensors is read.
    attack("torch", Form::Zip, vec![zip], 10).at(&place("weights.pth"), |path| {
        let refused = Lpips::load(path).err().map(|error| error.to_string()).unwrap_or_default();
        refused.contains("trunk") || refused.contains("expected floats") || refused.contains("lacks")
    });
}

#[test]
fn tensors() {
    let read = |bytes: &[u8]| {
        let Ok(mut file) = TorchFile::open("a.pt", Cursor::new(bytes)) else { return false };
        let root = file.root().clone();
        let keys = ["a", "b"];
        let found = keys.iter().filter_map(|key| file.tensor(key, root.get(key)?).ok()?).collect::<Vec<_>>();
        found.iter().filter(|tensor| file.read("a", tensor).is_ok()).count() > 0
    };
    let [zip, legacy] = seeds::tensors(["a", "b"]);
    // 16 times the file and 64 MiB, twice while a vector grows.
    let most = 256 * MIB;
    Attack { most, ..attack("tensors", Form::Zip, vec![zip], 20) }.run(read);
    Attack { most, ..attack("tensors, old form", Form::Plain, vec![legacy], 20) }.run(read);
}

/// Up to the body model, which is not there: nothing is written.
fn imports(fit: &Path, video: &Path) -> bool {
    // The body is read after the fit.
    let body = Some("no-such-body.npz".into());
    let options = ImportOptions { frames: video.to_owned(), fit: fit.to_owned(), body, ..ImportOptions::default() };
    let refused = import(&options, &place("imported")).err().map(|error| error.to_string());
    refused.is_none_or(|error| error.contains("no-such-body.npz"))
}

#[test]
fn fits_of_estimators() {
    let video = seeds::video();
    let phalp = Attack { most: 128 * MIB, ..attack("PHALP, COCO runs", Form::Plain, seeds::phalp(), 40) };
    phalp.at(&place("phalp.pkl"), |path| imports(path, &video));
    let dir = place("easymocap");
    std::fs::create_dir_all(dir.join("smpl")).unwrap();
    for (seed, name) in seeds::sam3d().into_iter().zip(["SAM 3D Body JSON", "SAM 3D Body pickle"]) {
        attack(name, Form::Plain, vec![seed], 10).at(&place("sam3d.dat"), |path| imports(path, &video));
    }
    let [frame, cameras] = seeds::easymocap();
    let lenses = |bytes: &[u8]| ["intri.yml", "extri.yml"].map(|name| std::fs::write(dir.join(name), bytes).unwrap());
    lenses(&cameras);
    let json = attack("EasyMocap JSON", Form::Plain, vec![frame.clone()], 10);
    json.at(&dir.join("smpl/000000.json"), |_| imports(&dir, &video));
    std::fs::write(dir.join("smpl/000000.json"), &frame).unwrap();
    attack("EasyMocap YAML", Form::Plain, vec![cameras], 10).run(|bytes| {
        lenses(bytes);
        imports(&dir, &video)
    });
    let Some(dir) = shared("estimators") else { return };
    for (name, form) in [
        ("wham/wham_output.pkl", Form::Plain),
        ("prompthmr/results.pkl", Form::Plain),
        ("gvhmr/hmr4d_results.pt", Form::Zip),
        ("romp/video_results.npz", Form::Zip),
    ] {
        let (seed, path) = (std::fs::read(dir.join(name)).unwrap(), place(name.split('/').next_back().unwrap()));
        let fit = Attack { most: 600 * MIB, ..attack(name, form, vec![seed], 5) };
        fit.at(&path, |path| imports(path, &dir.join("frames")));
    }
}

#[test]
fn people_of_runs() {
    let run = place("run");
    let (config, seed) = seeds::person(&run);
    let person = attack("person", Form::Safetensors, vec![seed], 20);
    person.at(&run.join("person.safetensors"), |_| Person::load(&run, &config).is_ok());
    attack("avatar", Form::Safetensors, seeds::avatars(), 30).at(&place("avatar.safetensors"), |path| {
        let Ok(avatar) = Avatar::load(path) else { return false };
        if let Some(clip) = avatar.clips.first() {
            let (pose, _) = clip.motion.at(0.02, avatar.num_joints());
            black_box(avatar.skin(&avatar.bones(&pose, Vec3::ZERO), &pose));
        }
        true
    });
}
