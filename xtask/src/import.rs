//! `import`: a capture from the results of a body estimator and a segmenter.

use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Error, Result, bail};
use clap::Args;
use occnerf::capture::{self, ImportOptions, Imported};

use crate::check::{self, CheckArguments};
use crate::place::{beside, not_within, take_place, vacant};
use crate::process::{results_in, say};

/// Marker of a finished directory.
const MARK: &str = "import.json";
/// Environment variable that names a body model.
const BODY_VARIABLE: &str = "SMPL_MODEL";

/// Output paths of each tool.
const TOOLS: &str = "\
Run one estimator and one segmenter as their own pages say, on the same frames (ffmpeg -i clip.mp4 frames/%06d.png).

--fit, told by what is in the file:
  WHAM              output/demo/CLIP/wham_output.pkl          (demo.py --save_pkl)
  4D-Humans, PHALP  outputs/results/demo_CLIP.pkl             (track.py; its masks are used without --masks)
  GVHMR             outputs/demo/CLIP/hmr4d_results.pt        (SMPL-X)
  PromptHMR         results/CLIP/results.pkl                  (SMPL-X; its masks are used, too)
  VIBE, PyMAF       output/CLIP/vibe_output.pkl
  CLIFF             CLIP/CLIP_cliff_hr48.npz                  (demo.py --save_results)
  GLAMR             OUT/grecon/CLIP_seed1.pkl
  ROMP              OUTPUT/video_results.npz                  (romp --mode=video -t)
  SAM 3D Body       its list of dictionaries as .npz, .npy, .pkl or .json: a folder with a file a frame, or one
                    file with a list of frames; its masks are used without --masks
  EasyMocap         OUTPUT, the folder with smpl/; intri.yml and extri.yml in it or above
  PeopleSnapshot    SUBJECT/poses.npz, as InstantAvatar prepares it, with cameras.npz (--frames images --masks masks)
  GaussianAvatar    SUBJECT/train/smpl_parms.pth, with cam_parms.npz (--frames train/images --masks train/masks)
  NeuMan            SCENE/smpl_output_romp.pkl, with alignments.npy and sparse/ (--frames images --masks segmentations)
  any other         joints (frames, J, 3) in camera axes and metres, .npy or .npz, with --joints

--masks, of the person as far as it is visible:
  SAM 2             OUTPUT/CLIP of vos_inference.py: PNGs by value, or a folder an object (--object, --occluder-objects)
  Grounded-SAM-2    OUTPUT with mask_data/mask_*.npy          (--object, --occluder-objects)
  MatAnyone         OUTPUT/CLIP with pha/0000.png
  any other         PNGs of 0 and 255 or with alpha, or one .npy or .npz (frames, height, width); inverted ones are
                    told by the border; without --masks, the frames' own alpha

--body: SMPL_NEUTRAL.pkl of SMPL_python_v.1.1.0 (smpl.is.tue.mpg.de), or SMPLX_NEUTRAL.npz (smpl-x.is.tue.mpg.de), if
you have it; without one the joints' rotations are put on an open body, whose shape training finds.

Then: cargo xtask train CAPTURE";

/// Arguments of `import`.
#[derive(Args)]
#[command(after_long_help = TOOLS, after_help = "--help says where each tool leaves its file")]
pub struct ImportArguments {
    /// Folder of the video's frames, PNG or JPEG, in the order of their names; or the video, where
    /// ffmpeg is installed
    #[arg(long, value_name = "DIR|VIDEO")]
    frames: PathBuf,
    /// What the estimator wrote: a file, or a folder
    #[arg(long, value_name = "FILE")]
    fit: PathBuf,
    /// What the segmenter wrote: a folder, a .npy or a .npz file [default: the masks in the fit, or
    /// the frames' alpha]
    #[arg(long, value_name = "DIR|FILE")]
    masks: Option<PathBuf>,
    /// The estimator's id of the person, or several ids of one person, as 0,4,17 [default: who is
    /// there in most frames]
    #[arg(long, value_name = "IDS")]
    person: Option<String>,
    /// The person's value in masks of ids [default: 1]
    #[arg(long, value_name = "ID")]
    object: Option<u32>,
    /// Values of occluders in masks of ids
    #[arg(long, value_name = "IDS", value_delimiter = ',')]
    occluder_objects: Vec<u32>,
    /// Focal length in pixels [default: the one that the estimator assumed]
    #[arg(long, value_name = "PX")]
    focal: Option<f64>,
    /// The body model that the estimator fitted, .npz or .pkl [default: the variable SMPL_MODEL,
    /// one that fits in a folder `body` near the fit or the frames, or the open body of this
    /// program]
    #[arg(long, value_name = "FILE")]
    body: Option<PathBuf>,
    /// The joints of a --fit that is an array of joints: coco17, openpose25, smpl24, h36m17 or
    /// mhr70
    #[arg(long, value_name = "SET")]
    joints: Option<String>,
    /// Points of the body that SAM 3D Body's pred_vertices lie on, which tell the twist of limbs;
    /// those of the open body are known, for a --body SMPL_NEUTRAL.pkl it is smpl2mhr_mapping.npz,
    /// for SMPLX_NEUTRAL.npz smplx2mhr_mapping.npz of github.com/facebookresearch/MHR
    /// (tools/mhr_smpl_conversion/assets)
    #[arg(long, value_name = "FILE")]
    vertex_map: Option<PathBuf>,
    /// 2-D key points of the frames, which registration then follows: OpenPose's folder of JSON
    /// (BODY_25), or one person's COCO points (frames, 17, 3) of ViTPose or RTMPose, .npy, .npz or
    /// .pt
    #[arg(long, value_name = "DIR|FILE")]
    keypoints: Option<PathBuf>,
    /// Copy the frames into the capture; else it has links to them
    #[arg(long)]
    copy: bool,
    /// Directory to write, new or empty
    #[arg(long, value_name = "CAPTURE")]
    out: PathBuf,
    /// Replace what an earlier import wrote to --out
    #[arg(long)]
    force: bool,
}

/// Runs the command; --out is replaced once complete.
pub fn import(arguments: &ImportArguments) -> Result<()> {
    let out = &arguments.out;
    vacant(out, arguments.force, MARK)?;
    let mut options = ImportOptions {
        frames: arguments.frames.clone(),
        fit: arguments.fit.clone(),
        masks: arguments.masks.clone(),
        person: arguments.person.clone(),
        object: arguments.object,
        occluder_objects: arguments.occluder_objects.clone(),
        focal: arguments.focal,
        body: arguments.body.clone().or_else(|| std::env::var_os(BODY_VARIABLE).map(PathBuf::from)),
        joints: arguments.joints.clone(),
        vertex_map: arguments.vertex_map.clone(),
        keypoints: arguments.keypoints.clone(),
        copy: arguments.copy,
    };
    for (what, path) in [
        ("--frames", Some(&options.frames)),
        ("--fit", Some(&options.fit)),
        ("--masks", options.masks.as_ref()),
        ("--vertex-map", options.vertex_map.as_ref()),
        ("--keypoints", options.keypoints.as_ref()),
    ] {
        if let Some(path) = path.filter(|path| !path.exists()) {
            bail!("{}: no such file or directory ({what})", path.display());
        }
        if let Some(path) = path {
            not_within(path, out, what)?;
        }
    }
    let decoded = beside(out, "frames")?;
    if options.frames.is_file() {
        decode(&options.frames, &decoded)?;
        (options.frames, options.copy) = (decoded.clone(), true);
    }
    let partial = beside(out, "partial")?;
    let written = capture::import(&options, &partial).map_err(Error::from).map_err(results_in(&partial));
    let written = written.and_then(|imported| {
        let mark =
            serde_json::json!({ "tool": imported.tool.name(), "person": imported.person, "frames": imported.frames });
        crate::run::write(&partial.join(MARK), &serde_json::to_string_pretty(&mark)?)?;
        take_place(&partial, out, arguments.force, MARK).map(|()| imported)
    });
    if options.frames == decoded {
        std::fs::remove_dir_all(&decoded).with_context(|| decoded.display().to_string())?;
    }
    let imported = match written {
        Ok(imported) => imported,
        Err(error) => {
            let _ = std::fs::remove_dir_all(&partial);
            return Err(error);
        }
    };
    say(&imported);
    check::check(&CheckArguments::of(out))?;
    say!("train on it: cargo xtask train {}", out.display());
    Ok(())
}

/// Decodes a video into a folder by ffmpeg.
fn decode(video: &Path, into: &Path) -> Result<()> {
    let command = format!("ffmpeg -i {} FRAMES/%06d.png", video.display());
    if into.exists() {
        std::fs::remove_dir_all(into).with_context(|| into.display().to_string())?;
    }
    std::fs::create_dir_all(into).with_context(|| into.display().to_string())?;
    let run =
        Command::new("ffmpeg").args(["-nostdin", "-v", "error", "-i"]).arg(video).arg(into.join("%06d.png")).output();
    let refused = match run {
        Ok(output) if output.status.success() => return Ok(()),
        Ok(output) => String::from_utf8_lossy(&output.stderr).trim().to_owned(),
        Err(error) => format!("ffmpeg: {error}"),
    };
    std::fs::remove_dir_all(into).with_context(|| into.display().to_string())?;
    bail!(
        "--frames {}: expected a folder of frames, or a video that ffmpeg reads ({command}): {refused}",
        video.display()
    )
}

/// Prints a summary of an import.
fn say(imported: &Imported) {
    let Imported { tool, person, frames, video_frames, focal, masks, betas_spread, .. } = imported;
    say!("{}: person {person}, {frames} of {video_frames} frames, focal length {focal:.1} px", tool.name());
    say!("masks: {masks}");
    match &imported.body {
        Some(body) => say!("body: {}", body.display()),
        None if tool.is_points() => say!("body: the open body of this program, fitted to the points"),
        None => {
            let own = if tool.joints() > 24 { "SMPLX_NEUTRAL.npz" } else { "SMPL_NEUTRAL.pkl" };
            say!(
                "body: the open body of this program, in its mean shape; training finds the person's from the pictures"
            );
            say!("      (with --body {own}, which {} fitted, it begins at the shape of the fit)", tool.name());
        }
    }
    if !imported.others.is_empty() {
        let each: Vec<String> = imported.others.iter().map(|(id, n)| format!("{id} ({n} frames)")).collect();
        say!("others there (--person ID): {}", each.join(", "));
    }
    let [before, after, between] = imported.unfitted;
    for (count, what) in [
        (before, "before the person's first"),
        (after, "after the last"),
        (between, "between, without a fit"),
        (imported.ghosts, "of these with a fit left over from an earlier frame"),
        (imported.unmasked, "with a fit but without a mask"),
        (imported.absent, "of the fit without a picture"),
    ] {
        if count > 0 {
            say!("left out: {count} frames {what}");
        }
    }
    imported.notes.iter().for_each(|note| say!("{note}"));
    if *betas_spread > 1e-6 {
        say!("shape: the robust mean of all frames (standard deviation of a coefficient at most {betas_spread:.2})");
    }
}
