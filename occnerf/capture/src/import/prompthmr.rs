//! PromptHMR's `results.pkl`: `people` {id: `frames` (N), `masks` (N,H,W), `smplx_cam` {`pose`
//! (N,75): root, 21 joints of the body, jaw, eyes; `shape` (N,10), `trans` (N,3)}}, `camera`
//! {`img_focal`, `img_center`}. SMPL-X with flat hands. Frames higher than 896 are worked on at a
//! smaller size, twice `img_center`.

use array_files::{Data, NdArray};

use super::fit::{BETAS, Fit, FitFrame, OwnMask, Person, Tool};
use super::item::{Item, vectors};
use super::video::Video;
use crate::CaptureError;

/// Joints in `pose`.
const JOINTS: usize = 25;
/// Height above which frames are worked on at a smaller size.
const WORKED_ON: f64 = 896.0;
/// How far the two sides' scales may be apart.
const ASPECT: f64 = 0.01;

pub(super) fn read(root: &Item<'_>, video: &Video) -> Result<Fit, CaptureError> {
    let camera = root.get("camera")?;
    let (focal, centre) = (camera.get("img_focal")?.number()?, camera.get("img_center")?);
    let at = centre.few(2)?;
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
    let mut people = Vec::new();
    for (id, person) in root.get("people")?.entries()? {
        let indices = person.get("frames")?.indices()?;
        let params = person.get("smplx_cam")?;
        let (pose, shape, trans) = (params.get("pose")?, params.get("shape")?, params.get("trans")?);
        let (poses, shapes, places) = (pose.rows(3 * JOINTS)?, shape.rows(BETAS)?, trans.rows(3)?);
        for (item, found) in [(&pose, poses.len()), (&shape, shapes.len()), (&trans, places.len())] {
            item.as_long(indices.len(), found)?;
        }
        let masks = person.find("masks").map(|item| masks(&item, indices.len())).transpose()?;
        let mut masks = masks.into_iter().flatten();
        let frames = indices.into_iter().enumerate().map(|(i, index)| FitFrame {
            mask: masks.next(),
            ..FitFrame::still(index, vectors(&poses[i]), shapes[i].clone(), &places[i], lens)
        });
        people.push(Person { id, frames: frames.collect(), ..Person::default() });
    }
    Ok(Fit { tool: Tool::PromptHmr, people, names: None })
}

/// `masks` (N,H,W), one by one.
fn masks(item: &Item<'_>, count: usize) -> Result<Vec<OwnMask>, CaptureError> {
    let NdArray { shape, data } = item.array()?;
    let &[n, height, width] = shape.as_slice() else {
        return Err(item.invalid("shape [_, _, _]", format!("shape {shape:?}")));
    };
    item.as_long(count, n)?;
    let Data::Bool(values) = data else { return Err(item.invalid("booleans", "numbers")) };
    let each = (height * width).max(1);
    Ok(values.chunks_exact(each).map(|mask| OwnMask::Pixels(height, width, mask.to_vec())).collect())
}
