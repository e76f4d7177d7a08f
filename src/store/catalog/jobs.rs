//! Reads and writes accepted jobs and answered requests.

use super::reader::{Fields, Reader, Tx};
use super::schema::{JOB_ITEMS, JOBS, REQUESTS};
use crate::store::rows::{ItemStatus, JobItemRow, JobRow, NewJobItem, RequestRow};
use crate::store::{Digest, StoreError};
use rusqlite::params;

type Result<T> = std::result::Result<T, StoreError>;

/// A reply is kept for at least this time.
const REQUEST_AGE_SECS: u64 = 24 * 60 * 60;

/// The key in `meta` of the wall clock of the last purge.
const PURGED_AT: &str = "requests_purged_at";

fn job_row(fields: &Fields<'_>) -> Result<JobRow> {
    Ok(JobRow {
        id: fields.get("id")?,
        collection: fields.get("collection")?,
        created_unix_secs: fields.get("created")?,
    })
}

impl Reader<'_> {
    /// The job with this id.
    pub fn job(&self, id: u64) -> Result<Option<JobRow>> {
        let id = i64::try_from(id).unwrap_or(i64::MAX);
        self.first(&JOBS, "WHERE id = ?1", [id], job_row)
    }

    /// The items of a job in order.
    pub fn job_items(&self, job: u64) -> Result<Vec<JobItemRow>> {
        let Some(job) = self.job(job)? else {
            return Ok(Vec::new());
        };
        self.all(
            &JOB_ITEMS,
            "WHERE job_id = ?1 ORDER BY idx",
            [job.id],
            |fields| item_row(fields, job.collection.clone()),
        )
    }

    /// One item of a job.
    pub fn job_item(&self, job: u64, index: u32) -> Result<Option<JobItemRow>> {
        let Some(job) = self.job(job)? else {
            return Ok(None);
        };
        let tail = "WHERE job_id = ?1 AND idx = ?2";
        self.first(&JOB_ITEMS, tail, params![job.id, index], |fields| {
            item_row(fields, job.collection.clone())
        })
    }

    /// Jobs before `before`, newest first, at most `limit`: all jobs, or those with a failed item;
    /// of all collections, or of one.
    pub fn jobs(
        &self,
        before: u64,
        failed: bool,
        collection: Option<&str>,
        limit: usize,
    ) -> Result<Vec<JobRow>> {
        let before = i64::try_from(before).unwrap_or(i64::MAX);
        let limit = i64::try_from(limit).unwrap_or(i64::MAX);
        let tail = "WHERE id < ?1 AND (?2 IS NULL OR collection = ?2) AND (NOT ?3 OR EXISTS (
                      SELECT 1 FROM job_items WHERE job_id = jobs.id AND status = 'failed'))
                    ORDER BY id DESC LIMIT ?4";
        let params = params![before, collection, failed, limit];
        self.all(&JOBS, tail, params, job_row)
    }

    /// The items of all jobs that are not done, in the order of acceptance.
    pub fn queued_items(&self) -> Result<Vec<JobItemRow>> {
        let tail = "WHERE status = 'queued' ORDER BY job_id, idx";
        self.all(&JOB_ITEMS, tail, [], |fields| {
            let job: u64 = fields.get("job_id")?;
            match self.job(job)? {
                Some(job) => item_row(fields, job.collection),
                None => Err(fields.damaged("job_id", format!("no job {job}"))),
            }
        })
    }

    /// The reply to a request, if it was answered and the reply is still kept.
    pub fn request(&self, client_id: &str, request_id: &str) -> Result<Option<RequestRow>> {
        let tail = "WHERE client_id = ?1 AND request_id = ?2";
        self.first(&REQUESTS, tail, [client_id, request_id], |fields| {
            Ok(RequestRow {
                client_id: fields.get("client_id")?,
                request_id: fields.get("request_id")?,
                request_digest: fields.get("request_digest")?,
                reply: fields.get("reply")?,
                created_unix_secs: fields.get("created")?,
            })
        })
    }
}

fn item_row(fields: &Fields<'_>, collection: String) -> Result<JobItemRow> {
    Ok(JobItemRow {
        job: fields.get("job_id")?,
        index: fields.get("idx")?,
        collection,
        item: NewJobItem {
            name: fields.get("name")?,
            original_digest: fields.get::<Digest>("original_digest")?,
            format: fields.get("format")?,
            replace: fields.get("replace_existing")?,
        },
        status: fields.get("status")?,
        detail_json: fields.get("detail")?,
    })
}

impl Tx<'_> {
    /// Accepts shapes, whose original bytes must be catalogued; returns the id of their job.
    pub fn insert_job(
        &self,
        collection: &str,
        created_unix_secs: u64,
        items: &[NewJobItem],
    ) -> Result<u64> {
        let row = params![None::<i64>, collection, created_unix_secs];
        let job = self.insert(&JOBS, collection, row)?;
        for (index, item) in items.iter().enumerate() {
            self.require_original(&item.original_digest)?;
            let row = params![
                job,
                index as u64,
                item.name,
                item.original_digest,
                item.format,
                item.replace,
                ItemStatus::Queued,
                None::<String>,
            ];
            self.insert(&JOB_ITEMS, format!("{job}, {index}"), row)?;
        }
        Ok(job.unsigned_abs())
    }

    /// Sets the status of an item.
    pub fn set_item(
        &self,
        job: u64,
        index: u32,
        status: ItemStatus,
        detail_json: Option<&str>,
    ) -> Result<()> {
        let sql = "UPDATE job_items SET status = ?3, detail = ?4 WHERE job_id = ?1 AND idx = ?2";
        let key = format!("{job}, {index}");
        self.change(
            &JOB_ITEMS,
            key,
            sql,
            params![job, index, status, detail_json],
        )
    }

    /// Deletes jobs without queued items that were accepted before a moment; returns their number.
    pub fn purge_jobs(&self, created_before_unix_secs: u64) -> Result<u64> {
        let sql = "DELETE FROM jobs WHERE created < ?1 AND NOT EXISTS (
                     SELECT 1 FROM job_items WHERE job_id = jobs.id AND status = 'queued')";
        let before = i64::try_from(created_before_unix_secs).unwrap_or(i64::MAX);
        Ok(self.execute(sql, [before])? as u64)
    }

    /// Stores the reply to a request, in the transaction of its effect.
    pub fn put_request(&self, row: &RequestRow) -> Result<()> {
        let key = format!("{}, {}", row.client_id, row.request_id);
        let row = params![
            row.client_id,
            row.request_id,
            row.request_digest,
            row.reply,
            row.created_unix_secs,
        ];
        self.insert(&REQUESTS, key, row)?;
        Ok(())
    }

    /// Deletes replies older than `keep_secs`, which counts as at least 24 h; returns their number.
    ///
    /// Call it about hourly, before [`Tx::purge_jobs`]. If the wall clock has jumped since the last
    /// call (or a day has passed without a call), replies and jobs do not age for that time, so
    /// that a jump deletes none.
    pub fn purge_requests(&self, now_unix_secs: u64, keep_secs: u64) -> Result<u64> {
        let now = now_unix_secs.min(i64::MAX as u64);
        let last = self
            .meta(PURGED_AT)?
            .and_then(|text| text.parse::<u64>().ok())
            .unwrap_or(now);
        if now < last || now - last >= REQUEST_AGE_SECS {
            let jump = now as i64 - last as i64;
            self.execute(
                "UPDATE requests SET created = min(created + ?1, ?2)",
                [jump, now as i64],
            )?;
            self.execute(
                "UPDATE jobs SET created = min(created + ?1, ?2)",
                [jump, now as i64],
            )?;
        }
        self.set_meta(PURGED_AT, &now.to_string())?;
        let before = now.saturating_sub(keep_secs.max(REQUEST_AGE_SECS));
        Ok(self.execute("DELETE FROM requests WHERE created < ?1", [before])? as u64)
    }
}
