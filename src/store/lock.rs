//! One process at a time holds a library folder.

use super::StoreError;
use rustix::fs::{FlockOperation, flock};
use rustix::io::{FdFlags, fcntl_setfd};
use rustix::process::{Pid, test_kill_process};
use std::fs::File;
use std::io::{self, Write};
use std::path::Path;
use std::time::{Duration, Instant};

/// The file that is locked, in the library's folder.
pub const LOCK_FILE: &str = "lock";

/// The folder in a library that readers lock against the removal of files.
const LOCKED_FOLDER: &str = "objects";

/// A process that was killed may have left a child between fork and exec, which shares its open files
/// for a moment.
const PATIENCE: Duration = Duration::from_millis(300);
/// The same, where the process that the lock file names is gone: then those that it let hold the library too are ending.
const PATIENCE_AFTER_DEATH: Duration = Duration::from_secs(10);

/// An exclusive lock on a library folder. The kernel releases it when the process ends, however it
/// ends, so a lock left behind by a crash does not exist.
#[derive(Debug)]
pub struct LibraryLock {
    file: File,
}

impl Drop for LibraryLock {
    fn drop(&mut self) {
        // Closing is not enough: the lock belongs to the open file, which a child that some other thread
        // has forked shares until it has become another program.
        let _ = flock(&self.file, FlockOperation::Unlock);
    }
}

impl LibraryLock {
    /// Takes the lock, or says within a third of a second that a running process holds it. The lock file names the
    /// holder's process id; it is never removed, since removing it would let two processes lock two different files.
    pub fn acquire(dir: &Path) -> Result<Self, StoreError> {
        let path = dir.join(LOCK_FILE);
        let file = File::options()
            .read(true)
            .write(true)
            .create(true)
            .truncate(false)
            .open(&path)
            .map_err(|e| StoreError::io(&path, e))?;
        let begin = Instant::now();
        loop {
            match flock(&file, FlockOperation::NonBlockingLockExclusive) {
                Ok(()) => break,
                Err(rustix::io::Errno::WOULDBLOCK) if begin.elapsed() < patience(&path) => {
                    std::thread::sleep(Duration::from_millis(5));
                }
                Err(rustix::io::Errno::WOULDBLOCK) => {
                    return Err(StoreError::Locked {
                        path: dir.display().to_string(),
                    });
                }
                Err(errno) => return Err(StoreError::io(&path, errno.into())),
            }
        }
        let mut lock = Self { file };
        lock.file
            .set_len(0)
            .and_then(|()| writeln!(lock.file, "{}", std::process::id()))
            .map_err(|e| StoreError::io(&path, e))?;
        Ok(lock)
    }

    /// Lets processes that are started from now on hold the lock too, for as long as they live.
    pub(super) fn share(&self) -> std::io::Result<()> {
        Ok(fcntl_setfd(&self.file, FdFlags::empty())?)
    }
}

/// How long to try.
fn patience(lock: &Path) -> Duration {
    let holder = std::fs::read_to_string(lock).ok();
    let pid = holder.and_then(|text| Pid::from_raw(text.trim().parse().ok()?));
    match pid.map(test_kill_process) {
        Some(Err(rustix::io::Errno::SRCH)) => PATIENCE_AFTER_DEATH,
        _ => PATIENCE,
    }
}

/// A folder that is locked; the folder itself, so that it needs no file and no right to write.
#[derive(Debug)]
pub(super) struct Locked(File);

impl Drop for Locked {
    fn drop(&mut self) {
        // As for [`LibraryLock`].
        let _ = flock(&self.0, FlockOperation::Unlock);
    }
}

impl Locked {
    /// Locks a folder for this alone, if nobody else has it locked.
    pub(super) fn try_exclusive(folder: &Path) -> io::Result<Option<Self>> {
        let locked = Self(File::open(folder)?);
        match flock(&locked.0, FlockOperation::NonBlockingLockExclusive) {
            Ok(()) => Ok(Some(locked)),
            Err(rustix::io::Errno::WOULDBLOCK) => Ok(None),
            Err(errno) => Err(errno.into()),
        }
    }

    fn shared(folder: &Path) -> io::Result<Self> {
        let locked = Self(File::open(folder)?);
        flock(&locked.0, FlockOperation::LockShared)?;
        Ok(locked)
    }
}

/// While it is there no file of a library is removed, in whichever process: for whoever reads the catalog and then, one
/// after the other, the files that it names.
#[derive(Debug)]
pub(super) struct Reading {
    _locked: Option<Locked>,
}

impl Reading {
    pub(super) fn begin(library: &Path) -> Result<Self, StoreError> {
        let folder = library.join(LOCKED_FOLDER);
        match Locked::shared(&folder) {
            Ok(locked) => Ok(Self {
                _locked: Some(locked),
            }),
            // Then there are no files.
            Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(Self { _locked: None }),
            Err(e) => Err(StoreError::io(&folder, e)),
        }
    }
}

/// For whoever removes files; nothing while somebody reads.
pub(super) fn try_removing(library: &Path) -> Result<Option<Locked>, StoreError> {
    let folder = library.join(LOCKED_FOLDER);
    Locked::try_exclusive(&folder).map_err(|e| StoreError::io(&folder, e))
}
