//! PeopleSnapshot as InstantAvatar prepares it: `poses.npz` {`betas` (10), `transl` (N,3), and
//! `thetas` (N,72) or `global_orient` (N,3) and `body_pose` (N,69)}, a row a frame; beside it or in
//! the folder above `cameras.npz` {`intrinsic` (3,3), `extrinsic` (4,4) world to camera, `height`,
//! `width`}. The root turns about the pelvis. GaussianAvatar makes of it `smpl_parms.pth` {`beta`
//! (1,10), `body_pose` (N,72), `trans` (N,3)} and `cam_parms.npz` {`intrinsic`, `extrinsic`}.

use std::io::{Read, Seek};
use std::path::{Path, PathBuf};

use array_files::npz::Npz;
use array_files::torch::TorchFile;
use glam::DVec3;

use super::fit::{About, BETAS, Fit, FitFrame, Person, SMPL, Tool};
use super::item::{Item, dictionary, vectors};
use super::video::Video;
use crate::CaptureError;

/// Whether an archive with these names is one.
pub(super) fn is(keys: &[String]) -> bool {
    let has = |key: &str| keys.iter().any(|other| other == key);
    has("transl") && has("betas") && (has("thetas") || has("body_pose"))
}

pub(super) fn read(path: &Path, npz: &mut Npz, video: &Video) -> Result<Fit, CaptureError> {
    let cameras = beside(path, "cameras.npz")?;
    let (camera, fit) = (dictionary(&mut Npz::open(&cameras)?)?, dictionary(npz)?);
    let (camera, fit) = (Item::new(&cameras, &camera), Item::new(path, &fit));
    for (key, side) in ["width", "height"].into_iter().zip(video.sides()) {
        let given = camera.get(key)?;
        let found = given.number()?;
        if found != side {
            return Err(given.invalid(format!("{side}, as the frames"), found.to_string()));
        }
    }
    let place = fit.get("transl")?;
    let poses = match fit.find("thetas") {
        Some(thetas) => thetas.rows(3 * SMPL)?,
        None => {
            let (roots, bodies) = (fit.get("global_orient")?.rows(3)?, fit.get("body_pose")?.rows(3 * SMPL - 3)?);
            roots.into_iter().zip(bodies).map(|(root, body)| [root, body].concat()).collect()
        }
    };
    let betas = fit.get("betas")?.numbers(&[Some(1), Some(BETAS)])?;
    frames(Tool::PeopleSnapshot, &camera, &place, &poses, &betas, video)
}

/// A fit by GaussianAvatar.
pub(super) fn of_gaussian_avatar<R: Read + Seek>(
    path: &Path,
    file: &mut TorchFile<R>,
    video: &Video,
) -> Result<Fit, CaptureError> {
    let cameras = beside(path, "cam_parms.npz")?;
    let camera = dictionary(&mut Npz::open(&cameras)?)?;
    let root = file.root().clone();
    let fit = file.resolve("", &root)?;
    let fit = Item::new(path, &fit);
    let (pose, shape) = (fit.get("body_pose")?.rows(3 * SMPL)?, fit.get("beta")?.rows(BETAS)?);
    let betas = shape.first().ok_or_else(|| fit.invalid("beta of one row", "none"))?;
    frames(Tool::GaussianAvatar, &Item::new(&cameras, &camera), &fit.get("trans")?, &pose, betas, video)
}

/// A file beside `path` or in the folder above.
fn beside(path: &Path, name: &str) -> Result<PathBuf, CaptureError> {
    let found = path.ancestors().skip(1).take(2).map(|dir| dir.join(name)).find(|file| file.is_file());
    found.ok_or_else(|| CaptureError::missing(&path.with_file_name(name), "file (nor in the folder above): the camera"))
}

/// A person before a camera that stands still, a row of `place` and of `poses` a picture.
fn frames(
    tool: Tool,
    camera: &Item<'_>,
    place: &Item<'_>,
    poses: &[Vec<f64>],
    betas: &[f64],
    video: &Video,
) -> Result<Fit, CaptureError> {
    let k = camera.get("intrinsic")?.numbers(&[Some(3), Some(3)])?;
    let extrinsic = camera.get("extrinsic")?;
    let (turn, moved) = extrinsic.rigid(&extrinsic.numbers(&[Some(4), Some(4)])?)?;
    let places = place.rows(3)?;
    place.as_long(poses.len(), places.len())?;
    // The frames of a partial split are unknown.
    if places.len() < video.names.len() {
        let expected = format!("{} rows, one a frame of the video", video.names.len());
        return Err(place.invalid(expected, places.len().to_string()));
    }
    let lens = [[k[0], k[4]], [k[2], k[5]]];
    let frames = poses.iter().zip(&places).enumerate().map(|(index, (pose, place))| FitFrame {
        world_to_camera: turn,
        about: About::Origin(turn),
        offset: turn * DVec3::from_slice(place) + moved,
        ..FitFrame::still(index, vectors(pose), betas.to_vec(), place, lens)
    });
    let person = Person { id: "0".to_owned(), frames: frames.collect(), ..Person::default() };
    Ok(Fit { tool, people: vec![person], names: None })
}

#[cfg(test)]
mod tests {
    use array_files::{Data, NdArray, npz};

    use super::*;
    use crate::import::fit::{axis_angle, rotation};
    use crate::import::read;
    use crate::import::tests::{Motion, extrinsics, known};
    use crate::testing::{Directory, Py, shared};
    use testkit::files::zip;

    #[test]
    fn what_is_prepared_from_a_known_motion_is_that_motion() {
        let Some(dir) = shared("estimators") else { return };
        let motion = known(&dir);
        let Motion { video, k, betas, poses, pelvises, joint } = &motion;
        let out = Directory::new("import-peoplesnapshot");
        let array = |shape: &[usize], values: Vec<f64>| NdArray { shape: shape.to_vec(), data: Data::F64(values) };
        let (turn, moved) = (rotation(DVec3::new(3.0, 0.2, -0.4)), DVec3::new(0.3, -0.2, 1.5));
        let extrinsic = extrinsics(turn, moved);
        let write = |name: &str, arrays: &[(&str, NdArray)]| npz::write(&out.path().join(name), arrays).unwrap();
        let cameras = |width: f64| {
            write(
                "cameras.npz",
                &[
                    ("intrinsic", array(&[3, 3], k.clone())),
                    ("extrinsic", array(&[4, 4], extrinsic.clone())),
                    ("height", array(&[], vec![256.0])),
                    ("width", array(&[], vec![width])),
                ],
            );
        };
        cameras(256.0);
        let count = poses.len();
        let roots: Vec<DVec3> = poses.iter().map(|pose| axis_angle(turn.transpose() * rotation(pose[0]))).collect();
        let thetas = poses.iter().zip(&roots).flat_map(|(pose, root)| [&[*root], &pose[1..]].concat());
        let thetas: Vec<f64> = thetas.flat_map(|v| v.to_array()).collect();
        let places = pelvises.iter().flat_map(|p| (turn.transpose() * (*p - moved) - *joint).to_array());
        let transl = array(&[count, 3], places.collect());
        let betas = array(&[1, 10], betas.clone());
        write(
            "poses.npz",
            &[("betas", betas.clone()), ("thetas", array(&[count, 72], thetas.clone())), ("transl", transl.clone())],
        );
        // The other form of the same, in a folder below.
        std::fs::create_dir_all(out.path().join("poses")).unwrap();
        let part = |from: usize, to: usize| thetas.chunks_exact(72).flat_map(|row| row[from..to].to_vec()).collect();
        write(
            "poses/train.npz",
            &[
                ("betas", betas.clone()),
                ("global_orient", array(&[count, 3], part(0, 3))),
                ("body_pose", array(&[count, 69], part(3, 72))),
                ("transl", transl.clone()),
            ],
        );
        // The same as GaussianAvatar has it, and with the joints of SMPL-X.
        let parms = |name: &str, width: usize| {
            let n = count as u32;
            let bodies = thetas.chunks_exact(72).flat_map(|row| row.iter().copied().chain([0.0; 93]).take(width));
            let parms = Py::record([
                ("beta", crate::testing::array(&[1, 10], &betas.to_f64())),
                ("body_pose", crate::testing::array(&[n, width as u32], &bodies.collect::<Vec<_>>())),
                ("trans", crate::testing::array(&[n, 3], &transl.to_f64())),
            ]);
            out.write(name, zip([("archive/data.pkl", parms.pickle())]));
        };
        parms("smpl_parms.pth", 72);
        parms("smplx.pth", 165);
        std::fs::copy(out.path().join("cameras.npz"), out.path().join("cam_parms.npz")).unwrap();
        let error = read::read(&out.path().join("smplx.pth"), video).err().unwrap().to_string();
        assert!(["smplx.pth", "body_pose", "72", "165"].iter().all(|word| error.contains(word)), "{error}");
        for (file, tool) in [
            ("poses.npz", Tool::PeopleSnapshot),
            ("poses/train.npz", Tool::PeopleSnapshot),
            ("smpl_parms.pth", Tool::GaussianAvatar),
        ] {
            let (fit, _) = read::read(&out.path().join(file), video).unwrap();
            assert_eq!((fit.tool, fit.people.len(), fit.people[0].frames.len()), (tool, 1, count));
            motion.is_of(&fit.people[0]);
        }
        let refused = |words: &[&str]| {
            let error = read::read(&out.path().join("poses.npz"), video).err().unwrap().to_string();
            assert!(words.iter().all(|word| error.contains(word)), "{error}");
        };
        cameras(1080.0);
        refused(&["cameras.npz", "width", "256", "1080"]);
        cameras(256.0);
        write(
            "poses.npz",
            &[("betas", betas), ("thetas", array(&[2, 72], vec![0.0; 144])), ("transl", array(&[2, 3], vec![0.0; 6]))],
        );
        refused(&["poses.npz", "transl", "20 rows", "found 2"]);
        std::fs::remove_file(out.path().join("cameras.npz")).unwrap();
        refused(&["cameras.npz", "missing"]);
    }
}
