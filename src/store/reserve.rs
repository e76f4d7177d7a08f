//! Reserves space on the disk for changes that free space.
//!
//! Even a removal writes: its rows go to the log before any space is freed. A reserve file of a few
//! megabytes is removed for it on a full disk, and created again when there is room.

use super::StoreError;
use super::error::is_no_space;
use rustix::fs::{FallocateFlags, fallocate, fstatvfs};
use std::fs::File;
use std::io::{self, Write as _};
use std::path::Path;

/// The reserve file in the library's folder.
const RESERVE_FILE: &str = "reserve";

/// Its size: a removal writes a few hundred kilobytes, and the log is emptied at 4 MiB.
const BYTES: u64 = 4 << 20;

/// It is created again only if this multiple of its size is free, so that it does not take the
/// space that was just freed.
const MIN_FREE: u64 = 4;

/// Removes the reserve; returns false if there was none.
pub(super) fn give_up(library: &Path) -> bool {
    match std::fs::remove_file(library.join(RESERVE_FILE)) {
        Ok(()) => {
            tracing::warn!("the disk is full: the room kept for removals is used");
            true
        }
        Err(_) => false,
    }
}

/// Creates the reserve if it is missing and there is enough room. Without it everything works
/// except removals on a full disk.
pub(super) fn keep(library: &Path) {
    match try_keep(library) {
        Ok(()) => {}
        Err(e) if is_no_space(&e) => {
            tracing::debug!("no room is kept for removals: the disk is full")
        }
        Err(e) => {
            let error = StoreError::io(&library.join(RESERVE_FILE), e);
            tracing::warn!(%error, "no room is kept for removals on a full disk");
        }
    }
}

fn try_keep(library: &Path) -> io::Result<()> {
    let path = library.join(RESERVE_FILE);
    if std::fs::symlink_metadata(&path).is_ok_and(|m| m.is_file() && m.len() == BYTES) {
        return Ok(());
    }
    let disk = fstatvfs(File::open(library)?)?;
    if disk.f_bavail.saturating_mul(disk.f_frsize) < MIN_FREE * BYTES {
        return Ok(());
    }
    // The file is too short if a process ended while it created it.
    match std::fs::remove_file(&path) {
        Err(e) if e.kind() != io::ErrorKind::NotFound => return Err(e),
        _ => {}
    }
    let mut file = File::options().write(true).create_new(true).open(&path)?;
    let made = match fallocate(&file, FallocateFlags::empty(), 0, BYTES) {
        Ok(()) => Ok(()),
        // Some file systems do not support this; the bytes are then written.
        Err(rustix::io::Errno::OPNOTSUPP) => {
            let block = [0; 1 << 16];
            (0..BYTES / block.len() as u64).try_for_each(|_| file.write_all(&block))
        }
        Err(errno) => Err(errno.into()),
    };
    made.inspect_err(|_| {
        let _ = std::fs::remove_file(&path);
    })
}
