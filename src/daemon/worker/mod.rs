//! Shapes are described and placed, and requests that compute are answered, in processes of their own, so that no shape
//! can take the daemon down.
//!
//! A worker is the same program again (`coseg worker`): it reads what is to be done from stdin, does it ([`inside`]),
//! and writes stages and the outcome to stdout, one piece of work after the other. A panic is caught in it and is
//! that shape's failure, or that request's. What ends the process (an abort, a stack overflow, memory beyond its limit) or holds it
//! beyond the time allowed costs one process; the next shape gets a new one.
//!
//! Workers that describe see bytes only. Those that place or answer open the library beside the daemon, which keeps its
//! own hands off a collection while one of them changes it; a worker that is killed in the middle of a commit leaves what
//! a crash leaves: nothing, or all of it.

mod answers;
mod inside;

pub(crate) use answers::subjects;
pub(crate) use inside::{Outcome, Said, outcome, panicked, read_answer};
pub use inside::{POISON_VARIABLE, run_worker};

use crate::library::isolate::{self, DescribeJob, Described};
use bytes::{Buf as _, Bytes};
use serde_json::{Value, json};
use std::collections::VecDeque;
use std::io::{self, BufRead as _, BufReader, Read, Write as _};
use std::os::unix::process::{CommandExt as _, ExitStatusExt as _};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

/// The subcommand that is a worker.
pub const WORKER_COMMAND: &str = "worker";
/// Between looks at whether the work is still wanted.
const LOOK: Duration = Duration::from_millis(50);
/// A worker that has described a larger file is not used again: its memory is given back.
const LARGE_FILE: usize = 8 << 20;
/// Address space of a worker beyond what the work is estimated to take: stacks, allocator, and meshes whose spectrum
/// has thousands of equal eigenvalues.
const MEMORY_MARGIN: u64 = 768 << 20;
/// Address space for placing, beside what reading the mesh file again takes: the arrays of forty representatives
/// and what discovery keeps of them.
const PLACE_MEMORY: u64 = 2 << 30;
/// Lines of stderr that are kept to say why a worker ended.
const KEPT_LINES: usize = 4;
/// Threads of all workers together, for each processor.
const THREADS_PER_PROCESSOR: usize = 2;
/// A frame from a worker is never longer: a description of the largest file.
const MAX_FRAME: u64 = 4 << 30;

const READY: u8 = b'r';
const STAGE: u8 = b's';
const OUTCOME: u8 = b'o';

/// Why a worker gave no outcome.
#[derive(Debug)]
pub(crate) enum Ended {
    /// The work was not wanted any more; the process was killed.
    Stopped,
    /// The process died.
    Died {
        /// What is known of why.
        text: String,
        /// Memory beyond the limit was asked for.
        out_of_memory: bool,
    },
}

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

struct Process {
    child: Child,
    input: ChildStdin,
    frames: mpsc::Receiver<(u8, Vec<u8>)>,
    said: Arc<Mutex<VecDeque<String>>>,
}

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
        let first = Process::start(pool.threads)?;
        match first.frames.recv_timeout(Duration::from_secs(30)) {
            Ok((READY, _)) => {}
            _ => return Err(io::Error::other(first.into_death().0)),
        }
        locked(&pool.describing).push(first);
        Ok(pool)
    }

    /// Ends the workers that wait for work.
    pub(crate) fn close(&self) {
        locked(&self.describing).clear();
        locked(&self.placing).clear();
        locked(&self.answering).clear();
    }

    fn or_start(&self, kept: Option<Process>) -> Result<Process, Ended> {
        // One that has ended while it had nothing to do is nobody's fault.
        let kept = kept.and_then(Process::still_there);
        let process = kept.map_or_else(|| Process::start(self.threads), Ok);
        process.map_err(|e| Ended::died(format!("a worker process cannot be started: {e}")))
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
        let mut header = job.header();
        header["memory"] = json!(MEMORY_MARGIN + 2 * memory);
        let process = self.or_start(kept)?;
        let (outcome, process) = process.run(&header, job.bytes, stage, wanted)?;
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
        let mut header = json!({ "library": self.library, "memory": PLACE_MEMORY });
        match work {
            Placing::Place(handed, n_bytes) => {
                header["place"] = handed.clone();
                // Where boundaries are refined, the file is read once more.
                let reading = crate::config::Limits::to_describe(n_bytes);
                header["memory"] = json!(PLACE_MEMORY + 2 * reading);
            }
            Placing::Relabel(collection) => header["relabel"] = json!(collection),
        }
        let outcome = self.beside(&self.placing, collection, &header, &[], wanted)?;
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
        let header = json!({
            "library": self.library,
            "memory": PLACE_MEMORY + 2 * work.memory,
            "answer": work.max_bytes,
        });
        let sent = joined(
            [work.request]
                .into_iter()
                .chain(work.frames.iter().map(Bytes::as_ref)),
        );
        let outcome = self.beside(&self.answering, collection, &header, &sent, wanted)?;
        taken_apart(outcome).map_err(|e| Ended::died(e.to_string()))
    }

    /// Runs work in a process that opens the library.
    fn beside(
        &self,
        idle: &Mutex<Idle>,
        collection: &str,
        header: &Value,
        bytes: &[u8],
        wanted: &dyn Fn() -> bool,
    ) -> Result<Vec<u8>, Ended> {
        let kept = {
            let mut idle = locked(idle);
            let at = idle.iter().rposition(|(served, _)| served == collection);
            // Starting another is dearer than learning another collection.
            at.or(idle.len().checked_sub(1)).map(|at| idle.remove(at).1)
        };
        let process = self.or_start(kept)?;
        let (outcome, process) = process.run(header, bytes, &|_| {}, wanted)?;
        let mut idle = locked(idle);
        if idle.len() < self.n_workers {
            idle.push((collection.to_owned(), process));
        }
        Ok(outcome)
    }
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

impl Ended {
    fn died(text: String) -> Self {
        Self::Died {
            text,
            out_of_memory: false,
        }
    }
}

impl Process {
    fn start(threads: usize) -> io::Result<Self> {
        // The program that runs, also if another version has been installed in its place.
        let mut child = Command::new("/proc/self/exe")
            .arg0("coseg")
            .arg(WORKER_COMMAND)
            .env("RAYON_NUM_THREADS", threads.to_string())
            // A backtrace would push what was said before it out of the lines that are kept.
            .env("RUST_BACKTRACE", "0")
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()?;
        let taken = (child.stdin.take(), child.stdout.take(), child.stderr.take());
        let (Some(input), Some(output), Some(errors)) = taken else {
            return Err(io::Error::other("a worker without pipes"));
        };
        let (sender, frames) = mpsc::channel();
        std::thread::Builder::new()
            .name("worker out".to_owned())
            .spawn(move || {
                let mut output = BufReader::new(output);
                while let Ok(frame) = read_frame(&mut output) {
                    if sender.send(frame).is_err() {
                        return;
                    }
                }
            })?;
        let said = Arc::new(Mutex::new(VecDeque::new()));
        let lines = Arc::clone(&said);
        std::thread::Builder::new()
            .name("worker err".to_owned())
            .spawn(move || {
                for line in BufReader::new(errors).lines().map_while(Result::ok) {
                    tracing::debug!(line, "a worker says");
                    let mut lines = lines.lock().unwrap_or_else(PoisonError::into_inner);
                    if lines.len() == KEPT_LINES {
                        lines.pop_front();
                    }
                    lines.push_back(line);
                }
            })?;
        Ok(Self {
            child,
            input,
            frames,
            said,
        })
    }

    /// Itself, unless it has ended.
    fn still_there(mut self) -> Option<Self> {
        matches!(self.child.try_wait(), Ok(None)).then_some(self)
    }

    /// Sends work, and gives the outcome back together with the process, which can take more.
    fn run(
        mut self,
        header: &Value,
        bytes: &[u8],
        stage: &dyn Fn(&str),
        wanted: &dyn Fn() -> bool,
    ) -> Result<(Vec<u8>, Self), Ended> {
        if self.send(header, bytes).is_err() {
            return Err(self.into_died());
        }
        loop {
            match self.frames.recv_timeout(LOOK) {
                Ok((STAGE, name)) => stage(&String::from_utf8_lossy(&name)),
                Ok((OUTCOME, outcome)) => return Ok((outcome, self)),
                Ok(_) | Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return Err(self.into_died()),
            }
            if !wanted() {
                return Err(Ended::Stopped);
            }
        }
    }

    fn send(&mut self, header: &Value, bytes: &[u8]) -> io::Result<()> {
        let header = header.to_string();
        self.input.write_all(&(header.len() as u64).to_le_bytes())?;
        self.input.write_all(header.as_bytes())?;
        self.input.write_all(&(bytes.len() as u64).to_le_bytes())?;
        self.input.write_all(bytes)?;
        self.input.flush()
    }

    fn into_died(self) -> Ended {
        let (text, out_of_memory) = self.into_death();
        Ended::Died {
            text,
            out_of_memory,
        }
    }

    /// What ended it, and whether it asked for too much memory.
    fn into_death(mut self) -> (String, bool) {
        // It has closed its output: it is ending, or about to be made to.
        std::thread::sleep(LOOK);
        let _ = self.child.kill();
        let how = match self.child.wait() {
            Ok(status) => match (status.signal(), status.code()) {
                (Some(6), _) => "it aborted".to_owned(),
                (Some(9), _) => "it was killed".to_owned(),
                (Some(11), _) => "it accessed memory that is not its own".to_owned(),
                (Some(signal), _) => format!("signal {signal} ended it"),
                (None, code) => format!("it ended with status {}", code.unwrap_or(-1)),
            },
            Err(e) => e.to_string(),
        };
        let said = self.said.lock().unwrap_or_else(PoisonError::into_inner);
        let last = said
            .iter()
            .map(String::as_str)
            .collect::<Vec<_>>()
            .join("; ");
        let out_of_memory = last.contains("memory allocation of");
        let text = if last.is_empty() {
            how
        } else {
            format!("{how}: {last}")
        };
        (text, out_of_memory)
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // It holds nothing that could be lost.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
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
