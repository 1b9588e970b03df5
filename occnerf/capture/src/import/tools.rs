//! Results of estimators that fit SMPL or SMPL-X to a video, a function a tool.

use std::collections::BTreeMap;
use std::path::Path;

use array_files::Data;
use array_files::pickle::Value;
use glam::DVec3;

use super::fit::{About, BETAS, Fit, FitFrame, ORTHONORMAL, OwnMask, People, Person, SMPL, Tool, axis_angle, pinhole};
use super::rle::Rle;
use super::video::Video;
use crate::CaptureError;
use crate::item::Item;
use crate::names::FrameName;

/// Names and values of a dictionary.
type Entries<'a> = [(String, Item<'a>)];

/// WHAM's `wham_output.pkl`: by person id `pose` (T,72) axis-angle in the camera, `trans` (T,3),
/// `betas` (T,10), `frame_ids` (T). The focal length is not in it: √(W² + H²), the principal point
/// the image's centre.
pub(super) fn wham(people: &Entries<'_>, video: &Video) -> Result<Fit, CaptureError> {
    let person = |(id, item): &(String, Item<'_>)| {
        let indices = item.get("frame_ids")?.indices()?;
        let rows = item.table(Some(indices.len()), &[("pose", 3 * SMPL), ("betas", BETAS), ("trans", 3)])?;
        let frames = indices.iter().zip(&rows).map(|(index, row)| FitFrame::still(*index, row, video.diagonal()));
        Ok(Person::new(id, frames))
    };
    // Dropped tracks are empty.
    let begun = people.iter().filter(|(_, item)| item.value.get("pose").is_some());
    Ok(Fit::of_video(Tool::Wham, begun.map(person).collect::<Result<_, CaptureError>>()?))
}

/// VIBE's `vibe_output.pkl`, which PyMAF's demo writes alike: by person id `pose` (T,72)
/// axis-angle in the camera, `betas` (T,10), `orig_cam` (T,4): scales and translation (sx, sy, tx,
/// ty) of a weak-perspective camera, x of the picture from −1 to 1 being sx (X + tx); `frame_ids`
/// (T). Without it, `pred_cam` (T,3): scale and translation in a square of `bboxes` (T,4): centre
/// and sides.
/// The focal length is not in it: √(W² + H²).
pub(super) fn vibe(people: &Entries<'_>, video: &Video) -> Result<Fit, CaptureError> {
    /// Least scale of a camera.
    const MIN_SCALE: f64 = 1e-3;
    let sides = video.sides();
    let lens = video.diagonal();
    let person = |(id, item): &(String, Item<'_>)| {
        let indices = item.get("frame_ids")?.indices()?;
        let count = Some(indices.len());
        let mut rows = item.table(count, &[("pose", 3 * SMPL), ("betas", BETAS)])?;
        let key = if item.find("orig_cam").is_some() { "orig_cam" } else { "pred_cam" };
        let cameras = match key {
            "orig_cam" => item.table(count, &[(key, 4)])?.iter().map(|cam| [cam[0], cam[2], cam[3]]).collect(),
            _ => {
                let whole = |row: &Vec<f64>| {
                    let (crop, bounds) = row.split_at(3);
                    let moved =
                        |i: usize| (2.0 * bounds[i] / sides[i] - 1.0) / (crop[0] * bounds[3] / sides[i]) + crop[1 + i];
                    [crop[0] * bounds[3] / sides[0], moved(0), moved(1)]
                };
                item.table(count, &[(key, 3), ("bboxes", 4)])?.iter().map(whole).collect::<Vec<_>>()
            }
        };
        for (i, (row, [scale, x, y])) in rows.iter_mut().zip(cameras).enumerate() {
            if !(scale >= MIN_SCALE && x.is_finite() && y.is_finite()) {
                let expected = format!("scales of at least {MIN_SCALE}");
                return Err(item.get(key)?.invalid(expected, format!("{scale} at {i}")));
            }
            // A metre has scale · W/2 pixels at the body.
            row.extend([x, y, lens[0][0] / (scale * sides[0] / 2.0)]);
        }
        Ok(Person::new(id, indices.iter().zip(&rows).map(|(index, row)| FitFrame::still(*index, row, lens))))
    };
    Ok(Fit::of_video(Tool::Vibe, people.iter().map(person).collect::<Result<_, CaptureError>>()?))
}

/// GVHMR's `hmr4d_results.pt`: `smpl_params_incam` {`body_pose` (L,63), `betas` (L,10),
/// `global_orient` (L,3), `transl` (L,3)} of SMPL-X, and `K_fullimg` (L,3,3); of its relative GEM
/// (`smpl_params.pt`) `body_params_incam`. The same re-saved by numpy, nested or with joined names.
/// One person in every frame.
pub(super) fn gvhmr(whole: &Item<'_>, video: &Video) -> Result<Fit, CaptureError> {
    /// Joints of the body in `body_pose`.
    const BODY: usize = 21;
    /// Pixels by which twice the principal point may be off the frames' size.
    const SIZE: f64 = 2.0;
    let names = ["smpl_params_incam", "body_params_incam"];
    let joined = names.into_iter().find(|name| whole.find(&format!("{name}_body_pose")).is_some());
    let (incam, prefix) = match joined {
        Some(name) => (whole.clone(), format!("{name}_")),
        None => {
            (names.iter().find_map(|name| whole.find(name)).map_or_else(|| whole.get(names[0]), Ok)?, String::new())
        }
    };
    let keys = ["global_orient", "body_pose", "betas", "transl"].map(|key| format!("{prefix}{key}"));
    let columns = [(&*keys[0], 3), (&*keys[1], 3 * BODY), (&*keys[2], BETAS), (&*keys[3], 3)];
    let rows = incam.table(None, &columns)?;
    let cameras = whole.get("K_fullimg")?;
    let matrices = cameras.numbers(&[None, Some(3), Some(3)])?;
    cameras.as_long(rows.len(), matrices.len() / 9)?;
    let [width, height] = video.sides();
    if let Some(k) = matrices.chunks_exact(9).find(|k| (2.0 * k[2] - width).hypot(2.0 * k[5] - height) > SIZE) {
        let expected = format!("a principal point at the centre of {width}×{height}, the frames' size");
        return Err(cameras.invalid(expected, format!("({}, {})", k[2], k[5])));
    }
    let frames = rows.iter().zip(matrices.chunks_exact(9)).enumerate();
    let frames = frames.map(|(index, (row, k))| FitFrame::still(index, row, pinhole(k)));
    Ok(Fit::of_video(Tool::Gvhmr, vec![Person::new(0, frames)]))
}

/// PromptHMR's `results.pkl`: `people` {id: `frames` (N), `masks` (N,H,W), `smplx_cam` {`pose`
/// (N,75): root, 21 joints of the body, jaw, eyes; `shape` (N,10), `trans` (N,3)}}, `camera`
/// {`img_focal`, `img_center`}. SMPL-X with flat hands. Frames higher than 896 are worked on at a
/// smaller size, twice `img_center`.
pub(super) fn prompthmr(root: &Item<'_>, video: &Video) -> Result<Fit, CaptureError> {
    /// Joints in `pose`.
    const JOINTS: usize = 25;
    /// Height above which frames are worked on at a smaller size.
    const WORKED_ON: f64 = 896.0;
    /// How far the two sides' scales may be apart.
    const ASPECT: f64 = 0.01;
    let camera = root.get("camera")?;
    let (focal, centre) = (camera.get("img_focal")?.number()?, camera.get("img_center")?);
    let at = centre.numbers(&[Some(2)])?;
    let [width, height] = video.sides();
    let scale = [width / (2.0 * at[0]), height / (2.0 * at[1])];
    let lens = if scale[0] > 0.0 && (scale[0] / scale[1] - 1.0).abs() < ASPECT {
        [scale.map(|scale| focal * scale), video.middle()]
    } else {
        // Of a cropped video, whose principal point is not its centre.
        let scale = (height / WORKED_ON).max(1.0);
        if !(0.0..=width).contains(&(scale * at[0])) || !(0.0..=height).contains(&(scale * at[1])) {
            let expected = format!("a point of {width}×{height}, the frames' size, or of the same at another scale");
            return Err(centre.invalid(expected, format!("{at:?}")));
        }
        [[focal * scale; 2], [at[0] * scale, at[1] * scale]]
    };
    let person = |(id, person): (String, Item<'_>)| {
        let indices = person.get("frames")?.indices()?;
        let columns = [("pose", 3 * JOINTS), ("shape", BETAS), ("trans", 3)];
        let rows = person.get("smplx_cam")?.table(Some(indices.len()), &columns)?;
        let mut masks = match person.find("masks") {
            Some(item) => own_masks(&item, indices.len())?.into_iter(),
            None => Vec::new().into_iter(),
        };
        let frames = indices.iter().zip(&rows);
        let frames = frames.map(|(index, row)| FitFrame { mask: masks.next(), ..FitFrame::still(*index, row, lens) });
        Ok(Person::new(id, frames))
    };
    let people = root.get("people")?.entries()?.into_iter().map(person).collect::<Result<_, CaptureError>>()?;
    Ok(Fit::of_video(Tool::PromptHmr, people))
}

/// `masks` (N,H,W), one by one.
fn own_masks(item: &Item<'_>, count: usize) -> Result<Vec<OwnMask>, CaptureError> {
    let array = item.array()?;
    let &[n, height, width] = array.shape.as_slice() else {
        return Err(item.invalid("shape [_, _, _]", format!("shape {:?}", array.shape)));
    };
    item.as_long(count, n)?;
    let Data::Bool(values) = &array.data else { return Err(item.invalid("booleans", "numbers")) };
    let each = (height * width).max(1);
    Ok(values.chunks_exact(each).map(|mask| OwnMask::Pixels(height, width, mask.to_vec())).collect())
}

/// GLAMR's `grecon/NAME_seed1.pkl`: `cam_pose` (T,4,4) world to camera, `person_data` by person id
/// {`smpl_pose` (T,69), `smpl_orient_world` (T,3), `root_trans_world` (T,3), the pelvis,
/// `smpl_beta` (T,10), `exist_frames` (T), `cam_K` (T,3,3), zero where the person is hidden}.
pub(super) fn glamr(root: &Item<'_>) -> Result<Fit, CaptureError> {
    let camera = root.get("cam_pose")?;
    let cameras = camera.numbers(&[None, Some(4), Some(4)])?;
    let count = cameras.len() / 16;
    let columns =
        [("smpl_orient_world", 3), ("smpl_pose", 3 * SMPL - 3), ("smpl_beta", BETAS), ("root_trans_world", 3)];
    let person = |(id, person): (String, Item<'_>)| {
        let rows = person.table(Some(count), &columns)?;
        let exists = person.get("exist_frames")?.numbers(&[Some(count)])?;
        let lens = person.get("cam_K")?;
        let lenses = lens.numbers(&[Some(count), Some(3), Some(3)])?;
        let seen = lenses.chunks_exact(9).find(|k| k[0] > 0.0);
        let k = seen.ok_or_else(|| lens.invalid("a frame with a focal length", "none"))?;
        let frame = |index: usize| {
            let (turn, moved) = camera.rigid(&cameras[16 * index..], ORTHONORMAL)?;
            let still = FitFrame::still(index, &rows[index], pinhole(k));
            Ok(FitFrame { world_to_camera: turn, about: About::Place, offset: turn * still.offset + moved, ..still })
        };
        let frames = (0..count).filter(|&i| exists[i] != 0.0).map(frame).collect::<Result<Vec<_>, CaptureError>>()?;
        Ok(Person::new(id, frames))
    };
    let people = root.get("person_data")?.entries()?.into_iter().map(person).collect::<Result<_, CaptureError>>()?;
    Ok(Fit::of_video(Tool::Glamr, people))
}

/// ROMP's `video_results.npz`: `results` {picture's name: {`smpl_thetas` (N,72), `smpl_betas`
/// (N,10), `cam_trans` (N,3), `track_ids` (N)}}, people in any order. The focal length is 443.4/512
/// · max(W, H) (60 degrees), the principal point that of the square that the picture is padded to,
/// its own centre.
pub(super) fn romp(results: &Item<'_>, video: &Video) -> Result<Fit, CaptureError> {
    let lens = video.lens(443.4 / 512.0 * video.longest());
    let (entries, names) = by_picture(results.entries()?);
    let (mut people, mut last) = (People::default(), BTreeMap::new());
    for (index, item) in entries.iter().enumerate() {
        let rows = item.table(None, &[("smpl_thetas", 3 * SMPL), ("smpl_betas", BETAS), ("cam_trans", 3)])?;
        let frames: Vec<FitFrame> = rows.iter().map(|row| FitFrame::still(index, row, lens)).collect();
        let tracks = match item.find("track_ids") {
            Some(tracks) => {
                let ids = tracks.numbers(&[None])?;
                tracks.as_long(rows.len(), ids.len())?;
                ids.iter().map(|id| *id as i64).collect()
            }
            None => tracked(&frames, &mut last),
        };
        tracks.into_iter().zip(frames).for_each(|(id, frame)| people.get(id).frames.push(frame));
    }
    Ok(Fit { tool: Tool::Romp, people: people.into_vec(), names: Some(names) })
}

/// Entries in the order of their pictures' names, and those names without extension.
fn by_picture<'a>(mut entries: Vec<(String, Item<'a>)>) -> (Vec<Item<'a>>, Vec<String>) {
    entries.sort_by(|a, b| FrameName(&a.0).cmp(&FrameName(&b.0)));
    let stem = |name: &str| Path::new(name).file_stem().map_or(String::new(), |s| s.to_string_lossy().into_owned());
    entries.into_iter().map(|(name, item)| (item, stem(&name))).unzip()
}

/// Ids of the people of a picture, where the file has none: of the person last seen nearest, within
/// two metres.
fn tracked(people: &[FitFrame], last: &mut BTreeMap<i64, DVec3>) -> Vec<i64> {
    const METRES: f64 = 2.0;
    let mut taken = Vec::new();
    for place in people.iter().map(|frame| frame.offset) {
        let is_only = people.len() == 1 && last.len() <= 1;
        let near = |at: &DVec3| is_only || at.distance(place) < METRES;
        let free = last.iter().filter(|(id, at)| !taken.contains(*id) && near(at));
        let nearest = free.min_by(|a, b| a.1.distance(place).total_cmp(&b.1.distance(place))).map(|(id, _)| *id);
        let id = nearest.unwrap_or_else(|| last.keys().next_back().map_or(0, |id| id + 1));
        last.insert(id, place);
        taken.push(id);
    }
    taken
}

/// CLIFF's `NAME_cliff_hr48.npz`, a row a person of a picture: `pose` (N,72) or (N,24,3,3), `shape`
/// (N,10), `global_t` (N,3), `focal_l` (N), and `detection_all` (N, K), whose first column is the
/// picture's index. People are told apart by their places.
pub(super) fn cliff(root: &Item<'_>, video: &Video) -> Result<Fit, CaptureError> {
    let (pose, detected) = (root.get("pose")?, root.get("detection_all")?);
    let rest = root.table(None, &[("shape", BETAS), ("global_t", 3)])?;
    let count = Some(rest.len());
    let focals = root.get("focal_l")?.numbers(&[count])?;
    let poses = match pose.array()?.shape.len() {
        4 => {
            let matrices = pose.numbers(&[count, Some(SMPL), Some(3), Some(3)])?;
            let turns = matrices.chunks_exact(9).map(|m| Ok(axis_angle(pose.rotation(m, ORTHONORMAL)?).to_array()));
            turns.collect::<Result<Vec<_>, CaptureError>>()?.concat()
        }
        _ => pose.numbers(&[count, Some(3 * SMPL)])?,
    };
    let columns = detected.array()?.shape.last().copied().unwrap_or(0).max(1);
    let mut pictures: BTreeMap<usize, Vec<FitFrame>> = BTreeMap::new();
    for (row, detection) in detected.numbers(&[count, Some(columns)])?.chunks_exact(columns).enumerate() {
        let index = detection[0];
        if !(index >= 0.0 && index.fract() == 0.0 && index < 1e9) {
            return Err(detected.invalid("indices of pictures in the first column", format!("{index} at {row}")));
        }
        let whole = [&poses[3 * SMPL * row..][..3 * SMPL], &rest[row]].concat();
        let frame = FitFrame::still(index as usize, &whole, video.lens(focals[row]));
        pictures.entry(frame.index).or_default().push(frame);
    }
    let (mut people, mut last) = (People::default(), BTreeMap::new());
    for frames in pictures.into_values() {
        let ids = tracked(&frames, &mut last);
        ids.into_iter().zip(frames).for_each(|(id, frame)| people.get(id).frames.push(frame));
    }
    Ok(Fit::of_video(Tool::Cliff, people.into_vec()))
}

/// PHALP's and 4D-Humans' `demo_NAME.pkl`: by frame, lists with one entry a track: `tid`,
/// `tracked_time`, `smpl` of rotation matrices, `camera` (a translation), `size`, `mask`. The focal
/// length is 5000/256 · max(W, H), the principal point that of the square that the picture is
/// padded to, its own centre.
pub(super) fn phalp(frames: Vec<(String, Item<'_>)>, video: &Video) -> Result<Fit, CaptureError> {
    let mut people = People::default();
    let (frames, names) = by_picture(frames);
    let is_named = names.iter().any(|name| video.index(name).is_some());
    for (place, item) in frames.iter().enumerate() {
        let index = match item.find("time").filter(|_| !is_named) {
            Some(time) => {
                let index = time.whole()?;
                usize::try_from(index).map_err(|_| time.invalid("an index of a frame", index.to_string()))?
            }
            None => place,
        };
        for (track, id) in item.get("tid")?.list()?.iter().enumerate() {
            let person = people.get(id.whole()?);
            // A track without a detection repeats an earlier frame, mask included.
            if item.entry("tracked_time", track)?.whole()? > 0 {
                person.ghosts += 1;
            } else {
                person.frames.push(phalp_frame(item, track, index, video)?);
            }
        }
    }
    Ok(Fit { tool: Tool::Phalp, people: people.into_vec(), names: is_named.then_some(names) })
}

fn phalp_frame(item: &Item<'_>, track: usize, index: usize, video: &Video) -> Result<FitFrame, CaptureError> {
    let [width, height] = video.sides();
    let size = item.entry("size", track)?;
    let found = size.numbers(&[Some(2)])?;
    if found != [height, width] {
        let expected = format!("{width}×{height}, as the frames");
        return Err(size.invalid(expected, format!("{}×{}", found[1], found[0])));
    }
    let smpl = item.entry("smpl", track)?;
    let mut row = Vec::new();
    for (key, joints) in [("global_orient", 1), ("body_pose", SMPL - 1)] {
        let turns = smpl.get(key)?;
        for values in turns.numbers(&[Some(joints), Some(3), Some(3)])?.chunks_exact(9) {
            row.extend(axis_angle(turns.rotation(values, ORTHONORMAL)?).to_array());
        }
    }
    row.extend(smpl.get("betas")?.numbers(&[Some(1), Some(BETAS)])?);
    row.extend(item.entry("camera", track)?.numbers(&[Some(3)])?);
    let mask = match item.find("mask") {
        Some(_) => {
            let list = item.entry("mask", track)?;
            // A list of one, or the runs themselves.
            let inner = match list.value {
                Value::Dict(_) => Some(list),
                _ => list.list()?.into_iter().next(),
            };
            inner.map(|item| Rle::read(&item)).transpose()?.map(OwnMask::Runs)
        }
        None => None,
    };
    let lens = video.lens(5000.0 / 256.0 * video.longest());
    Ok(FitFrame { mask, ..FitFrame::still(index, &row, lens) })
}
