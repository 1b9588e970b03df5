//! Files that are whole at every moment: replaced in one go, and on the disk before the old one is
//! gone.

use std::ffi::OsString;
use std::fs::File;
use std::io::{BufWriter, IntoInnerError, Result};
use std::path::{Path, PathBuf};

/// Replaces the file at `path` by what `write` writes.
///
/// Whoever reads `path`, at any moment and after a power cut, finds the old content or the new one,
/// whole. The new content stands in `path` with `.partial` behind it until it is complete and on
/// the disk; one process at a time may write a path. Where anything fails the old file stays as it
/// was, and the partial one is removed.
///
/// # Errors
/// Those of the system, and of `write`.
pub fn replace_file(path: &Path, write: impl FnOnce(&mut BufWriter<File>) -> Result<()>) -> Result<()> {
    let partial = partial(path);
    let written = File::create(&partial).and_then(|file| {
        let mut to = BufWriter::with_capacity(1 << 20, file);
        write(&mut to)?;
        to.into_inner().map_err(IntoInnerError::into_error)?.sync_all()?;
        std::fs::rename(&partial, path)
    });
    if written.is_err() {
        let _ = std::fs::remove_file(&partial);
        return written;
    }
    // The new name is an entry of the directory. Not every file system can be asked to keep one:
    // the file is whole either way.
    let parent = path.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let _ = File::open(parent).and_then(|directory| directory.sync_all());
    Ok(())
}

fn partial(path: &Path) -> PathBuf {
    let mut name = OsString::from(path);
    name.push(".partial");
    name.into()
}

#[cfg(test)]
mod tests {
    use std::io::{Error, Write};

    use super::*;

    #[test]
    fn the_old_content_stays_until_the_new_one_is_complete() {
        let folder = std::env::temp_dir().join(format!("occnerf-atomic-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let path = folder.join("a.json");
        replace_file(&path, |to| to.write_all(b"old")).unwrap();
        let failed = replace_file(&path, |to| {
            to.write_all(b"half of the n")?;
            to.flush()?;
            assert_eq!(std::fs::read(&path)?, b"old");
            Err(Error::other("no more"))
        });
        assert_eq!(failed.unwrap_err().to_string(), "no more");
        assert_eq!(std::fs::read(&path).unwrap(), b"old");
        assert!(!partial(&path).exists());
        replace_file(&path, |to| to.write_all(b"new")).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"new");
        assert!(replace_file(&folder.join("no/such/folder"), |_| Ok(())).is_err());
        assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 1);
        std::fs::remove_dir_all(&folder).unwrap();
    }
}
