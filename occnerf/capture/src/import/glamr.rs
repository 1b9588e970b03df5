//! GLAMR's `grecon/NAME_seed1.pkl`: `cam_pose` (T,4,4) world to camera, `person_data` by person id
//! {`smpl_pose` (T,69), `smpl_orient_world` (T,3), `root_trans_world` (T,3), the pelvis, `smpl_beta`
//! (T,10), `exist_frames` (T), `cam_K` (T,3,3), zero where the person is hidden}.

use super::fit::{About, BETAS, Fit, FitFrame, Person, SMPL, Tool};
use super::item::{Item, vectors};
use crate::CaptureError;

pub(super) fn read(root: &Item<'_>) -> Result<Fit, CaptureError> {
    let camera = root.get("cam_pose")?;
    let cameras = camera.numbers(&[None, Some(4), Some(4)])?;
    let count = cameras.len() / 16;
    let mut people = Vec::new();
    for (id, person) in root.get("person_data")?.entries()? {
        let rows = |key: &str, width: usize| person.get(key)?.numbers(&[Some(count), Some(width)]);
        let (bodies, shapes) = (rows("smpl_pose", 3 * SMPL - 3)?, rows("smpl_beta", BETAS)?);
        let (roots, places) = (vectors(&rows("smpl_orient_world", 3)?), vectors(&rows("root_trans_world", 3)?));
        let exists = person.get("exist_frames")?.numbers(&[Some(count)])?;
        let lens = person.get("cam_K")?;
        let lenses = lens.numbers(&[Some(count), Some(3), Some(3)])?;
        let seen = lenses.chunks_exact(9).find(|k| k[0] > 0.0);
        let k = seen.ok_or_else(|| lens.invalid("a frame with a focal length", "none"))?;
        let frame = |index: usize| {
            let (turn, moved) = camera.rigid(&cameras[16 * index..][..16])?;
            let offset = turn * places[index] + moved;
            let body = &bodies[(3 * SMPL - 3) * index..][..3 * SMPL - 3];
            let betas = shapes[BETAS * index..][..BETAS].to_vec();
            let pose = [vec![roots[index]], vectors(body)].concat();
            let still = FitFrame::still(index, pose, betas, &offset.to_array(), [[k[0], k[4]], [k[2], k[5]]]);
            Ok(FitFrame { world_to_camera: turn, about: About::Place, ..still })
        };
        let frames = (0..count).filter(|&i| exists[i] != 0.0).map(frame).collect::<Result<_, CaptureError>>()?;
        people.push(Person { id, frames, ..Person::default() });
    }
    Ok(Fit { tool: Tool::Glamr, people, names: None })
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::import::fit::{axis_angle, rotation};
    use crate::import::read;
    use crate::import::tests::{Motion, extrinsics, known};
    use crate::testing::{Directory, Py, array, shared};

    #[test]
    fn what_is_written_of_a_known_motion_is_that_motion() {
        let Some(dir) = shared("estimators") else { return };
        let motion = known(&dir);
        let Motion { video, k, betas, poses, pelvises, .. } = &motion;
        let count = poses.len();
        let (mut cameras, mut roots, mut places, mut lenses) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        for (i, (pose, pelvis)) in poses.iter().zip(pelvises).enumerate() {
            let (turn, moved) =
                (rotation(DVec3::new(1.7, 0.02 * i as f64, -0.4)), DVec3::new(0.3, -0.2, 0.1 * i as f64));
            cameras.extend(extrinsics(turn, moved));
            roots.extend(axis_angle(turn.transpose() * rotation(pose[0])).to_array());
            places.extend((turn.transpose() * (*pelvis - moved)).to_array());
            // Hidden in the third frame, not there in the last.
            lenses.extend(if i == 2 { vec![0.0; 9] } else { k.clone() });
        }
        let bodies: Vec<f64> = poses.iter().flat_map(|pose| pose[1..].iter().flat_map(|v| v.to_array())).collect();
        let exists: Vec<f64> = (0..count).map(|i| f64::from(i + 1 < count)).collect();
        let n = count as u32;
        let write = |beta: u32| {
            let person = Py::record([
                ("exist_frames", array(&[n], &exists)),
                ("smpl_pose", array(&[n, 69], &bodies)),
                ("smpl_beta", array(&[n, beta], &betas[..beta as usize].repeat(count))),
                ("smpl_orient_world", array(&[n, 3], &roots)),
                ("root_trans_world", array(&[n, 3], &places)),
                ("cam_K", array(&[n, 3, 3], &lenses)),
            ]);
            let people = Py::Dict(vec![("0".to_owned(), person)]);
            Py::record([("cam_pose", array(&[n, 4, 4], &cameras)), ("person_data", people)]).pickle()
        };
        let out = Directory::new("import-glamr");
        out.write("clip_seed1.pkl", write(10));
        let (fit, _) = read::read(&out.path().join("clip_seed1.pkl"), video).unwrap();
        assert_eq!((fit.tool, fit.people[0].frames.len()), (Tool::Glamr, count - 1));
        motion.is_of(&fit.people[0]);
        out.write("clip_seed1.pkl", write(9));
        let error = read::read(&out.path().join("clip_seed1.pkl"), video).err().unwrap().to_string();
        assert!(
            ["clip_seed1.pkl", "person_data.0.smpl_beta", "10]", "9]"].iter().all(|w| error.contains(w)),
            "{error}"
        );
    }
}
