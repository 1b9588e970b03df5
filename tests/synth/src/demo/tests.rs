use std::sync::OnceLock;

use capture::Pixels;

use super::*;

fn body() -> &'static BodyModel {
    static BODY: OnceLock<BodyModel> = OnceLock::new();
    BODY.get_or_init(BodyModel::embedded)
}

/// Full size, since whole columns are what the obstacle is made of; every fifth frame of the
/// default.
fn config() -> DemoConfig {
    DemoConfig { frames: 20, eval_cameras: 2, ..DemoConfig::default() }
}

fn small() -> DemoConfig {
    DemoConfig { size: 48, frames: 6, eval_cameras: 3, eval_every: 4, ..DemoConfig::default() }
}

fn occluded() -> &'static Capture {
    static CAPTURE: OnceLock<Capture> = OnceLock::new();
    CAPTURE.get_or_init(|| demo(&config(), body()).unwrap())
}

fn clear() -> &'static Capture {
    static CAPTURE: OnceLock<Capture> = OnceLock::new();
    let config = DemoConfig { occluded_fraction: 0.0, ..config() };
    CAPTURE.get_or_init(|| demo(&config, body()).unwrap())
}

fn subject(frame: &Frame) -> usize {
    frame.pixels().unwrap().mask.iter().filter(|m| **m > 0.5).count()
}

#[test]
fn half_of_the_subject_is_hidden_in_the_first_four_fifths() {
    let count = |capture: &Capture| capture.train[..16].iter().map(subject).sum::<usize>() as f32;
    let hidden = 1.0 - count(occluded()) / count(clear());
    assert!((hidden - 0.5).abs() < 0.03, "{hidden}");
    for (with, without) in occluded().train.iter().zip(&clear().train).skip(16) {
        assert_eq!(with.pixels().unwrap().image, without.pixels().unwrap().image);
        assert_eq!(with.pixels().unwrap().mask, without.pixels().unwrap().mask);
    }
}

#[test]
fn what_the_obstacle_hides_is_zero_and_the_rest_untouched() {
    for (with, without) in occluded().train.iter().zip(&clear().train) {
        let (with, without) = (with.pixels().unwrap(), without.pixels().unwrap());
        for pixel in 0..with.mask.len() {
            let color = |pixels: &Pixels| [0, 1, 2].map(|c| pixels.image.pixels[3 * pixel + c]);
            if with.mask[pixel] == without.mask[pixel] {
                assert_eq!(color(&with), color(&without));
            } else {
                assert_eq!((with.mask[pixel], color(&with)), (0.0, [0.0; 3]));
            }
        }
    }
    for (with, without) in occluded().eval.iter().zip(&clear().eval) {
        assert_eq!(
            with.frame.pixels().unwrap().image,
            without.frame.pixels().unwrap().image,
            "evaluation views are never occluded"
        );
    }
}

#[test]
fn colours_are_premultiplied_and_edges_are_soft() {
    let mut soft = 0;
    for frame in &clear().train {
        for (pixel, &mask) in frame.pixels().unwrap().image.pixels.chunks(3).zip(&frame.pixels().unwrap().mask) {
            assert!(pixel.iter().all(|c| (0.0..=mask).contains(c)));
            soft += usize::from(mask > 0.0 && mask < 1.0);
        }
    }
    assert!(soft > 20 * 100, "{soft} partly covered pixels");
}

#[test]
fn every_camera_sees_the_whole_person_filling_three_quarters_of_the_height() {
    let frames = clear().train.iter().chain(clear().eval.iter().map(|e| &e.frame));
    for frame in frames {
        let size = config().size as usize;
        let mask = frame.pixels().unwrap().mask;
        let rows: Vec<usize> =
            (0..size).filter(|row| mask[row * size..(row + 1) * size].iter().any(|m| *m > 0.5)).collect();
        let (top, bottom) = (rows[0], rows[rows.len() - 1]);
        let share = (bottom + 1 - top) as f32 / size as f32;
        assert!((0.68..0.84).contains(&share), "{}: {share}", frame.name);
        assert!(top > 4 && bottom < size - 5, "{}: rows {top} to {bottom}", frame.name);
        let border = |x: usize| (0..size).any(|row| mask[row * size + x] > 0.0);
        assert!(!border(0) && !border(size - 1), "{} is cut off at a side", frame.name);
    }
}

#[test]
fn the_prior_lies_within_the_picture_of_the_person_but_is_not_the_truth() {
    let mut inside = 0;
    let mut all = 0;
    for frame in clear().train.iter().chain(clear().eval.iter().map(|e| &e.frame)) {
        let posed = body().pose(&body().shaped(&frame.betas), &frame.pose, frame.placement);
        let mask = frame.pixels().unwrap().mask;
        // Fingers are thinner than the errors of the prior.
        let hand = |v: usize| body().weights.row(v).any(|(joint, weight)| joint >= 20 && weight > 0.5);
        for (_, &v) in posed.vertices.iter().enumerate().filter(|(v, _)| !hand(*v)) {
            let p = frame.camera.project(v).unwrap();
            let pixel = p.y as usize * config().size as usize + p.x as usize;
            inside += usize::from(mask[pixel] > 0.5);
            all += 1;
        }
    }
    let share = inside as f32 / all as f32;
    assert!((0.93..0.999).contains(&share), "{share}");
    let (truth, guess) = shapes(&config(), body());
    assert_eq!(guess, clear().mean_betas);
    assert!(truth.iter().zip(&guess).all(|(t, g)| t != g && (t - g).abs() < 0.75));
}

#[test]
fn evaluation_frames_share_the_prior_of_their_instant() {
    let capture = demo(&small(), body()).unwrap();
    assert_eq!((capture.train.len(), capture.eval.len()), (6, 6));
    let order: Vec<(&str, usize)> = capture.eval.iter().map(|e| (e.camera_name.as_str(), e.train_index)).collect();
    assert_eq!(order[..3], [("Camera_B2", 0), ("Camera_B2", 4), ("Camera_B3", 0)]);
    for eval in &capture.eval {
        let train = &capture.train[eval.train_index];
        assert_eq!((&eval.frame.name, &eval.frame.pose), (&train.name, &train.pose));
        assert_eq!(eval.frame.placement, train.placement);
        assert_ne!(eval.frame.camera, train.camera);
    }
}

#[test]
fn the_same_config_gives_the_same_bits_on_any_number_of_threads() {
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| demo(&small(), body()).unwrap())
    };
    let (one, three) = (on(1), on(3));
    assert_eq!(format!("{one:?}"), format!("{three:?}"));
    let other = demo(&DemoConfig { seed: 1, ..small() }, body()).unwrap();
    assert_ne!(other.train[0].pixels().unwrap().image, one.train[0].pixels().unwrap().image);
    assert_ne!(other.train[0].pose, one.train[0].pose);
}

#[test]
fn a_known_obstacle_is_marked_where_it_is() {
    let known = DemoConfig { known_occluder: true, ..small() };
    let capture = demo(&known, body()).unwrap();
    assert!(demo(&small(), body()).unwrap().train.iter().all(|f| f.pixels().unwrap().occluder.is_none()));
    for (i, frame) in capture.train.iter().enumerate() {
        let pixels = frame.pixels().unwrap();
        let occluder = pixels.occluder.as_ref().unwrap();
        assert_eq!(occluder.iter().any(|o| *o), i < 5, "frame {i}");
        for (pixel, hidden) in occluder.iter().enumerate() {
            assert!(!hidden || pixels.mask[pixel] == 0.0);
            assert_eq!(*hidden, occluder[pixel % 48], "the obstacle is as high as the picture");
        }
    }
}

#[test]
fn clothes_stand_off_by_at_most_three_centimetres_and_skin_does_not() {
    let shaped = body().shaped(&[]);
    let landmarks = landmarks::Landmarks::new(&shaped);
    let mut seen = std::collections::BTreeMap::new();
    for &v in &shaped.vertices {
        let q = landmarks.figure(v);
        let thickness = landmarks.thickness(q);
        assert!((0.0..0.035).contains(&thickness), "{q}: {thickness}");
        let (garment, _) = landmarks.garment(q);
        let entry = seen.entry(format!("{garment:?}")).or_insert((0, 0.0f32));
        *entry = (entry.0 + 1, entry.1 + thickness);
    }
    assert_eq!(seen.len(), 7, "every garment is worn: {seen:?}");
    for (garment, (count, sum)) in seen {
        let mean = sum / count as f32;
        let bare = garment == "Skin" || garment == "Sock";
        assert_eq!(mean == 0.0, bare, "{garment}: {mean}");
        assert!(bare || mean > 0.007, "{garment}: {mean}");
    }
}

#[test]
fn a_body_in_centimetres_gives_the_same_pictures() {
    let mut centimetres = body().clone();
    for v in
        (centimetres.v_template.iter_mut()).chain(&mut centimetres.shapedirs).chain(&mut centimetres.posedirs.values)
    {
        *v *= 100.0;
    }
    let (metres, centimetres) = (demo(&small(), body()).unwrap(), demo(&small(), &centimetres).unwrap());
    for (a, b) in metres.train.iter().zip(&centimetres.train) {
        let differences =
            a.pixels().unwrap().mask.iter().zip(&b.pixels().unwrap().mask).filter(|(a, b)| a != b).count();
        assert!(differences <= 3, "{differences} pixels of {} differ", a.name);
        let distance = |f: &Frame| f.camera.centre_of_projection().length();
        assert!((distance(b) / distance(a) - 100.0).abs() < 1e-2);
    }
}

#[test]
fn impossible_settings_are_named() {
    for (word, config) in [
        ("size", DemoConfig { size: 4, ..small() }),
        ("size", DemoConfig { size: u32::MAX, ..small() }),
        ("frames", DemoConfig { frames: 0, ..small() }),
        ("eval_every", DemoConfig { eval_every: 0, ..small() }),
        ("eval_cameras", DemoConfig { eval_cameras: 1000, ..small() }),
        ("occluded_fraction", DemoConfig { occluded_fraction: 1.0, ..small() }),
        ("occluded_share", DemoConfig { occluded_share: -0.1, ..small() }),
        ("pressed", DemoConfig { pressed: f32::NAN, ..small() }),
        ("pose_noise_degrees", DemoConfig { pose_noise_degrees: f32::NAN, ..small() }),
    ] {
        let message = demo(&config, body()).unwrap_err().to_string();
        assert!(message.contains(word) && message.contains("expected"), "{message}");
    }
    let mut other = body().clone();
    other.parents.pop();
    assert!(demo(&small(), &other).unwrap_err().to_string().contains("24 joints"));
}

#[test]
fn one_frame_and_no_evaluation_camera_make_a_capture() {
    let least = DemoConfig { size: 16, frames: 1, eval_cameras: 0, ..small() };
    let capture = demo(&least, body()).unwrap();
    assert_eq!((capture.train.len(), capture.eval.len()), (1, 0));
}

#[test]
fn an_outfit_covers_pixels_beside_the_body_and_leaves_the_motion_as_it_is() {
    let plain = demo(&small(), body()).unwrap();
    for (outfit, least) in [(Outfit::Skirt, 1.15), (Outfit::LongHair, 1.01)] {
        let dressed = demo(&DemoConfig { outfit, ..small() }, body()).unwrap();
        let [mut covered, mut more] = [0.0, 0.0];
        for (a, b) in plain.eval.iter().zip(&dressed.eval) {
            assert_eq!((&a.frame.pose, a.frame.placement), (&b.frame.pose, b.frame.placement));
            let [a, b] = [a, b].map(|view| view.frame.pixels().unwrap().mask);
            assert!(a.iter().zip(&b).all(|(a, b)| a <= b), "{outfit:?} hides the person");
            covered += a.iter().sum::<f32>();
            more += b.iter().sum::<f32>();
        }
        assert!(more > least * covered, "{outfit:?}: {more} of {covered}");
    }
}
