//! Stores immutable, content-addressed files: the array file of each description and the original
//! bytes.
//!
//! A file is written under `tmp/`, synced and renamed to its final name, and its folder is synced.
//! Only then does the caller write the catalog row that names it, with length and digest. That row
//! is the only commit marker: a file without one does not count. Files that this process wrote or
//! released are removed soon after nothing needs them; orphans of other processes are swept after a
//! day. A file with a final name is complete and never changes. Where other bytes are needed under
//! a name that exists, they get a name of their own beside it, so that a row never refers to
//! replaced bytes.

use super::array_file::DescriptionFile;
use super::codec::decompress;
use super::disk::{Disk, is_gone};
use super::error::is_no_space;
use super::mapped::{ArrayFileError, MappedDescription};
use super::rows::{ObjectKind, ObjectRow};
use super::{Digest, Health, StoreError};
use crate::pipeline::Description;
use std::collections::{HashMap, HashSet};
use std::io;
use std::ops::Deref;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Default size of array files that stay mapped between uses, in bytes.
pub const DEFAULT_CACHE_BYTES: usize = 16 << 20;

/// Orphans younger than this may belong to unfinished work.
pub const ORPHAN_AGE: Duration = Duration::from_secs(24 * 60 * 60);

/// Of the levels below 7, OBJ text hardly shrinks further beyond this one.
const ZSTD_LEVEL: i32 = 3;

const TEMPORARY: &str = "tmp";

/// The folders of object files, and of files that may become object files.
pub(super) const FOLDERS: [&str; 3] = ["objects", "originals", TEMPORARY];

/// The object files of one library.
pub struct Objects {
    disk: Arc<dyn Disk>,
    root: PathBuf,
    health: Health,
    /// Files of one name are published one at a time, so that no process finds a name that may yet
    /// be taken back. There is a lock for each prefix of a digest, so that files in different
    /// folders do not wait for each other.
    publishing: [Mutex<()>; 256],
    state: Arc<Mutex<State>>,
}

struct State {
    /// Files that writers in this process may be about to name in the catalog, with the number of
    /// such writers.
    held: HashMap<String, usize>,
    /// Files that are not held any more, or whose rows are deleted, with the time: a reader that
    /// found a row may be about to open its file. Times are of the monotonic clock, so that a jump
    /// of the wall clock removes no file.
    let_go: HashMap<String, Instant>,
    /// Folders whose names are durable.
    durable_folders: HashSet<String>,
    n_temporary: u64,
    /// Opened files, most recently used last.
    cache: Vec<(String, Digest, MappedDescription)>,
    cache_bytes: usize,
}

/// The row of a stored file, for the caller to commit. The file is not removed while this value
/// exists; drop it after the commit.
#[derive(Debug)]
pub struct Kept {
    row: ObjectRow,
    _hold: Hold,
}

impl Deref for Kept {
    type Target = ObjectRow;

    fn deref(&self) -> &ObjectRow {
        &self.row
    }
}

/// Protects a file, named relative to the library, from removal.
struct Hold {
    file: String,
    state: Arc<Mutex<State>>,
}

impl std::fmt::Debug for Hold {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("Hold").field(&self.file).finish()
    }
}

impl Drop for Hold {
    fn drop(&mut self) {
        let mut state = locked(&self.state);
        let n = state.held.get_mut(&self.file);
        match n {
            Some(n) if *n > 1 => *n -= 1,
            _ => {
                state.held.remove(&self.file);
                // If the file was committed, the catalog shows it at the time of removal.
                state.let_go.insert(self.file.clone(), Instant::now());
            }
        }
    }
}

fn locked(state: &Mutex<State>) -> MutexGuard<'_, State> {
    // Every change of the state is complete in itself, so a panic elsewhere left the state
    // consistent.
    state.lock().unwrap_or_else(PoisonError::into_inner)
}

impl ObjectKind {
    pub(super) fn folder(self) -> &'static str {
        match self {
            Self::Description => "objects",
            Self::Original => "originals",
        }
    }

    fn extension(self) -> &'static str {
        match self {
            Self::Description => "safetensors",
            Self::Original => "zst",
        }
    }
}

impl Objects {
    /// Opens the files below `root`, which must exist; creates the folders.
    pub fn open(disk: Arc<dyn Disk>, root: &Path, health: Health) -> Result<Self, StoreError> {
        let objects = Self {
            disk,
            root: root.to_path_buf(),
            health,
            publishing: std::array::from_fn(|_| Mutex::new(())),
            state: Arc::new(Mutex::new(State {
                held: HashMap::new(),
                let_go: HashMap::new(),
                durable_folders: HashSet::new(),
                n_temporary: 0,
                cache: Vec::new(),
                cache_bytes: DEFAULT_CACHE_BYTES,
            })),
        };
        for folder in FOLDERS {
            let path = root.join(folder);
            objects
                .disk
                .create_dir(&path)
                .map_err(|e| StoreError::io(&path, e))?;
        }
        objects
            .disk
            .sync_dir(root)
            .map_err(|e| objects.sync_failed(root, &e))?;
        Ok(objects)
    }

    /// Stores a description under its digest (see [`Digest::of_description`]) and returns the row
    /// that makes it count, for the caller to commit.
    pub fn put_description(
        &self,
        digest: Digest,
        description: &Description,
        params_json: &str,
    ) -> Result<Kept, StoreError> {
        let file = DescriptionFile::new(description, params_json)?;
        let pieces = file.pieces();
        self.put(ObjectKind::Description, digest, &pieces, |stored| {
            holds(stored, &pieces)
        })
    }

    /// Stores the bytes of a mesh file, compressed, and returns the row that makes them count.
    pub fn put_original(&self, bytes: &[u8]) -> Result<Kept, StoreError> {
        let digest = Digest::of(bytes);
        let path = self.root.join(ObjectKind::Original.folder());
        let compressed =
            zstd::bulk::compress(bytes, ZSTD_LEVEL).map_err(|e| StoreError::io(&path, e))?;
        self.put(ObjectKind::Original, digest, &[&compressed], |stored| {
            decompress(stored, bytes.len()).is_ok_and(|stored| stored == bytes)
        })
    }

    /// The description of a row: mapped, with its length and BLAKE3 checked once after opening.
    pub fn open_description(&self, row: &ObjectRow) -> Result<MappedDescription, StoreError> {
        if let Some(mapped) = self.cached(&row.file, row.blake3) {
            return Ok(mapped);
        }
        let mapped = map_description(&self.root, row)?;
        let mut state = self.state();
        state
            .cache
            .push((row.file.clone(), row.blake3, mapped.clone()));
        state.trim_cache();
        Ok(mapped)
    }

    /// The original bytes of a row.
    pub fn original(&self, row: &ObjectRow) -> Result<Vec<u8>, StoreError> {
        read_original(&*self.disk, &self.root, row)
    }

    /// Limits the bytes that stay mapped between uses; 0 keeps no unused mapping.
    pub fn set_cache_bytes(&self, bytes: usize) {
        let mut state = self.state();
        state.cache_bytes = bytes;
        state.trim_cache();
    }

    /// Drops all unused mappings.
    pub fn unmap(&self) {
        self.state().cache.clear();
    }

    /// Records that the rows of these files, named relative to the library, were deleted.
    pub(super) fn let_go(&self, files: impl IntoIterator<Item = String>) {
        let now = Instant::now();
        self.state()
            .let_go
            .extend(files.into_iter().map(|file| (file, now)));
    }

    /// Records that a row names a released file again.
    pub(super) fn still_needed(&self, file: &str) {
        self.state().let_go.remove(file);
    }

    /// Files that were released at least `min_age` ago and have not been held since.
    pub(super) fn let_go_since(&self, min_age: Duration) -> Vec<String> {
        let state = self.state();
        let old = state.let_go.iter().filter(|(file, since)| {
            since.elapsed() >= min_age && !state.held.contains_key(file.as_str())
        });
        old.map(|(file, _)| file.clone()).collect()
    }

    /// Removes a file that is neither catalogued nor held; returns whether it did.
    pub(super) fn remove(
        &self,
        file: &str,
        catalogued: impl Fn(&str) -> Result<bool, StoreError>,
    ) -> Result<bool, StoreError> {
        self.health.writable()?;
        // The state stays locked until the file is gone: a writer of the same name announces itself
        // first, and keeps its hold until its row is committed. So every writer that is about to
        // name the file is visible here, or in the catalog.
        let mut state = self.state();
        if state.held.contains_key(file) {
            return Ok(false);
        }
        let is_needed = catalogued(file)?;
        state.let_go.remove(file);
        if is_needed {
            return Ok(false);
        }
        let path = self.root.join(file);
        match self.disk.remove(&path) {
            Ok(()) => {}
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(false),
            Err(e) => return Err(StoreError::io(&path, e)),
        }
        // A mapping would keep its space in use.
        state.cache.retain(|(mapped, ..)| mapped != file);
        Ok(true)
    }

    /// Removes files that are neither catalogued, nor held, nor younger than `min_age`, and returns
    /// their names. The age of files that this process released is measured by the monotonic clock.
    pub(super) fn sweep(
        &self,
        min_age: Duration,
        catalogued: impl Fn(&str) -> Result<bool, StoreError>,
    ) -> Result<Vec<String>, StoreError> {
        self.health.writable()?;
        let mut swept = Vec::new();
        for folder in FOLDERS {
            let path = self.root.join(folder);
            for entry in self
                .disk
                .files(&path)
                .map_err(|e| StoreError::io(&path, e))?
            {
                let file = relative(&self.root, &entry.path);
                // A time in the future counts as no age.
                let by_clock = entry.modified.elapsed().is_ok_and(|age| age >= min_age);
                let old = match self.state().let_go.get(&file) {
                    Some(since) => since.elapsed() >= min_age,
                    None => by_clock,
                };
                if old && self.remove(&file, &catalogued)? {
                    swept.push(file);
                }
            }
        }
        Ok(swept)
    }

    fn hold(&self, file: &str) -> Hold {
        *self.state().held.entry(file.to_owned()).or_default() += 1;
        Hold {
            file: file.to_owned(),
            state: Arc::clone(&self.state),
        }
    }

    fn put(
        &self,
        kind: ObjectKind,
        digest: Digest,
        pieces: &[&[u8]],
        same: impl Fn(&[u8]) -> bool,
    ) -> Result<Kept, StoreError> {
        self.health.writable()?;
        let hex = digest.to_string();
        let folder = format!("{}/{}", kind.folder(), &hex[..2]);
        let _publishing = self.publishing[usize::from(digest.0[0])]
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        self.make_folder(kind.folder(), &folder)?;

        let blake3 = Digest::of_pieces(pieces);
        let beside = &blake3.to_string()[..16];
        let names = [hex.clone(), format!("{hex}-{beside}")];
        for name in names {
            let file = format!("{folder}/{name}.{}", kind.extension());
            let hold = self.hold(&file);
            let path = self.root.join(&file);
            match self.disk.read(&path) {
                // It is durable: it was synced before it got this name, and the name existed when
                // `make_folder` synced the folder, or was published since.
                Ok(stored) if same(&stored) => {
                    let (length, blake3) = (stored.len() as u64, Digest::of(&stored));
                    let row = ObjectRow {
                        kind,
                        digest,
                        file,
                        length,
                        blake3,
                    };
                    return Ok(Kept { row, _hold: hold });
                }
                // The bytes differ: either they are damaged, or another version wrote them and a
                // row names them.
                Ok(_) => continue,
                Err(e) if e.kind() == io::ErrorKind::InvalidData => continue,
                Err(e) if e.kind() == io::ErrorKind::NotFound => {}
                Err(e) => return Err(StoreError::io(&path, e)),
            }
            self.publish(&self.root.join(&folder), &path, pieces)?;
            let row = ObjectRow {
                kind,
                digest,
                file,
                length: pieces.iter().map(|p| p.len() as u64).sum(),
                blake3,
            };
            return Ok(Kept { row, _hold: hold });
        }
        Err(damaged(
            &format!("{folder}/{hex}"),
            "both files of this name hold other bytes",
        ))
    }

    /// Creates the folder of a two-digit prefix. Once for each process both its name and the names
    /// in it are synced: an earlier process may have ended between a rename and its sync.
    fn make_folder(&self, parent: &str, folder: &str) -> Result<(), StoreError> {
        if self.state().durable_folders.contains(folder) {
            return Ok(());
        }
        let path = self.root.join(folder);
        let created = self
            .disk
            .create_dir(&path)
            .map_err(|e| StoreError::io(&path, e))?;
        let parent = self.root.join(parent);
        let synced = self.disk.sync_dir(&parent).and_then(|()| match created {
            true => Ok(()),
            false => self.disk.sync_dir(&path),
        });
        if let Err(e) = synced {
            // The folder is removed, so that the next attempt starts from the beginning; a folder
            // that existed before cannot be removed.
            return Err(
                if created && is_no_space(&e) && self.disk.remove_dir(&path).is_ok() {
                    StoreError::io(&parent, e)
                } else {
                    self.health.stop(format!("fsync {}: {e}", path.display()))
                },
            );
        }
        self.state().durable_folders.insert(folder.to_string());
        Ok(())
    }

    /// Writes a temporary file, syncs it, renames it, and syncs the folder.
    fn publish(&self, folder: &Path, path: &Path, pieces: &[&[u8]]) -> Result<(), StoreError> {
        let (temporary, _hold) = self.temporary();
        let written = self.write_synced(&temporary, pieces).and_then(|()| {
            self.disk
                .rename(&temporary, path)
                .map_err(|e| StoreError::io(path, e))
        });
        if let Err(error) = written {
            // If this fails too, the sweep finds the file.
            let _ = self.disk.remove(&temporary);
            return Err(error);
        }
        match self.disk.sync_dir(folder) {
            Ok(()) => Ok(()),
            // The name is taken back, so that no later call finds a name whose sync failed.
            Err(e) if is_no_space(&e) && self.disk.remove(path).is_ok() => {
                Err(StoreError::io(folder, e))
            }
            Err(e) => Err(self.health.stop(format!("fsync {}: {e}", folder.display()))),
        }
    }

    fn write_synced(&self, path: &Path, pieces: &[&[u8]]) -> Result<(), StoreError> {
        let mut file = self
            .disk
            .create(path)
            .map_err(|e| StoreError::io(path, e))?;
        for piece in pieces {
            file.write_all(piece).map_err(|e| StoreError::io(path, e))?;
        }
        file.sync().map_err(|e| self.sync_failed(path, &e))
    }

    /// A full disk is temporary: the file is removed, and the next attempt writes a new one. After
    /// any other failed sync the store refuses writes.
    fn sync_failed(&self, path: &Path, error: &io::Error) -> StoreError {
        let path = path.display().to_string();
        if is_no_space(error) {
            StoreError::NoSpace { path }
        } else {
            self.health.stop(format!("fsync {path}: {error}"))
        }
    }

    /// A path for a new temporary file, with the hold that protects it from sweeps.
    fn temporary(&self) -> (PathBuf, Hold) {
        loop {
            let n = {
                let mut state = self.state();
                state.n_temporary += 1;
                state.n_temporary
            };
            let name = format!("{TEMPORARY}/{}-{n}", std::process::id());
            let path = self.root.join(&name);
            let hold = self.hold(&name);
            // An earlier process with the same id may have left a file behind.
            if !self.disk.exists(&path) {
                return (path, hold);
            }
        }
    }

    fn cached(&self, file: &str, blake3: Digest) -> Option<MappedDescription> {
        let mut state = self.state();
        let found = state
            .cache
            .iter()
            .position(|(f, b, _)| f == file && *b == blake3)?;
        let entry = state.cache.remove(found);
        let mapped = entry.2.clone();
        state.cache.push(entry);
        Some(mapped)
    }

    fn state(&self) -> MutexGuard<'_, State> {
        locked(&self.state)
    }
}

impl State {
    fn trim_cache(&mut self) {
        let mut total: usize = self
            .cache
            .iter()
            .map(|(_, _, mapped)| mapped.file_len())
            .sum();
        while total > self.cache_bytes {
            total -= self.cache.remove(0).2.file_len();
        }
    }
}

/// Maps the array file of a row; a missing or wrong file is damage.
pub(super) fn map_description(
    root: &Path,
    row: &ObjectRow,
) -> Result<MappedDescription, StoreError> {
    let path = root.join(&row.file);
    match MappedDescription::open(&path, row.length, Some(row.blake3.0)) {
        Ok(mapped) => Ok(mapped),
        Err(ArrayFileError::Io(e)) if !is_gone(&e) => Err(StoreError::io(&path, e)),
        Err(e) => Err(damaged(&row.file, e)),
    }
}

/// Reads the original of a row; a missing or wrong file is damage.
pub(super) fn read_original(
    disk: &dyn Disk,
    root: &Path,
    row: &ObjectRow,
) -> Result<Vec<u8>, StoreError> {
    let path = root.join(&row.file);
    let stored = match disk.read(&path) {
        Ok(stored) => stored,
        Err(e) if is_gone(&e) => return Err(damaged(&row.file, e)),
        Err(e) => return Err(StoreError::io(&path, e)),
    };
    let (found, expected) = (stored.len() as u64, row.length);
    if found != expected {
        return Err(damaged(
            &row.file,
            ArrayFileError::Length { found, expected },
        ));
    }
    let (found, expected) = (Digest::of(&stored), row.blake3);
    if found != expected {
        return Err(damaged(
            &row.file,
            ArrayFileError::Digest { found, expected },
        ));
    }
    let bytes = decompress(&stored, usize::MAX).map_err(|e| damaged(&row.file, e))?;
    let found = Digest::of(&bytes);
    if found != row.digest {
        let message = format!(
            "its content's BLAKE3 is {found}, but its name is {}",
            row.digest
        );
        return Err(damaged(&row.file, message));
    }
    Ok(bytes)
}

/// The name of a file relative to the library's folder, as in the catalog.
pub(super) fn relative(root: &Path, path: &Path) -> String {
    path.strip_prefix(root)
        .unwrap_or(path)
        .display()
        .to_string()
}

/// Whether `stored` equals the joined pieces.
fn holds(mut stored: &[u8], pieces: &[&[u8]]) -> bool {
    let all = pieces.iter().all(|piece| {
        let rest = stored.strip_prefix(*piece);
        stored = rest.unwrap_or_default();
        rest.is_some()
    });
    all && stored.is_empty()
}

fn damaged(file: &str, message: impl ToString) -> StoreError {
    StoreError::Damaged {
        path: file.to_string(),
        message: message.to_string(),
    }
}

#[cfg(test)]
mod tests;
