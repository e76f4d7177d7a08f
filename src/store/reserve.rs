//! Room on the disk that is kept for changes that free room.
//!
//! Even a removal writes: its rows go to the log before anything is given back. On a full disk a file
//! that holds a few megabytes and nothing else is removed for it, and made anew when there is room.

use super::StoreError;
use super::error::is_no_space;
use rustix::fs::{FallocateFlags, fallocate, fstatvfs};
use std::fs::File;
use std::io::{self, Write as _};
use std::path::Path;

/// The file, in the library's folder.
const RESERVE_FILE: &str = "reserve";

/// Its length: a removal writes a few hundred kilobytes, and the log is emptied when it has 4 MiB.
const BYTES: u64 = 4 << 20;

/// It is made anew only where as many times its length are free, so that it does not take what was just freed.
const MIN_FREE: u64 = 4;

/// Gives up the room; false if there was none.
pub(super) fn give_up(library: &Path) -> bool {
    match std::fs::remove_file(library.join(RESERVE_FILE)) {
        Ok(()) => {
            tracing::warn!("the disk is full: the room kept for removals is used");
            true
        }
        Err(_) => false,
    }
}

/// Keeps the room if it is not kept and there is enough. Without it all goes on, but for removals on a full disk.
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
    // Short, if a process ended while it was made.
    match std::fs::remove_file(&path) {
        Err(e) if e.kind() != io::ErrorKind::NotFound => return Err(e),
        _ => {}
    }
    let mut file = File::options().write(true).create_new(true).open(&path)?;
    let made = match fallocate(&file, FallocateFlags::empty(), 0, BYTES) {
        Ok(()) => Ok(()),
        // Not every file system can: there the bytes are written.
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
