//! Shapes are accepted, described and placed; each request takes effect once.

use super::isolate::DescribeJob;
use super::jobs::Attempts;
use super::names::check_shape_name;
use super::rows::{damaged, format_from_name, from_json, operator_from_name, to_json};
use super::{
    Described, Describer, Failure, FailureSubject, ItemState, Job, JobItem, Library, LibraryError,
    NewShape, Outcome, Placed, RequestKey, Result,
};
use crate::mesh::{CleanError, CleanReport, ParseError};
use crate::pipeline::{ALGORITHM_VERSION, DescribeError, Params, READING_VERSION};
use crate::spectrum::SpectrumError;
use crate::store::{
    CollectionRow, Digest, ItemStatus, JobItemRow, Kept, NewJobItem, ObjectKind, RequestRow,
    ShapeRow, Tx,
};
use std::cell::RefCell;
use std::sync::PoisonError;
use std::time::{Instant, SystemTime, UNIX_EPOCH};

/// Shapes whose files are durable, and that count once they are submitted.
#[derive(Debug, Default)]
pub struct KeptShapes {
    objects: Vec<Kept>,
    items: Vec<NewJobItem>,
}

impl KeptShapes {
    /// None, to be kept one after the other.
    pub fn new() -> Self {
        Self::default()
    }
}

/// Shapes that a request adds to a collection.
#[derive(Debug, Clone, Copy)]
pub struct Submission<'a> {
    /// Where they are added.
    pub collection: &'a str,
    /// The shapes.
    pub shapes: &'a KeptShapes,
    /// Whose request it is.
    pub key: Option<&'a RequestKey>,
}

impl Submission<'_> {
    /// What tells this request from another one with the same key.
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
    /// Writes the files of shapes, durably, for [`Library::submit`] to accept. Several threads may do so at a time.
    ///
    /// # Errors
    /// A bad name; the disk.
    pub fn keep(&self, shapes: Vec<NewShape>) -> Result<KeptShapes> {
        for s in &shapes {
            check_shape_name(&s.name)?;
        }
        let mut kept = KeptShapes::default();
        for s in shapes {
            self.keep_another(&mut kept, s)?;
        }
        Ok(kept)
    }

    /// Writes the file of one more shape, as [`Library::keep`] does, so that they need not be in memory together.
    ///
    /// # Errors
    /// A bad name; the disk.
    pub fn keep_another(&self, kept: &mut KeptShapes, shape: NewShape) -> Result<()> {
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

    /// Accepts shapes: when this returns a job with them is durable. The same key gives the same job again.
    ///
    /// # Errors
    /// No such collection, or a key that was used for another request.
    pub fn submit(
        &self,
        collection: &str,
        shapes: &KeptShapes,
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

    /// Accepts shapes of several requests in the order given, in one transaction: a job for each, which is durable even if
    /// it cannot be read back, or none of them.
    ///
    /// # Errors
    /// As [`Library::submit`], of the first that has one; then nothing is accepted.
    pub fn submit_together(&self, submissions: &[Submission<'_>]) -> Result<Vec<Result<Job>>> {
        for submission in submissions {
            self.collection_row(submission.collection)?;
        }
        let replies = self.store.catalog().write(|tx| -> Result<Vec<_>> {
            let submit = |s: &Submission<'_>| {
                once_in(tx, s.key, s.digest(), |tx| {
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

    /// A job as it stands.
    ///
    /// # Errors
    /// There is none of the id.
    pub fn job(&self, id: u64) -> Result<Job> {
        let (job, items) = self.store.catalog().read(|r| -> Result<_> {
            let job = r.job(id)?;
            let job = job.ok_or_else(|| LibraryError::not_found("job", id.to_string()))?;
            Ok((job, r.job_items(id)?))
        })?;
        let carrying = if items.is_empty() {
            Some(self.carrying(id, &job.collection)?)
        } else {
            None
        };
        let items = items
            .into_iter()
            .map(|i| self.item(i))
            .collect::<Result<_>>()?;
        Ok(Job {
            id,
            collection: job.collection,
            items,
            carrying,
        })
    }

    /// Items not yet done, in order of acceptance: what a daemon takes up again when it starts.
    ///
    /// # Errors
    /// The catalog cannot be read.
    pub fn queued_items(&self) -> Result<Vec<JobItem>> {
        let rows = self
            .store
            .catalog()
            .read(|r| r.queued_items().map_err(LibraryError::from))?;
        rows.into_iter().map(|i| self.item(i)).collect()
    }

    /// Cancels the items of a job that are not done.
    ///
    /// # Errors
    /// There is no such job.
    pub fn cancel(&self, job: u64) -> Result<Job> {
        self.job(job)?;
        let cancel = |tx: &Tx<'_>| -> Result<()> {
            for item in tx
                .job_items(job)?
                .iter()
                .filter(|i| i.status == ItemStatus::Queued)
            {
                tx.set_item(job, item.index, ItemStatus::Cancelled, None)?;
            }
            Ok(())
        };
        self.store.freeing(|| self.store.catalog().write(cancel))?;
        self.job(job)
    }

    /// Bytes of an item's file, for whoever plans its memory.
    ///
    /// # Errors
    /// There is no such item, or the catalog cannot be read.
    pub fn item_bytes(&self, item: &JobItem) -> Result<u64> {
        self.object_length(&self.item_row(item)?.item.original_digest)
    }

    /// Whether placing an item would need its description now: not when the same bytes are there
    /// under its name, or others that it may not replace. Either may change until the items before
    /// it are placed. Bytes that the first release read are described again when they are to
    /// replace themselves: it may have read them in another way.
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

    /// The pure stage of an item, on any thread. `stage` is told each stage's name as it begins; when it returns
    /// false the work stops.
    ///
    /// # Errors
    /// Why the shape is refused, or why it was stopped.
    pub fn describe_item(
        &self,
        item: &JobItem,
        stage: &dyn Fn(&str) -> bool,
    ) -> std::result::Result<Described, Failure> {
        self.describe_item_by(item, stage, &|job, stage| job.run(stage))
    }

    /// The same, done by `describer`, perhaps in another process.
    ///
    /// # Errors
    /// Why the shape is refused, or why it was stopped.
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

    fn describe_bytes(
        &self,
        item: &JobItem,
        stage: &dyn Fn(&str) -> bool,
        describer: &Describer<'_>,
    ) -> std::result::Result<Described, Failure> {
        let row = self.item_row(item).map_err(|e| failure(&e))?;
        let collection = self
            .collection_row(&item.collection)
            .map_err(|e| failure(&e))?;
        let (params, params_json) = params_of(&collection).map_err(|e| failure(&e))?;
        let bytes = self
            .original_bytes(&row.item.original_digest)
            .map_err(|e| failure(&e))?;
        let format =
            format_from_name(&row.item.format, "job_items.format").map_err(|e| failure(&e))?;
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
        let digest = Digest::of_description(&row.item.original_digest, &params_json, &algorithm);
        let stages_ms = laps.into_inner().0;
        Ok(Described {
            description,
            stages_ms,
            digest,
            params_json,
            stored: None,
        })
    }

    /// Places a described item and commits it, or commits that it failed. To be called in the order of acceptance
    /// within a collection.
    ///
    /// # Errors
    /// The store fails; a shape that is refused is an [`ItemState::Failed`].
    pub fn place_item(
        &self,
        item: &JobItem,
        described: std::result::Result<Described, Failure>,
    ) -> Result<ItemState> {
        let Ok(collection) = self.collection_row(&item.collection) else {
            let gone = LibraryError::not_found("collection", &item.collection);
            return self.fail(item, failure(&gone));
        };
        self.with_lane(collection, |lane| {
            let row = self.item_row(item)?;
            if row.status != ItemStatus::Queued {
                return Ok(self.item(row)?.state);
            }
            let read = |name: &str| {
                let id = lane.row.id;
                self.store
                    .catalog()
                    .read(|r| r.shape_by_name(id, name).map_err(LibraryError::from))
            };
            let existing: Option<ShapeRow> = read(&item.name)?;
            let read_again = |shape: &ShapeRow| {
                let found = described.as_ref().map(|d| &d.description.report);
                row.item.replace
                    && read_by_first_release(shape)
                    && found.is_ok_and(CleanReport::differs_from_first_release)
            };
            match &existing {
                Some(shape)
                    if shape.content_digest == row.item.original_digest && !read_again(shape) =>
                {
                    let placed = Placed {
                        outcome: Outcome::Unchanged,
                        version: shape.version,
                        sequence: lane.row.sequence,
                        n_maps: 0,
                        n_relabelled: 0,
                        n_inconsistent: 0,
                        stages_ms: Vec::new(),
                    };
                    self.store.catalog().write(|tx| -> Result<()> {
                        let detail = to_json(&placed);
                        Ok(tx.set_item(item.job, item.index, ItemStatus::Done, Some(&detail))?)
                    })?;
                    return Ok(ItemState::Done(Box::new(placed)));
                }
                Some(_) if !row.item.replace => return self.fail(item, taken(item)),
                _ => {}
            }
            match described {
                Err(why) => self.fail(item, why),
                Ok(described) => {
                    let placed = self.place_described(lane, &row, described, existing.as_ref())?;
                    Ok(ItemState::Done(Box::new(placed)))
                }
            }
        })
    }

    /// Submits, describes and places one shape, for use in process.
    ///
    /// # Errors
    /// As [`Library::submit`]; [`LibraryError::Refused`] if the shape is refused.
    pub fn add(&self, collection: &str, shape: NewShape) -> Result<Placed> {
        let job = self.submit(collection, &self.keep(vec![shape])?, None)?;
        let item = &job.items[0];
        match self.place_item(item, self.describe_item(item, &|_| true))? {
            ItemState::Done(placed) => Ok(*placed),
            ItemState::Failed(why) => Err(LibraryError::Refused(why)),
            ItemState::Queued | ItemState::Running(_) | ItemState::Cancelled => {
                Err(LibraryError::FailedPrecondition {
                    reason: "CANCELLED",
                    message: format!("job {} was cancelled", job.id),
                })
            }
        }
    }

    /// Runs a change unless its key was answered before; the reply, then or now.
    pub(super) fn once(
        &self,
        key: Option<&RequestKey>,
        request: Digest,
        change: impl FnOnce(&Tx<'_>) -> Result<Vec<u8>>,
    ) -> Result<Vec<u8>> {
        let catalog = self.store.catalog();
        catalog.write(|tx| once_in(tx, key, request, change))
    }

    pub(super) fn object_length(&self, original: &Digest) -> Result<u64> {
        Ok(self.object(ObjectKind::Original, original)?.length)
    }

    fn fail(&self, item: &JobItem, why: Failure) -> Result<ItemState> {
        let cancelled = why.code == "CANCELLED";
        let status = if cancelled {
            ItemStatus::Cancelled
        } else {
            ItemStatus::Failed
        };
        self.store.catalog().write(|tx| -> Result<()> {
            Ok(tx.set_item(item.job, item.index, status, Some(&to_json(&why)))?)
        })?;
        Ok(if cancelled {
            ItemState::Cancelled
        } else {
            ItemState::Failed(why)
        })
    }

    pub(super) fn item_row(&self, item: &JobItem) -> Result<JobItemRow> {
        let row = self
            .store
            .catalog()
            .read(|r| r.job_item(item.job, item.index).map_err(LibraryError::from))?;
        row.ok_or_else(|| {
            let name = format!("{} of job {}", item.index, item.job);
            LibraryError::not_found("job item", name)
        })
    }

    pub(super) fn item(&self, row: JobItemRow) -> Result<JobItem> {
        let place = format!("job_items {}, {}", row.job, row.index);
        let detail = || {
            row.detail_json
                .as_deref()
                .ok_or_else(|| damaged(&place, "no detail"))
        };
        let attempts = match (row.status, &row.detail_json) {
            (ItemStatus::Queued, Some(detail)) => from_json::<Attempts>(detail, &place)?.attempts,
            _ => 0,
        };
        let state = match row.status {
            ItemStatus::Queued => {
                let running = self.running.lock().unwrap_or_else(PoisonError::into_inner);
                let stage = running.get(&(row.job, row.index)).cloned();
                stage.map_or(ItemState::Queued, ItemState::Running)
            }
            ItemStatus::Done => ItemState::Done(Box::new(from_json(detail()?, &place)?)),
            ItemStatus::Failed => ItemState::Failed(from_json(detail()?, &place)?),
            ItemStatus::Cancelled => ItemState::Cancelled,
        };
        Ok(JobItem {
            job: row.job,
            index: row.index,
            collection: row.collection,
            name: row.item.name,
            state,
            attempts,
        })
    }
}

/// Runs a change within a transaction unless its key was answered before; the reply, then or now.
fn once_in(
    tx: &Tx<'_>,
    key: Option<&RequestKey>,
    request: Digest,
    change: impl FnOnce(&Tx<'_>) -> Result<Vec<u8>>,
) -> Result<Vec<u8>> {
    let Some(key) = key else { return change(tx) };
    if let Some(row) = tx.request(&key.client_id, &key.request_id)? {
        if row.request_digest != request {
            return Err(LibraryError::FailedPrecondition {
                reason: "REQUEST_ID_REUSED",
                message: format!(
                    "client {:?} used request id {:?} for another request before",
                    key.client_id, key.request_id
                ),
            });
        }
        return Ok(row.reply);
    }
    let reply = change(tx)?;
    tx.put_request(&RequestRow {
        client_id: key.client_id.clone(),
        request_id: key.request_id.clone(),
        request_digest: request,
        reply: reply.clone(),
        created_unix_secs: unix_secs(),
    })?;
    Ok(reply)
}

pub(super) fn unix_secs() -> u64 {
    SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .map_or(0, |d| d.as_secs())
}

/// What decides the bits of a description besides bytes and parameters: the algorithm, the
/// instruction set that the kernels choose at run time, and, where it matters, how the bytes are
/// read.
pub(super) fn algorithm(report: &CleanReport) -> String {
    let algorithm = format!("{ALGORITHM_VERSION} {:?}", pulp::Arch::new());
    match report.differs_from_first_release() {
        true => format!("{algorithm} reading {READING_VERSION}"),
        false => algorithm,
    }
}

/// Whether a shape was described by the first release, whose reports lack the later counts.
fn read_by_first_release(shape: &ShapeRow) -> bool {
    !shape.report_json.contains("n_concave_polygons")
}

/// The parameters of a collection's descriptions, and the text that names them.
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

fn taken(item: &JobItem) -> Failure {
    Failure {
        code: "ALREADY_EXISTS".into(),
        reason: "NAME_TAKEN".into(),
        message: format!(
            "collection {:?} has a shape named {:?} with other bytes; replace it or choose another name",
            item.collection, item.name
        ),
        subject: None,
    }
}

/// An error of the library as the failure of an item.
fn failure(error: &LibraryError) -> Failure {
    let (code, reason) = match error {
        LibraryError::InvalidArgument { reason, .. } | LibraryError::InvalidFace { reason, .. } => {
            ("INVALID_ARGUMENT", *reason)
        }
        LibraryError::NotFound { .. } => ("NOT_FOUND", "GONE"),
        LibraryError::AlreadyExists { reason, .. } => ("ALREADY_EXISTS", *reason),
        LibraryError::FailedPrecondition { reason, .. } => ("FAILED_PRECONDITION", *reason),
        LibraryError::Refused(failure) => return failure.clone(),
        LibraryError::Store(e) if e.is_damage() => ("DATA_LOSS", "DAMAGED"),
        LibraryError::Store(_) => ("INTERNAL", "STORE"),
    };
    Failure {
        code: code.into(),
        reason: reason.into(),
        message: error.to_string(),
        subject: None,
    }
}

/// Why a mesh could not be described, as the failure of an item.
pub(super) fn refusal(error: &DescribeError) -> Failure {
    let (code, reason) = match error {
        DescribeError::Parse(e) => ("INVALID_ARGUMENT", parse_reason(e)),
        DescribeError::Clean(CleanError::AllDegenerate { .. }) => ("INVALID_ARGUMENT", "NO_AREA"),
        DescribeError::Clean(_) => ("INVALID_ARGUMENT", "MESH"),
        DescribeError::Laplacian(_) => ("INVALID_ARGUMENT", "LAPLACIAN"),
        DescribeError::Spectrum(SpectrumError::Cancelled { .. }) => ("CANCELLED", "CANCELLED"),
        DescribeError::Spectrum(_) => ("INTERNAL", "SPECTRUM"),
        DescribeError::Cancelled(_) => ("CANCELLED", "CANCELLED"),
    };
    let subject = match error {
        DescribeError::Parse(e) => parse_subject(e),
        _ => None,
    };
    Failure {
        code: code.into(),
        reason: reason.into(),
        message: error.to_string(),
        subject,
    }
}

fn parse_reason(error: &ParseError) -> &'static str {
    match error {
        ParseError::VertexOutOfRange { .. } => "VERTEX_INDEX",
        ParseError::NonFinite { .. } => "NON_FINITE_VERTEX",
        ParseError::TooManyTriangles => "MESH_TOO_LARGE",
        _ => "PARSE",
    }
}

/// Where in the file, if it is one place.
fn parse_subject(error: &ParseError) -> Option<FailureSubject> {
    match error {
        ParseError::NotANumber { line, .. }
        | ParseError::ShortVertex { line, .. }
        | ParseError::EmptyFace { line, .. }
        | ParseError::ShortFace { line, .. }
        | ParseError::BadLine { line, .. }
        | ParseError::ShortRow { line, .. }
        | ParseError::Trailing { line, .. } => Some(FailureSubject::Line(*line as u64)),
        ParseError::PolygonTooLarge { face, .. }
        | ParseError::EmptyPolygon { face }
        | ParseError::VertexOutOfRange { face, .. }
        | ParseError::NonFinite { face, .. } => Some(FailureSubject::Face(*face as u64)),
        _ => None,
    }
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
