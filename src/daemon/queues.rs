//! Accepted shapes enter the placement queue of their collection; a queue is made for the first
//! one.

use crate::daemon::placing;
use crate::daemon::progress::Waiting;
use crate::daemon::shared::Daemon;
use crate::daemon::work::Step;
use crate::ipc::convert;
use crate::library::Job;
use std::sync::Arc;
use tokio::sync::mpsc;

impl Daemon {
    /// Begins the work on the shapes of an accepted job, unless that was done before.
    pub(crate) fn begin(self: &Arc<Self>, job: &Job, n_bytes: &[u64]) {
        if self.work.progress().is_known(job.id) {
            return;
        }
        let items = job.items.iter().zip(n_bytes);
        self.resume_items(
            items
                .map(|(item, &n_bytes)| Waiting {
                    item: item.clone(),
                    n_bytes,
                })
                .collect(),
        );
    }

    /// Begins, or resumes, the work on shapes in the order given.
    pub(crate) fn resume_items(self: &Arc<Self>, items: Vec<Waiting>) {
        for waiting in items {
            if convert::job_finished(&waiting.item.state) {
                continue;
            }
            self.ensure_queue(&waiting.item.collection);
            let mut progress = self.work.progress();
            // Without a queue the daemon drains, and the shape is resumed at the next start.
            if progress.queue(&waiting.item.collection).is_some() {
                progress.push(waiting);
            }
        }
        self.work.changed();
        self.work.notify_arrival();
    }

    /// Relabels stale shapes of the collection, after a commit that may have made some stale.
    pub(crate) fn nudge(self: &Arc<Self>, collection: &str) {
        self.ensure_queue(collection);
        if let Some(queue) = self.work.progress().queue(collection) {
            // A queue ends only when the daemon does.
            let _ = queue.send(Step::Relabel);
        }
        self.work.changed();
    }

    fn ensure_queue(self: &Arc<Self>, collection: &str) {
        let mut progress = self.work.progress();
        if self.is_draining() || progress.queue(collection).is_some() {
            return;
        }
        let (sender, steps) = mpsc::unbounded_channel();
        progress.add_queue(collection, sender);
        let placing = placing::place_in_order(Arc::clone(self), collection.to_owned(), steps);
        self.work.spawn_placing(placing);
    }

    /// Cancels the shapes of a job that are not placed, after the catalog did.
    pub(crate) fn forget_cancelled(&self, job: &Job) {
        let mut progress = self.work.progress();
        progress.cancel(job.id);
        progress.drop_waiting(job.id, |index| {
            job.items
                .iter()
                .any(|i| i.index == index && convert::job_finished(&i.state))
        });
        drop(progress);
        self.work.changed();
    }
}
