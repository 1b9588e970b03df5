//! ROMP's `video_results.npz`: `results` {picture's name: {`smpl_thetas` (N,72), `smpl_betas`
//! (N,10), `cam_trans` (N,3), `track_ids` (N)}}, people in any order. The focal length is 443.4/512
//! · max(W, H) (60 degrees), the principal point that of the square that the picture is padded to,
//! its own centre.

use std::collections::BTreeMap;
use std::path::Path;

use array_files::pickle::Value;
use glam::DVec3;

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
    let names = entries.iter().map(|(name, _)| stem(name)).collect();
    let mut people: BTreeMap<i64, Person> = BTreeMap::new();
    let mut last: BTreeMap<i64, DVec3> = BTreeMap::new();
    for (index, (_, item)) in entries.iter().enumerate() {
        let (thetas, betas, trans) = (item.get("smpl_thetas")?, item.get("smpl_betas")?, item.get("cam_trans")?);
        let (poses, shapes, places) = (thetas.rows(3 * SMPL)?, betas.rows(BETAS)?, trans.rows(3)?);
        let tracks = match item.find("track_ids") {
            Some(tracks) => tracks.numbers(&[None])?.iter().map(|id| *id as i64).collect(),
            None => tracked(&places, &mut last),
        };
        for (item, found) in [(&thetas, poses.len()), (&betas, shapes.len()), (&trans, places.len())] {
            item.as_long(tracks.len(), found)?;
        }
        for (i, id) in tracks.into_iter().enumerate() {
            let new = || Person { id: id.to_string(), ..Person::default() };
            let frame = FitFrame::still(index, vectors(&poses[i]), shapes[i].clone(), &places[i], lens);
            people.entry(id).or_insert_with(new).frames.push(frame);
        }
    }
    Ok(Fit { tool: Tool::Romp, people: people.into_values().collect(), names: Some(names) })
}

/// Ids of people at these places, where the file has none: of the person last seen nearest, within two
/// metres.
pub(super) fn tracked(places: &[Vec<f64>], last: &mut BTreeMap<i64, DVec3>) -> Vec<i64> {
    const METRES: f64 = 2.0;
    let mut taken = Vec::new();
    for place in places.iter().map(|place| DVec3::from_slice(place)) {
        let is_only = places.len() == 1 && last.len() <= 1;
        let near = |at: &DVec3| is_only || at.distance(place) < METRES;
        let free = last.iter().filter(|(id, at)| !taken.contains(*id) && near(at));
        let nearest = free.min_by(|a, b| a.1.distance(place).total_cmp(&b.1.distance(place))).map(|(id, _)| *id);
        let id = nearest.unwrap_or_else(|| last.keys().next_back().map_or(0, |id| id + 1));
        last.insert(id, place);
        taken.push(id);
    }
    taken
}
