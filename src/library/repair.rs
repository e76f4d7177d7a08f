//! Recomputes damaged data from the stored meshes, where that is possible.
//!
//! Descriptions, signatures, maps and indexes can be recomputed. The original bytes, labels,
//! corrections and events cannot: where one of these is damaged, the repair reports it, and a
//! snapshot is needed.

use super::error::{LibraryError, Result};
use super::facade::Library;
use super::isolate::DescribeJob;
use super::rows::format_from_name;
use super::sources::{Sources, object};
use super::submit::{algorithm, params_of};
use crate::mesh::CleanReport;
use crate::store::check::Finding;
use crate::store::quarantine::{accept_loss, rebuild_indexes};
use crate::store::{CollectionRow, Digest, ObjectKind, ShapeRow};
use std::collections::BTreeSet;
use std::path::Path;

/// The result of a repair.
#[derive(Debug, Clone, PartialEq)]
pub struct Repaired {
    /// Lines of text about what was repaired, and what could not be.
    pub done: Vec<String>,
    /// Findings of a check after the repair.
    pub left: Vec<Finding>,
}

impl Library {
    /// Repairs the library in `dir` as far as possible. No process may hold it. Damaged files are
    /// moved to `quarantine/`.
    ///
    /// # Errors
    /// The library is held, or so damaged that it cannot be opened.
    pub fn repair(dir: &Path) -> Result<Repaired> {
        let mut done = Vec::new();
        let lost = accept_loss(dir)?;
        done.extend(lost.iter().map(|what| format!("catalog.db: {what}")));
        if rebuild_indexes(dir)? {
            done.push("catalog.db: its indexes were rebuilt".to_owned());
        }
        let library = Self::open(dir)?;
        if lost.is_some() {
            // The sweep would treat them as files of an addition that was never accepted.
            for file in library.store.uncatalogued_originals()? {
                library.store.put_aside(&file)?;
                done.push(format!(
                    "{file}: a mesh that no row names was put into quarantine/: it \
                     can be added again"
                ));
            }
        }
        let rows = library.store.catalog().read(|r| -> Result<_> {
            let mut rows = Vec::new();
            for collection in r.collections()? {
                for shape in r.shapes(collection.id, 0, usize::MAX, None)? {
                    rows.push((collection.clone(), shape));
                }
            }
            Ok(rows)
        })?;
        for (collection, shape) in &rows {
            match library.repair_shape(collection, shape) {
                Ok(what) => done.extend(what),
                Err(e) => done.push(format!(
                    "{}/{}: not repaired: {e}",
                    collection.name, shape.name
                )),
            }
        }
        done.extend(library.drop_bad_maps()?);
        let collections: BTreeSet<&str> = rows.iter().map(|(c, _)| c.name.as_str()).collect();
        for name in collections {
            match library.mend_maps(name) {
                Ok(mended) => done.extend(mended.into_iter().map(|m| format!("{name}: {m}"))),
                Err(e) => done.push(format!("{name}: maps not recomputed: {e}")),
            }
        }
        drop(library);
        Ok(Repaired {
            done,
            left: Self::check(dir)?,
        })
    }

    /// Recomputes the description and the signature of one shape.
    fn repair_shape(&self, collection: &CollectionRow, shape: &ShapeRow) -> Result<Vec<String>> {
        let mut done = Vec::new();
        let location = format!("{}/{}", collection.name, shape.name);
        let object = object(
            &self.store,
            ObjectKind::Description,
            &shape.description_digest,
        )?;
        let whole = match self.store.objects().open_description(&object) {
            Ok(mapped) => mapped,
            Err(e) if e.is_damage() => {
                let (params, params_json) = params_of(collection)?;
                let name = |report: &CleanReport| {
                    let algorithm = algorithm(report);
                    Digest::of_description(&shape.content_digest, &params_json, &algorithm)
                };
                let bytes = self.store.original(&shape.content_digest)?;
                let job = DescribeJob {
                    bytes: &bytes,
                    format: format_from_name(&shape.format, "shapes.format")?,
                    params,
                };
                let description = job.run(&|_| true).map_err(LibraryError::Refused)?;
                let name = name(&description.report);
                if name != shape.description_digest {
                    done.push(format!(
                        "{location}: {}: made by another version or on another kind of processor; \
                         remove the shape and add it again",
                        object.file
                    ));
                    return Ok(done);
                }
                self.store.put_aside(&object.file)?;
                let again =
                    self.store
                        .objects()
                        .put_description(name, &description, &params_json)?;
                self.store
                    .catalog()
                    .write(|tx| -> Result<()> { Ok(tx.insert_object(&again)?) })?;
                done.push(format!("{location}: {} was recomputed", again.file));
                self.store.objects().open_description(&again)?
            }
            Err(e) => return Err(e.into()),
        };
        let read = self
            .store
            .catalog()
            .read(|r| -> Result<_> { Ok(r.signature(shape.id)?) });
        if !matches!(read, Ok(Some(_))) {
            let signature = whole.view().signature.to_vec();
            self.store
                .catalog()
                .write(|tx| -> Result<()> { Ok(tx.put_signature(shape.id, &signature)?) })?;
            done.push(format!(
                "{location}: its signature was taken from its description"
            ));
        }
        Ok(done)
    }

    /// Deletes maps with damaged rows. They are computed again when they are requested.
    fn drop_bad_maps(&self) -> Result<Vec<String>> {
        let catalog = self.store.catalog();
        let keys = catalog.read(|r| -> Result<_> { Ok(r.map_keys()?) })?;
        let mut done = Vec::new();
        for (from, to) in keys {
            match catalog.read(|r| -> Result<_> { Ok(r.map(from, to)?) }) {
                Err(LibraryError::Store(e)) if e.is_damage() => {
                    catalog.write(|tx| -> Result<()> { Ok(tx.delete_map(from, to)?) })?;
                    done.push(format!(
                        "maps {from}, {to}: was deleted, because its row was damaged"
                    ));
                }
                _ => {}
            }
        }
        let keys = catalog.read(|r| -> Result<_> { Ok(r.point_map_keys()?) })?;
        for (from, to, request) in keys {
            let read = catalog.read(|r| -> Result<_> { Ok(r.point_maps(from, to, &request)?) });
            match read {
                Err(LibraryError::Store(e)) if e.is_damage() => {
                    catalog.write(|tx| -> Result<()> {
                        Ok(tx.delete_point_maps(from, to, &request)?)
                    })?;
                    done.push(format!(
                        "point_maps {from}, {to}: were deleted, because their row was damaged"
                    ));
                }
                _ => {}
            }
        }
        Ok(done)
    }
}
