//! Locks a library folder, so that one process at a time holds it.

use super::StoreError;
use rustix::fs::{FlockOperation, flock};
use rustix::io::{FdFlags, fcntl_setfd};
use rustix::process::{Pid, test_kill_process};
use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt as _;
use std::path::Path;
use std::time::{Duration, Instant};

/// The lock file in the library's folder.
pub const LOCK_FILE: &str = "lock";

/// The folder in a library that readers lock against the removal of files.
const LOCKED_FOLDER: &str = "objects";

/// Time to wait for a lock: a killed process may have left a child between fork and exec, which
/// briefly shares its open files.
const PATIENCE: Duration = Duration::from_millis(300);
/// Time to wait if the process named in the lock file is gone: the processes that shared its lock
/// are then ending.
const PATIENCE_AFTER_DEATH: Duration = Duration::from_secs(10);

/// An exclusive lock on a library folder. The kernel releases it when the process ends, however it
/// ends, so a lock left behind by a crash does not exist.
#[derive(Debug)]
pub struct LibraryLock {
    file: File,
}

impl Drop for LibraryLock {
    fn drop(&mut self) {
        // Closing is not enough: the lock belongs to the open file, which a child forked by another
        // thread shares until it becomes another program.
        let _ = flock(&self.file, FlockOperation::Unlock);
    }
}

impl LibraryLock {
    /// Takes the lock, or fails within a third of a second if a running process holds it. The lock
    /// file contains the holder's process id. It is never removed, since otherwise two processes
    /// could lock two different files.
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
                        holder: Holder::read(&path).in_words(),
                    });
                }
                Err(errno) => return Err(StoreError::io(&path, errno.into())),
            }
        }
        let lock = Self { file };
        lock.write("").map_err(|e| StoreError::io(&path, e))?;
        Ok(lock)
    }

    /// Writes the address of the holder for processes that find the library locked.
    pub(super) fn write_endpoint(&self, endpoint: &str) -> std::io::Result<()> {
        self.write(endpoint)
    }

    /// Writes the process id on the first line, and the endpoint, if there is one, on the second.
    /// It is one write, so that readers see either all of it or, between the two steps, an empty
    /// file.
    fn write(&self, endpoint: &str) -> std::io::Result<()> {
        let text = format!("{}\n{endpoint}\n", std::process::id());
        self.file.set_len(0)?;
        self.file.write_all_at(text.as_bytes(), 0)
    }

    /// Lets processes that are started from now on share the lock, for as long as they live.
    pub(super) fn share(&self) -> std::io::Result<()> {
        Ok(fcntl_setfd(&self.file, FdFlags::empty())?)
    }
}

/// The holder according to a lock file. It only serves messages and the time to wait; nothing else
/// depends on it.
#[derive(Debug, Default, PartialEq)]
struct Holder {
    pid: Option<Pid>,
    endpoint: Option<String>,
}

impl Holder {
    fn read(lock: &Path) -> Self {
        std::fs::read_to_string(lock).map_or_else(|_| Self::default(), |text| Self::parse(&text))
    }

    fn parse(text: &str) -> Self {
        let mut lines = text.lines().map(str::trim);
        let pid = lines.next().and_then(|l| l.parse().ok());
        Self {
            pid: pid.filter(|pid| *pid > 0).and_then(Pid::from_raw),
            endpoint: lines.next().filter(|l| !l.is_empty()).map(str::to_owned),
        }
    }

    fn is_gone(&self) -> bool {
        let found = self.pid.map(test_kill_process);
        matches!(found, Some(Err(rustix::io::Errno::SRCH)))
    }

    /// Describes the holder: `process 7, a daemon at ipc:///x; …`.
    fn in_words(&self) -> String {
        let Some(pid) = self.pid.map(Pid::as_raw_nonzero) else {
            return "another process".to_owned();
        };
        if self.is_gone() {
            return format!(
                "a child of process {pid}, which has ended; the child ends by itself, try again"
            );
        }
        match &self.endpoint {
            Some(at) => {
                format!("process {pid}, the daemon at {at}; `coseg stop --endpoint {at}` ends it")
            }
            None => format!("process {pid}"),
        }
    }
}

/// The time to wait for a lock.
fn patience(lock: &Path) -> Duration {
    match Holder::read(lock).is_gone() {
        true => PATIENCE_AFTER_DEATH,
        false => PATIENCE,
    }
}

#[cfg(test)]
mod tests {
    use super::{Holder, LOCK_FILE, LibraryLock};

    #[test]
    fn whoever_finds_it_taken_hears_by_whom_and_where() {
        let directory = tempfile::tempdir().unwrap();
        let lock = LibraryLock::acquire(directory.path()).unwrap();
        let held = |what: &str| {
            let pid = std::process::id();
            format!(
                "{} is held by process {pid}{what}",
                directory.path().display()
            )
        };
        let refused = || {
            LibraryLock::acquire(directory.path())
                .unwrap_err()
                .to_string()
        };
        assert_eq!(refused(), held(""));
        lock.write_endpoint("ipc:///run/x/coseg.sock").unwrap();
        assert_eq!(
            refused(),
            held(
                ", the daemon at ipc:///run/x/coseg.sock; `coseg stop --endpoint \
                 ipc:///run/x/coseg.sock` ends it"
            )
        );
        // The data of an earlier holder do not describe the next one.
        drop(lock);
        std::fs::write(directory.path().join(LOCK_FILE), "1\nipc:///stale\nmore\n").unwrap();
        let _again = LibraryLock::acquire(directory.path()).unwrap();
        assert_eq!(refused(), held(""));
    }

    #[test]
    fn what_is_not_understood_is_another_process() {
        for text in ["", "x", "-7\nipc:///x", "99999999999999999999"] {
            assert_eq!(
                Holder::parse(text).in_words(),
                "another process",
                "{text:?}"
            );
        }
        let gone = Holder::parse("2147483647\nipc:///x\n").in_words();
        assert!(
            gone.starts_with("a child of process 2147483647, which has ended"),
            "{gone}"
        );
    }
}

/// A locked folder. The folder itself is locked, so that neither a file nor write permission is
/// needed.
#[derive(Debug)]
pub(super) struct Locked(File);

impl Drop for Locked {
    fn drop(&mut self) {
        // Closing is not enough, as for [`LibraryLock`].
        let _ = flock(&self.0, FlockOperation::Unlock);
    }
}

impl Locked {
    /// Locks a folder exclusively, if no other process has locked it.
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

/// A guard during which no file of a library is removed, in any process. Readers of the catalog
/// hold it while they open the files that it names.
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
            // Without the folder there are no files.
            Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(Self { _locked: None }),
            Err(e) => Err(StoreError::io(&folder, e)),
        }
    }
}

/// Locks for removing files; returns `None` while a reader holds its guard.
pub(super) fn try_removing(library: &Path) -> Result<Option<Locked>, StoreError> {
    let folder = library.join(LOCKED_FOLDER);
    Locked::try_exclusive(&folder).map_err(|e| StoreError::io(&folder, e))
}
