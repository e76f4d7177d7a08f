//! Reads jobs, counts failed attempts, and retries failed jobs.

use super::collection::State;
use super::error::{LibraryError, Named, Result};
use super::facade::Library;
use super::reason::Reason;
use super::rows::{damaged, from_json, to_json};
use super::types::{ItemState, Job, JobItem, PropagationProgress};
use crate::store::{ItemStatus, JobItemRow, ObjectKind, Tx};
use serde::{Deserialize, Serialize};
use std::sync::PoisonError;
use std::time::{SystemTime, UNIX_EPOCH};

/// Age until which finished jobs, and the bytes of shapes that failed, are stored.
const JOB_AGE_SECS: u64 = 30 * 24 * 60 * 60;
/// Age until which replies are stored.
const REPLY_AGE_SECS: u64 = 7 * 24 * 60 * 60;

/// The stored detail of an item that is still queued.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct Attempts {
    /// Number of times that the work on the item ended its process.
    pub(super) attempts: u32,
    /// How the work ended most recently.
    why: String,
}

/// Selects jobs to list.
#[derive(Debug, Clone, Default)]
pub struct JobFilter {
    /// Selects only jobs with a failed shape, and only their failed shapes.
    pub failed: bool,
    /// Selects only jobs older than this one; 0 begins with the newest.
    pub before: u64,
    /// Selects only jobs of one collection.
    pub collection: Option<String>,
}

impl Library {
    /// Returns the progress of the propagation of a job's correction. Nothing remains to be done
    /// once the collection is deleted, or once a later change has replaced the correction.
    pub(super) fn propagation(&self, job: u64, collection: &str) -> Result<PropagationProgress> {
        self.store
            .catalog()
            .read(|r| -> Result<PropagationProgress> {
                let Some(row) = r.collection(collection)? else {
                    return Ok(PropagationProgress::default());
                };
                let state = State::of(&row)?;
                let newest = state.propagation.filter(|c| c.job == job);
                let n_stale = r.n_stale(row.id)?;
                Ok(
                    newest.map_or_else(PropagationProgress::default, |c| PropagationProgress {
                        n_shapes: c.n_shapes,
                        n_left: n_stale.min(c.n_shapes),
                    }),
                )
            })
    }

    pub(super) fn item_row(&self, item: &JobItem) -> Result<JobItemRow> {
        let row = self
            .store
            .catalog()
            .read(|r| r.job_item(item.job, item.index).map_err(LibraryError::from))?;
        row.ok_or_else(|| {
            let name = format!("{} of job {}", item.index, item.job);
            LibraryError::not_found(Named::JobItem, name)
        })
    }

    pub(super) fn item(&self, row: JobItemRow) -> Result<JobItem> {
        let location = format!("job_items {}, {}", row.job, row.index);
        let detail = || {
            row.detail_json
                .as_deref()
                .ok_or_else(|| damaged(&location, "no detail"))
        };
        let attempts = match (row.status, &row.detail_json) {
            (ItemStatus::Queued, Some(detail)) => {
                from_json::<Attempts>(detail, &location)?.attempts
            }
            _ => 0,
        };
        let state = match row.status {
            ItemStatus::Queued => {
                let running = self.running.lock().unwrap_or_else(PoisonError::into_inner);
                let stage = running.get(&(row.job, row.index)).cloned();
                stage.map_or(ItemState::Queued, ItemState::Running)
            }
            ItemStatus::Done => ItemState::Done(Box::new(from_json(detail()?, &location)?)),
            ItemStatus::Failed => ItemState::Failed(from_json(detail()?, &location)?),
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

    /// Returns a job.
    ///
    /// # Errors
    /// There is no job of this id.
    pub fn job(&self, id: u64) -> Result<Job> {
        let (job, items) = self.store.catalog().read(|r| -> Result<_> {
            let job = r.job(id)?;
            let job = job.ok_or_else(|| LibraryError::not_found(Named::Job, id.to_string()))?;
            Ok((job, r.job_items(id)?))
        })?;
        let propagation = if items.is_empty() {
            Some(self.propagation(id, &job.collection)?)
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
            propagation,
        })
    }

    /// Returns the items that are not done, in order of acceptance. A daemon resumes them when it
    /// starts.
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

    /// Durably counts another attempt on an item that ended its process. Returns the new count.
    ///
    /// # Errors
    /// The catalog cannot be written.
    pub fn note_attempt(&self, item: &JobItem, why: &str) -> Result<u32> {
        self.store.catalog().write(|tx| {
            let row = tx.job_item(item.job, item.index)?;
            let Some(row) = row.filter(|r| r.status == ItemStatus::Queued) else {
                // The item was cancelled meanwhile.
                return Ok(0);
            };
            let attempts = self.item(row)?.attempts + 1;
            let why = why.to_owned();
            let detail = to_json(&Attempts { attempts, why });
            tx.set_item(item.job, item.index, ItemStatus::Queued, Some(&detail))?;
            Ok(attempts)
        })
    }

    /// Returns at most `limit` jobs, newest first.
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
                    propagation: if is_carrying {
                        Some(self.propagation(job.id, &job.collection)?)
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

    /// Queues the failed items of a job again and resets the count of their attempts. Returns the
    /// job and these items.
    ///
    /// # Errors
    /// There is no such job, or the bytes of a failed shape are no longer stored.
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
                        reason: Reason::OriginalGone,
                        message: format!(
                            "the bytes of shape {:?} are no longer stored; add it again",
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

    /// Deletes replies and jobs beyond their age. Call it about hourly. A clock that jumps makes
    /// nothing older.
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
