//! Whole files: read up to a limit, and replaced in one go, on the disk before the old one is gone.

use std::fs::File;
use std::io::{self, BufWriter, ErrorKind, IntoInnerError, Read};
use std::path::Path;

use crate::Error;

/// Largest file that is read, in bytes: 2 GiB.
pub(crate) const MAX_FILE_BYTES: u64 = 1 << 31;
/// Most bytes that are read of what is no plain file: 256 MiB.
const MAX_PIPED_BYTES: u64 = 1 << 28;
/// Start of the names of temporary files. A killed process leaves its own behind, which [`sweep`]
/// removes.
const PREFIX: &str = ".unfinished-";

/// Reads a file of at most `limit` bytes; a device or a pipe, whose reported length means nothing,
/// of at most 256 MiB too.
///
/// ```
/// # let path = std::env::temp_dir().join("array-files-bounded.txt");
/// std::fs::write(&path, "four")?;
/// assert_eq!(array_files::read_bounded(&path, 4)?, b"four");
/// let error = array_files::read_bounded(&path, 3).unwrap_err();
/// assert_eq!(error.to_string(), "more than 3 bytes, the most that is read of such a file");
/// # std::fs::remove_file(&path)?;
/// # Ok::<(), std::io::Error>(())
/// ```
///
/// # Errors
/// Those of the system; [`ErrorKind::FileTooLarge`] beyond the limit; [`ErrorKind::OutOfMemory`].
pub fn read_bounded(path: &Path, limit: u64) -> io::Result<Vec<u8>> {
    let file = File::open(path)?;
    let found = file.metadata()?;
    let limit = if found.is_file() { limit } else { limit.min(MAX_PIPED_BYTES) };
    let read = if found.len() > limit { None } else { read_limited(file, found.len() as usize, limit)? };
    read.ok_or_else(|| {
        let what = format!("more than {limit} bytes, the most that is read of such a file");
        io::Error::new(ErrorKind::FileTooLarge, what)
    })
}

/// Reads an array file: at most 2 GiB by [`read_bounded`].
///
/// # Errors
/// [`Error::Io`]; [`Error::Invalid`] for a web page.
pub fn read_file(path: &Path) -> Result<Vec<u8>, Error> {
    let bytes = read_bounded(path, MAX_FILE_BYTES).map_err(Error::io(path))?;
    let start = decode_text(&bytes[..bytes.len().min(256)]).trim_start().to_ascii_lowercase();
    if start.starts_with("<!doctype html") || start.starts_with("<html") {
        let message = "a web page (HTML), as sites send it in place of a file that needs a login";
        return Err(Error::invalid(&path.display().to_string(), "", message.to_owned()));
    }
    Ok(bytes)
}

/// The text of a file as editors on any system write it: UTF-8, with a byte-order mark or without,
/// or UTF-16 with one; line ends of `\r\n` and `\r` become `\n`. What is not valid becomes U+FFFD.
///
/// ```
/// use array_files::decode_text;
/// assert_eq!(decode_text(b"\xef\xbb\xbfv 0 0 0\r\nv 1 0 0\r"), "v 0 0 0\nv 1 0 0\n");
/// assert_eq!(decode_text(b"\xff\xfe{\0}\0"), "{}");
/// ```
pub fn decode_text(bytes: &[u8]) -> String {
    let utf16 = |bytes: &[u8], from: fn([u8; 2]) -> u16| {
        let units: Vec<u16> = bytes.chunks(2).map(|pair| from([pair[0], *pair.get(1).unwrap_or(&0)])).collect();
        String::from_utf16_lossy(&units)
    };
    let text = match bytes {
        [0xEF, 0xBB, 0xBF, rest @ ..] => String::from_utf8_lossy(rest).into_owned(),
        [0xFF, 0xFE, rest @ ..] => utf16(rest, u16::from_le_bytes),
        [0xFE, 0xFF, rest @ ..] => utf16(rest, u16::from_be_bytes),
        _ => String::from_utf8_lossy(bytes).into_owned(),
    };
    if text.contains('\r') { text.replace("\r\n", "\n").replace('\r', "\n") } else { text }
}

/// Everything from `reader`, or `None` if it is more than `limit` bytes; `expected` bytes are
/// reserved.
pub(crate) fn read_limited(reader: impl Read, expected: usize, limit: u64) -> io::Result<Option<Vec<u8>>> {
    let mut bytes = Vec::new();
    bytes.try_reserve_exact(expected)?;
    reader.take(limit + 1).read_to_end(&mut bytes)?;
    Ok(Some(bytes).filter(|bytes| bytes.len() as u64 <= limit))
}

/// Bytes that `packed` compressed bytes may expand to: 256 times as many and 64 MiB, at most
/// [`MAX_FILE_BYTES`]. Measurements compress little; runs of zeros do a thousandfold.
pub(crate) fn unpacked_limit(packed: u64) -> u64 {
    packed.saturating_mul(256).saturating_add(64 << 20).min(MAX_FILE_BYTES)
}

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
pub fn replace_file(path: &Path, write: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>) -> io::Result<()> {
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
    let system =
        |error: io::Error| error.raw_os_error().map_or_else(|| error.kind().into(), io::Error::from_raw_os_error);
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
    use std::io::Write;

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
            Err(io::Error::other("no more"))
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
