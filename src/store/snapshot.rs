//! Copies a library at one moment, even while it is in use.
//!
//! The catalog is copied in one read transaction, then the files that the copy names. Files are
//! immutable, and those that the library releases meanwhile are not removed before they are copied.
//! The copy either exists completely under its name or not at all; the remains of an interrupted
//! copy are reused by the next copy of that name.

use super::catalog::witness::{self, Witness};
use super::catalog::{self, Reader};
use super::check::{Finding, check};
use super::disk::{Disk, RealDisk};
use super::lock::{Locked, Reading};
use super::objects::{FOLDERS, relative};
use super::{StoreError, create_library_folder};
use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

/// The result of copying.
#[derive(Debug, Clone, PartialEq)]
pub struct Snapshot {
    /// Number of object files.
    pub n_files: u64,
    /// Size of all files in bytes.
    pub n_bytes: u64,
    /// The findings of a check of the copy; it contains the damage of the library, too.
    pub findings: Vec<Finding>,
}

/// Copies the library in `from` to `to`, which must be missing or an empty folder, and verifies the
/// copy. With `link` object files become hard links where possible, which is fast and takes no
/// space, but damage affects both.
///
/// # Errors
/// If there is no library, its catalog cannot be read, or the copy cannot be written. Nothing is
/// left behind then, except a folder named `to` with `.partial` if it cannot be removed; the next
/// copy reuses it.
pub fn copy(from: &Path, to: &Path, link: bool) -> Result<Snapshot, StoreError> {
    let at = |path: &Path| {
        let path = path.to_path_buf();
        move |e| StoreError::io(&path, e)
    };
    let source = catalog::path_in(from);
    if let Some(shortfall) = witness::shortfall(&source)? {
        return Err(shortfall.refusal());
    }
    fs::metadata(&source).map_err(at(&source))?;
    match fs::remove_dir(to) {
        Ok(()) => {}
        Err(e) if e.kind() == io::ErrorKind::NotFound => {}
        Err(e) => return Err(StoreError::io(to, e)),
    }
    let mut partial = to.as_os_str().to_owned();
    partial.push(".partial");
    let partial = PathBuf::from(partial);
    let _alone = take_over(&partial)?;
    // Held from before the catalog is read until all files are copied.
    let _reading = Reading::begin(from)?;
    let copied = copy_into(from, &partial, link).and_then(|counts| {
        fs::rename(&partial, to).map_err(at(to))?;
        let parent = to.parent().filter(|p| !p.as_os_str().is_empty());
        let parent = parent.unwrap_or(Path::new("."));
        RealDisk.sync_dir(parent).map_err(at(parent))?;
        Ok(counts)
    });
    let (n_files, n_bytes) = match copied {
        Ok(counts) => counts,
        Err(e) => {
            let _ = fs::remove_dir_all(&partial);
            return Err(e);
        }
    };
    Ok(Snapshot {
        n_files,
        n_bytes,
        findings: check(to)?,
    })
}

/// Creates the folder for a copy, or empties that of an interrupted copy, and locks it.
fn take_over(partial: &Path) -> Result<Locked, StoreError> {
    let at = |e| StoreError::io(partial, e);
    let refuse = |text: &str| {
        let e = io::Error::new(io::ErrorKind::AlreadyExists, text);
        Err(StoreError::io(partial, e))
    };
    create_library_folder(partial)?;
    if !fs::symlink_metadata(partial).map_err(at)?.is_dir() {
        return refuse("it is there, and is no folder");
    }
    let Some(lock) = Locked::try_exclusive(partial).map_err(at)? else {
        return refuse("another process is writing a copy into it");
    };
    let entries = fs::read_dir(partial).and_then(Iterator::collect::<io::Result<Vec<_>>>);
    let entries = entries.map_err(at)?;
    let is_ours = |name: &std::ffi::OsStr| {
        let name = name.to_string_lossy();
        FOLDERS.contains(&&*name) || name.starts_with("catalog.")
    };
    if entries.iter().any(|entry| !is_ours(&entry.file_name())) {
        return refuse("it exists, and contains files that no copy leaves");
    }
    for entry in entries {
        let path = entry.path();
        let removed = match entry.file_type() {
            Ok(kind) if kind.is_dir() => fs::remove_dir_all(&path),
            Ok(_) => fs::remove_file(&path),
            Err(e) => Err(e),
        };
        removed.map_err(|e| StoreError::io(&path, e))?;
    }
    Ok(lock)
}

fn copy_into(from: &Path, to: &Path, link: bool) -> Result<(u64, u64), StoreError> {
    create_library_folder(to)?;
    let target = catalog::path_in(to);
    let source = catalog::path_in(from);
    let log = catalog::log_of(&source);
    if let Some(message) = catalog::log::damage(&log).map_err(|e| StoreError::io(&log, e))? {
        return Err(StoreError::Damaged {
            path: relative(from, &log),
            message,
        });
    }
    let connection = catalog::open_reader(&source)?;
    connection.execute("VACUUM INTO ?1", [target.display().to_string()])?;
    drop(connection);
    sync(&target)?;
    let connection = catalog::open_reader(&target)?;
    let reader = Reader::new(&connection);
    let rows = reader.objects()?;
    let committed = reader.n_commits()?;
    let witness = Witness {
        library: reader.library_id()?,
        settled: committed,
        committed,
    };
    drop(connection);
    witness.write(&target)?;
    let mut folders: BTreeSet<PathBuf> = FOLDERS.iter().map(|f| to.join(f)).collect();
    for folder in &folders {
        fs::create_dir(folder).map_err(|e| StoreError::io(folder, e))?;
    }
    let (mut n_files, mut n_bytes) = (0, fs::metadata(&target).map_or(0, |m| m.len()));
    for row in &rows {
        let (source, target) = (from.join(&row.file), to.join(&row.file));
        if let Some(folder) = target.parent() {
            fs::create_dir_all(folder).map_err(|e| StoreError::io(folder, e))?;
            folders.insert(folder.to_path_buf());
        }
        let linked = link && fs::hard_link(&source, &target).is_ok();
        if !linked {
            match fs::copy(&source, &target) {
                Ok(_) => sync(&target)?,
                // The check reports the missing file.
                Err(e) if e.kind() == io::ErrorKind::NotFound => continue,
                Err(e) => return Err(StoreError::io(&target, e)),
            }
        }
        n_files += 1;
        n_bytes += row.length;
    }
    folders.insert(to.to_path_buf());
    for folder in &folders {
        RealDisk
            .sync_dir(folder)
            .map_err(|e| StoreError::io(folder, e))?;
    }
    Ok((n_files, n_bytes))
}

fn sync(path: &Path) -> Result<(), StoreError> {
    File::open(path)
        .and_then(|f| f.sync_all())
        .map_err(|e| StoreError::io(path, e))
}
