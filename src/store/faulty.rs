//! A file system in memory that fails on demand and can simulate crashes.

use super::disk::{Disk, Entry, NewFile};
use rand::{Rng, SeedableRng};
use rand_pcg::Pcg64;
use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard};
use std::time::SystemTime;

/// An operation that changed something, or made changes durable.
#[derive(Debug, Clone)]
enum Op {
    CreateDir(PathBuf),
    Create {
        path: PathBuf,
        inode: usize,
    },
    Write {
        inode: usize,
        bytes: Vec<u8>,
    },
    Sync {
        inode: usize,
    },
    Rename {
        from: PathBuf,
        to: PathBuf,
        inode: usize,
    },
    SyncDir(PathBuf),
    Remove(PathBuf),
    RemoveDir(PathBuf),
}

/// Selects the operation that fails, its error, and whether all later ones fail too.
#[derive(Debug, Clone, Copy)]
pub(super) struct Fault {
    pub(super) at: usize,
    pub(super) errno: i32,
    pub(super) for_ever: bool,
}

pub(super) const EIO: i32 = 5;
pub(super) const ENOSPC: i32 = 28;

#[derive(Debug, Default)]
struct Mem {
    folders: BTreeSet<PathBuf>,
    names: BTreeMap<PathBuf, usize>,
    contents: Vec<Vec<u8>>,
    log: Vec<Op>,
    n_operations: usize,
    fault: Option<Fault>,
    /// The paths of failed syncs, and the number of repeated ones. A folder counts only if its sync
    /// failed permanently: after a full disk the name is taken back, and the next sync concerns
    /// another name.
    failed_syncs: BTreeSet<String>,
    n_retried_syncs: usize,
}

/// The file system. Its root folder is `/l`.
#[derive(Debug, Default)]
pub(super) struct MemDisk(Mutex<Mem>);

impl MemDisk {
    pub(super) fn new() -> Self {
        let disk = Self::default();
        disk.mem().folders.insert("/l".into());
        disk
    }

    pub(super) fn set_fault(&self, fault: Option<Fault>) {
        self.mem().fault = fault;
    }

    pub(super) fn n_operations(&self) -> usize {
        self.mem().n_operations
    }

    pub(super) fn n_logged(&self) -> usize {
        self.mem().log.len()
    }

    pub(super) fn n_retried_syncs(&self) -> usize {
        self.mem().n_retried_syncs
    }

    /// Simulates a new process, which does not know the failures that an earlier one saw.
    pub(super) fn restart(&self) {
        self.mem().failed_syncs.clear();
    }

    /// A state of the disk after a crash that follows `n_logged` operations. Synced data are
    /// present; of the rest each write is kept, dropped or torn and each change of a name kept or
    /// dropped, independently of the others. Seed 0 drops everything that was not synced.
    pub(super) fn after_crash(&self, n_logged: usize, seed: u64) -> Self {
        let mem = self.mem();
        let log = &mem.log[..n_logged];
        let mut random = Pcg64::seed_from_u64(seed);
        let mut luck = |durable: bool| durable || (seed != 0 && random.random_bool(0.5));
        let synced_after = |at: usize, is_it: &dyn Fn(&Op) -> bool| log[at..].iter().any(is_it);
        let dir_synced = |at: usize, path: &Path| {
            synced_after(
                at,
                &|op| matches!(op, Op::SyncDir(dir) if Some(dir.as_path()) == path.parent()),
            )
        };
        let mut image = Mem {
            contents: vec![Vec::new(); mem.contents.len()],
            ..Mem::default()
        };
        image.folders.insert("/l".into());
        for (at, op) in log.iter().enumerate() {
            match op {
                Op::CreateDir(path) => {
                    if luck(dir_synced(at, path)) {
                        image.folders.insert(path.clone());
                    }
                }
                Op::Create { path, inode } => {
                    if luck(dir_synced(at, path)) {
                        image.names.insert(path.clone(), *inode);
                    }
                }
                Op::Rename { from, to, inode } => {
                    if luck(dir_synced(at, to)) {
                        image.names.remove(from);
                        image.names.insert(to.clone(), *inode);
                    }
                }
                Op::Remove(path) => {
                    if luck(dir_synced(at, path)) {
                        image.names.remove(path);
                    }
                }
                Op::RemoveDir(path) => {
                    if luck(dir_synced(at, path)) {
                        image.folders.remove(path);
                    }
                }
                Op::Write { inode, bytes } => {
                    let same =
                        |op: &Op| matches!(op, Op::Sync { inode: synced } if synced == inode);
                    let content = &mut image.contents[*inode];
                    if luck(synced_after(at, &same)) {
                        content.extend(bytes);
                    } else if luck(false) {
                        // A torn write: some blocks arrived, the others are zeros.
                        for block in bytes.chunks(16) {
                            let arrived = luck(false);
                            content.extend(block.iter().map(|&b| if arrived { b } else { 0 }));
                        }
                    }
                }
                Op::Sync { .. } | Op::SyncDir(_) => {}
            }
        }
        // Files in a missing folder are missing.
        let folders = image.folders.clone();
        let reachable = |path: &Path| {
            path.ancestors()
                .skip(1)
                .take_while(|p| p.starts_with("/l"))
                .all(|p| folders.contains(p))
        };
        image.folders.retain(|path| reachable(path));
        image.names.retain(|path, _| reachable(path));
        Self(Mutex::new(image))
    }

    fn mem(&self) -> MutexGuard<'_, Mem> {
        self.0
            .lock()
            .expect("no test panics while it holds the disk")
    }

    /// Counts an operation that takes no space, so that it succeeds on a full disk.
    fn begin_without_space(&self) -> io::Result<MutexGuard<'_, Mem>> {
        if self.mem().fault.is_some_and(|fault| fault.errno == ENOSPC) {
            let mut mem = self.mem();
            mem.n_operations += 1;
            return Ok(mem);
        }
        self.begin()
    }

    /// Counts an operation; returns its error if it is to fail.
    fn begin(&self) -> io::Result<MutexGuard<'_, Mem>> {
        let mut mem = self.mem();
        let at = mem.n_operations;
        mem.n_operations += 1;
        match mem.fault {
            Some(fault) if at == fault.at || (fault.for_ever && at > fault.at) => {
                Err(io::Error::from_raw_os_error(fault.errno))
            }
            _ => Ok(mem),
        }
    }

    fn begin_sync(&self, what: String) -> io::Result<MutexGuard<'_, Mem>> {
        {
            let mut mem = self.mem();
            mem.n_retried_syncs += usize::from(mem.failed_syncs.contains(&what));
        }
        match self.begin() {
            Ok(mem) => Ok(mem),
            Err(e) => {
                if what.starts_with("inode") || e.raw_os_error() == Some(EIO) {
                    self.mem().failed_syncs.insert(what);
                }
                Err(e)
            }
        }
    }
}

fn not_found() -> io::Error {
    io::ErrorKind::NotFound.into()
}

struct MemFile<'d> {
    disk: &'d MemDisk,
    inode: usize,
}

impl NewFile for MemFile<'_> {
    fn write_all(&mut self, bytes: &[u8]) -> io::Result<()> {
        // A failing write may have been partly done.
        let (result, bytes) = match self.disk.begin() {
            Ok(_) => (Ok(()), bytes),
            Err(e) => (Err(e), &bytes[..bytes.len() / 2]),
        };
        let mut mem = self.disk.mem();
        mem.contents[self.inode].extend(bytes);
        mem.log.push(Op::Write {
            inode: self.inode,
            bytes: bytes.to_vec(),
        });
        result
    }

    fn sync(&mut self) -> io::Result<()> {
        let mut mem = self.disk.begin_sync(format!("inode {}", self.inode))?;
        mem.log.push(Op::Sync { inode: self.inode });
        Ok(())
    }
}

impl Disk for MemDisk {
    fn create_dir(&self, path: &Path) -> io::Result<bool> {
        let mut mem = self.begin()?;
        if !mem.folders.contains(path.parent().expect("not the root")) {
            return Err(not_found());
        }
        let created = mem.folders.insert(path.to_path_buf());
        if created {
            mem.log.push(Op::CreateDir(path.to_path_buf()));
        }
        Ok(created)
    }

    fn create(&self, path: &Path) -> io::Result<Box<dyn NewFile + '_>> {
        let mut mem = self.begin()?;
        if !mem.folders.contains(path.parent().expect("not the root")) {
            return Err(not_found());
        }
        if mem.names.contains_key(path) {
            return Err(io::ErrorKind::AlreadyExists.into());
        }
        let inode = mem.contents.len();
        mem.contents.push(Vec::new());
        mem.names.insert(path.to_path_buf(), inode);
        mem.log.push(Op::Create {
            path: path.to_path_buf(),
            inode,
        });
        drop(mem);
        Ok(Box::new(MemFile { disk: self, inode }))
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        let mut mem = self.begin()?;
        let inode = mem.names.remove(from).ok_or_else(not_found)?;
        mem.names.insert(to.to_path_buf(), inode);
        mem.log.push(Op::Rename {
            from: from.to_path_buf(),
            to: to.to_path_buf(),
            inode,
        });
        Ok(())
    }

    fn sync_dir(&self, path: &Path) -> io::Result<()> {
        let mut mem = self.begin_sync(path.display().to_string())?;
        mem.log.push(Op::SyncDir(path.to_path_buf()));
        Ok(())
    }

    fn remove(&self, path: &Path) -> io::Result<()> {
        let mut mem = self.begin_without_space()?;
        mem.names.remove(path).ok_or_else(not_found)?;
        mem.log.push(Op::Remove(path.to_path_buf()));
        Ok(())
    }

    fn remove_dir(&self, path: &Path) -> io::Result<()> {
        let mut mem = self.begin_without_space()?;
        if mem.names.keys().any(|name| name.parent() == Some(path)) {
            return Err(io::ErrorKind::DirectoryNotEmpty.into());
        }
        mem.folders.remove(path);
        mem.log.push(Op::RemoveDir(path.to_path_buf()));
        Ok(())
    }

    fn exists(&self, path: &Path) -> bool {
        let mem = self.mem();
        mem.names.contains_key(path) || mem.folders.contains(path)
    }

    fn read(&self, path: &Path) -> io::Result<Vec<u8>> {
        let mem = self.begin_without_space()?;
        let inode = *mem.names.get(path).ok_or_else(not_found)?;
        Ok(mem.contents[inode].clone())
    }

    fn files(&self, dir: &Path) -> io::Result<Vec<Entry>> {
        let mem = self.begin_without_space()?;
        let below = mem.names.iter().filter(|(path, _)| path.starts_with(dir));
        let entry = |(path, &inode): (&PathBuf, &usize)| Entry {
            path: path.clone(),
            length: mem.contents[inode].len() as u64,
            modified: SystemTime::UNIX_EPOCH,
        };
        Ok(below.map(entry).collect())
    }
}
