//! The frames of a video.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use super::fit::Lens;
use crate::CaptureError;
use crate::image::dimensions;
use crate::names::{FrameName, number};
use crate::pictures::Pictures;

/// Extensions of pictures that are not read.
const OTHER_PICTURES: [&str; 9] = ["webp", "tif", "tiff", "bmp", "gif", "heic", "avif", "jp2", "exr"];

/// A video's frames as files, in order.
pub(super) struct Video {
    pub names: Vec<String>,
    pub paths: Vec<PathBuf>,
    pub size: (u32, u32),
}

impl Video {
    /// The pictures of a folder, all of one size.
    pub fn list(dir: &Path) -> Result<Self, CaptureError> {
        let (names, paths): (Vec<String>, Vec<PathBuf>) = Pictures::list(dir)?.into_vec().into_iter().unzip();
        let Some(first) = paths.first() else {
            let entries = std::fs::read_dir(dir).map_err(CaptureError::io(dir))?.filter_map(Result::ok);
            let others = entries.filter_map(|entry| Some(entry.path().extension()?.to_string_lossy().to_lowercase()));
            let others: BTreeSet<String> = others.collect();
            let all = others.iter().map(String::as_str).collect::<Vec<_>>().join(", ");
            let picture = others.iter().find(|other| OTHER_PICTURES.contains(&other.as_str()));
            let found = match picture {
                Some(kind) => format!("files of {all} (`mogrify -format png *.{kind}` of ImageMagick converts them)"),
                None if all.is_empty() => "none".to_owned(),
                None => format!("files of {all}"),
            };
            return Err(CaptureError::invalid(dir, "files", "the video's frames, .png or .jpg", found));
        };
        let size = dimensions(first)?;
        for path in &paths {
            let other = dimensions(path)?;
            if other != size {
                let expected = format!("{}×{}, as the first frame", size.0, size.1);
                return Err(CaptureError::invalid(path, "size", expected, format!("{}×{}", other.0, other.1)));
            }
        }
        Ok(Self { names, paths, size })
    }

    /// The frame called `name`.
    pub fn index(&self, name: &str) -> Option<usize> {
        self.names.binary_search_by(|frame| FrameName(frame).cmp(&FrameName(name))).ok()
    }

    /// The numbers of the frames, where all have one and they ascend.
    pub fn numbers(&self) -> Option<Vec<usize>> {
        let numbers: Option<Vec<usize>> = self.names.iter().map(|name| number(name)).collect();
        numbers.filter(|numbers| numbers.windows(2).all(|pair| pair[0] < pair[1]))
    }

    /// The gaps between the frames' numbers, in words; empty where there are none.
    pub fn gaps(&self) -> String {
        let numbers = self.numbers().unwrap_or_default();
        let gap = |pair: &[usize]| match pair[1] - pair[0] {
            1 => None,
            2 => Some(format!("{}", pair[0] + 1)),
            _ => Some(format!("{} to {}", pair[0] + 1, pair[1] - 1)),
        };
        let gaps: Vec<String> = numbers.windows(2).filter_map(gap).collect();
        match gaps.len() {
            0..=8 => gaps.join(", "),
            n => format!("{}, … {n} in all", gaps[..8].join(", ")),
        }
    }

    /// Width and height.
    pub fn sides(&self) -> [f64; 2] {
        [self.size.0.into(), self.size.1.into()]
    }

    /// The longer of the two.
    pub fn longest(&self) -> f64 {
        let [width, height] = self.sides();
        width.max(height)
    }

    /// The image centre, most estimators' principal point.
    pub fn middle(&self) -> [f64; 2] {
        self.sides().map(|side| side / 2.0)
    }

    /// A lens of this focal length about the image centre.
    pub fn lens(&self, focal: f64) -> Lens {
        [[focal; 2], self.middle()]
    }

    /// The lens of files that have none: of the diagonal's length.
    pub fn diagonal(&self) -> Lens {
        let [width, height] = self.sides();
        self.lens(width.hypot(height))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::Directory;

    #[test]
    fn pictures_of_other_kinds_are_named_with_a_command() {
        let dir = Directory::new("import-webp");
        let refused = || Video::list(dir.path()).err().unwrap().to_string();
        assert!(refused().contains("found none"), "{}", refused());
        for (name, words) in
            [("1.webp", "files of webp (`mogrify -format png *.webp`"), ("2.TIF", "files of tif, webp")]
        {
            dir.write(name, b"RIFF");
            assert!(refused().contains(words), "{}", refused());
        }
    }
}
