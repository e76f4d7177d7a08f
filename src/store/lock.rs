//! One process at a time holds a library folder.

use super::StoreError;
use rustix::fs::{FlockOperation, flock};
use std::fs::File;
use std::io::Write;
use std::path::Path;

/// The file that is locked, in the library's folder.
pub const LOCK_FILE: &str = "lock";

/// An exclusive lock on a library folder. The kernel releases it when the process ends, however it
/// ends, so a lock left behind by a crash does not exist.
#[derive(Debug)]
pub struct LibraryLock {
    _file: File,
}

impl LibraryLock {
    /// Takes the lock without waiting. The lock file names the holder's process id for people; it
    /// is never removed, since removing it would let two processes lock two different files.
    pub fn acquire(dir: &Path) -> Result<Self, StoreError> {
        let path = dir.join(LOCK_FILE);
        let mut file = File::options()
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .open(&path)
            .map_err(|e| StoreError::io(&path, e))?;
        match flock(&file, FlockOperation::NonBlockingLockExclusive) {
            Ok(()) => {}
            Err(rustix::io::Errno::WOULDBLOCK) => {
                return Err(StoreError::Locked {
                    path: dir.display().to_string(),
                });
            }
            Err(errno) => return Err(StoreError::io(&path, errno.into())),
        }
        file.set_len(0)
            .and_then(|()| writeln!(file, "{}", std::process::id()))
            .map_err(|e| StoreError::io(&path, e))?;
        Ok(Self { _file: file })
    }
}
