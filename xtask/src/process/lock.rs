//! Locks on folders: readers share one, a writer excludes all others.

use std::fs::{File, TryLockError};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use anyhow::Result;

use super::ending::{Ending, is_read_only, unwritten};
use crate::note;

/// Lock files of the folders that this process writes.
static HELD: Mutex<Vec<(PathBuf, File)>> = Mutex::new(Vec::new());

/// Lock on a folder, held by the system until the process ends; a `.lock` file left behind has no
/// meaning.
#[must_use]
pub struct Lock {
    /// Folder of an entry of [`HELD`].
    written: Option<PathBuf>,
    _shared: Option<File>,
}

impl Lock {
    /// Takes the folder for writing, and removes what killed writers left unfinished.
    ///
    /// # Errors
    /// [`Ending::Busy`] where another process reads or writes it; [`Ending::Unwritten`].
    pub fn take(folder: &Path) -> Result<Self> {
        let path = folder.join(".lock");
        let file = File::options().create(true).truncate(false).write(true).open(&path).map_err(unwritten(&path))?;
        locked(folder, &path, file.try_lock())?;
        held().push((folder.to_owned(), file));
        let lock = Self { written: Some(folder.to_owned()), _shared: None };
        // The folder may have been replaced before it was locked.
        still_held(folder).map_err(|_| Ending::Busy(folder.to_owned()))?;
        array_files::sweep(folder);
        Ok(lock)
    }

    /// Takes the folder for reading. A reader may add what follows from what it reads. Without a
    /// lock in a folder that cannot be written and has none.
    ///
    /// # Errors
    /// [`Ending::Busy`] where another process writes it; [`Ending::Unwritten`].
    pub fn share(folder: &Path) -> Result<Self> {
        let path = folder.join(".lock");
        let made = || File::options().create(true).truncate(false).write(true).open(&path);
        let file = match File::open(&path).or_else(|_| made()).map_err(unwritten(&path)) {
            Err(error) if is_read_only(&error) => return Ok(Self { written: None, _shared: None }),
            file => file?,
        };
        locked(folder, &path, file.try_lock_shared())?;
        Ok(Self { written: None, _shared: Some(file) })
    }
}

impl Drop for Lock {
    fn drop(&mut self) {
        held().retain(|(folder, _)| Some(folder) != self.written.as_ref());
    }
}

fn held() -> std::sync::MutexGuard<'static, Vec<(PathBuf, File)>> {
    HELD.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The outcome of trying; a warning in place of a lock for network file systems without locks.
fn locked(folder: &Path, path: &Path, tried: Result<(), TryLockError>) -> Result<()> {
    match tried {
        Ok(()) => {}
        Err(TryLockError::WouldBlock) => return Err(Ending::Busy(folder.to_owned()).into()),
        Err(TryLockError::Error(error)) => {
            note!("warning: {}: no locks here ({error}): let no other process write this folder", path.display());
        }
    }
    Ok(())
}

/// Checks that a folder taken for writing has not been replaced by another since, which another
/// process may be writing; any other folder passes.
///
/// # Errors
/// [`Ending::Unwritten`].
pub fn still_held(folder: &Path) -> Result<()> {
    let held = held();
    let Some((_, file)) = held.iter().find(|(taken, _)| taken == folder) else { return Ok(()) };
    let path = folder.join(".lock");
    let same = identity(file.metadata()).and_then(|ours| Ok(ours == identity(path.metadata())?));
    match same {
        Ok(true) => Ok(()),
        Ok(false) => Err(io::Error::other("another folder has taken its place")),
        Err(error) => Err(error),
    }
    .map_err(unwritten(folder))
}

/// Device and inode.
#[cfg(unix)]
fn identity(of: io::Result<std::fs::Metadata>) -> io::Result<(u64, u64)> {
    use std::os::unix::fs::MetadataExt;
    of.map(|of| (of.dev(), of.ino()))
}

/// Unknown on other systems.
#[cfg(not(unix))]
fn identity(of: io::Result<std::fs::Metadata>) -> io::Result<()> {
    of.map(drop)
}

#[cfg(test)]
mod tests {
    use testkit::files::Directory;

    use super::*;

    fn is_busy(lock: Result<Lock>) -> bool {
        matches!(lock.err().unwrap().downcast_ref(), Some(Ending::Busy(_)))
    }

    #[test]
    fn readers_share_a_folder_and_a_writer_has_it_alone() {
        let folder = Directory::new("lock");
        let folder = folder.path();
        let lock = Lock::take(folder).unwrap();
        assert!(is_busy(Lock::take(folder)) && is_busy(Lock::share(folder)));
        drop(lock);
        let readers = [Lock::share(folder).unwrap(), Lock::share(folder).unwrap()];
        assert!(is_busy(Lock::take(folder)));
        drop(readers);
        drop(Lock::take(folder).unwrap());
        let gone = Lock::take(&folder.join("gone")).err().unwrap();
        assert!(matches!(gone.downcast_ref(), Some(Ending::Unwritten { .. })), "{gone}");
    }

    #[cfg(unix)]
    #[test]
    fn a_folder_in_the_place_of_the_one_that_was_taken_is_not_written() {
        let folder = Directory::new("replaced");
        let folder = folder.path();
        let lock = Lock::take(folder).unwrap();
        still_held(folder).unwrap();
        std::fs::remove_dir_all(folder).unwrap();
        std::fs::create_dir(folder).unwrap();
        assert!(still_held(folder).is_err());
        let other = File::create(folder.join(".lock")).unwrap();
        other.try_lock().unwrap();
        let error = still_held(folder).unwrap_err();
        assert!(error.to_string().contains("another folder has taken its place"), "{error}");
        let write = crate::run::write(&folder.join("metrics.json"), "{}");
        assert!(write.is_err() && !folder.join("metrics.json").exists());
        drop((lock, other));
    }
}
