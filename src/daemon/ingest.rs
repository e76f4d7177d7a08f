//! Reads files that a request names by path. Each is opened once, below a directory that the
//! configuration allows, and everything after that uses the open file, whatever the name stands for
//! by then.
//!
//! A user who may write into such a directory can replace a file by a link to another one, or by a
//! pipe, at any moment. So links are resolved first, to learn where the path leads. That place is
//! then opened from the allowed directory down, and no step may be a link (`openat2`, or step by
//! step where the kernel has none). The open file must be regular and not too large, and no more
//! than its length at that time is read.
//!
//! A network file system may hang in any of this, so it is done in threads that are abandoned when
//! the time is up.

use crate::daemon::answer::busy;
use crate::daemon::shared::Daemon;
use crate::ipc::convert;
use crate::ipc::wire::{self, ErrorCode, ErrorReason};
use rustix::fs::{CWD, Mode, OFlags, ResolveFlags, openat, openat2};
use rustix::io::Errno;
use std::fs::File;
use std::io::{self, Read as _};
use std::os::fd::OwnedFd;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Component, Path, PathBuf};
use std::sync::{Arc, mpsc};
use std::time::{Duration, Instant};

/// How long one file may take, unless the request's own deadline is sooner.
const PATIENCE: Duration = Duration::from_secs(60);
/// How long after that deadline the file is given up: the answer is that the deadline passed.
const AFTER_DEADLINE: Duration = Duration::from_millis(500);
/// Between attempts to open a file whose lease its holder was asked to give back.
const LEASE_PACE: Duration = Duration::from_millis(20);

/// Opens without following links, and without waiting for the other end of a pipe.
const OPEN: OFlags = OFlags::RDONLY
    .union(OFlags::NOFOLLOW)
    .union(OFlags::NONBLOCK)
    .union(OFlags::NOCTTY)
    .union(OFlags::CLOEXEC);

/// Reads the files that one request names.
pub(crate) struct Files<'a> {
    daemon: &'a Arc<Daemon>,
    roots: Vec<PathBuf>,
    max_bytes: u64,
    deadline: Option<Instant>,
}

/// Why a file was not read.
#[derive(Debug)]
enum Refusal {
    /// It is not below an allowed directory.
    Forbidden,
    /// Anything else, in words.
    Unreadable(String),
}

impl<'a> Files<'a> {
    pub(crate) fn new(daemon: &'a Arc<Daemon>, deadline: Option<Instant>) -> Self {
        let config = daemon.config();
        Self {
            daemon,
            roots: config.ingest.paths.clone(),
            max_bytes: config.limits.shape_bytes(),
            deadline,
        }
    }

    /// Bytes of a file.
    pub(crate) fn length(&self, path: &Path) -> Result<u64, wire::Error> {
        let (name, roots) = (path.to_owned(), self.roots.clone());
        self.by_deadline(path, move |until| {
            open(&name, &roots, until)?
                .metadata()
                .map(|m| m.len())
                .map_err(|e| unreadable(&name, &e))
        })
    }

    /// All bytes of a file, which must still have `length` of them.
    pub(crate) fn read(&self, path: &Path, length: u64) -> Result<Vec<u8>, wire::Error> {
        let Some(memory) = self.daemon.admission.memory.try_reserve(length) else {
            return Err(busy("no memory is left for the files that requests name"));
        };
        let (name, roots) = (path.to_owned(), self.roots.clone());
        let length = length.min(self.max_bytes);
        self.by_deadline(path, move |until| {
            // Held also while this hangs and nobody waits for it.
            let _memory = memory;
            let file = open(&name, &roots, until)?;
            read_all(file, length).map_err(|e| unreadable(&name, &e))
        })
    }

    /// Runs `work`, which gets the time by which it must be done; an error if that passes.
    fn by_deadline<T: Send + 'static>(
        &self,
        path: &Path,
        work: impl FnOnce(Instant) -> Result<T, Refusal> + Send + 'static,
    ) -> Result<T, wire::Error> {
        let Ok(permit) = Arc::clone(&self.daemon.capacity.reading).try_acquire_owned() else {
            return Err(busy("too many files are being read"));
        };
        let patience = Instant::now() + PATIENCE;
        let deadline = self.deadline.map(|d| d + AFTER_DEADLINE);
        let until = deadline.map_or(patience, |d| d.min(patience));
        let (sender, done) = mpsc::sync_channel(1);
        let spawned = std::thread::Builder::new()
            .name("file".to_owned())
            .spawn(move || {
                let _permit = permit;
                // Nobody may be waiting any more.
                let _ = sender.send(work(until));
            });
        let path = path.display();
        let refuse = |text: String| {
            let (code, reason) = (ErrorCode::InvalidArgument, ErrorReason::PathUnreadable);
            convert::error(code, reason, text)
        };
        spawned.map_err(|e| refuse(format!("{path}: {e}")))?;
        match done.recv_timeout(until.saturating_duration_since(Instant::now())) {
            Ok(Ok(value)) => Ok(value),
            Ok(Err(Refusal::Forbidden)) => Err(convert::error(
                ErrorCode::PermissionDenied,
                ErrorReason::PathForbidden,
                format!("{path} is not below a directory of ingest.paths"),
            )),
            Ok(Err(Refusal::Unreadable(text))) => Err(refuse(text)),
            Err(_) => Err(refuse(format!(
                "{path} could not be read in time: the disk or network file system that it is on \
                 hangs"
            ))),
        }
    }
}

fn unreadable(path: &Path, error: &impl std::fmt::Display) -> Refusal {
    Refusal::Unreadable(format!("{}: {error}", path.display()))
}

/// Opens a regular file below one of `roots`.
fn open(path: &Path, roots: &[PathBuf], until: Instant) -> Result<File, Refusal> {
    let (root, below) = resolve(path, roots).ok_or(Refusal::Forbidden)?;
    loop {
        match open_beneath(&root, &below) {
            // This attempt asked the holder of a lease to give it back.
            Err(Errno::AGAIN) if Instant::now() < until => std::thread::sleep(LEASE_PACE),
            Err(Errno::LOOP | Errno::XDEV | Errno::NOTDIR | Errno::NOENT) => {
                return Err(unreadable(path, &"it was exchanged while it was opened"));
            }
            Err(e) => return Err(unreadable(path, &io::Error::from(e))),
            Ok(file) => {
                let metadata = file.metadata().map_err(|e| unreadable(path, &e))?;
                return match metadata.is_file() {
                    true => Ok(file),
                    false => Err(Refusal::Unreadable(format!(
                        "{} is not a regular file",
                        path.display()
                    ))),
                };
            }
        }
    }
}

/// The target of a path after its links: one of `roots`, and the path from there.
fn resolve(path: &Path, roots: &[PathBuf]) -> Option<(PathBuf, PathBuf)> {
    if !path.is_absolute() {
        return None;
    }
    let location = path.canonicalize().ok()?;
    roots.iter().find_map(|root| {
        let root = root.canonicalize().ok()?;
        let below = location.strip_prefix(&root).ok()?.to_owned();
        Some((root, below))
    })
}

/// Opens `below` from `root` down; no step may be a link.
fn open_beneath(root: &Path, below: &Path) -> Result<File, Errno> {
    if below.as_os_str().is_empty() {
        return Ok(openat(CWD, root, OPEN, Mode::empty())?.into());
    }
    let root = openat(CWD, root, OFlags::PATH | OFlags::CLOEXEC, Mode::empty())?;
    let resolve = ResolveFlags::BENEATH | ResolveFlags::NO_SYMLINKS | ResolveFlags::NO_MAGICLINKS;
    match openat2(&root, below, OPEN, Mode::empty(), resolve) {
        // Older kernels, and filters that do not know it.
        Err(Errno::NOSYS | Errno::PERM) => open_stepwise(root, below),
        opened => Ok(opened?.into()),
    }
}

fn open_stepwise(root: OwnedFd, below: &Path) -> Result<File, Errno> {
    let mut folder = root;
    let mut steps = below.components().peekable();
    while let Some(step) = steps.next() {
        let Component::Normal(name) = step else {
            return Err(Errno::XDEV);
        };
        if steps.peek().is_none() {
            return Ok(openat(&folder, name, OPEN, Mode::empty())?.into());
        }
        let flags = OFlags::PATH | OFlags::DIRECTORY | OFlags::NOFOLLOW | OFlags::CLOEXEC;
        folder = openat(&folder, name, flags, Mode::empty())?;
    }
    Err(Errno::NOENT)
}

/// Reads a file that has `length` bytes, and none that is being written.
fn read_all(mut file: File, length: u64) -> io::Result<Vec<u8>> {
    let changed = || io::Error::other("it was changed while it was read");
    let stamp = |file: &File| {
        let m = file.metadata()?;
        io::Result::Ok((m.len(), m.mtime(), m.mtime_nsec()))
    };
    let before = stamp(&file)?;
    if before.0 != length {
        return Err(changed());
    }
    let mut bytes = Vec::new();
    let n = usize::try_from(length).map_err(io::Error::other)?;
    bytes.try_reserve_exact(n).map_err(io::Error::other)?;
    (&mut file).take(length).read_to_end(&mut bytes)?;
    if bytes.len() as u64 != length || stamp(&file)? != before {
        return Err(changed());
    }
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::{open, open_beneath, open_stepwise, read_all};
    use rustix::fs::{CWD, FileType, Mode, OFlags, mknodat, openat};
    use std::os::unix::fs::symlink;
    use std::path::{Path, PathBuf};
    use std::time::Instant;

    /// An allowed folder with a file, a link to it, a link to one outside, a folder, a link to a
    /// folder outside, and a pipe.
    fn folders() -> (tempfile::TempDir, PathBuf) {
        let dir = tempfile::tempdir().unwrap();
        let (root, outside) = (dir.path().join("in"), dir.path().join("out"));
        std::fs::create_dir_all(root.join("deep/er")).unwrap();
        std::fs::create_dir_all(&outside).unwrap();
        std::fs::write(outside.join("secret"), "secret").unwrap();
        std::fs::write(root.join("deep/er/file"), "inside").unwrap();
        symlink("deep/er/file", root.join("near")).unwrap();
        symlink(root.join("deep"), root.join("absolute")).unwrap();
        symlink(outside.join("secret"), root.join("far")).unwrap();
        symlink(&outside, root.join("away")).unwrap();
        let mode = Mode::RUSR | Mode::WUSR;
        mknodat(CWD, root.join("pipe"), FileType::Fifo, mode, 0).unwrap();
        (dir, root)
    }

    fn read(path: &Path, root: &Path) -> Result<String, String> {
        let file = open(path, &[root.to_owned()], Instant::now()).map_err(|e| format!("{e:?}"))?;
        Ok(std::io::read_to_string(file).unwrap())
    }

    #[test]
    fn links_that_stay_below_are_followed_and_no_others() {
        let (_dir, root) = folders();
        for inside in ["deep/er/file", "near", "absolute/er/file", "deep/../near"] {
            let found = read(&root.join(inside), &root);
            assert_eq!(found.as_deref(), Ok("inside"), "{inside}");
        }
        for outside in ["far", "away/secret", "../out/secret", "missing"] {
            let refused = read(&root.join(outside), &root).unwrap_err();
            assert_eq!(refused, "Forbidden", "{outside}");
        }
        for (odd, why) in [
            ("pipe", "not a regular file"),
            ("deep", "not a regular file"),
        ] {
            let refused = read(&root.join(odd), &root).unwrap_err();
            assert!(refused.contains(why), "{refused}");
        }
    }

    /// As if the name had been replaced after its links were resolved.
    #[test]
    fn what_is_exchanged_for_a_link_or_a_pipe_is_not_opened() {
        let (_dir, root) = folders();
        for below in [
            "far",
            "away/secret",
            "near",
            "absolute/er/file",
            "../out/secret",
        ] {
            let below = Path::new(below);
            assert!(open_beneath(&root, below).is_err(), "{below:?}");
            let folder = openat(CWD, &root, OFlags::PATH, Mode::empty()).unwrap();
            assert!(open_stepwise(folder, below).is_err(), "{below:?}, stepwise");
        }
        // Opened at once, although nobody writes into it; that it is none is seen then.
        let pipe = open_beneath(&root, Path::new("pipe")).unwrap();
        assert!(!pipe.metadata().unwrap().is_file());
        let folder = openat(CWD, &root, OFlags::PATH, Mode::empty()).unwrap();
        let file = open_stepwise(folder, Path::new("deep/er/file")).unwrap();
        assert_eq!(std::io::read_to_string(file).unwrap(), "inside");
    }

    #[test]
    fn no_more_is_read_than_was_there() {
        let (_dir, root) = folders();
        let path = root.join("deep/er/file");
        let opened = || open(&path, std::slice::from_ref(&root), Instant::now()).unwrap();
        assert_eq!(read_all(opened(), 6).unwrap(), b"inside");
        for other in [5, 7] {
            let refused = read_all(opened(), other).unwrap_err().to_string();
            assert!(refused.contains("changed"), "{refused}");
        }
    }
}
