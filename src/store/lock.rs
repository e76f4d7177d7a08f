//! One process at a time holds a library folder.

use super::StoreError;
use rustix::fs::{FlockOperation, flock};
use rustix::io::{FdFlags, fcntl_setfd};
use rustix::process::{Pid, test_kill_process};
use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt as _;
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

    /// Tells whoever finds the library held where the holder can be asked.
    pub(super) fn tell(&self, endpoint: &str) -> std::io::Result<()> {
        self.write(endpoint)
    }

    /// The process id on the first line, the endpoint, if there is one, on the second: one write,
    /// so that nobody reads half of it but between the two steps, when there is nothing.
    fn write(&self, endpoint: &str) -> std::io::Result<()> {
        let text = format!("{}\n{endpoint}\n", std::process::id());
        self.file.set_len(0)?;
        self.file.write_all_at(text.as_bytes(), 0)
    }

    /// Lets processes that are started from now on hold the lock too, for as long as they live.
    pub(super) fn share(&self) -> std::io::Result<()> {
        Ok(fcntl_setfd(&self.file, FdFlags::empty())?)
    }
}

/// What a lock file says of who holds it. Words for people and a hint of how long to wait: nothing
/// else follows from it.
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

    /// `process 7, a daemon at ipc:///x; …`.
    fn in_words(&self) -> String {
        let Some(pid) = self.pid.map(Pid::as_raw_nonzero) else {
            return "another process".to_owned();
        };
        if self.is_gone() {
            return format!(
                "what process {pid}, which has ended, had started; it ends by itself, try again"
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

/// How long to try.
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
        lock.tell("ipc:///run/x/coseg.sock").unwrap();
        assert_eq!(
            refused(),
            held(
                ", the daemon at ipc:///run/x/coseg.sock; `coseg stop --endpoint ipc:///run/x/coseg.sock` ends it"
            )
        );
        // What another has left there says nothing of the next.
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
            gone.starts_with("what process 2147483647, which has ended"),
            "{gone}"
        );
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
