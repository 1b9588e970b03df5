//! A small demo capture, settings that train it in milliseconds a step, and places for files.

use std::sync::OnceLock;

use glam::Vec3;
use occnerf::capture::Capture;
use occnerf::{Config, Method, MotionKind, PreparedFrame, Preset, Scene, StepReport, Trainer};
use smpl::{BodyModel, SparseRows};
use synth::{DemoConfig, demo};
use testkit::files::Directory;
use visibility::RayMesh;

pub const METHODS: [Method; 2] = [Method::Occnerf, Method::HashPoint];

pub fn body() -> &'static BodyModel {
    static BODY: OnceLock<BodyModel> = OnceLock::new();
    BODY.get_or_init(BodyModel::embedded)
}

pub fn demo_config() -> DemoConfig {
    DemoConfig { size: 48, frames: 6, eval_cameras: 2, eval_every: 3, ..DemoConfig::default() }
}

pub fn capture() -> &'static Capture {
    static CAPTURE: OnceLock<Capture> = OnceLock::new();
    CAPTURE.get_or_init(|| demo(&demo_config(), body()).unwrap())
}

/// Labels and queries do not depend on the method, so one scene serves all of them.
pub fn scene() -> &'static Scene {
    static SCENE: OnceLock<Scene> = OnceLock::new();
    SCENE.get_or_init(|| Scene::new(capture(), body(), &tiny(Method::Occnerf, MotionKind::Surface)).unwrap())
}

/// The fast preset with small patches and a small field.
pub fn tiny(method: Method, motion: MotionKind) -> Config {
    let mut config = Config::preset(Preset::Fast, method);
    config.steps = 8;
    (config.patches, config.patch_size, config.samples) = (3, 16, 24);
    (config.field.width, config.field.depth) = (32, 2);
    (config.encoding.levels, config.encoding.log2_table_size, config.encoding.n_max) = (6, 12, 96);
    // With all parts of the paper's surface term.
    (config.surface.coarse_levels, config.surface.attention) = (3, true);
    config.surface.surface_term = method == Method::Occnerf;
    config.motion.kind = motion;
    config.motion.shell_interval = 2;
    if motion != MotionKind::Surface {
        config.motion.shell_interval = 0;
        config.field.prior_colors = false;
    }
    config
}

/// Trains from the start for `steps` and returns the reports and the checkpoint.
pub fn train(scene: &Scene, config: &Config, steps: u64) -> (Vec<StepReport>, Vec<u8>) {
    let mut trainer = Trainer::new(scene, config.clone()).unwrap();
    let reports = (0..steps).map(|_| trainer.step().unwrap()).collect();
    (reports, checkpoint(&trainer))
}

/// The bytes that a trainer saves.
pub fn checkpoint(trainer: &Trainer<'_>) -> Vec<u8> {
    let dir = Directory::new("checkpoint");
    let path = dir.path().join("checkpoint.safetensors");
    trainer.save(&path).unwrap();
    std::fs::read(path).unwrap()
}

/// Bits of every loss, so that NaN and −0 are told apart too.
pub fn bits(reports: &[StepReport]) -> Vec<[u64; 4]> {
    reports.iter().map(|r| [r.loss, r.mse, r.perceptual, r.completeness].map(f64::to_bits)).collect()
}

/// Runs `work` on a pool of its own.
pub fn on_threads<T: Send>(threads: usize, work: impl FnOnce() -> T + Send) -> T {
    rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(work)
}

/// Pixels whose centre's ray hits the posed prior.
pub fn silhouette(scene: &Scene, frame: &PreparedFrame) -> Vec<bool> {
    let mesh = RayMesh::new(&frame.view.posed.vertices, &scene.body.model.faces).unwrap();
    let camera = &frame.view.camera;
    let pixels = (0..camera.height).flat_map(|row| (0..camera.width).map(move |column| (row, column)));
    let rays = pixels.map(|(row, column)| camera.ray(column as f32 + 0.5, row as f32 + 0.5));
    rays.map(|ray| mesh.first_hit(ray.origin, ray.direction).is_some()).collect()
}

/// Four vertices, two joints, two shapes.
pub fn tiny_body() -> BodyModel {
    let corner = |i: usize| Vec3::new((i & 1) as f32, (i >> 1) as f32, 0.3 * i as f32);
    BodyModel {
        v_template: (0..4).map(corner).collect(),
        faces: vec![[0, 1, 2], [1, 3, 2]],
        shapedirs: vec![Vec3::splat(0.01); 8],
        posedirs: SparseRows::from_rows((0..4).map(|i| vec![(i as u32, Vec3::splat(0.02))])),
        weights: SparseRows::from_rows((0..4).map(|i| vec![(u32::from(i > 1), 1.0f32)])),
        j_regressor: SparseRows::from_rows((0..2).map(|j| vec![(2 * j as u32, 0.5f32), (2 * j as u32 + 1, 0.5)])),
        parents: vec![None, Some(0)],
    }
}
