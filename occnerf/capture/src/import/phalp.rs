//! PHALP's and 4D-Humans' `demo_NAME.pkl`: by frame, lists with one entry a track: `tid`,
//! `tracked_time`, `smpl` of rotation matrices, `camera` (a translation), `size`, `mask`. The focal
//! length is 5000/256 · max(W, H), the principal point that of the square that the picture is
//! padded to, its own centre.

use std::collections::BTreeMap;
use std::path::Path;

use array_files::pickle::Value;

use super::fit::{BETAS, Fit, FitFrame, OwnMask, Person, SMPL, Tool, axis_angle};
use super::item::Item;
use super::rle::Rle;
use super::video::Video;
use crate::CaptureError;
use crate::names::FrameName;

pub(super) fn read(frames: &[(String, Item<'_>)], video: &Video) -> Result<Fit, CaptureError> {
    let mut people: BTreeMap<i64, Person> = BTreeMap::new();
    let mut frames: Vec<&(String, Item<'_>)> = frames.iter().collect();
    frames.sort_by(|a, b| FrameName(&a.0).cmp(&FrameName(&b.0)));
    let stem = |name: &str| Path::new(name).file_stem().map_or(String::new(), |s| s.to_string_lossy().into_owned());
    let names: Vec<String> = frames.iter().map(|(name, _)| stem(name)).collect();
    let is_named = names.iter().any(|name| video.index(name).is_some());
    for (place, (_, item)) in frames.into_iter().enumerate() {
        let index = match item.find("time").filter(|_| !is_named) {
            Some(time) => {
                let index = time.whole()?;
                usize::try_from(index).map_err(|_| time.invalid("an index of a frame", index.to_string()))?
            }
            None => place,
        };
        for (track, id) in item.get("tid")?.list()?.iter().enumerate() {
            let id = id.whole()?;
            let new = || Person { id: id.to_string(), ..Person::default() };
            let person = people.entry(id).or_insert_with(new);
            // A track without a detection repeats an earlier frame, mask included.
            if item.entry("tracked_time", track)?.whole()? > 0 {
                person.ghosts += 1;
            } else {
                person.frames.push(frame(item, track, index, video)?);
            }
        }
    }
    Ok(Fit { tool: Tool::Phalp, people: people.into_values().collect(), names: is_named.then_some(names) })
}

fn frame(item: &Item<'_>, track: usize, index: usize, video: &Video) -> Result<FitFrame, CaptureError> {
    let [width, height] = video.sides();
    let size = item.entry("size", track)?;
    let found = size.few(2)?;
    if found != [height, width] {
        let text = |h: f64, w: f64| format!("{w}×{h}");
        return Err(size.invalid(format!("{}, as the frames", text(height, width)), text(found[0], found[1])));
    }
    let smpl = item.entry("smpl", track)?;
    let (root, rest) = (smpl.get("global_orient")?, smpl.get("body_pose")?);
    let three = [Some(1), Some(3), Some(3)];
    let mut pose = vec![axis_angle(root.rotation(&root.numbers(&three)?)?)];
    for values in rest.numbers(&[Some(SMPL - 1), Some(3), Some(3)])?.chunks_exact(9) {
        pose.push(axis_angle(rest.rotation(values)?));
    }
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
    let betas = smpl.get("betas")?.numbers(&[Some(1), Some(BETAS)])?;
    let lens = [[5000.0 / 256.0 * width.max(height); 2], video.middle()];
    let place = item.entry("camera", track)?.few(3)?;
    Ok(FitFrame { mask, ..FitFrame::still(index, pose, betas, &place, lens) })
}
