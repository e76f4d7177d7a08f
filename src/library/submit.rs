//! Accepts shapes and describes them.

use super::error::Result;
use super::facade::Library;
use super::isolate::{self, DescribeJob};
use super::lookup::object_length;
use super::names::check_shape_name;
use super::once::{Request, once, unix_secs};
use super::refusal::failure;
use super::rows::{damaged, format_from_name, operator_from_name};
use super::sources::Sources;
use super::types::{Failure, Job, JobItem, NewShape, RequestKey};
use crate::mesh::{CleanReport, Format};
use crate::pipeline::{ALGORITHM_VERSION, Description, Params, READING_VERSION};
use crate::store::{CollectionRow, Digest, ItemStatus, Kept, NewJobItem, ObjectRow, ShapeRow};
use std::cell::RefCell;
use std::sync::PoisonError;
use std::time::Instant;

/// Describes one shape, in this process or in another one.
pub type Describer<'a> =
    dyn Fn(&isolate::DescribeJob<'_>, &dyn Fn(&str) -> bool) -> isolate::Described + 'a;

/// A description with the values that the library needs to commit it.
#[derive(Debug, Clone)]
pub struct Described {
    /// What was computed.
    pub description: Description,
    /// Stage and milliseconds, in order.
    pub stages_ms: Vec<(String, f64)>,
    pub(super) digest: Digest,
    pub(super) params_json: String,
    /// The object of its file, if it is already stored.
    pub(super) stored: Option<ObjectRow>,
}

/// Shapes whose files are durable. They become part of a collection once they are submitted.
#[derive(Debug, Default)]
pub struct StoredOriginals {
    objects: Vec<Kept>,
    items: Vec<NewJobItem>,
}

impl StoredOriginals {
    /// Begins without shapes; [`Library::store_another_original`] adds them one by one.
    pub fn new() -> Self {
        Self::default()
    }
}

/// Shapes that a request adds to a collection.
#[derive(Debug, Clone, Copy)]
pub struct Submission<'a> {
    /// The collection to which they are added.
    pub collection: &'a str,
    /// The shapes.
    pub shapes: &'a StoredOriginals,
    /// Key of the request, if it has one.
    pub key: Option<&'a RequestKey>,
}

impl Submission<'_> {
    /// The digest that distinguishes this request from another one with the same key.
    fn digest(&self) -> Digest {
        let items = &self.shapes.items;
        let mut request = blake3::Hasher::new();
        request.update(format!("submit {:?} {}", self.collection, items.len()).as_bytes());
        for item in items {
            let what = format!("{:?} {} {}", item.name, item.format, item.replace);
            request
                .update(what.as_bytes())
                .update(&item.original_digest.0);
        }
        Digest(*request.finalize().as_bytes())
    }
}

impl Library {
    /// Makes the files of shapes durable, so that [`Library::submit`] can accept them. Several
    /// threads may do so at a time.
    ///
    /// # Errors
    /// A name is not valid, or the disk fails.
    pub fn store_originals(&self, shapes: Vec<NewShape>) -> Result<StoredOriginals> {
        for s in &shapes {
            check_shape_name(&s.name)?;
        }
        let mut kept = StoredOriginals::default();
        for s in shapes {
            self.store_another_original(&mut kept, s)?;
        }
        Ok(kept)
    }

    /// Makes the file of one more shape durable, as [`Library::store_originals`] does, so that they
    /// need not be in memory together.
    ///
    /// # Errors
    /// A name is not valid, or the disk fails.
    pub fn store_another_original(
        &self,
        kept: &mut StoredOriginals,
        shape: NewShape,
    ) -> Result<()> {
        check_shape_name(&shape.name)?;
        let object = self.store.objects().put_original(&shape.bytes)?;
        kept.items.push(NewJobItem {
            name: shape.name,
            original_digest: object.digest,
            format: shape.format.name().into(),
            replace: shape.replace,
        });
        kept.objects.push(object);
        Ok(())
    }

    /// Accepts shapes. When this returns, a job with them is durable. A repeated request with the
    /// same key returns the same job.
    ///
    /// # Errors
    /// There is no such collection, or the key was used for another request.
    pub fn submit(
        &self,
        collection: &str,
        shapes: &StoredOriginals,
        key: Option<&RequestKey>,
    ) -> Result<Job> {
        let submission = Submission {
            collection,
            shapes,
            key,
        };
        let jobs = self.submit_together(&[submission])?;
        jobs.into_iter().next().expect("invariant: a job for each")
    }

    /// Accepts shapes of several requests in the given order, in one transaction: either a job for
    /// each, which is durable even if it cannot be read back, or none of them.
    ///
    /// # Errors
    /// Those of [`Library::submit`], for the first request that has one; then nothing is accepted.
    pub fn submit_together(&self, submissions: &[Submission<'_>]) -> Result<Vec<Result<Job>>> {
        for submission in submissions {
            self.collection_row(submission.collection)?;
        }
        let replies = self.store.catalog().write(|tx| -> Result<Vec<_>> {
            let submit = |s: &Submission<'_>| {
                once(tx, &Request::new(s.key, s.digest()), |tx| {
                    for object in &s.shapes.objects {
                        tx.insert_object(object)?;
                    }
                    let job = tx.insert_job(s.collection, unix_secs(), &s.shapes.items)?;
                    Ok(job.to_le_bytes().to_vec())
                })
            };
            submissions.iter().map(submit).collect()
        })?;
        let job = |reply: Vec<u8>| {
            let id = reply.as_slice().try_into().map(u64::from_le_bytes);
            self.job(id.map_err(|_| damaged("requests", "the reply is no job id"))?)
        };
        Ok(replies.into_iter().map(job).collect())
    }

    /// Returns the number of bytes of an item's file, from which its memory can be planned.
    ///
    /// # Errors
    /// There is no such item, or the catalog cannot be read.
    pub fn item_bytes(&self, item: &JobItem) -> Result<u64> {
        object_length(&self.store, &self.item_row(item)?.item.original_digest)
    }

    /// Returns whether placing an item would need its description now. It would not if the same
    /// bytes are stored under its name, or others that it may not replace. Either may change until
    /// the items before it are placed. Bytes that the first release read are described again when
    /// they are to replace themselves, because it may have read them in another way.
    ///
    /// # Errors
    /// There is no such item or collection, or the catalog cannot be read.
    pub fn needs_description(&self, item: &JobItem) -> Result<bool> {
        let row = self.item_row(item)?;
        let id = self.collection_row(&item.collection)?.id;
        let existing = self
            .store
            .catalog()
            .read(|r| -> Result<Option<ShapeRow>> { Ok(r.shape_by_name(id, &item.name)?) })?;
        let replaced = |shape: ShapeRow| {
            let other = shape.content_digest != row.item.original_digest;
            row.item.replace && (other || read_by_first_release(&shape))
        };
        Ok(row.status == ItemStatus::Queued && existing.is_none_or(replaced))
    }

    /// Runs the pure stage of an item, on any thread. Calls `stage` with the name of each stage as
    /// it begins, and stops when it returns false.
    ///
    /// # Errors
    /// The shape is refused, or the work was stopped.
    pub fn describe_item(
        &self,
        item: &JobItem,
        stage: &dyn Fn(&str) -> bool,
    ) -> std::result::Result<Described, Failure> {
        self.describe_item_by(item, stage, &|job, stage| job.run(stage))
    }

    /// Does the same with `describer`, which may use another process.
    ///
    /// # Errors
    /// The shape is refused, or the work was stopped.
    pub fn describe_item_by(
        &self,
        item: &JobItem,
        stage: &dyn Fn(&str) -> bool,
        describer: &Describer<'_>,
    ) -> std::result::Result<Described, Failure> {
        let key = (item.job, item.index);
        let described = self.describe_bytes(item, stage, describer);
        self.running
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .remove(&key);
        described
    }

    /// Returns what the description of an item needs: its bytes, their format, the parameters and
    /// their text, and the digest of the bytes.
    fn to_describe(&self, item: &JobItem) -> Result<(Vec<u8>, Format, Params, String, Digest)> {
        let row = self.item_row(item)?;
        let collection = self.collection_row(&item.collection)?;
        let (params, params_json) = params_of(&collection)?;
        let original = row.item.original_digest;
        let bytes = self.store.original(&original)?;
        let format = format_from_name(&row.item.format, "job_items.format")?;
        Ok((bytes, format, params, params_json, original))
    }

    fn describe_bytes(
        &self,
        item: &JobItem,
        stage: &dyn Fn(&str) -> bool,
        describer: &Describer<'_>,
    ) -> std::result::Result<Described, Failure> {
        let (bytes, format, params, params_json, original) =
            self.to_describe(item).map_err(|e| failure(&e))?;
        let laps = RefCell::new((Vec::<(String, f64)>::new(), Instant::now()));
        let lap = || {
            let (stages, since) = &mut *laps.borrow_mut();
            if let Some(last) = stages.last_mut() {
                last.1 += since.elapsed().as_secs_f64() * 1e3;
            }
            *since = Instant::now();
        };
        let observed = |name: &str| {
            if laps.borrow().0.last().is_some_and(|last| last.0 == name) {
                return stage(name);
            }
            lap();
            let mut running = self.running.lock().unwrap_or_else(PoisonError::into_inner);
            running.insert((item.job, item.index), name.to_string());
            drop(running);
            laps.borrow_mut().0.push((name.to_string(), 0.0));
            stage(name)
        };
        let work = DescribeJob {
            bytes: &bytes,
            format,
            params,
        };
        let description = describer(&work, &observed)?;
        lap();
        let algorithm = algorithm(&description.report);
        let digest = Digest::of_description(&original, &params_json, &algorithm);
        let stages_ms = laps.into_inner().0;
        Ok(Described {
            description,
            stages_ms,
            digest,
            params_json,
            stored: None,
        })
    }
}

/// Returns everything that decides the bits of a description besides bytes and parameters: the
/// algorithm, the instruction set that the kernels choose at run time and, where it matters, how
/// the bytes are read.
pub(super) fn algorithm(report: &CleanReport) -> String {
    let algorithm = format!("{ALGORITHM_VERSION} {:?}", pulp::Arch::new());
    match report.differs_from_first_release() {
        true => format!("{algorithm} reading {READING_VERSION}"),
        false => algorithm,
    }
}

/// Returns whether the first release described a shape: its reports lack the later counts.
pub(super) fn read_by_first_release(shape: &ShapeRow) -> bool {
    !shape.report_json.contains("n_concave_polygons")
}

/// Returns the parameters of a collection's descriptions, and the text that identifies them.
pub(super) fn params_of(row: &CollectionRow) -> Result<(Params, String)> {
    let operator = operator_from_name(&row.operator, &format!("collections {}", row.name))?;
    let params = Params {
        operator,
        working_faces: row.working_faces,
        ..Params::default()
    };
    let json = serde_json::json!({
        "operator": row.operator,
        "working_faces": params.working_faces,
        "n_eigenpairs": params.n_eigenpairs,
    });
    Ok((params, json.to_string()))
}

#[cfg(test)]
mod tests {
    use super::{ALGORITHM_VERSION, CleanReport, algorithm};

    #[test]
    fn only_files_that_are_read_in_another_way_than_before_have_descriptions_of_another_name() {
        let first = format!("{ALGORITHM_VERSION} {:?}", pulp::Arch::new());
        let with = |change: fn(&mut CleanReport)| {
            let mut report = CleanReport::default();
            change(&mut report);
            algorithm(&report)
        };
        for change in [
            |_: &mut CleanReport| {},
            |r: &mut CleanReport| r.n_nonplanar_polygons = 7,
            |r: &mut CleanReport| r.n_nonsimple_polygons = 7,
            |r: &mut CleanReport| r.n_unread_statements = 7,
        ] {
            assert_eq!(with(change), first);
        }
        for change in [
            |r: &mut CleanReport| r.n_concave_polygons = 1,
            |r: &mut CleanReport| r.n_tolerated_statements = 1,
            |r: &mut CleanReport| r.n_inner_walls = 1,
        ] {
            assert_eq!(with(change), format!("{first} reading 2"));
        }
    }
}
