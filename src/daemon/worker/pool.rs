//! The workers that wait for work, and the work that they are given.

use super::pipe::{MEMORY_MARGIN, join_pieces, split_pieces};
use super::process::{Ended, Fallen, Process};
use crate::config::Limits;
use crate::library::isolate::{self, DescribeJob, Described};
use bytes::Bytes;
use serde_json::{Value, json};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

/// How long the first worker may take to start.
const FIRST_START: Duration = Duration::from_secs(30);
/// How long starting a worker is tried, when the machine has no process, thread or memory left for
/// it; and the delay before it is tried again, doubled each time.
const START_PATIENCE: Duration = Duration::from_secs(60);
const START_AGAIN: Duration = Duration::from_millis(100);
/// A worker that has described a larger file is not used again, so that its memory is released.
const LARGE_FILE: usize = 8 << 20;
/// Memory for placing, beside what reading the mesh file again takes: the arrays of forty
/// representatives and what discovery keeps of them.
const PLACE_MEMORY: u64 = 2 << 30;
/// Threads of all workers together, for each processor.
const THREADS_PER_PROCESSOR: usize = 2;

/// Work on a collection in a worker that opens the library.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Placing<'a> {
    /// Place the shape of this ticket ([`crate::Library::placement_ticket`]), whose file has this
    /// number of bytes.
    Place(&'a Value, u64),
    /// Relabel at most so many stale shapes of a collection, those with these names first.
    Relabel(&'a str, usize, &'a [String]),
    /// Make a step towards the proposals of a collection.
    Propose(&'a str),
}

/// Workers that wait for work.
pub(crate) struct Pool {
    describing: Mutex<Vec<Process>>,
    placing: Mutex<Idle>,
    /// Apart from those that place, since they are ended as soon as anything else is to be done.
    proposing: Mutex<Idle>,
    /// These have the priority of the daemon; the others have a lower one.
    answering: Mutex<Idle>,
    library: PathBuf,
    n_workers: usize,
    threads: usize,
    /// Bytes of prepared shapes that each placing worker keeps.
    prepared_bytes: u64,
}

/// Processes, each with the collection that it served last and has in memory.
type Idle = Vec<(String, Process)>;

fn locked<T>(idle: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    // Processes are pushed and popped, which no panic interrupts.
    idle.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Pool {
    /// Starts the first worker, to see that it can be. `library` is the folder of the open library;
    /// all placing workers together keep `prepared_bytes` of prepared shapes.
    pub(crate) fn new(library: &Path, n_workers: usize, prepared_bytes: u64) -> io::Result<Self> {
        let processors = std::thread::available_parallelism().map_or(1, usize::from);
        let threads = THREADS_PER_PROCESSOR * processors / n_workers.max(1);
        let pool = Self {
            describing: Mutex::default(),
            placing: Mutex::default(),
            proposing: Mutex::default(),
            answering: Mutex::default(),
            library: library.to_path_buf(),
            n_workers: n_workers.max(1),
            threads: threads.clamp(1, processors),
            prepared_bytes: prepared_bytes / n_workers.max(1) as u64,
        };
        let first = Process::start(pool.threads)?.ready(FIRST_START);
        locked(&pool.describing).push(first.map_err(io::Error::other)?);
        Ok(pool)
    }

    /// Ends the workers that wait for work.
    pub(crate) fn close(&self) {
        locked(&self.describing).clear();
        locked(&self.placing).clear();
        locked(&self.proposing).clear();
        locked(&self.answering).clear();
    }

    /// Runs work that may hold so many bytes of `memory`, in the `idle` process or in another. A
    /// process that ends before it has the work, or cannot be started, is not the fault of the
    /// work, and another is tried.
    fn run(
        &self,
        idle: Option<Process>,
        work: &Work<'_>,
        stage: &dyn Fn(&str),
        wanted: &dyn Fn() -> bool,
    ) -> Result<(Vec<u8>, Process), Ended> {
        let mut header = work.header.clone();
        header["memory"] = json!(work.memory);
        let mut idle = idle.and_then(Process::still_running);
        let (begin, mut delay) = (Instant::now(), START_AGAIN);
        loop {
            let process = idle.take().map_or_else(|| Process::start(self.threads), Ok);
            let run = |p: Process| p.run(&header, work.bytes, work.memory, stage, wanted);
            let text = match process.map(run) {
                Ok(Ok(done)) => return Ok(done),
                Ok(Err(Fallen::AtWork(ended))) => return Err(ended),
                Ok(Err(Fallen::BeforeWork(text))) => text,
                Err(e) => e.to_string(),
            };
            if begin.elapsed() >= START_PATIENCE {
                let text = format!("a worker process cannot be started: {text}");
                return Err(Ended::died(text));
            }
            tracing::warn!(text, "a worker process cannot be started; trying again");
            let again = Instant::now() + delay;
            while Instant::now() < again {
                if !wanted() {
                    return Err(Ended::Stopped);
                }
                std::thread::sleep(START_AGAIN);
            }
            delay *= 2;
        }
    }

    /// Describes in a worker. `memory` is the estimate for the work. `stage` is called with each
    /// stage, and the work continues for as long as `wanted` returns true.
    pub(crate) fn describe(
        &self,
        job: &DescribeJob<'_>,
        memory: u64,
        stage: &dyn Fn(&str),
        wanted: &dyn Fn() -> bool,
    ) -> Result<Described, Ended> {
        let idle = locked(&self.describing).pop();
        let work = Work {
            header: job.header(),
            bytes: job.bytes,
            memory: MEMORY_MARGIN + 2 * memory,
        };
        let (outcome, process) = self.run(idle, &work, stage, wanted)?;
        let outcome = isolate::decode(&outcome).map_err(|e| Ended::died(e.to_string()))?;
        if job.bytes.len() <= LARGE_FILE {
            locked(&self.describing).push(process);
        }
        Ok(outcome)
    }

    /// Places, relabels or proposes in a worker. To place or relabel, the caller has exclusive use
    /// of the collection in this process.
    pub(crate) fn place(
        &self,
        collection: &str,
        work: Placing<'_>,
        wanted: &dyn Fn() -> bool,
    ) -> Result<Value, Ended> {
        let mut header = json!({ "library": self.library, "prepared": self.prepared_bytes });
        let mut memory = PLACE_MEMORY;
        let idle = match work {
            Placing::Propose(_) => &self.proposing,
            _ => &self.placing,
        };
        match work {
            Placing::Place(ticket, n_bytes) => {
                header["place"] = ticket.clone();
                // The refinement of boundaries reads the file once more.
                let reading = Limits::to_describe(n_bytes);
                memory += 2 * reading;
            }
            Placing::Relabel(collection, most, first) => {
                header["relabel"] = json!(collection);
                header["first"] = json!(first);
                header["most"] = json!(most);
            }
            Placing::Propose(collection) => header["propose"] = json!(collection),
        }
        let work = Work {
            header,
            bytes: &[],
            memory,
        };
        let outcome = self.run_with_library(idle, collection, &work, wanted)?;
        serde_json::from_slice(&outcome).map_err(|e| Ended::died(e.to_string()))
    }

    /// Runs remote work in a worker, and returns the pieces that
    /// [`read_answer`](super::read_answer) reads. The caller of an edit has exclusive use of the
    /// collection in this process.
    pub(crate) fn answer(
        &self,
        collection: &str,
        work: &RemoteWork<'_>,
        wanted: &dyn Fn() -> bool,
    ) -> Result<Vec<Bytes>, Ended> {
        let header = json!({ "library": self.library, "answer": work.max_bytes });
        let sent = join_pieces(
            [work.request]
                .into_iter()
                .chain(work.frames.iter().map(Bytes::as_ref)),
        );
        let work = Work {
            header,
            bytes: &sent,
            memory: PLACE_MEMORY + 2 * work.memory,
        };
        let outcome = self.run_with_library(&self.answering, collection, &work, wanted)?;
        split_pieces(outcome).map_err(|e| Ended::died(e.to_string()))
    }

    /// Runs work in a process that opens the library.
    fn run_with_library(
        &self,
        idle: &Mutex<Idle>,
        collection: &str,
        work: &Work<'_>,
        wanted: &dyn Fn() -> bool,
    ) -> Result<Vec<u8>, Ended> {
        let process = {
            let mut idle = locked(idle);
            let at = idle.iter().rposition(|(served, _)| served == collection);
            // Starting another process is dearer than reading another collection.
            at.or(idle.len().checked_sub(1)).map(|at| idle.remove(at).1)
        };
        let (outcome, process) = self.run(process, work, &|_| {}, wanted)?;
        let mut idle = locked(idle);
        if idle.len() < self.n_workers {
            idle.push((collection.to_owned(), process));
        }
        Ok(outcome)
    }
}

/// A message to a process, and the memory that it may take.
struct Work<'a> {
    header: Value,
    bytes: &'a [u8],
    /// Bytes beyond those that the process holds before.
    memory: u64,
}

/// A computation or an edit for a worker.
pub(crate) struct RemoteWork<'a> {
    /// The encoded request, with its key but without frames.
    pub(crate) request: &'a [u8],
    /// The raw frames that came with it.
    pub(crate) frames: &'a [Bytes],
    /// The estimate of its memory.
    pub(crate) memory: u64,
    /// Bytes of all frames of the answer.
    pub(crate) max_bytes: u64,
}
