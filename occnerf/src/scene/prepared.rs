//! A capture prepared for training: posed bodies and pixel labels.

use std::sync::{Arc, OnceLock};

use glam::Vec3;
use rayon::prelude::*;
use smpl::BodyModel;
use visibility::{RayMesh, VisibilityCounts};

use crate::Error;
use crate::capture::{Capture, CaptureError, Frame, Light, PixelReader, PixelSource, Pixels, Registered};
use crate::config::Config;
use crate::model::body::{Body, PosedFrame};
use crate::model::colors::PriorColors;
use crate::model::subdivide::Anchor;
use crate::model::view::{PosedView, pinhole};
use crate::scene::hands::HandColor;
use crate::scene::labels::{Label, Labels, dilate, label_pixels};
use crate::scene::masks::mend_masks;
use crate::scene::registration::register;
use crate::scene::reliability::Reliability;
use crate::scene::seen::{ColorObservation, MOST, deeper, measure_light, seen, strange_edge};

/// A frame with its posed prior.
pub struct PreparedFrame {
    /// Name in the capture.
    pub name: String,
    /// Name of the camera in the capture; empty for training frames, `held out` for those held out.
    pub camera_name: String,
    /// Pose and camera, lengths normalised.
    pub view: Arc<PosedView>,
    /// Picture and mask, as in the capture; `None` for a synthetic view.
    pub source: Option<PixelSource>,
    /// Labels of the pixels, H × W; only training frames are labelled, and those held out.
    pub labels: Labels,
}

impl PreparedFrame {
    /// The picture and its mask.
    ///
    /// # Errors
    /// [`Error::Data`] for files that cannot be read; [`Error::Scene`] for a view without a
    /// picture.
    pub fn pixels(&self) -> Result<Pixels, Error> {
        self.photographed(PixelSource::pixels)
    }

    /// A reader of single pixels.
    pub(crate) fn reader(&self) -> Result<PixelReader, Error> {
        self.photographed(PixelSource::reader)
    }

    fn photographed<T>(&self, read: impl FnOnce(&PixelSource) -> Result<T, CaptureError>) -> Result<T, Error> {
        let source = self.source.as_ref().ok_or_else(|| Error::Scene("a view without a picture".to_owned()))?;
        Ok(read(source)?)
    }
}

/// Camera name of a held-out training frame.
pub const HELD_OUT: &str = "held out";

/// Most frames of [`Scene::covered`].
const COVERED_FRAMES: usize = 32;

/// Immutable input of training and evaluation.
pub struct Scene {
    /// Name of the capture.
    pub name: String,
    /// The shaped body.
    pub body: Arc<Body>,
    /// Training frames.
    pub train: Vec<PreparedFrame>,
    /// Evaluation frames, never seen in training.
    pub eval: Vec<PreparedFrame>,
    /// The capture with its bodies.
    pub registered: Registered,
    /// Whether albedo and light are separated.
    pub(crate) lit: bool,
    /// Width of the masks' contaminated edge, pixels.
    pub(crate) edge: usize,
    /// Offset of the clothes at each vertex, normalised metres; empty where unknown.
    pub(crate) clothes: Vec<f32>,
    /// Ascending indices of the training frames that are not held out.
    pub(crate) learnt: Vec<usize>,
    /// Cache of [`Scene::colors`].
    pub(crate) colors: OnceLock<PriorColors>,
    /// Cache of [`Scene::lighting`].
    pub(crate) lighting: OnceLock<(Light, Reliability, Option<HandColor>)>,
}

impl Scene {
    /// Corrects the masks of a capture, registers its bodies, and prepares it; takes masks and
    /// bodies as they are for `registration.rounds` of 0.
    ///
    /// # Errors
    /// Those of [`Scene::prepare`].
    pub fn new(capture: &Capture, model: &BodyModel, config: &Config) -> Result<Self, Error> {
        config.validate()?;
        let registered = match config.registration.rounds {
            0 => capture.clone().into(),
            rounds => register(mend_masks(capture.clone(), model)?, model, rounds)?,
        };
        Self::prepare(registered, model, config)
    }

    /// Prepares a registered capture.
    ///
    /// # Errors
    /// A configuration that is not valid; [`Error::Scene`] for a capture that cannot be trained on;
    /// pictures that cannot be read.
    pub fn prepare(registered: Registered, model: &BodyModel, config: &Config) -> Result<Self, Error> {
        config.validate()?;
        let Registered { capture, clothes, fists, .. } = &registered;
        let model = &model.with_fists(*fists);
        if let Some(lost) = capture.eval.iter().find(|e| e.train_index >= capture.train.len()) {
            let (name, at, frames) = (&lost.frame.name, lost.train_index, capture.train.len());
            return Err(Error::Scene(format!("view {name} is of training frame {at}, expected one of {frames}")));
        }
        let vertices = model.num_vertices();
        if !(clothes.is_empty() || clothes.len() == vertices && clothes.iter().all(|c| c.is_finite())) {
            let found = clothes.len();
            return Err(Error::Scene(format!("clothes are {found} numbers, expected none or {vertices}, all finite")));
        }
        let body = Arc::new(Body::new(model, &capture.mean_betas, config)?);
        let train: Result<Vec<_>, Error> = (capture.train.par_iter().enumerate())
            .map(|(i, frame)| prepare(&body, frame, i, "", Some(config)))
            .collect();
        let eval: Result<Vec<_>, Error> =
            capture.eval.par_iter().map(|e| prepare(&body, &e.frame, e.train_index, &e.camera_name, None)).collect();
        let mut scene = Self {
            name: capture.name.clone(),
            train: train?,
            eval: eval?,
            clothes: clothes.iter().map(|c| c * body.scale).collect(),
            body,
            registered,
            lit: config.field.prior_light,
            edge: 0,
            learnt: Vec::new(),
            colors: OnceLock::new(),
            lighting: OnceLock::new(),
        };
        let held_out = |i: usize| config.held_out > 0 && i.is_multiple_of(config.held_out);
        scene.learnt = (0..scene.train.len()).filter(|&i| !held_out(i)).collect();
        if config.registration.rounds > 0 {
            scene.leave_out_edges()?;
        }
        scene.hold_out();
        if scene.train.iter().all(|f| f.labels.num_subject() == 0) {
            let beside =
                if scene.learnt.len() < scene.train.len() { " beside the frames that are held out" } else { "" };
            return Err(Error::Scene(format!("{}: no training mask shows the subject{beside}", scene.name)));
        }
        Ok(scene)
    }

    /// Colours of the prior, measured on first use ([`PriorColors::measure`]), or those of a
    /// resumed run.
    ///
    /// # Errors
    /// Pictures that cannot be read.
    pub fn colors(&self) -> Result<&PriorColors, Error> {
        if let Some(colors) = self.colors.get() {
            return Ok(colors);
        }
        let measured = PriorColors::measure(self)?;
        Ok(self.colors.get_or_init(|| measured))
    }

    /// Light of the frames, measured on first use if the configuration asks for one or that of a
    /// resumed run, reliability of their colours under it, and the colour of the hands.
    ///
    /// # Errors
    /// Pictures that cannot be read.
    pub(crate) fn lighting(&self) -> Result<&(Light, Reliability, Option<HandColor>), Error> {
        if let Some(lighting) = self.lighting.get() {
            return Ok(lighting);
        }
        let (seen, vertices) = (self.seen()?, self.body.canonical.vertices.len());
        let light = match self.colors.get() {
            Some(colors) => colors.light,
            None if self.lit => measure_light(&deeper(&seen, self.edge), vertices),
            None => Light::default(),
        };
        let views = self.train.iter().map(|frame| &frame.view);
        let views: Vec<(&[Vec3], Vec3)> =
            views.map(|view| (&view.posed.vertices[..], view.camera.centre_of_projection())).collect();
        let hands = HandColor::measure(&self.body.model, &seen);
        let measured = (light, Reliability::measure(&seen, &views, light), hands);
        Ok(self.lighting.get_or_init(|| measured))
    }

    /// Sets the colours of a resumed run, which its field is relative to.
    #[must_use]
    pub fn with_colors(self, colors: PriorColors) -> Self {
        Self { colors: OnceLock::from(colors), lighting: OnceLock::new(), ..self }
    }

    /// Colour observations of the vertices in each training frame, with their depth inside the
    /// mask; none of held-out frames.
    pub(crate) fn seen(&self) -> Result<Vec<Vec<(ColorObservation, usize)>>, Error> {
        let anchors: Vec<Anchor> = (0..self.body.canonical.vertices.len() as u32).map(Anchor::vertex).collect();
        (0..self.train.len()).into_par_iter().map(|frame| self.seen_in(frame, &anchors)).collect()
    }

    /// [`Scene::seen`] for points of the prior in one frame.
    pub(crate) fn seen_in(&self, frame: usize, anchors: &[Anchor]) -> Result<Vec<(ColorObservation, usize)>, Error> {
        if self.learnt.binary_search(&frame).is_err() {
            return Ok(Vec::new());
        }
        let frame = &self.train[frame];
        seen(&frame.view, &frame.pixels()?, &self.body.model.faces, &self.clothes, anchors)
    }

    /// Makes held-out training frames, if any, the evaluation frames in place of other cameras'.
    fn hold_out(&mut self) {
        if self.learnt.len() < self.train.len() {
            self.eval.clear();
        }
        let learnt = &self.learnt;
        for (_, frame) in self.train.iter_mut().enumerate().filter(|(i, _)| learnt.binary_search(i).is_err()) {
            let unknown = Labels::new(&vec![Label::Unknown; frame.labels.len()]);
            let labels = std::mem::replace(&mut frame.labels, unknown);
            self.eval.push(PreparedFrame {
                name: frame.name.clone(),
                camera_name: HELD_OUT.to_owned(),
                view: Arc::clone(&frame.view),
                source: frame.source.clone(),
                labels,
            });
        }
    }

    /// Labels the contaminated edge pixels of masks as unknown.
    fn leave_out_edges(&mut self) -> Result<(), Error> {
        let (vertices, frames) = (self.body.canonical.vertices.len(), self.seen()?);
        let inside = deeper(&frames, MOST);
        let light = if self.lit { measure_light(&inside, vertices) } else { Light::default() };
        self.edge = strange_edge(&frames, light, vertices);
        // The mask may be as much too small.
        let (inner, outer) = (self.edge as f32, self.edge as f32 + 1.0);
        if self.edge == 0 {
            return Ok(());
        }
        self.train.par_iter_mut().for_each(|frame| {
            let width = frame.view.camera.width as usize;
            let labels: Vec<Label> = frame.labels.iter().collect();
            let subject: Vec<bool> = labels.iter().map(|&l| l == Label::Subject).collect();
            let other: Vec<bool> = subject.iter().map(|s| !s).collect();
            let (near_subject, near_other) = (dilate(&subject, width, outer), dilate(&other, width, inner));
            let band = |i: usize| if subject[i] { near_other[i] } else { near_subject[i] };
            let each = labels.into_iter().enumerate().map(|(i, l)| if band(i) { Label::Unknown } else { l });
            frame.labels = Labels::new(&each.collect::<Vec<_>>());
        });
        Ok(())
    }

    /// Share of the training masks' pixels that the prior covers, over up to 32 frames; close to 0
    /// where cameras or bodies are wrong.
    ///
    /// # Errors
    /// A picture of more than 16384 pixels a side.
    pub fn covered(&self) -> Result<f64, Error> {
        let shown: Vec<&PreparedFrame> = self.train.iter().filter(|frame| frame.labels.num_subject() > 0).collect();
        let every = shown.len().div_ceil(COVERED_FRAMES).max(1);
        let counts = shown.into_par_iter().step_by(every).map(|frame| {
            let silhouette = frame.view.silhouette(&self.body.model.faces)?;
            let both = frame.labels.iter().zip(silhouette).filter(|(label, body)| *label == Label::Subject && *body);
            Ok((both.count(), frame.labels.num_subject()))
        });
        let counts = counts.collect::<Result<Vec<_>, Error>>()?;
        let sum = |pick: fn(&(usize, usize)) -> usize| counts.iter().map(pick).sum::<usize>() as f64;
        Ok(sum(|count| count.0) / sum(|count| count.1).max(1.0))
    }

    /// Number of training frames in which each vertex of the prior is visible at a subject pixel,
    /// by ray casting.
    pub fn vertex_frequencies(&self) -> Result<Vec<u64>, Error> {
        let visible: Result<Vec<Vec<bool>>, Error> = self
            .train
            .par_iter()
            .map(|frame| {
                let mesh = RayMesh::new(&frame.view.posed.vertices, &self.body.model.faces)?;
                let usable: Vec<bool> = frame.labels.iter().map(|label| label == Label::Subject).collect();
                Ok(visibility::visible_vertices(
                    &mesh,
                    &frame.view.posed.vertices,
                    &pinhole(&frame.view.camera),
                    Some(&usable),
                ))
            })
            .collect();
        let mut counts = VisibilityCounts::new(self.body.canonical.vertices.len());
        visible?.iter().for_each(|visible| counts.add_visible(visible));
        Ok(counts.counts().to_vec())
    }
}

/// Poses the prior for `frame`, and labels its pixels if it is for training with `config`.
fn prepare(
    body: &Body,
    frame: &Frame,
    instant: usize,
    camera_name: &str,
    config: Option<&Config>,
) -> Result<PreparedFrame, Error> {
    let moment = PosedFrame { betas: &frame.betas, pose: &frame.pose, placement: frame.placement };
    let view = body.view(&frame.camera, instant, moment);
    let mut labels = Labels::default();
    if let Some(config) = config {
        let camera = &view.camera;
        let silhouette = view.silhouette(&body.model.faces)?;
        let depth = camera.world_to_camera.transform_point3(view.centre()).z.max(1e-3);
        let pixels = frame.pixels()?;
        labels = Labels::new(&label_pixels(
            config.occluded,
            &pixels.mask,
            &silhouette,
            pixels.occluder.as_deref(),
            camera.width as usize,
            camera.focal.x / depth,
        ));
    }
    Ok(PreparedFrame {
        name: frame.name.clone(),
        camera_name: camera_name.to_owned(),
        view: Arc::new(view),
        source: Some(frame.source.clone()),
        labels,
    })
}
