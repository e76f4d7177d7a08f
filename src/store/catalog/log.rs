//! Finds damage in the catalog's write-ahead log, which SQLite itself takes for the end of the log.
//!
//! Recovery reads the log up to the first frame whose checksum is wrong, because a commit that a
//! crash interrupted looks like that. A flipped bit in the middle looks the same, and all commits
//! after it would be lost silently. The two can be distinguished: each commit is synced before the
//! next begins, so no commit follows an interrupted one, which itself contains at most one frame
//! marked as commit. (Format: "Database File Format", section 4, sqlite.org.)

use std::io;
use std::path::Path;

const HEADER: usize = 32;
const FRAME_HEADER: usize = 24;

/// The damage of the log at `path`; `None` if none can be found.
///
/// It may run beside a writer: a finding that two reads agree on did not change in between.
pub(in crate::store) fn damage(path: &Path) -> io::Result<Option<String>> {
    let look = || match std::fs::read(path) {
        Ok(log) => Ok(damage_in(&log)),
        Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(e) => Err(e),
    };
    let first = look()?;
    if first.is_none() {
        return Ok(None);
    }
    let second = look()?;
    Ok(if first == second {
        first.map(|(message, _)| message)
    } else {
        None
    })
}

/// The message, and the salts of the log's generation.
fn damage_in(log: &[u8]) -> Option<(String, [u8; 8])> {
    let header = log.get(..HEADER)?;
    let salts: [u8; 8] = header[16..24].try_into().ok()?;
    let page_bytes = u32_at(header, 8) as usize;
    let big_endian = u32_at(header, 0) & 1 == 1;
    let whole_header = matches!(u32_at(header, 0), 0x377f_0682 | 0x377f_0683)
        && (512..=65_536).contains(&page_bytes)
        && checksum([0; 2], &header[..24], big_endian) == sums_at(header, 24);
    if !whole_header {
        // One sector is written entirely or not at all, and a log that was never synced is empty or
        // zero there.
        let blank = header.iter().all(|&byte| byte == 0) && log.len() <= HEADER;
        return (!blank).then(|| ("the header of the log is damaged".into(), salts));
    }
    let mut sums = sums_at(header, 24);
    let mut first_bad = None;
    let mut n_commits_after = 0;
    for (index, frame) in log[HEADER..]
        .chunks_exact(FRAME_HEADER + page_bytes)
        .enumerate()
    {
        let same_generation = frame[8..16] == salts;
        let is_commit = u32_at(frame, 4) != 0;
        if first_bad.is_some() {
            n_commits_after += usize::from(same_generation && is_commit);
            continue;
        }
        sums = checksum(sums, &frame[..8], big_endian);
        sums = checksum(sums, &frame[FRAME_HEADER..], big_endian);
        if !same_generation || sums != sums_at(frame, 16) {
            first_bad = Some(index);
            n_commits_after += usize::from(same_generation && is_commit);
        }
    }
    let index = first_bad.filter(|_| n_commits_after >= 2)?;
    let message =
        format!("frame {index} of the log is damaged, and {n_commits_after} commits follow it");
    Some((message, salts))
}

/// SQLite's checksum, continued from `sums`; the length of `bytes` is a multiple of 8.
fn checksum(sums: [u32; 2], bytes: &[u8], big_endian: bool) -> [u32; 2] {
    let word = |bytes: [u8; 4]| match big_endian {
        true => u32::from_be_bytes(bytes),
        false => u32::from_le_bytes(bytes),
    };
    let (words, _) = bytes.as_chunks::<4>();
    let [mut s0, mut s1] = sums;
    for pair in words.chunks_exact(2) {
        s0 = s0.wrapping_add(word(pair[0])).wrapping_add(s1);
        s1 = s1.wrapping_add(word(pair[1])).wrapping_add(s0);
    }
    [s0, s1]
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_be_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]])
}

fn sums_at(bytes: &[u8], at: usize) -> [u32; 2] {
    [u32_at(bytes, at), u32_at(bytes, at + 4)]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::catalog::{Catalog, path_in};
    use crate::store::rows::NewCollection;
    use crate::store::{Health, StoreError};

    /// The log of a catalog with several commits, as a crash would leave it.
    fn log() -> Vec<u8> {
        let dir = tempfile::tempdir().expect("a folder");
        let catalog = Catalog::open(&path_in(dir.path()), Health::default()).expect("opens");
        for name in ["a", "b", "c", "d", "e"] {
            let new = NewCollection {
                name: name.into(),
                ..NewCollection::default()
            };
            catalog
                .write(|tx| tx.insert_collection(&new))
                .expect("inserted");
        }
        std::fs::read(dir.path().join("catalog.db-wal")).expect("there")
    }

    #[test]
    fn an_interrupted_commit_is_not_damage() {
        let log = log();
        assert_eq!(damage_in(&log), None);
        for end in 0..log.len() {
            assert_eq!(damage_in(&log[..end]), None, "cut at {end}");
        }
        // The last frame is a commit; any byte of it may be missing.
        for at in log.len() - 4096 - FRAME_HEADER..log.len() {
            let mut torn = log.clone();
            torn[at] ^= 1;
            assert_eq!(damage_in(&torn), None, "byte {at}");
        }
        assert_eq!(damage_in(&[0; HEADER]), None);
    }

    #[test]
    fn a_bit_that_rots_before_the_last_commits_is_damage() {
        let log = log();
        let commits: Vec<usize> = log[HEADER..]
            .chunks_exact(FRAME_HEADER + 4096)
            .enumerate()
            .filter(|(_, frame)| u32_at(frame, 4) != 0)
            .map(|(index, _)| index)
            .collect();
        assert!(commits.len() >= 5, "{commits:?}");
        // Everything up to the last commit but one is followed by two commits.
        let end = HEADER + (commits[commits.len() - 2]) * (FRAME_HEADER + 4096);
        for at in (0..HEADER).chain((HEADER..end).step_by(97)) {
            let mut rotten = log.clone();
            rotten[at] ^= 4;
            assert!(damage_in(&rotten).is_some(), "byte {at} of {end}");
        }
        for at in (0..end).step_by(4096) {
            let mut zeroed = log.clone();
            zeroed[at..(at + 4096).min(end)].fill(0);
            assert!(damage_in(&zeroed).is_some(), "block at {at}");
        }
    }

    #[test]
    fn a_catalog_with_a_damaged_log_is_not_opened_and_not_changed() {
        let dir = tempfile::tempdir().expect("a folder");
        let path = path_in(dir.path());
        drop(Catalog::open(&path, Health::default()).expect("opens"));
        let mut log = log();
        log[HEADER + 100] ^= 1;
        let log_path = dir.path().join("catalog.db-wal");
        std::fs::write(&log_path, &log).expect("written");
        let refused = Catalog::open(&path, Health::default());
        assert!(
            matches!(refused, Err(StoreError::Damaged { .. })),
            "{refused:?}"
        );
        assert_eq!(std::fs::read(&log_path).expect("there"), log);
    }
}
