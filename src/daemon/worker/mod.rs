//! Shapes are described and placed, and requests that compute are answered, in processes of their own, so that no shape
//! can take the daemon down.
//!
//! A worker is the same program again (`coseg worker`): it reads what is to be done from stdin,
//! does it ([`inside`]), and writes stages and the outcome to stdout, one piece of work after the
//! other. A panic is caught in it and is that shape's failure, or that request's. What ends the
//! process (an abort, a stack overflow, more memory than it may hold) or holds it beyond the time
//! allowed costs one process; the next shape gets a new one.
//!
//! Workers that describe see bytes only. Those that place or answer open the library beside the daemon, which keeps its
//! own hands off a collection while one of them changes it; a worker that is killed in the middle of a commit leaves what
//! a crash leaves: nothing, or all of it.

mod answers;
mod inside;
mod process;

pub(crate) use answers::subjects;
pub(crate) use inside::{Outcome, Said, outcome, panicked, read_answer};
pub(crate) use process::Ended;

pub use inside::{POISON_VARIABLE, run_worker};

use crate::library::isolate::{self, DescribeJob, Described};
use bytes::{Buf as _, Bytes};
use process::{Fallen, Process};
use serde_json::{Value, json};
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

/// The subcommand that is a worker.
pub const WORKER_COMMAND: &str = "worker";
/// How long the first worker may take to start.
const FIRST_START: Duration = Duration::from_secs(30);
/// How long starting a worker is tried, when the machine has no process, thread or memory left for
/// it; and the delay before it is tried again, doubled each time.
const START_PATIENCE: Duration = Duration::from_secs(60);
const START_AGAIN: Duration = Duration::from_millis(100);
/// A worker that has described a larger file is not used again: its memory is given back.
const LARGE_FILE: usize = 8 << 20;
/// Memory that a worker may hold beyond what the work is estimated to take: what the allocator
/// keeps, and meshes whose spectrum has thousands of equal eigenvalues.
const MEMORY_MARGIN: u64 = 768 << 20;
/// Memory for placing, beside what reading the mesh file again takes: the arrays of forty
/// representatives and what discovery keeps of them.
const PLACE_MEMORY: u64 = 2 << 30;
/// Threads of all workers together, for each processor.
const THREADS_PER_PROCESSOR: usize = 2;
/// A frame from a worker is never longer: a description of the largest file.
const MAX_FRAME: u64 = 4 << 30;

const READY: u8 = b'r';
const STAGE: u8 = b's';
const OUTCOME: u8 = b'o';

/// What is to be done in a worker that opens the library.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Placing<'a> {
    /// Place the shape that was handed over ([`crate::Library::hand_over`]), whose file has so many bytes.
    Place(&'a Value, u64),
    /// Label one stale shape of a collection anew.
    Relabel(&'a str),
}

/// Workers that wait for work.
pub(crate) struct Pool {
    describing: Mutex<Vec<Process>>,
    placing: Mutex<Idle>,
    /// As urgent as the daemon, which the others give way to.
    answering: Mutex<Idle>,
    library: PathBuf,
    n_workers: usize,
    threads: usize,
}

/// Processes with the collection that each has served last, and still knows.
type Idle = Vec<(String, Process)>;

fn locked<T>(kept: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    // Processes are pushed and popped, which nothing interrupts half-way.
    kept.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Pool {
    /// Starts the first worker, to see that it can be. `library` is the folder of the open library.
    pub(crate) fn new(library: &Path, n_workers: usize) -> io::Result<Self> {
        let processors = std::thread::available_parallelism().map_or(1, usize::from);
        let threads = THREADS_PER_PROCESSOR * processors / n_workers.max(1);
        let pool = Self {
            describing: Mutex::default(),
            placing: Mutex::default(),
            answering: Mutex::default(),
            library: library.to_path_buf(),
            n_workers: n_workers.max(1),
            threads: threads.clamp(1, processors),
        };
        let first = Process::start(pool.threads)?.ready(FIRST_START);
        locked(&pool.describing).push(first.map_err(io::Error::other)?);
        Ok(pool)
    }

    /// Ends the workers that wait for work.
    pub(crate) fn close(&self) {
        locked(&self.describing).clear();
        locked(&self.placing).clear();
        locked(&self.answering).clear();
    }

    /// Runs work that may hold so many bytes of `memory`, in the process that was kept or in
    /// another. A process that ends while it has nothing to do, or cannot be started, is not the
    /// fault of the work, and another is tried.
    fn run(
        &self,
        kept: Option<Process>,
        work: &Work<'_>,
        stage: &dyn Fn(&str),
        wanted: &dyn Fn() -> bool,
    ) -> Result<(Vec<u8>, Process), Ended> {
        let mut header = work.header.clone();
        header["memory"] = json!(work.memory);
        let mut kept = kept.and_then(Process::still_there);
        let (begin, mut delay) = (Instant::now(), START_AGAIN);
        loop {
            let process = kept.take().map_or_else(|| Process::start(self.threads), Ok);
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

    /// Describes in a worker. `memory` is what the work is estimated to take; `stage` is told each stage, and
    /// the work goes on for as long as `wanted` says so.
    pub(crate) fn describe(
        &self,
        job: &DescribeJob<'_>,
        memory: u64,
        stage: &dyn Fn(&str),
        wanted: &dyn Fn() -> bool,
    ) -> Result<Described, Ended> {
        let kept = locked(&self.describing).pop();
        let work = Work {
            header: job.header(),
            bytes: job.bytes,
            memory: MEMORY_MARGIN + 2 * memory,
        };
        let (outcome, process) = self.run(kept, &work, stage, wanted)?;
        let outcome = isolate::decode(&outcome).map_err(|e| Ended::died(e.to_string()))?;
        if job.bytes.len() <= LARGE_FILE {
            locked(&self.describing).push(process);
        }
        Ok(outcome)
    }

    /// Places, or labels anew, in a worker. Whoever calls this keeps this process from using the collection.
    pub(crate) fn place(
        &self,
        collection: &str,
        work: Placing<'_>,
        wanted: &dyn Fn() -> bool,
    ) -> Result<Value, Ended> {
        let mut header = json!({ "library": self.library });
        let mut memory = PLACE_MEMORY;
        match work {
            Placing::Place(handed, n_bytes) => {
                header["place"] = handed.clone();
                // Where boundaries are refined, the file is read once more.
                let reading = crate::config::Limits::to_describe(n_bytes);
                memory += 2 * reading;
            }
            Placing::Relabel(collection) => header["relabel"] = json!(collection),
        }
        let work = Work {
            header,
            bytes: &[],
            memory,
        };
        let outcome = self.beside(&self.placing, collection, &work, wanted)?;
        serde_json::from_slice(&outcome).map_err(|e| Ended::died(e.to_string()))
    }

    /// Answers a request in a worker; what [`read_answer`] reads comes back. Whoever calls this for a change keeps this
    /// process from using the collection.
    pub(crate) fn answer(
        &self,
        collection: &str,
        work: &Answering<'_>,
        wanted: &dyn Fn() -> bool,
    ) -> Result<Vec<Bytes>, Ended> {
        let header = json!({ "library": self.library, "answer": work.max_bytes });
        let sent = joined(
            [work.request]
                .into_iter()
                .chain(work.frames.iter().map(Bytes::as_ref)),
        );
        let work = Work {
            header,
            bytes: &sent,
            memory: PLACE_MEMORY + 2 * work.memory,
        };
        let outcome = self.beside(&self.answering, collection, &work, wanted)?;
        taken_apart(outcome).map_err(|e| Ended::died(e.to_string()))
    }

    /// Runs work in a process that opens the library.
    fn beside(
        &self,
        idle: &Mutex<Idle>,
        collection: &str,
        work: &Work<'_>,
        wanted: &dyn Fn() -> bool,
    ) -> Result<Vec<u8>, Ended> {
        let kept = {
            let mut idle = locked(idle);
            let at = idle.iter().rposition(|(served, _)| served == collection);
            // Starting another is dearer than learning another collection.
            at.or(idle.len().checked_sub(1)).map(|at| idle.remove(at).1)
        };
        let (outcome, process) = self.run(kept, work, &|_| {}, wanted)?;
        let mut idle = locked(idle);
        if idle.len() < self.n_workers {
            idle.push((collection.to_owned(), process));
        }
        Ok(outcome)
    }
}

/// What a process is sent, and what it may hold.
struct Work<'a> {
    header: Value,
    bytes: &'a [u8],
    /// Bytes beyond what it holds before.
    memory: u64,
}

/// A request for a worker.
pub(crate) struct Answering<'a> {
    /// The encoded request, with its key but without frames.
    pub(crate) request: &'a [u8],
    /// The raw frames that came with it.
    pub(crate) frames: &'a [Bytes],
    /// Memory that the work is estimated to take.
    pub(crate) memory: u64,
    /// Bytes that the frames of the answer may have.
    pub(crate) max_bytes: u64,
}

/// Pieces as one, each after its length.
fn joined<'a>(pieces: impl IntoIterator<Item = &'a [u8]>) -> Vec<u8> {
    let mut out = Vec::new();
    for piece in pieces {
        out.extend_from_slice(&(piece.len() as u64).to_le_bytes());
        out.extend_from_slice(piece);
    }
    out
}

/// The same back, not copied.
fn taken_apart(joined: Vec<u8>) -> io::Result<Vec<Bytes>> {
    let mut rest = Bytes::from(joined);
    let mut pieces = Vec::new();
    while !rest.is_empty() {
        let length = rest.try_get_u64_le().map_err(io::Error::other)?;
        let length = usize::try_from(length).ok().filter(|n| *n <= rest.len());
        pieces.push(rest.split_to(length.ok_or(io::ErrorKind::UnexpectedEof)?));
    }
    Ok(pieces)
}

fn read_u64(input: &mut impl Read) -> io::Result<u64> {
    let mut bytes = [0; 8];
    input.read_exact(&mut bytes)?;
    Ok(u64::from_le_bytes(bytes))
}

fn read_bytes(input: &mut impl Read) -> io::Result<Vec<u8>> {
    let length = read_u64(input)?;
    if length > MAX_FRAME {
        return Err(io::Error::other(format!("a frame of {length} bytes")));
    }
    let mut bytes = Vec::new();
    // Not allocated before it is there.
    input.take(length).read_to_end(&mut bytes)?;
    if bytes.len() as u64 == length {
        Ok(bytes)
    } else {
        Err(io::ErrorKind::UnexpectedEof.into())
    }
}

fn read_frame(input: &mut impl Read) -> io::Result<(u8, Vec<u8>)> {
    let mut kind = [0];
    input.read_exact(&mut kind)?;
    Ok((kind[0], read_bytes(input)?))
}

#[cfg(test)]
mod tests {
    use super::{joined, taken_apart};

    #[test]
    fn pieces_come_back_and_cut_ones_do_not() {
        let pieces: [&[u8]; 3] = [b"a header", b"", &[7; 300]];
        let whole = joined(pieces);
        assert_eq!(taken_apart(whole.clone()).unwrap(), pieces);
        assert!(taken_apart(Vec::new()).unwrap().is_empty());
        let cut = (0..whole.len()).filter(|end| taken_apart(whole[..*end].to_vec()).is_ok());
        // Between two pieces nothing is missing.
        assert_eq!(cut.collect::<Vec<_>>(), [0, 16, 24]);
    }
}
