//! WHAM's `wham_output.pkl`: by person id `pose` (T,72) axis-angle in the camera, `trans` (T,3),
//! `betas` (T,10), `frame_ids` (T). The focal length is not in it: √(W² + H²), the principal point
//! the image's centre.

use super::fit::{BETAS, Fit, FitFrame, Person, SMPL, Tool};
use super::item::{Item, vectors};
use super::video::Video;
use crate::CaptureError;

pub(super) fn read(people: &[(String, Item<'_>)], video: &Video) -> Result<Fit, CaptureError> {
    let [width, height] = video.sides();
    let lens = [[width.hypot(height); 2], video.middle()];
    let person = |(id, item): &(String, Item<'_>)| {
        let indices = item.get("frame_ids")?.indices()?;
        let (pose, trans, betas) = (item.get("pose")?, item.get("trans")?, item.get("betas")?);
        let (poses, places, shapes) = (pose.rows(3 * SMPL)?, trans.rows(3)?, betas.rows(BETAS)?);
        for (item, found) in [(&pose, poses.len()), (&trans, places.len()), (&betas, shapes.len())] {
            item.as_long(indices.len(), found)?;
        }
        let frames = (indices.into_iter().zip(poses)).zip(places.into_iter().zip(shapes));
        let frames = frames.map(|((i, pose), (place, betas))| FitFrame::still(i, vectors(&pose), betas, &place, lens));
        Ok(Person { id: id.clone(), frames: frames.collect(), ..Person::default() })
    };
    // Dropped tracks are empty.
    let begun = people.iter().filter(|(_, item)| item.value.get("pose").is_some());
    Ok(Fit { tool: Tool::Wham, people: begun.map(person).collect::<Result<_, CaptureError>>()?, names: None })
}
