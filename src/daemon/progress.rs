//! The state of jobs in this process: stages, revisions, cancellations.
//!
//! The catalog holds what is durable. The stage of a shape is not, and is held here.

use crate::library::JobItem;
use std::collections::{BTreeMap, HashMap, VecDeque};
use tokio::sync::mpsc;

/// A shape that waits to be described.
#[derive(Debug, Clone)]
pub(crate) struct Waiting {
    pub(crate) item: JobItem,
    /// Bytes of its file.
    pub(crate) n_bytes: u64,
}

/// Bytes of a file that take about as long as a shape takes whatever its size.
const UNIT_BYTES: f64 = (512_u64 << 10) as f64;
/// Seconds of a unit of work before any was done.
const FIRST_PACE: f64 = 0.5;
/// Share of the newest shape in the pace.
const PACE_WEIGHT: f64 = 0.1;

fn units_of(n_shapes: usize, n_bytes: u64) -> f64 {
    n_shapes as f64 + n_bytes as f64 / UNIT_BYTES
}

/// Accepted shapes that are not placed, with an estimate of the time that they take.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Load {
    pub(crate) n_shapes: usize,
    pub(crate) n_bytes: u64,
    units: f64,
    pace: f64,
}

impl Load {
    /// Seconds until all of it is placed.
    pub(crate) fn seconds(&self) -> f64 {
        self.units * self.pace
    }

    /// Seconds for shapes of together `n_bytes` more.
    pub(crate) fn seconds_of(&self, n_shapes: usize, n_bytes: u64) -> f64 {
        units_of(n_shapes, n_bytes) * self.pace
    }
}

/// A job of which something is left to do.
#[derive(Debug, Default)]
struct LiveJob {
    revision: u64,
    n_live: usize,
    stages: HashMap<u32, String>,
    cancelled: bool,
}

/// Shapes of one collection that wait to be described, and the way to its placement queue.
struct Queue<S> {
    waiting: VecDeque<Waiting>,
    n_live: usize,
    steps: mpsc::UnboundedSender<S>,
}

/// All accepted shapes that are not placed yet. `S` is a message to a placement queue.
pub(crate) struct Progress<S> {
    queues: HashMap<String, Queue<S>>,
    /// Collections with waiting shapes; the first has the turn.
    turns: VecDeque<String>,
    jobs: HashMap<u64, LiveJob>,
    /// Bytes of the file of each live shape, by job and index.
    sizes: HashMap<(u64, u32), u64>,
    /// Room that is reserved: shapes, and bytes of their files.
    reserved: (usize, u64),
    /// Seconds that a unit of work has taken lately.
    pace: f64,
    /// Jobs are numbered in order of acceptance; this is the last one added.
    highest_job: u64,
    /// Counts changes, so that a job that is resumed after a restart does not repeat its revisions
    /// soon.
    n_changes: u64,
}

impl<S> Progress<S> {
    pub(crate) fn new() -> Self {
        Self {
            queues: HashMap::new(),
            turns: VecDeque::new(),
            jobs: HashMap::new(),
            sizes: HashMap::new(),
            reserved: (0, 0),
            pace: FIRST_PACE,
            highest_job: 0,
            n_changes: 0,
        }
    }

    /// The way to the placement queue of `collection`, if there is one.
    pub(crate) fn queue(&self, collection: &str) -> Option<&mpsc::UnboundedSender<S>> {
        self.queues.get(collection).map(|l| &l.steps)
    }

    pub(crate) fn add_queue(&mut self, collection: &str, steps: mpsc::UnboundedSender<S>) {
        let queue = Queue {
            waiting: VecDeque::new(),
            n_live: 0,
            steps,
        };
        self.queues.insert(collection.to_owned(), queue);
    }

    /// Lets all queues end after the steps that were sent to them.
    pub(crate) fn close(&mut self) {
        self.queues.clear();
        self.turns.clear();
    }

    /// Lets the queue of a collection that is gone end, unless it still has something to do.
    pub(crate) fn remove_idle_queue(&mut self, collection: &str) {
        if self.queues.get(collection).is_some_and(|l| l.n_live == 0) {
            self.queues.remove(collection);
        }
    }

    /// Whether a job was added before, as when its request is repeated.
    pub(crate) fn is_known(&self, job: u64) -> bool {
        job <= self.highest_job
    }

    /// Adds a shape after all others of its collection, whose queue must exist.
    pub(crate) fn push(&mut self, waiting: Waiting) {
        let (job, collection) = (waiting.item.job, waiting.item.collection.clone());
        self.highest_job = self.highest_job.max(job);
        let queue = self
            .queues
            .get_mut(&collection)
            .expect("invariant: queues come before shapes");
        if queue.waiting.is_empty() {
            self.turns.push_back(collection);
        }
        let place = (job, waiting.item.index);
        self.sizes.insert(place, waiting.n_bytes);
        queue.waiting.push_back(waiting);
        queue.n_live += 1;
        self.jobs.entry(job).or_default().n_live += 1;
        self.touch(job);
    }

    /// The next shape to describe: collections take turns.
    pub(crate) fn pop(&mut self) -> Option<(Waiting, mpsc::UnboundedSender<S>)> {
        while let Some(collection) = self.turns.pop_front() {
            let Some(queue) = self.queues.get_mut(&collection) else {
                continue;
            };
            let Some(waiting) = queue.waiting.pop_front() else {
                continue;
            };
            let steps = queue.steps.clone();
            if !queue.waiting.is_empty() {
                self.turns.push_back(collection);
            }
            return Some((waiting, steps));
        }
        None
    }

    /// Drops the waiting shapes of a job that `is_over` says are over.
    pub(crate) fn drop_waiting(&mut self, job: u64, is_over: impl Fn(u32) -> bool) {
        let mut dropped = Vec::new();
        for queue in self.queues.values_mut() {
            queue.waiting.retain(|w| {
                let over = w.item.job == job && is_over(w.item.index);
                if over {
                    dropped.push(w.item.clone());
                }
                !over
            });
        }
        for item in &dropped {
            self.finish(item);
        }
    }

    /// Notes the stage that a shape is at.
    pub(crate) fn set_stage(&mut self, item: &JobItem, stage: &str) {
        if let Some(job) = self.jobs.get_mut(&item.job) {
            job.stages.insert(item.index, stage.to_owned());
            self.touch(item.job);
        }
    }

    /// Nothing of this shape is left to do.
    pub(crate) fn finish(&mut self, item: &JobItem) {
        self.sizes.remove(&(item.job, item.index));
        if let Some(queue) = self.queues.get_mut(&item.collection) {
            queue.n_live = queue.n_live.saturating_sub(1);
        }
        self.touch(item.job);
        if let Some(job) = self.jobs.get_mut(&item.job) {
            job.stages.remove(&item.index);
            job.n_live = job.n_live.saturating_sub(1);
            if job.n_live == 0 {
                self.jobs.remove(&item.job);
            }
        }
    }

    pub(crate) fn cancel(&mut self, job: u64) {
        if let Some(live) = self.jobs.get_mut(&job) {
            live.cancelled = true;
            self.touch(job);
        }
    }

    pub(crate) fn is_cancelled(&self, job: u64) -> bool {
        self.jobs.get(&job).is_some_and(|j| j.cancelled)
    }

    /// The revision of a job of which something is left to do.
    pub(crate) fn revision(&self, job: u64) -> Option<u64> {
        self.jobs.get(&job).map(|j| j.revision)
    }

    pub(crate) fn stage(&self, job: u64, index: u32) -> Option<&str> {
        self.jobs.get(&job)?.stages.get(&index).map(String::as_str)
    }

    /// Notes how long a shape has taken, divided by the number of those that are done side by side.
    pub(crate) fn note_pace(&mut self, n_bytes: u64, secs: f64) {
        self.pace += (secs / units_of(1, n_bytes) - self.pace) * PACE_WEIGHT;
    }

    /// Reserves room for shapes that are being added.
    pub(crate) fn reserve(&mut self, n_bytes: &[u64]) {
        self.reserved.0 += n_bytes.len();
        self.reserved.1 += n_bytes.iter().sum::<u64>();
    }

    /// Gives back reserved room.
    pub(crate) fn release(&mut self, n_bytes: &[u64]) {
        self.reserved.0 -= n_bytes.len();
        self.reserved.1 -= n_bytes.iter().sum::<u64>();
    }

    /// Accepted shapes that are not placed, and reserved room.
    pub(crate) fn load(&self) -> Load {
        let n_shapes = self.sizes.len() + self.reserved.0;
        let n_bytes = self.sizes.values().sum::<u64>() + self.reserved.1;
        Load {
            n_shapes,
            n_bytes,
            units: units_of(n_shapes, n_bytes),
            pace: self.pace,
        }
    }

    /// Accepted shapes that are not placed yet, of one collection or of all.
    pub(crate) fn n_live(&self, collection: Option<&str>) -> usize {
        match collection {
            Some(name) => self.queues.get(name).map_or(0, |l| l.n_live),
            None => self.queues.values().map(|l| l.n_live).sum(),
        }
    }

    /// Jobs of which a shape is in work, and jobs that only wait.
    pub(crate) fn n_jobs(&self) -> (usize, usize) {
        let working = self.jobs.values().filter(|j| !j.stages.is_empty()).count();
        (working, self.jobs.len() - working)
    }

    /// Shapes in work at each stage.
    pub(crate) fn n_at_stages(&self) -> BTreeMap<String, usize> {
        let mut counts = BTreeMap::new();
        for stage in self.jobs.values().flat_map(|j| j.stages.values()) {
            *counts.entry(stage.clone()).or_default() += 1;
        }
        counts
    }

    fn touch(&mut self, job: u64) {
        self.n_changes += 1;
        if let Some(live) = self.jobs.get_mut(&job) {
            live.revision = self.n_changes;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{Progress, Waiting};
    use crate::library::{ItemState, JobItem};
    use tokio::sync::mpsc;

    fn waiting(collection: &str, job: u64, index: u32) -> Waiting {
        let item = JobItem {
            job,
            index,
            collection: collection.to_owned(),
            name: format!("{collection}{index}"),
            state: ItemState::Queued,
            attempts: 0,
        };
        Waiting { item, n_bytes: 1 }
    }

    fn progress() -> Progress<()> {
        let mut progress = Progress::new();
        for collection in ["a", "b"] {
            progress.add_queue(collection, mpsc::unbounded_channel().0);
        }
        progress
    }

    #[test]
    fn collections_take_turns_and_keep_their_order() {
        let mut progress = progress();
        for index in 0..3 {
            progress.push(waiting("a", 1, index));
        }
        progress.push(waiting("b", 2, 0));
        let order: Vec<_> = std::iter::from_fn(|| progress.pop())
            .map(|(w, _)| w.item.name)
            .collect();
        assert_eq!(order, ["a0", "b0", "a1", "a2"]);
    }

    #[test]
    fn a_job_lives_until_its_last_shape_is_over() {
        let mut progress = progress();
        progress.push(waiting("a", 7, 0));
        progress.push(waiting("a", 7, 1));
        assert!(progress.is_known(7) && progress.is_known(6) && !progress.is_known(8));
        let before = progress.revision(7).unwrap();
        let (first, _) = progress.pop().unwrap();
        progress.set_stage(&first.item, "spectrum");
        assert_eq!(progress.stage(7, 0), Some("spectrum"));
        assert_eq!(progress.n_jobs(), (1, 0));
        assert_eq!(progress.n_at_stages().get("spectrum"), Some(&1));
        assert!(progress.revision(7).unwrap() > before);
        progress.finish(&first.item);
        assert_eq!((progress.n_live(Some("a")), progress.n_live(None)), (1, 1));
        assert_eq!((progress.load().n_shapes, progress.load().n_bytes), (1, 1));
        let before = progress.load().seconds();
        progress.note_pace(1, 100.0);
        assert!(progress.load().seconds() > before + 5.0);
        progress.cancel(7);
        assert!(progress.is_cancelled(7));
        progress.drop_waiting(7, |index| index == 1);
        assert_eq!((progress.n_live(None), progress.revision(7)), (0, None));
        assert!(progress.pop().is_none());
    }
}
