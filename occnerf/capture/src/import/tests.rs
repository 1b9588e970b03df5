//! Every estimator's file against what another reader made of it.

use std::path::{Path, PathBuf};

use array_files::NdArray;
use array_files::npz::{self, Npz};
use glam::{DMat3, DVec3};
use proptest::prelude::*;
use smpl::BodyModel;

use super::fit::{FitFrame, SMPLX};
use super::*;
use crate::item::Item;
use crate::testing::{Directory, shared};

/// A person's motion in the camera, for fixtures of other forms.
pub(super) struct Motion {
    pub video: Video,
    pub k: Vec<f64>,
    pub betas: Vec<f64>,
    /// Axis-angle of each joint, the root's in the camera.
    pub poses: Vec<Vec<DVec3>>,
    pub pelvises: Vec<DVec3>,
    /// The pelvis at rest.
    pub joint: DVec3,
}

impl Motion {
    /// That the person moves so, in the camera.
    #[track_caller]
    pub fn is_of(&self, person: &Person) {
        for (i, frame) in person.frames.iter().enumerate() {
            let lens = (i, [self.k[0], self.k[4]], [self.k[2], self.k[5]]);
            assert_eq!((frame.index, frame.focal, frame.centre), lens);
            assert!(frame.pelvis(self.joint).distance(self.pelvises[i]) < 1e-5);
            let root = frame.world_to_camera * fit::rotation(frame.pose[0]);
            assert!(root.abs_diff_eq(fit::rotation(self.poses[i][0]), 1e-5));
            assert!(frame.pose[1..].iter().zip(&self.poses[i][1..]).all(|(a, b)| a.distance(*b) < 1e-5));
        }
    }
}

/// The rows of a camera's 4 × 4 extrinsics.
pub(super) fn extrinsics(turn: DMat3, moved: DVec3) -> Vec<f64> {
    let row = |r: usize| [turn.row(r).x, turn.row(r).y, turn.row(r).z, moved[r]];
    [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]].concat()
}

pub(super) fn known(dir: &Path) -> Motion {
    let mut expected = Expected::open(dir, "easymocap");
    let (roots, poses) = (expected.values("root_cam"), expected.values("poses"));
    let betas = expected.values("betas_mean");
    let poses = poses.chunks_exact(72).zip(roots.chunks_exact(9)).map(|(pose, root)| {
        let root = fit::axis_angle(DMat3::from_cols_slice(root).transpose());
        [vec![root], fit::vectors(&pose[3..])].concat()
    });
    let body = BodyModel::load(&dir.join("../body/open_body.npz")).unwrap();
    let shape: Vec<f32> = betas.iter().map(|&b| b as f32).collect();
    Motion {
        video: Video::list(&dir.join("frames")).unwrap(),
        k: expected.values("K"),
        poses: poses.collect(),
        pelvises: fit::vectors(&expected.values("pelvis_cam")),
        joint: body.shaped(&shape).joints[0].as_dvec3(),
        betas,
    }
}

/// A video of pictures that are not read.
pub(super) fn video(names: impl IntoIterator<Item = impl ToString>, size: (u32, u32)) -> Video {
    let names: Vec<String> = names.into_iter().map(|name| name.to_string()).collect();
    Video { paths: vec![PathBuf::new(); names.len()], names, size }
}

struct Expected(Npz);

impl Expected {
    fn open(dir: &Path, name: &str) -> Self {
        Self(Npz::open(&dir.join(format!("expected/expected_{name}.npz"))).unwrap())
    }

    fn array(&mut self, key: &str) -> NdArray {
        self.0.array(key).unwrap()
    }

    fn values(&mut self, key: &str) -> Vec<f64> {
        self.array(key).to_f64()
    }
}

fn fit_of(dir: &Path, file: &str, person: Option<&str>) -> (Tool, Person, Vec<(String, usize)>) {
    let video = Video::list(&dir.join("frames")).unwrap();
    let path = dir.join(file);
    let (fit, _) = read::read(&path, &video).unwrap_or_else(|e| panic!("{e}"));
    let (person, others, _) = choose(&path, fit.people, person).unwrap();
    (fit.tool, person, others)
}

#[test]
fn the_person_in_most_frames_is_chosen_and_the_others_are_named() {
    let Some(dir) = shared("estimators") else { return };
    for (file, tool, id, others, ghosts) in [
        ("wham/wham_output.pkl", Tool::Wham, "0", vec![("1".to_owned(), 6)], 0),
        ("phalp/demo_clip.pkl", Tool::Phalp, "1", vec![("2".to_owned(), 5)], 2),
        ("gvhmr/hmr4d_results.pt", Tool::Gvhmr, "0", vec![], 0),
        ("prompthmr/results.pkl", Tool::PromptHmr, "1", vec![("2".to_owned(), 3)], 0),
        ("romp/video_results.npz", Tool::Romp, "1", vec![("2".to_owned(), 5)], 0),
        ("easymocap/smpl", Tool::EasyMocap, "0", vec![("1".to_owned(), 5)], 0),
    ] {
        let (found, person, rest) = fit_of(&dir, file, None);
        assert_eq!((found, person.id.as_str(), rest, person.ghosts), (tool, id, others, ghosts), "{file}");
    }
    let (_, person, _) = fit_of(&dir, "wham/wham_output_gap.pkl", None);
    assert_eq!(gaps(&person, 20), [0, 0, 3]);
    let (_, person, _) = fit_of(&dir, "prompthmr/results.pkl", None);
    assert_eq!(gaps(&person, 20), [4, 4, 0]);
}

#[test]
fn masks_are_as_another_reader_has_them() {
    let Some(dir) = shared("estimators") else { return };
    let video = Video::list(&dir.join("frames")).unwrap();
    for name in ["sam2", "sam2_per_object", "grounded_sam2", "matanyone", "phalp", "prompthmr"] {
        let mut expected = Expected::open(&dir, &format!("masks_{name}"));
        let packed = expected.array("masks_packed");
        let (packed, indices) = (packed.to_f64(), expected.values("frame_index"));
        let each = 256 * 256 / 8;
        let path = dir.join(name);
        let own = match name {
            "phalp" => Some("phalp/demo_clip.pkl"),
            "prompthmr" => Some("prompthmr/results.pkl"),
            _ => None,
        };
        let found: Vec<(usize, Vec<u8>)> = match own {
            Some(file) => {
                let person = fit_of(&dir, file, None).1;
                let frames = person.frames.iter().map(|frame| {
                    let mask = frame.mask.as_ref().unwrap();
                    (frame.index, write::own_levels(mask, video.size, &path, name).unwrap())
                });
                frames.collect()
            }
            None => {
                let masks = Masks::open(&path, &ImportOptions::default(), &video).unwrap();
                let held = (0..20).filter(|&i| masks.has(i));
                held.map(|i| (i, masks.levels(i, &video).unwrap().0)).collect()
            }
        };
        assert_eq!(found.len(), indices.len(), "{name}");
        for (i, (index, levels)) in found.iter().enumerate() {
            assert_eq!(*index as f64, indices[i], "{name}");
            for (at, level) in levels.iter().enumerate() {
                let bit = packed[i * each + at / 8] as u8 >> (7 - at % 8) & 1;
                assert_eq!(u8::from(*level >= 128), bit, "{name}, frame {index}, pixel {at}");
            }
        }
    }
}

#[test]
fn objects_in_front_become_occluders() {
    let Some(dir) = shared("estimators") else { return };
    let video = Video::list(&dir.join("frames")).unwrap();
    let options = ImportOptions { occluder_objects: vec![2], ..ImportOptions::default() };
    let (values, folders) = (dir.join("sam2"), dir.join("sam2_per_object"));
    let by_value = Masks::open(&values, &options, &video).unwrap();
    let by_folder = Masks::open(&folders, &options, &video).unwrap();
    for i in [0, 7, 19] {
        let (a, b) = (by_value.levels(i, &video).unwrap(), by_folder.levels(i, &video).unwrap());
        assert!(a == b, "frame {i}");
        let front = a.1.unwrap();
        assert!(front.iter().filter(|v| **v == 255).count() > 1000);
        assert!(front.iter().zip(&a.0).all(|(front, person)| front & person == 0));
    }
    let wrong = ImportOptions { object: Some(9), ..ImportOptions::default() };
    for path in [&values, &folders] {
        let error = Masks::open(path, &wrong, &video).err().unwrap().to_string();
        assert!(error.contains("object 9") && error.contains("1, 2"), "{error}");
    }
}

#[test]
fn outliers_do_not_move_the_mean_shape() {
    let mut frames: Vec<Vec<f64>> = (0..20).map(|i| vec![1.0 + 0.01 * f64::from(i % 5 - 2); BETAS]).collect();
    frames[3] = vec![40.0; BETAS];
    let (mean, spread) = robust_mean(frames.iter().map(Vec::as_slice));
    assert!(mean.iter().all(|m| (m - 1.0).abs() < 0.01), "{mean:?}");
    assert!(spread > 5.0);
}

#[test]
fn masks_are_matched_by_name_by_order_or_by_number() {
    let dir = Directory::new("import-match");
    let video = video((1..=4).map(|i| format!("{i:06}")), (4, 4));
    let options = ImportOptions::default();
    let open = |folder: &str| Masks::open(&dir.file(folder), &options, &video);
    std::fs::create_dir_all(dir.file("nothing")).unwrap();
    for (folder, names, found) in [
        ("names", &["000002", "000004"][..], Ok([1, 3].as_slice())),
        ("order", &["0000", "0001", "0002", "0003"], Ok(&[0, 1, 2, 3])),
        ("number", &["00000", "00002"], Ok(&[0, 2])),
        ("beyond", &["00007"], Err("00007")),
        ("twice", &["a_01", "b_01"], Err("number 1")),
        ("nothing", &[], Err("masks")),
    ] {
        for name in names {
            dir.picture(&format!("{folder}/{name}.png"), (4, 4), |x, y| if x == 1 && y == 1 { 255 } else { 0 });
        }
        match (open(folder), found) {
            (Ok(masks), Ok(found)) => assert_eq!((0..4).filter(|&i| masks.has(i)).collect::<Vec<_>>(), found),
            (masks, found) => assert!(masks.err().unwrap().to_string().contains(found.unwrap_err()), "{folder}"),
        }
    }
    // Masks of all but the person, told by the border.
    dir.picture("inverted/000001.png", (4, 4), |x, y| if x == 1 && y == 1 { 0 } else { 255 });
    let inverted = open("inverted").unwrap();
    let levels = inverted.levels(0, &video).unwrap().0;
    assert!(inverted.kind.contains("all but the person"));
    assert!(levels.iter().enumerate().all(|(i, level)| (*level == 255) == (i == 5)));
    dir.picture("empty/000001.png", (4, 4), |_, _| 0);
    assert!(open("empty").err().unwrap().to_string().contains("all masks"));
}

/// A `.npy` of 64-bit floats.
fn npy(shape: &[usize], values: &[f64]) -> Vec<u8> {
    testkit::files::npy("<f8", shape, &values.iter().flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>())
}

/// Levels of the person in a mask of 4 × 2 pixels.
fn levels_of(extension: &str, bytes: &[u8], options: &ImportOptions) -> Vec<u8> {
    let dir = Directory::new("import-levels");
    // What systems leave beside pictures.
    for leftover in ["._000000.png", ".DS_Store", "Thumbs.db"] {
        dir.write(&format!("masks/{leftover}"), b"Mac OS X");
    }
    dir.write(&format!("masks/000000.{extension}"), bytes);
    let (path, video) = (dir.file("masks"), video(["000000"], (4, 2)));
    Masks::open(&path, options, &video).unwrap().levels(0, &video).unwrap().0
}

/// A PNG of 4 × 2 pixels.
fn png_of<P>(pixel: impl Fn(u32, u32) -> P) -> Vec<u8>
where
    P: image::PixelWithColorType,
    image::ImageBuffer<P, Vec<P::Subpixel>>: Into<image::DynamicImage>,
{
    let mut bytes = std::io::Cursor::new(Vec::new());
    image::ImageBuffer::from_fn(4, 2, pixel).into().write_to(&mut bytes, image::ImageFormat::Png).unwrap();
    bytes.into_inner()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]
    #[test]
    fn ids_are_integers_at_any_depth(bits in 1u32..16, a in 1u32..1 << 15, b in 1u32..1 << 15) {
        // As large as the depth holds.
        let [id, other] = [a, b].map(|id| (id >> (15 - bits)).max(1));
        prop_assume!(id != other);
        ids(id, other);
    }
}

/// A mask of two people, in every form that holds their ids.
fn ids(id: u32, other: u32) {
    use image::{Luma, Rgb};
    // Pixel 3 is the person, pixel 5 another person.
    let value = |x: u32, y: u32| [0, 0, 0, id, 0, other, 0, 0][(y * 4 + x) as usize];
    let options = ImportOptions { object: Some(id), ..ImportOptions::default() };
    let check = |kind: &str, extension: &str, bytes: &[u8]| {
        assert_eq!(levels_of(extension, bytes, &options), [0, 0, 0, 255, 0, 0, 0, 0], "{kind} of {id}, {other}");
    };
    check("16 bits", "png", &png_of(|x, y| Luma([value(x, y) as u16])));
    let values: Vec<f64> = (0..8).map(|i| f64::from(value(i, 0))).collect();
    check("floats", "npy", &npy(&[1, 2, 4], &values));
    for depth in [2u32, 4, 8].into_iter().filter(|depth| id.max(other) < 1 << depth) {
        // Larger shades of grey are coverage.
        let kinds = [png::ColorType::Indexed, png::ColorType::Grayscale];
        for kind in kinds.into_iter().take(if id.max(other) < 128 { 2 } else { 1 }) {
            let row = |y| (0..4).fold(0u32, |row, x| row << depth | value(x, y)) << (32 - 4 * depth);
            let packed = |y| row(y).to_be_bytes()[..(depth as usize).div_ceil(2)].to_vec();
            let mut bytes = Vec::new();
            let mut encoder = png::Encoder::new(&mut bytes, 4, 2);
            encoder.set_color(kind);
            encoder.set_depth(png::BitDepth::from_u8(depth as u8).unwrap());
            encoder.set_palette(vec![77; 3 << depth]);
            encoder.write_header().unwrap().write_image_data(&[packed(0), packed(1)].concat()).unwrap();
            check(&format!("{depth} bits, {kind:?}"), "png", &bytes);
        }
    }
    if id.max(other) < 128 {
        check("grey of three channels", "png", &png_of(|x, y| Rgb([value(x, y) as u8; 3])));
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(32))]
    #[test]
    fn masks_in_alpha_and_of_16_bits_are_coverage(soft in any::<u8>(), color in any::<[u8; 3]>()) {
        coverage([0, 0, 0, 255, 0, 0, soft, 0], color);
    }
}

fn coverage(expected: [u8; 8], [r, g, b]: [u8; 3]) {
    use image::{Luma, LumaA, Rgba};
    let pixel = |x: u32, y: u32| expected[(y * 4 + x) as usize];
    // Cut out of a photograph, or white; the rest of the picture is as background removers leave
    // it.
    for bytes in [
        png_of(|x, y| Rgba([255, 255, 255, pixel(x, y)])),
        png_of(|x, y| Rgba([r, g, b, pixel(x, y)])),
        png_of(|x, y| LumaA([255, pixel(x, y)])),
        png_of(|x, y| Luma([u16::from(pixel(x, y)) * 257])),
    ] {
        assert_eq!(levels_of("png", &bytes, &ImportOptions::default()), expected);
    }
}

#[test]
fn a_stack_with_an_axis_of_one_and_an_archive_are_masks() {
    let dir = Directory::new("import-stack");
    let values: Vec<f64> = (0..24).map(|i| f64::from(i % 8 == 3)).collect();
    let video = video(1..=3, (4, 2));
    let data = array_files::Data::F64(values.clone());
    for shape in [&[3, 2, 4][..], &[3, 1, 2, 4], &[3, 2, 4, 1]] {
        dir.write("stack.npy", npy(shape, &values));
        let array = array_files::NdArray { shape: shape.to_vec(), data: data.clone() };
        npz::write(&dir.path().join("stack.npz"), &[("masks", array)]).unwrap();
        for file in ["stack.npy", "stack.npz"] {
            let path = dir.path().join(file);
            let masks = Masks::open(&path, &ImportOptions::default(), &video).unwrap();
            let levels = masks.levels(2, &video).unwrap().0;
            assert!(levels.iter().enumerate().all(|(i, level)| (*level == 255) == (i == 3)), "{file} {shape:?}");
        }
    }
    let arrays = ["masks", "boxes"].map(|key| (key, array_files::NdArray { shape: vec![3, 2, 4], data: data.clone() }));
    npz::write(&dir.file("several.npz"), &arrays).unwrap();
    let error = Masks::open(&dir.file("several.npz"), &ImportOptions::default(), &video).err().unwrap().to_string();
    for word in ["several.npz", "one array of masks", "boxes"] {
        assert!(error.contains(word), "{error}");
    }
}

#[test]
fn a_stack_that_claims_endless_empty_masks_is_refused_at_once() {
    let dir = Directory::new("import-endless");
    dir.write("stack.npy", npy(&[1 << 40, 0, 0], &[]));
    let error = Masks::open(&dir.file("stack.npy"), &ImportOptions::default(), &video(1..=1, (4, 2))).err().unwrap();
    assert!(error.to_string().contains("shape"), "{error}");
}

#[test]
fn gvhmr_saved_again_with_joined_names_is_the_same() {
    let Some(dir) = shared("estimators") else { return };
    let video = Video::list(&dir.join("frames")).unwrap();
    let path = dir.join("gvhmr/hmr4d_results.pt");
    let whole = file::value(&path, "").unwrap();
    let out = Directory::new("import-gvhmr-again");
    let frames = |path: &Path| {
        let (fit, _) = read::read(path, &video).unwrap();
        assert_eq!(fit.tool, Tool::Gvhmr);
        let person = fit.people.into_iter().next().unwrap();
        person.frames.into_iter().map(|f| (f.pose, f.betas, f.offset, f.focal)).collect::<Vec<_>>()
    };
    let incam = Item::new(&path, &whole).get("smpl_params_incam").unwrap().entries().unwrap();
    for prefix in ["smpl_params_incam", "body_params_incam"] {
        let array = |item: &Item<'_>| item.array().unwrap().into_owned();
        let below = incam.iter().map(|(key, item)| (format!("{prefix}_{key}"), array(item)));
        let camera = ("K_fullimg".to_owned(), array(&Item::new(&path, &whole).get("K_fullimg").unwrap()));
        let arrays: Vec<_> = below.chain([camera]).collect();
        let named: Vec<_> = arrays.iter().map(|(key, array)| (key.as_str(), array.clone())).collect();
        let again = out.path().join("gvhmr.npz");
        npz::write(&again, &named).unwrap();
        assert_eq!(frames(&again), frames(&path));
    }
}

#[test]
fn one_person_under_several_ids_is_joined() {
    let frame = |index: usize, x: f64| FitFrame { index, offset: DVec3::new(x, 0.0, 3.0), ..FitFrame::default() };
    let track = |id: &str, frames: std::ops::Range<usize>, x: f64| Person::new(id, frames.map(|index| frame(index, x)));
    let people =
        || vec![track("0", 0..10, 0.0), track("4", 12..20, 0.2), track("9", 3..8, 0.1), track("17", 25..30, 4.0)];
    let (person, others, hint) = choose(Path::new("f"), people(), None).unwrap();
    assert_eq!((person.id.as_str(), person.frames.len(), others.len()), ("0", 10, 3));
    assert!(hint.unwrap().contains("--person 0,4"), "9 is there at the same time, 17 elsewhere");
    let (person, others, hint) = choose(Path::new("f"), people(), Some("0, 4,17")).unwrap();
    assert_eq!((person.frames.len(), others.len(), hint), (23, 1, None));
    assert!(person.frames.windows(2).all(|pair| pair[0].index < pair[1].index));
    assert!(choose(Path::new("f"), people(), Some("0,5")).err().unwrap().to_string().contains("person 5"));
}

#[test]
fn fits_that_are_wrong_are_named() {
    let Some(dir) = shared("estimators") else { return };
    let video = Video::list(&dir.join("frames")).unwrap();
    let few = Video { names: video.names[..7].to_vec(), paths: video.paths[..7].to_vec(), size: video.size };
    for file in [
        "wham/wham_output.pkl",
        "phalp/demo_clip.pkl",
        "gvhmr/hmr4d_results.pt",
        "prompthmr/results.pkl",
        "romp/video_results.npz",
        "easymocap",
    ] {
        match read::read(&dir.join(file), &few) {
            Ok((fit, _)) => assert!(fit.people.iter().any(|person| person.absent > 0), "{file}"),
            Err(error) => assert!(error.to_string().contains('7'), "{file}: {error}"),
        }
    }
    let tall = Video { size: (256, 512), names: video.names, paths: video.paths };
    for file in ["phalp/demo_clip.pkl", "easymocap", "gvhmr/hmr4d_results.pt"] {
        let error = read::read(&dir.join(file), &tall).err().unwrap().to_string();
        assert!(error.contains("512"), "{file}: {error}");
    }
    let (_, person, _) = fit_of(&dir, "wham/wham_output.pkl", None);
    let error = choose(Path::new("f"), vec![person], Some("5")).err().unwrap().to_string();
    assert!(error.contains("person 5") && error.contains("0 (20 frames)"), "{error}");
    let bodies = dir.join("../body");
    for (tool, body, words) in [
        (Tool::Gvhmr, "open_body.npz", ["SMPLX_NEUTRAL.npz", "smpl-x.is.tue.mpg.de"]),
        (Tool::Wham, "open_body_x.npz", ["SMPL_NEUTRAL.pkl", "smpl.is.tue.mpg.de"]),
    ] {
        let error = body::find(tool, Some(&bodies.join(body)), &[]).err().unwrap().to_string();
        assert!(words.iter().all(|word| error.contains(word)), "{error}");
        let (path, model) = body::find(tool, None, &[Path::new("/")]).unwrap();
        assert_eq!((path, model.num_joints()), (None, 24));
    }
    assert_eq!(SMPLX, Tool::PromptHmr.joints());
}

/// Name in `expected/`, file, person asked for.
const FITS: [(&str, &str, Option<&str>); 12] = [
    ("wham", "wham/wham_output.pkl", None),
    ("wham_person1", "wham/wham_output.pkl", Some("1")),
    ("wham_gap", "wham/wham_output_gap.pkl", None),
    ("phalp", "phalp/demo_clip.pkl", None),
    ("phalp_person2", "phalp/demo_clip.pkl", Some("2")),
    ("gvhmr", "gvhmr/hmr4d_results.pt", None),
    ("prompthmr", "prompthmr/results.pkl", None),
    ("prompthmr_person2", "prompthmr/results.pkl", Some("2")),
    ("romp", "romp/video_results.npz", None),
    ("romp_person2", "romp/video_results.npz", Some("2")),
    ("easymocap", "easymocap", None),
    ("easymocap_person1", "easymocap", Some("1")),
];

#[track_caller]
fn near(what: &str, found: &[f64], expected: &[f64], tolerance: f64) {
    assert_eq!(found.len(), expected.len(), "{what}");
    let worst = found.iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(worst <= tolerance, "{what}: off by {worst}");
}

#[test]
fn another_focal_length_leaves_the_pelvis_on_its_pixel() {
    let Some(dir) = shared("estimators") else { return };
    for (_, file, _) in FITS {
        let (_, person, _) = fit_of(&dir, file, None);
        for frame in &person.frames {
            let joint = DVec3::new(0.0, -0.22, 0.02);
            let pixel = |frame: &FitFrame| {
                let p = frame.pelvis(joint);
                [frame.focal[0] * p.x / p.z, frame.focal[1] * p.y / p.z]
            };
            let mut other = frame.clone();
            other.refocused(700.0, joint);
            near(file, &pixel(&other), &pixel(frame), 1e-9);
            let depth = frame.pelvis(joint).z / frame.focal[0];
            near(file, &[other.focal[0], other.pelvis(joint).z / 700.0], &[700.0, depth], 1e-9);
        }
    }
}

#[test]
fn a_lost_picture_costs_its_own_frame_alone() {
    let Some(dir) = shared("estimators") else { return };
    let video = Video::list(&dir.join("frames")).unwrap();
    let lost = 6;
    let mut short = Video::list(&dir.join("frames")).unwrap();
    short.names.remove(lost);
    short.paths.remove(lost);
    for (_, file, person) in FITS {
        let frames = |video: &Video| {
            let (fit, note) = read::read(&dir.join(file), video).unwrap();
            let (person, ..) = choose(Path::new(file), fit.people, person).unwrap();
            (person, note)
        };
        let ((whole, _), (part, note)) = (frames(&video), frames(&short));
        for frame in &part.frames {
            let name = &short.names[frame.index];
            let same = whole.frames.iter().find(|other| video.names[other.index] == *name).unwrap();
            assert_eq!((&frame.pose, frame.offset), (&same.pose, same.offset), "{file} {name}: {note:?}");
        }
        let had = whole.frames.iter().any(|frame| frame.index == lost);
        assert_eq!((part.frames.len(), part.absent), (whole.frames.len() - usize::from(had), usize::from(had)));
    }
    for masks in ["sam2", "sam2_per_object", "matanyone"] {
        let path = dir.join(masks);
        let open = |video: &Video| Masks::open(&path, &ImportOptions::default(), video).unwrap();
        let (all, some) = (open(&video), open(&short));
        for (i, name) in short.names.iter().enumerate() {
            let other = video.names.iter().position(|other| other == name).unwrap();
            assert_eq!(some.has(i), all.has(other), "{masks} {name}");
            if some.has(i) {
                assert_eq!(some.levels(i, &short).unwrap(), all.levels(other, &video).unwrap(), "{name}");
            }
        }
    }
}
