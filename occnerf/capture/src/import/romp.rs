//! ROMP's `video_results.npz`: `results` {picture's name: {`smpl_thetas` (N,72), `smpl_betas`
//! (N,10), `cam_trans` (N,3), `track_ids` (N)}}, people in any order. The focal length is 443.4/512
//! · max(W, H) (60 degrees), the principal point that of the square that the picture is padded to,
//! its own centre.

use std::collections::BTreeMap;
use std::path::Path;

use array_files::pickle::Value;

use super::fit::{BETAS, Fit, FitFrame, Person, SMPL, Tool};
use super::item::{Item, vectors};
use super::video::Video;
use crate::CaptureError;
use crate::names::FrameName;

pub(super) fn read(path: &Path, results: &Value, video: &Video) -> Result<Fit, CaptureError> {
    let root = Item { path, key: "results".to_owned(), value: results };
    let [width, height] = video.sides();
    let lens = [[443.4 / 512.0 * width.max(height); 2], video.middle()];
    let mut entries = root.entries()?;
    entries.sort_by(|a, b| FrameName(&a.0).cmp(&FrameName(&b.0)));
    let stem = |name: &str| Path::new(name).file_stem().map_or(String::new(), |s| s.to_string_lossy().into_owned());
    let named = |name: &str| video.names.iter().position(|frame| *frame == stem(name));
    // Frames extracted by ROMP itself have other names.
    let by_order = entries.len() == video.names.len() && entries.iter().all(|(name, _)| named(name).is_none());
    let mut people: BTreeMap<i64, Person> = BTreeMap::new();
    for (place, (name, item)) in entries.iter().enumerate() {
        let index = if by_order { Some(place) } else { named(name) };
        let index = index.ok_or_else(|| {
            let expected =
                format!("the name of a frame ({} to {})", video.names[0], video.names[video.names.len() - 1]);
            item.invalid(expected, name.as_str())
        })?;
        let (thetas, betas, trans) = (item.get("smpl_thetas")?, item.get("smpl_betas")?, item.get("cam_trans")?);
        let (poses, shapes, places) = (thetas.rows(3 * SMPL)?, betas.rows(BETAS)?, trans.rows(3)?);
        let tracks = match item.find("track_ids") {
            Some(tracks) => tracks.numbers(&[None])?.iter().map(|id| *id as i64).collect(),
            None if poses.len() == 1 => vec![0],
            None => return Err(item.invalid("`track_ids`, as ROMP writes them with -t", "several people without")),
        };
        for (item, found) in [(&thetas, poses.len()), (&betas, shapes.len()), (&trans, places.len())] {
            item.as_long(tracks.len(), found)?;
        }
        for (i, id) in tracks.into_iter().enumerate() {
            let new = || Person { id: id.to_string(), frames: Vec::new(), ghosts: 0 };
            let frame = FitFrame::still(index, vectors(&poses[i]), shapes[i].clone(), &places[i], lens);
            people.entry(id).or_insert_with(new).frames.push(frame);
        }
    }
    Ok(Fit { tool: Tool::Romp, people: people.into_values().collect() })
}
