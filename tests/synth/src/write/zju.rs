//! Raw ZJU-MoCap.

use glam::{Mat3, Vec3};
use image::GrayImage;
use serde_json::{Value, json};

use super::folder::{Folder, flat, origin, rgb, rows};
use super::pickle::Py;
use crate::film::Synthetic;
use capture::Area;
use capture::{CaptureError, Frame, Image};

/// Folder of the training camera.
const TRAINING: &str = "Camera_B1";
/// Lengths of `T` in a metre.
const MILLIMETRES: f32 = 1000.0;

pub(super) fn write(synthetic: &Synthetic, folder: &Folder<'_>) -> Result<(), CaptureError> {
    let capture = &synthetic.capture;
    // Each camera's folder, and its frames with the number of their instant.
    let mut cameras: Vec<(&str, Vec<(usize, &Frame)>)> = vec![(TRAINING, capture.train.iter().enumerate().collect())];
    for frames in capture.eval.chunk_by(|a, b| a.camera_name == b.camera_name) {
        cameras.push((&frames[0].camera_name, frames.iter().map(|e| (e.train_index, &e.frame)).collect()));
    }
    folder.file("annots.npy", annots(capture.train.len(), &cameras).npy())?;
    folder.make("new_params")?;
    for (i, frame) in capture.train.iter().enumerate() {
        let (rh, th) = origin(frame);
        let params = Py::record([
            ("poses", Py::floats(&[1, 3 * frame.pose.len()], &flat(&frame.pose))),
            ("Rh", Py::floats(&[1, 3], &rh.to_array())),
            ("Th", Py::floats(&[1, 3], &th.to_array())),
            ("shapes", Py::floats(&[1, frame.betas.len()], &frame.betas)),
        ]);
        folder.file(&format!("new_params/{i}.npy"), params.npy())?;
    }
    folder.file("occlusion.json", occlusion(synthetic).to_string())?;
    for (camera, frames) in &cameras {
        folder.make(camera)?;
        let training = *camera == TRAINING;
        let picture = |i: usize| match &synthetic.objects {
            Some(objects) if training => Ok(rgb(&objects.photograph(&synthetic.clear[i].pixels()?, true))),
            _ if training => synthetic.clear[i].pixels().map(|clear| rgb(&clear.image)),
            _ => frames[i].1.pixels().map(|pixels| rgb(&pixels.image)),
        };
        let name = |kind: &str, i: &usize| format!("{kind}{camera}/{i:06}.png");
        let names = |kind: &str| -> Vec<String> { frames.iter().map(|(i, _)| name(kind, i)).collect() };
        folder.pictures(&names(""), picture)?;
        for kind in ["mask_cihp/", "mask/"] {
            folder.make(&format!("{kind}{camera}"))?;
            folder.pictures(&names(kind), |i| {
                // A rectangle is left to occlusion.json.
                if training && synthetic.objects.is_none() {
                    return synthetic.clear[i].pixels().map(|clear| labels(&clear.mask, &clear.image));
                }
                frames[i].1.pixels().map(|pixels| labels(&pixels.mask, &pixels.image))
            })?;
        }
    }
    Ok(())
}

/// 1 where the subject is, else 0.
fn labels(mask: &[f32], like: &Image) -> GrayImage {
    let label = |x: u32, y: u32| u8::from(mask[(y * like.width + x) as usize] > 0.5);
    GrayImage::from_fn(like.width, like.height, |x, y| image::Luma([label(x, y)]))
}

fn annots(instants: usize, cameras: &[(&str, Vec<(usize, &Frame)>)]) -> Py {
    let list = |of: &dyn Fn(&Frame) -> Py| {
        Py::List(cameras.iter().filter_map(|(_, frames)| frames.first()).map(|(_, frame)| of(frame)).collect())
    };
    let pose = |frame: &Frame| frame.camera.world_to_camera;
    let cams = Py::record([
        ("K", list(&|f| Py::floats(&[3, 3], &rows(f.camera.intrinsics())))),
        ("R", list(&|f| Py::floats(&[3, 3], &rows(Mat3::from(pose(f).matrix3))))),
        ("T", list(&|f| Py::floats(&[3, 1], &(Vec3::from(pose(f).translation) * MILLIMETRES).to_array()))),
        ("D", list(&|_| Py::floats(&[5, 1], &[0.0; 5]))),
    ]);
    let mut paths: Vec<Vec<Py>> = vec![Vec::new(); instants];
    for (camera, frames) in cameras {
        for (i, _) in frames {
            paths[*i].push(Py::text(&format!("{camera}/{i:06}.png")));
        }
    }
    let ims = paths.into_iter().map(|list| Py::record([("ims", Py::List(list))])).collect();
    Py::record([("cams", cams), ("ims", Py::List(ims))])
}

/// The rectangle; of one that moves, its place in each frame.
fn occlusion(synthetic: &Synthetic) -> Value {
    let size = synthetic.config.size;
    let hiding = synthetic.hidden.iter().enumerate().filter(|(_, area)| !area.is_empty());
    let (frames, areas): (Vec<usize>, Vec<&Area>) = hiding.unzip();
    let corners = |a: &Area| json!({"x0": a.columns.start, "y0": a.rows.start, "x1": a.columns.end, "y1": a.rows.end});
    let none = Area { columns: 0..0, rows: 0..size };
    let first = areas.first().copied().unwrap_or(&none);
    let mut file = json!({
        "camera": TRAINING,
        "image_size": [size, size],
        "rect": corners(first),
        "frames": frames,
    });
    if areas.iter().any(|area| *area != first) {
        file["rects"] = areas.iter().map(|area| corners(area)).collect();
    }
    file
}
