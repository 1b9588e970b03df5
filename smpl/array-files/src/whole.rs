//! Files that are replaced in one go, and on the disk before the old one is gone.

use std::fs::File;
use std::io::{BufWriter, Error, ErrorKind, IntoInnerError, Result};
use std::path::Path;

/// Start of the names of temporary files. A killed process leaves its own behind, which [`sweep`]
/// removes.
const PREFIX: &str = ".unfinished-";

/// Replaces the file at `path` by what `write` writes.
///
/// A reader of `path`, at any moment and after a power cut, finds the old content or the new one,
/// whole. Until it is complete the new content has a random name in the same directory; where
/// anything fails the old file stays. Permissions of the old file are kept. Of a symbolic link the
/// target is replaced. Devices and pipes are written to as they are.
///
/// ```
/// use std::io::Write;
/// let path = std::env::temp_dir().join("array-files-replace.txt");
/// array_files::replace_file(&path, |to| to.write_all(b"whole"))?;
/// assert_eq!(std::fs::read(&path)?, b"whole");
/// # std::fs::remove_file(&path)?;
/// # Ok::<(), std::io::Error>(())
/// ```
///
/// # Errors
/// Those of the system, and of `write`; a directory, or a link without a target, at `path`.
pub fn replace_file(path: &Path, write: impl FnOnce(&mut BufWriter<File>) -> Result<()>) -> Result<()> {
    let filled = |file: File| {
        let mut to = BufWriter::with_capacity(1 << 20, file);
        write(&mut to)?;
        to.into_inner().map_err(IntoInnerError::into_error)
    };
    let (target, old) = match path.metadata() {
        Ok(found) if found.is_dir() => return Err(ErrorKind::IsADirectory.into()),
        Ok(found) if !found.is_file() => return filled(File::options().write(true).open(path)?).map(drop),
        Ok(found) => (path.canonicalize()?, Some(found.permissions())),
        Err(error) if error.kind() == ErrorKind::NotFound && !path.is_symlink() => (path.to_owned(), None),
        Err(error) => return Err(error),
    };
    let parent = target.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let mut builder = tempfile::Builder::new();
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    // The path in an error would be the temporary one.
    let system = |error: Error| error.raw_os_error().map_or_else(|| error.kind().into(), Error::from_raw_os_error);
    let (file, unfinished) = builder.prefix(PREFIX).tempfile_in(parent).map_err(system)?.into_parts();
    let file = filled(file)?;
    old.map_or(Ok(()), |old| file.set_permissions(old))?;
    file.sync_all()?;
    unfinished.persist(&target).map_err(|error| error.error)?;
    // The new name is an entry of the directory. Not every file system can be asked to keep one:
    // the file is whole either way.
    let _ = File::open(parent).and_then(|directory| directory.sync_all());
    Ok(())
}

/// Removes the temporary files that killed processes left in a directory, to which no other process
/// may be writing.
pub fn sweep(directory: &Path) {
    let entries = std::fs::read_dir(directory).into_iter().flatten().flatten();
    for entry in entries.filter(|entry| entry.file_name().to_string_lossy().starts_with(PREFIX)) {
        let _ = std::fs::remove_file(entry.path());
    }
}

#[cfg(test)]
mod tests {
    use std::io::{Read, Write};

    use super::*;

    fn folder(name: &str) -> std::path::PathBuf {
        let folder = std::env::temp_dir().join(format!("array-files-{name}-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        folder
    }

    #[test]
    fn the_old_content_stays_until_the_new_one_is_complete() {
        let folder = folder("whole");
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
        replace_file(&path, |to| to.write_all(b"new")).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"new");
        assert!(replace_file(&folder.join("no/such/folder"), |_| Ok(())).is_err());
        assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 1);
        assert_eq!(replace_file(&folder, |_| Ok(())).unwrap_err().kind(), ErrorKind::IsADirectory);
        std::fs::write(folder.join(".unfinished-killed"), b"half").unwrap();
        sweep(&folder);
        assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 1);
        std::fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn a_process_beside_writes_the_same_path_and_nobody_s_files_vanish() {
        let folder = folder("beside");
        let (path, own) = (folder.join("a.json"), folder.join("a.json.partial"));
        std::fs::write(&own, b"of the user").unwrap();
        std::thread::scope(|scope| {
            for byte in *b"abcd" {
                let path = &path;
                scope.spawn(move || {
                    for _ in 0..50 {
                        replace_file(path, |to| to.write_all(&[byte; 5000])).unwrap();
                        let found = std::fs::read(path).unwrap();
                        assert!(found.len() == 5000 && found.iter().all(|b| *b == found[0]));
                    }
                });
            }
        });
        assert_eq!(std::fs::read(&own).unwrap(), b"of the user");
        assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 2);
        std::fs::remove_dir_all(&folder).unwrap();
    }

    #[cfg(unix)]
    #[test]
    fn links_are_followed_permissions_kept_and_devices_and_pipes_written_to() {
        use std::os::unix::fs::{FileTypeExt, PermissionsExt, symlink};

        let folder = folder("links");
        let (target, link) = (folder.join("target"), folder.join("link"));
        std::fs::write(&target, b"old").unwrap();
        std::fs::set_permissions(&target, PermissionsExt::from_mode(0o640)).unwrap();
        symlink("target", &link).unwrap();
        replace_file(&link, |to| to.write_all(b"new")).unwrap();
        assert!(link.symlink_metadata().unwrap().is_symlink() && std::fs::read(&target).unwrap() == b"new");
        assert_eq!(target.metadata().unwrap().permissions().mode() & 0o777, 0o640);
        symlink("nothing", folder.join("broken")).unwrap();
        assert!(replace_file(&folder.join("broken"), |_| Ok(())).is_err());
        // A device behind a link, as one at the path itself.
        symlink("/dev/full", folder.join("full")).unwrap();
        let full = replace_file(&folder.join("full"), |to| to.write_all(b"x")).unwrap_err();
        assert_eq!(full.kind(), ErrorKind::StorageFull);
        assert!(std::fs::metadata("/dev/full").unwrap().file_type().is_char_device());
        let pipe = folder.join("pipe");
        assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
        let reader = std::thread::spawn({
            let pipe = pipe.clone();
            move || {
                let mut bytes = Vec::new();
                File::open(pipe).and_then(|mut file| file.read_to_end(&mut bytes)).map(|_| bytes)
            }
        });
        replace_file(&pipe, |to| to.write_all(b"through")).unwrap();
        assert_eq!(reader.join().unwrap().unwrap(), b"through");
        assert!(pipe.metadata().unwrap().file_type().is_fifo());
        std::fs::remove_dir_all(&folder).unwrap();
    }
}
