//! Jobs for the operator: attempts that failed, jobs that failed, and trying again.

use super::rows::{CollectionState, to_json};
use super::{Carrying, Job, JobItem, Library, LibraryError, Result};
use crate::store::{ItemStatus, ObjectKind};
use serde::{Deserialize, Serialize};
use std::time::{SystemTime, UNIX_EPOCH};

/// Jobs that are over are kept this long, and so are the bytes of shapes that failed.
const JOB_AGE_SECS: u64 = 30 * 24 * 60 * 60;
/// Replies are kept this long.
const REPLY_AGE_SECS: u64 = 7 * 24 * 60 * 60;

/// What is kept of an item that is still queued.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Attempts {
    /// How often the work on it ended its process.
    pub(super) attempts: u32,
    /// How the last time.
    why: String,
}

/// Which jobs to list.
#[derive(Debug, Clone, Default)]
pub struct JobFilter {
    /// Only those of which a shape failed, with only the failed shapes.
    pub failed: bool,
    /// Only those older than this one; 0: from the newest.
    pub before: u64,
    /// Only those of one collection.
    pub collection: Option<String>,
}

impl Library {
    /// How far the correction of a job is carried. Nothing is left of it once the collection is gone, or once a later
    /// change has taken its place.
    pub(super) fn carrying(&self, job: u64, collection: &str) -> Result<Carrying> {
        self.store.catalog().read(|r| -> Result<Carrying> {
            let Some(row) = r.collection(collection)? else {
                return Ok(Carrying::default());
            };
            let state = CollectionState::of(&row)?;
            let newest = state.carrying.filter(|c| c.job == job);
            let n_stale = r.n_stale(row.id)?;
            Ok(newest.map_or_else(Carrying::default, |c| Carrying {
                n_shapes: c.n_shapes,
                n_left: n_stale.min(c.n_shapes),
            }))
        })
    }

    /// Notes durably that the work on an item ended its process once more; how often now.
    ///
    /// # Errors
    /// The catalog cannot be written.
    pub fn note_attempt(&self, item: &JobItem, why: &str) -> Result<u32> {
        self.store.catalog().write(|tx| {
            let row = tx.job_item(item.job, item.index)?;
            let Some(row) = row.filter(|r| r.status == ItemStatus::Queued) else {
                // Cancelled meanwhile.
                return Ok(0);
            };
            let attempts = self.item(row)?.attempts + 1;
            let why = why.to_owned();
            let detail = to_json(&Attempts { attempts, why });
            tx.set_item(item.job, item.index, ItemStatus::Queued, Some(&detail))?;
            Ok(attempts)
        })
    }

    /// Jobs, newest first, at most `limit`.
    ///
    /// # Errors
    /// The catalog cannot be read.
    pub fn jobs(&self, filter: &JobFilter, limit: usize) -> Result<Vec<Job>> {
        let before = if filter.before == 0 {
            u64::MAX
        } else {
            filter.before
        };
        let found = self.store.catalog().read(|r| -> Result<Vec<_>> {
            let jobs = r.jobs(before, filter.failed, filter.collection.as_deref(), limit)?;
            let with_items = |job: crate::store::rows::JobRow| Ok((r.job_items(job.id)?, job));
            jobs.into_iter().map(with_items).collect()
        })?;
        let is_listed = |status| !filter.failed || status == ItemStatus::Failed;
        found
            .into_iter()
            .map(|(items, job)| {
                let is_carrying = items.is_empty();
                let items = items.into_iter().filter(|i| is_listed(i.status));
                Ok(Job {
                    carrying: if is_carrying {
                        Some(self.carrying(job.id, &job.collection)?)
                    } else {
                        None
                    },
                    id: job.id,
                    collection: job.collection,
                    items: items.map(|i| self.item(i)).collect::<Result<_>>()?,
                })
            })
            .collect()
    }

    /// Queues the failed items of a job again, with all attempts before them; the job, and which items.
    ///
    /// # Errors
    /// There is no such job, or the bytes of a failed shape are kept no longer.
    pub fn retry(&self, job: u64) -> Result<(Job, Vec<JobItem>)> {
        self.job(job)?;
        let queued = self.store.catalog().write(|tx| -> Result<Vec<u32>> {
            let mut queued = Vec::new();
            for row in tx.job_items(job)? {
                if row.status != ItemStatus::Failed {
                    continue;
                }
                if tx
                    .object(ObjectKind::Original, &row.item.original_digest)?
                    .is_none()
                {
                    return Err(LibraryError::FailedPrecondition {
                        reason: "ORIGINAL_GONE",
                        message: format!(
                            "the bytes of shape {:?} are kept no longer; add it again",
                            row.item.name
                        ),
                    });
                }
                tx.set_item(job, row.index, ItemStatus::Queued, None)?;
                queued.push(row.index);
            }
            Ok(queued)
        })?;
        let job = self.job(job)?;
        let items = job.items.iter().filter(|i| queued.contains(&i.index));
        let items = items.cloned().collect();
        Ok((job, items))
    }

    /// Forgets replies and jobs that are so old that nobody asks for them. To be called about hourly; a clock that
    /// jumps makes nothing older.
    ///
    /// # Errors
    /// The catalog cannot be written.
    pub fn forget_old(&self) -> Result<(u64, u64)> {
        let now = SystemTime::now().duration_since(UNIX_EPOCH);
        let now = now.map_or(0, |d| d.as_secs());
        self.store.catalog().write(|tx| {
            let replies = tx.purge_requests(now, REPLY_AGE_SECS)?;
            Ok((replies, tx.purge_jobs(now.saturating_sub(JOB_AGE_SECS))?))
        })
    }
}
