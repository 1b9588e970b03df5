//! Plain, obviously right answers in `f64`, to compare fast code with.

mod encoding;
mod geometry;
mod metrics;
mod points;
mod render;

pub use encoding::{hash_encode, hash_index};
pub use geometry::{closest_point, first_hit, inside, winding_number};
pub use metrics::{mask_iou, psnr, ssim, ssim_map};
pub use points::{farthest_points, knn};
pub use render::composite;
