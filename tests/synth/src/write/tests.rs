use std::sync::OnceLock;

use glam::Vec3;
use smpl::BodyModel;

use super::folder::byte;
use capture::{Capture, Frame, Layout, LoadOptions, find_body, load_capture};
use testkit::files::Directory;

use crate::{Obstacle, Occlusion, Perturbation, SynthConfig, Synthetic, synthesise};

const LAYOUTS: [Layout; 3] = [Layout::HumanNerf, Layout::ZjuMocap, Layout::Wild];

fn config(occlusion: Occlusion) -> SynthConfig {
    SynthConfig { size: 48, frames: 5, eval_cameras: 2, eval_every: 2, occlusion, ..SynthConfig::default() }
}

fn central() -> &'static Synthetic {
    static MADE: OnceLock<Synthetic> = OnceLock::new();
    MADE.get_or_init(|| make(Occlusion::Rectangle(Obstacle::default())))
}

fn make(occlusion: Occlusion) -> Synthetic {
    synthesise(None, None, &config(occlusion), &|_| {}).unwrap()
}

/// Writes, finds the body, and loads.
fn round(synthetic: &Synthetic, layout: Layout, name: &str) -> (Directory, BodyModel, Capture) {
    let dir = Directory::new(name);
    let count = std::sync::atomic::AtomicUsize::new(0);
    synthetic
        .write(dir.path(), layout, &|_| {
            count.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
        })
        .unwrap();
    assert_eq!(count.into_inner(), synthetic.num_pictures(layout), "{layout:?}");
    let body = BodyModel::load(&find_body(dir.path()).unwrap()).unwrap();
    let capture = load_capture(dir.path(), &body, &LoadOptions::default()).unwrap();
    (dir, body, capture)
}

/// The same view of the same posed body, whatever world it is in.
#[track_caller]
fn same_view(body: &BodyModel, a: &Frame, b: &Frame) {
    let seen = |f: &Frame| -> Vec<Vec3> {
        let posed = body.pose(&body.shaped(&f.betas), &f.pose, f.placement);
        posed.vertices.iter().step_by(7).map(|&v| f.camera.project(v).unwrap()).collect()
    };
    for (p, q) in seen(a).iter().zip(seen(b)) {
        // Rounding: pixels of 48, metres of 4.
        assert!(p.distance(q) < 2e-3, "{}: {p} {q}", a.name);
    }
    assert_eq!(a.betas, b.betas);
}

/// Pictures as near as 8 bits and the layout's masks allow.
#[track_caller]
fn same_picture(layout: Layout, made: &Frame, read: &Frame) {
    let (a, b) = (made.pixels().unwrap(), read.pixels().unwrap());
    for (i, (m, r)) in a.mask.iter().zip(&b.mask).enumerate() {
        let subject = (*m > 0.5, *r > 0.5);
        assert_eq!(subject.0, subject.1, "{layout:?} {}: pixel {i}, {m} {r}", made.name);
        let labels = layout == Layout::ZjuMocap;
        let expected = if labels { f32::from(subject.0) } else { *m };
        assert!((expected - r).abs() <= 0.5 / 255.0 + 1e-6, "{layout:?} {}: {m} {r}", made.name);
        if labels && !subject.0 {
            continue;
        }
        for c in 0..3 {
            let (p, q) = (a.image.pixels[3 * i + c], b.image.pixels[3 * i + c]);
            assert!((p - q).abs() < 1.5 / 255.0, "{layout:?} {}: {p} {q}", made.name);
        }
    }
}

#[test]
fn every_layout_reads_back_as_it_was_made() {
    let made = central();
    for layout in LAYOUTS {
        let (_dir, body, read) = round(made, layout, &format!("write-{layout:?}"));
        assert_eq!(body, made.body);
        assert_eq!(read.mean_betas, made.capture.mean_betas);
        assert_eq!(read.train.len(), made.capture.train.len());
        for (a, b) in made.capture.train.iter().zip(&read.train) {
            same_view(&body, a, b);
            same_picture(layout, a, b);
        }
        if layout == Layout::Wild {
            let kept: Vec<usize> = read.eval.iter().map(|e| e.train_index).collect();
            assert_eq!(kept, [0, 2, 4]);
            for view in &read.eval {
                let i = view.train_index;
                let clear = Frame { source: made.clear[i].clone(), ..made.capture.train[i].clone() };
                same_view(&body, &clear, &view.frame);
                same_picture(layout, &clear, &view.frame);
            }
            continue;
        }
        assert_eq!(read.eval.len(), 6);
        for (a, b) in made.capture.eval.iter().zip(&read.eval) {
            assert_eq!((&a.camera_name, a.train_index), (&b.camera_name, b.train_index));
            same_view(&body, &a.frame, &b.frame);
            same_picture(layout, &a.frame, &b.frame);
        }
    }
}

#[test]
fn objects_are_in_the_pictures_and_marked_in_the_wild_layout() {
    let made = make(Occlusion::Objects { fraction: 0.4, position: 0.0 });
    for layout in LAYOUTS {
        let (dir, _, read) = round(&made, layout, &format!("write-objects-{layout:?}"));
        for (i, (a, b)) in made.capture.train.iter().zip(&read.train).enumerate() {
            for (p, (m, r)) in a.pixels().unwrap().mask.iter().zip(&b.pixels().unwrap().mask).enumerate() {
                assert_eq!(*m > 0.5, *r > 0.5, "{layout:?} {i} {p}");
            }
            assert_eq!(b.pixels().unwrap().occluder.is_some(), layout == Layout::Wild);
            if b.pixels().unwrap().occluder.is_some() {
                assert_eq!(a.pixels().unwrap().occluder, b.pixels().unwrap().occluder);
            }
        }
        // The room and the objects are in the file, not in what is read.
        let path = match layout {
            Layout::ZjuMocap => "Camera_B1/000000.png",
            Layout::HumanNerf => "images/frame_000000.png",
            Layout::Wild => "images/000000.png",
        };
        let picture = image::open(dir.path().join(path)).unwrap().into_rgb8();
        assert!(picture.pixels().all(|p| p.0 != [0; 3]), "{layout:?}");
        let mask = &read.train[0].pixels().unwrap().mask;
        assert!(
            read.train[0].pixels().unwrap().image.pixels.chunks(3).zip(mask).all(|(p, m)| *m > 0.0 || p == [0.0; 3])
        );
    }
}

#[test]
fn a_place_that_cannot_be_written_is_named() {
    let dir = Directory::new("write-blocked");
    dir.write("images", "a file where a folder should be");
    let message = central().write(dir.path(), Layout::HumanNerf, &|_| {}).unwrap_err().to_string();
    assert!(message.contains("images"), "{message}");
}

#[test]
fn half_covered_pixels_stay_on_their_side() {
    assert_eq!([0.0, 0.25, 0.5, 0.75, 1.0, -1.0, 7.0, f32::NAN].map(byte), [0, 64, 127, 191, 255, 0, 255, 0]);
}

/// Whatever is done to them: resized, behind an obstacle that moves, with masks too large or too
/// small.
#[test]
fn pictures_decoded_on_demand_are_those_decoded_at_once() {
    for (layout, made) in LAYOUTS.map(|layout| (layout, central())) {
        let (dir, body, _) = round(made, layout, &format!("write-demand-{layout:?}"));
        let moving = Obstacle { travel: 0.2, ..Obstacle::default() };
        for mask_pixels in [0, 2, -1] {
            let at_once = LoadOptions { resize: Some(40), ..LoadOptions::default() };
            let read = |options: &LoadOptions| {
                let mut capture = load_capture(dir.path(), &body, options).unwrap();
                moving.hide(&mut capture.train).unwrap();
                let wrong = Perturbation { mask_pixels, ..Perturbation::default() };
                wrong.apply(&mut capture, &body).unwrap();
                capture
            };
            let all = read(&at_once);
            let bodies = (all.train.len() + all.eval.len()) * body.num_vertices() * 24;
            let picture = 40 * 40 * 16usize;
            let labels = all.train.len() * picture.div_ceil(42);
            // Room for the pictures of two frames, and to decode another.
            let on_demand = LoadOptions { max_bytes: (bodies + labels + 2 * picture + 48 * 48 * 48) as u64, ..at_once };
            let few = read(&on_demand);
            let frames = |capture: &Capture| -> Vec<Frame> {
                capture.train.iter().chain(capture.eval.iter().map(|e| &e.frame)).cloned().collect()
            };
            assert_eq!(all.train.len() + all.eval.len(), few.train.len() + few.eval.len());
            for (a, b) in frames(&all).iter().zip(&frames(&few)) {
                assert!(a.pixels().unwrap() == b.pixels().unwrap(), "{layout:?} {mask_pixels}: {}", a.name);
            }
        }
    }
}
