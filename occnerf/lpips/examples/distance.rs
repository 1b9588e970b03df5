//! LPIPS distance of two PNGs of the same size:
//! `cargo run --release -p lpips --example distance WEIGHTS A.png B.png`.

use std::path::Path;

use lpips::Lpips;

/// Width, height and sRGB values in [0, 1].
fn read(path: &str) -> Result<([usize; 2], Vec<f32>), image::ImageError> {
    let image = image::open(path)?.into_rgb32f();
    let size = [image.width() as usize, image.height() as usize];
    Ok((size, image.into_raw()))
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [weights, a, b] = arguments.as_slice() else {
        return Err("expected WEIGHTS A.png B.png".into());
    };
    let network = Lpips::load(Path::new(weights))?;
    let ((size, a), (other, b)) = (read(a)?, read(b)?);
    if size != other {
        return Err(format!("images of {size:?} and {other:?} pixels").into());
    }
    let distance = network.distance(&a, &b, size[0], size[1])?[0];
    println!("{}: {distance:.4}", network.name());
    Ok(())
}
