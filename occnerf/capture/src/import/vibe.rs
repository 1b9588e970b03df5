//! VIBE's `vibe_output.pkl`, which PyMAF's demo writes alike: by person id `pose` (T,72)
//! axis-angle in the camera, `betas` (T,10), `orig_cam` (T,4): scales and translation (sx, sy, tx, ty)
//! of a weak-perspective camera, x of the picture from −1 to 1 being sx (X + tx); `frame_ids` (T).
//! Without it, `pred_cam` (T,3): scale and translation in a square of `bboxes` (T,4): centre and sides.
//! The focal length is not in it: √(W² + H²).

use glam::DVec3;

use super::fit::{BETAS, Fit, FitFrame, Person, SMPL, Tool};
use super::item::{Item, vectors};
use super::video::Video;
use crate::CaptureError;

/// Least scale of a camera.
const MIN_SCALE: f64 = 1e-3;

pub(super) fn read(people: &[(String, Item<'_>)], video: &Video) -> Result<Fit, CaptureError> {
    let [width, height] = video.sides();
    let focal = width.hypot(height);
    let person = |(id, item): &(String, Item<'_>)| {
        let indices = item.get("frame_ids")?.indices()?;
        let (pose, betas) = (item.get("pose")?, item.get("betas")?);
        let (poses, shapes) = (pose.rows(3 * SMPL)?, betas.rows(BETAS)?);
        let cameras = item.find("orig_cam").map_or_else(|| item.get("pred_cam"), Ok)?;
        let cams = match item.find("orig_cam") {
            Some(cameras) => cameras.rows(4)?,
            None => {
                let (crops, boxes) = (cameras.rows(3)?, item.get("bboxes")?);
                let boxes = boxes.numbers(&[Some(crops.len()), Some(4)])?;
                let whole = |(crop, bounds): (Vec<f64>, &[f64])| {
                    let scales = [width, height].map(|side| crop[0] * bounds[3] / side);
                    let moved = |i: usize| (2.0 * bounds[i] / [width, height][i] - 1.0) / scales[i] + crop[1 + i];
                    vec![scales[0], scales[1], moved(0), moved(1)]
                };
                crops.into_iter().zip(boxes.chunks_exact(4)).map(whole).collect()
            }
        };
        for (item, found) in [(&pose, poses.len()), (&betas, shapes.len()), (&cameras, cams.len())] {
            item.as_long(indices.len(), found)?;
        }
        let frame = |(i, index): (usize, usize)| {
            let [scale, _, x, y] = [0, 1, 2, 3].map(|k| cams[i][k]);
            if !(scale >= MIN_SCALE && x.is_finite() && y.is_finite()) {
                return Err(cameras.invalid(format!("scales of at least {MIN_SCALE}"), format!("{scale} at {i}")));
            }
            // A metre has scale · W/2 pixels at the body.
            let place = DVec3::new(x, y, focal / (scale * width / 2.0));
            let lens = [[focal; 2], video.middle()];
            Ok(FitFrame::still(index, vectors(&poses[i]), shapes[i].clone(), &place.to_array(), lens))
        };
        let frames = indices.into_iter().enumerate().map(frame).collect::<Result<_, CaptureError>>()?;
        Ok(Person { id: id.clone(), frames, ..Person::default() })
    };
    Ok(Fit { tool: Tool::Vibe, people: people.iter().map(person).collect::<Result<_, CaptureError>>()?, names: None })
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;
    use crate::import::read;
    use crate::testing::{Directory, Py, array};

    #[test]
    fn a_weak_perspective_camera_and_ours_agree_near_the_body() {
        let dir = Directory::new("import-vibe");
        let (scale, tx, ty) = (0.8, 0.1, -0.25);
        // The vertical scale is the horizontal one times W/H.
        let camera = [scale, scale * 640.0 / 480.0, tx, ty];
        // The same in a square of 200 pixels about (350, 180).
        let crop =
            [scale * 640.0 / 200.0, tx - (350.0 - 320.0) / 320.0 / scale, ty - (180.0 - 240.0) / 240.0 / camera[1]];
        let whole = vec![("orig_cam", array(&[2, 4], &camera.repeat(2)))];
        let square = array(&[2, 4], &[350.0, 180.0, 200.0, 200.0].repeat(2));
        let crops = vec![("pred_cam", array(&[2, 3], &crop.repeat(2))), ("bboxes", square)];
        let video = Video {
            names: (0..6).map(|i| format!("{i:06}")).collect(),
            paths: vec![PathBuf::new(); 6],
            size: (640, 480),
        };
        for cameras in [whole, crops] {
            let mut person = vec![
                ("frame_ids", array(&[2], &[3.0, 4.0])),
                ("pose", array(&[2, 72], &[0.1; 144])),
                ("betas", array(&[2, 10], &[0.5; 20])),
            ];
            person.extend(cameras);
            dir.write(
                "vibe_output.pkl",
                Py::Dict(vec![(
                    "7".to_owned(),
                    Py::Dict(person.into_iter().map(|(key, value)| (key.to_owned(), value)).collect()),
                )])
                .pickle(),
            );
            let (fit, note) = read::read(&dir.path().join("vibe_output.pkl"), &video).unwrap();
            assert_eq!((fit.tool, fit.people[0].id.as_str(), note), (Tool::Vibe, "7", None));
            let frame = &fit.people[0].frames[0];
            assert_eq!(frame.index, 3);
            for p in [DVec3::ZERO, DVec3::new(0.3, -0.6, 0.0)] {
                let q = p + frame.pelvis(DVec3::ZERO);
                let found = [0, 1].map(|i| frame.focal[i] * q[i] / q.z + frame.centre[i]);
                let expected = [320.0 * (1.0 + camera[0] * (p.x + tx)), 240.0 * (1.0 + camera[1] * (p.y + ty))];
                assert!(found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-3), "{found:?} {expected:?}");
            }
        }
    }
}
