//! Exclusive locks on folders.

use std::fs::{File, TryLockError};
use std::path::{Path, PathBuf};

use anyhow::Result;

use super::ending::{Ending, unwritten};
use crate::note;

/// Exclusive lock on writing a folder, held by the system until the process ends; a `.lock` file left
/// behind has no meaning.
#[must_use]
pub struct Lock {
    _file: Option<File>,
}

impl Lock {
    /// Takes the folder.
    ///
    /// # Errors
    /// [`Ending::Busy`] where another process has it; [`Ending::Unwritten`].
    pub fn take(folder: &Path) -> Result<Self> {
        match Self::try_take(folder)? {
            Some(lock) => Ok(lock),
            None => Err(Ending::Busy(folder.to_owned()).into()),
        }
    }

    /// Takes the folder; `None` where another process has it.
    ///
    /// # Errors
    /// [`Ending::Unwritten`].
    pub fn try_take(folder: &Path) -> Result<Option<Self>> {
        let (path, file) = Self::open(folder)?;
        match file.try_lock() {
            Ok(()) => Ok(Some(Self { _file: Some(file) })),
            Err(TryLockError::WouldBlock) => Ok(None),
            Err(TryLockError::Error(error)) => Ok(Some(without(&path, &error))),
        }
    }

    /// Waits for the folder.
    ///
    /// # Errors
    /// [`Ending::Unwritten`].
    pub fn wait(folder: &Path) -> Result<Self> {
        let (path, file) = Self::open(folder)?;
        match file.lock() {
            Ok(()) => Ok(Self { _file: Some(file) }),
            Err(error) => Ok(without(&path, &error)),
        }
    }

    fn open(folder: &Path) -> Result<(PathBuf, File)> {
        let path = folder.join(".lock");
        let file = File::options().create(true).truncate(false).write(true).open(&path).map_err(unwritten(&path))?;
        Ok((path, file))
    }
}

/// A warning in place of a lock, for network file systems without locks.
fn without(path: &Path, error: &std::io::Error) -> Lock {
    note!("warning: {}: no locks here ({error}): let no other process write this folder", path.display());
    Lock { _file: None }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_is_taken_once_until_it_is_let_go() {
        let folder = std::env::temp_dir().join(format!("xtask-lock-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let lock = Lock::take(&folder).unwrap();
        assert!(Lock::try_take(&folder).unwrap().is_none());
        let busy = Lock::take(&folder).err().unwrap();
        assert!(matches!(busy.downcast_ref(), Some(Ending::Busy(_))), "{busy}");
        drop(lock);
        drop(Lock::wait(&folder).unwrap());
        assert!(Lock::try_take(&folder).unwrap().is_some());
        let gone = Lock::take(&folder.join("gone")).err().unwrap();
        assert!(matches!(gone.downcast_ref(), Some(Ending::Unwritten { .. })), "{gone}");
        std::fs::remove_dir_all(&folder).unwrap();
    }
}
