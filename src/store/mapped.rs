//! Maps an array file into memory as a [`DescriptionView`]: checked once, not copied.
//!
//! Committed files never change and are mapped for reading only. Before the first access the length
//! is compared with the catalog's, and the pages are populated by a system call that returns an
//! error where an access would raise SIGBUS (a truncated file, a bad sector). Then the header is
//! checked and, on request, the BLAKE3.

#![allow(unsafe_code)]

use super::Digest;
pub use super::array_file::{ARRAY_FORMAT, ArrayFileError, write_description};
use super::array_file::{DATA_ALIGNMENT, Layout, check_indices};
use super::disk::open_regular;
use crate::mesh::CleanReport;
use crate::pipeline::{Description, DescriptionView};
use memmap2::{Advice, Mmap};
use std::fs::File;
use std::io::Read;
use std::ops::Range;
use std::path::Path;
use std::sync::Arc;

#[cfg(target_endian = "big")]
compile_error!("array files are little-endian and used where they are mapped");

/// A description whose arrays are mapped from its file, or from one that contains it. Clones share
/// the mapping, which stays valid after the file is removed.
#[derive(Debug, Clone)]
pub struct MappedDescription(Arc<Mapped>);

#[derive(Debug)]
struct Mapped {
    file: MappedFile,
    /// The bytes of the array file in the mapping.
    range: Range<usize>,
    layout: Layout,
}

/// A whole file, mapped for reading. Clones share the mapping.
#[derive(Debug, Clone)]
pub struct MappedFile(Arc<Mmap>);

impl MappedFile {
    /// Maps the file at `path`. Nobody may write into it as long as it is mapped; it may be removed
    /// or replaced by another file.
    pub fn open(path: &Path) -> Result<Self, ArrayFileError> {
        Self::of(&open_regular(path)?)
    }

    fn of(file: &File) -> Result<Self, ArrayFileError> {
        if file.metadata()?.len() == 0 {
            return Err(ArrayFileError::Header("the file is empty".into()));
        }
        // SAFETY: the bytes must not change and the file must not shrink while they are borrowed.
        // Files of the store are written under another name, renamed once complete and never opened
        // for writing again; the store's lock keeps a second process of ours out, and the store
        // removes files only by unlinking, which leaves mappings whole. Bundles are written and
        // replaced in the same way. The mapping is private and read-only, is never handed out
        // except as slices borrowed from `self`, and every bit pattern is a valid f32, f64 or u32.
        // Someone else who writes into such files breaks this contract: no program can map files
        // safely against that.
        let mapped = unsafe { Mmap::map(file) }?;
        populate(file, &mapped)?;
        Ok(Self(Arc::new(mapped)))
    }

    /// The bytes of the file.
    pub fn bytes(&self) -> &[u8] {
        &self.0
    }
}

impl MappedDescription {
    /// Maps the file at `path` after checking everything about it that can be checked.
    ///
    /// `expected_len` and `expected_blake3` come from the catalog. Without a digest the contents of
    /// the arrays are not verified, except for their indices, which are always in range.
    pub fn open(
        path: &Path,
        expected_len: u64,
        expected_blake3: Option<[u8; 32]>,
    ) -> Result<Self, ArrayFileError> {
        let file = open_regular(path)?;
        let found = file.metadata()?.len();
        if found != expected_len {
            return Err(ArrayFileError::Length {
                found,
                expected: expected_len,
            });
        }
        let file = MappedFile::of(&file)?;
        Self::within(&file, 0..file.bytes().len(), expected_blake3)
    }

    /// Returns the description whose array file is a range of the bytes of a mapped file, which
    /// must begin at a multiple of 64. Checks it as [`MappedDescription::open`] does.
    ///
    /// # Panics
    /// If the range is not in the file.
    pub fn within(
        file: &MappedFile,
        range: Range<usize>,
        expected_blake3: Option<[u8; 32]>,
    ) -> Result<Self, ArrayFileError> {
        let bytes = &file.bytes()[range.clone()];
        if !range.start.is_multiple_of(DATA_ALIGNMENT) {
            return Err(ArrayFileError::Alignment {
                name: "description",
                offset: range.start,
                alignment: DATA_ALIGNMENT,
            });
        }
        if let Some(expected) = expected_blake3.map(Digest) {
            let found = Digest::of(bytes);
            if found != expected {
                return Err(ArrayFileError::Digest { found, expected });
            }
        }
        let layout = Layout::parse(bytes)?;
        let file = file.clone();
        let mapped = Self(Arc::new(Mapped {
            file,
            range,
            layout,
        }));
        check_indices(&mapped.view())?;
        Ok(mapped)
    }

    /// The bytes of its array file.
    pub fn file_bytes(&self) -> &[u8] {
        &self.0.file.bytes()[self.0.range.clone()]
    }

    /// The arrays, borrowed from the mapping.
    pub fn view(&self) -> DescriptionView<'_> {
        let layout = &self.0.layout;
        DescriptionView {
            vertices: self.slice(&layout.vertices),
            faces: self.slice(&layout.faces),
            mass: self.slice(&layout.mass),
            eigenvalues: self.slice(&layout.eigenvalues),
            eigenvectors: self.slice(&layout.eigenvectors),
            n_eigenvectors: layout.n_eigenvectors,
            hks: self.slice(&layout.hks),
            face_descriptors: self.slice(&layout.face_descriptors),
            n_descriptors: layout.n_descriptors,
            patches: self.slice(&layout.patches),
            face_map: self.slice(&layout.face_map),
            polygon_area: self.slice(&layout.polygon_area),
            signature: self.slice(&layout.signature),
        }
    }

    /// The findings and actions of cleaning.
    pub fn report(&self) -> &CleanReport {
        &self.0.layout.report
    }

    /// Surface area in squared input units.
    pub fn area(&self) -> f64 {
        self.0.layout.area
    }

    /// The parameters of its computation, unchanged.
    pub fn params_json(&self) -> &str {
        &self.0.layout.params
    }

    /// Size of the file in bytes.
    pub fn file_len(&self) -> usize {
        self.0.range.len()
    }

    /// A copy in memory, equal to the description that was written.
    pub fn to_description(&self) -> Description {
        let view = self.view();
        Description {
            area: self.area(),
            report: self.report().clone(),
            vertices: view.vertices.to_vec(),
            faces: view.faces.to_vec(),
            mass: view.mass.to_vec(),
            eigenvalues: view.eigenvalues.to_vec(),
            eigenvectors: view.eigenvectors.to_vec(),
            n_eigenvectors: view.n_eigenvectors,
            hks: view.hks.to_vec(),
            face_descriptors: view.face_descriptors.to_vec(),
            n_descriptors: view.n_descriptors,
            patches: view.patches.to_vec(),
            face_map: view.face_map.to_vec(),
            polygon_area: view.polygon_area.to_vec(),
            signature: view.signature.to_vec(),
        }
    }

    fn slice<T: bytemuck::AnyBitPattern>(&self, range: &Range<usize>) -> &[T] {
        bytemuck::try_cast_slice(&self.file_bytes()[range.clone()]).expect(
            "invariant: the layout was checked for bounds, sizes and alignment, and maps \
                     begin at pages",
        )
    }
}

/// Reads every page of a new mapping in a way that returns an error where an access would raise
/// SIGBUS.
fn populate(file: &File, mapped: &Mmap) -> Result<(), ArrayFileError> {
    match mapped.advise(Advice::PopulateRead) {
        Ok(()) => Ok(()),
        // Kernels before 5.14 do not know the advice. Reading the file loads the same pages into
        // the page cache and reports the same errors.
        Err(e) if e.raw_os_error() == Some(rustix::io::Errno::INVAL.raw_os_error()) => {
            let mut read = 0;
            let mut block = vec![0; 1 << 16];
            let mut file = file;
            loop {
                match file.read(&mut block).map_err(ArrayFileError::Unreadable)? {
                    0 => break,
                    n => read += n as u64,
                }
            }
            let expected = mapped.len() as u64;
            if read == expected {
                Ok(())
            } else {
                Err(ArrayFileError::Length {
                    found: read,
                    expected,
                })
            }
        }
        Err(e) => Err(ArrayFileError::Unreadable(e)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A plain read of such a page would end the process with SIGBUS.
    #[test]
    fn pages_beyond_the_end_of_a_file_are_an_error() {
        let file = tempfile::tempfile().expect("a file");
        file.set_len(3 * 4096).expect("grown");
        // SAFETY: the bytes are never accessed; only `populate` looks at the pages.
        let mapped = unsafe { Mmap::map(&file) }.expect("mapped");
        populate(&file, &mapped).expect("all there");
        file.set_len(4096).expect("cut");
        let error = populate(&file, &mapped).expect_err("pages are missing");
        assert!(matches!(error, ArrayFileError::Unreadable(_)), "{error}");
    }
}
