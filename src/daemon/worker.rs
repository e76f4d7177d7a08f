//! Shapes are described in processes of their own, so that none can take the daemon down.
//!
//! A worker is the same program again (`coseg worker`): it reads a shape from stdin, describes it, and writes
//! stages and the outcome to stdout, one shape after the other. A panic is caught in it and is that shape's
//! failure. What ends the process (an abort, a stack overflow, memory beyond its limit) or holds it beyond
//! the time allowed costs one process; the next shape gets a new one.

use crate::library::Failure;
use crate::library::isolate::{self, DescribeJob, Described};
use rustix::process::{Resource, Rlimit, getppid, getrlimit, setrlimit};
use serde_json::{Value, json};
use std::collections::VecDeque;
use std::io::{self, BufRead as _, BufReader, Read, Write};
use std::os::unix::process::{CommandExt as _, ExitStatusExt as _};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::process::{Child, ChildStdin, Command, ExitCode, Stdio};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

/// The subcommand that is a worker.
pub const WORKER_COMMAND: &str = "worker";
/// If it is set for the daemon, a comment `poison: abort` (or panic, loop, alloc) in a mesh does as it says, in
/// the worker. For tests of the isolation; no client can set it.
pub const POISON_VARIABLE: &str = "COSEG_TEST_POISON";
/// Between looks at whether the work is still wanted.
const LOOK: Duration = Duration::from_millis(50);
/// A worker that has described a larger file is not used again: its memory is given back.
const LARGE_FILE: usize = 8 << 20;
/// Address space of a worker beyond what the work is estimated to take: stacks, allocator, margin.
const MEMORY_MARGIN: u64 = 256 << 20;
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

/// Workers that wait for work.
pub(crate) struct Pool {
    idle: Mutex<Vec<Process>>,
    threads: usize,
}

struct Process {
    child: Child,
    input: ChildStdin,
    frames: mpsc::Receiver<(u8, Vec<u8>)>,
    said: Arc<Mutex<VecDeque<String>>>,
}

impl Pool {
    /// Starts the first worker, to see that it can be.
    pub(crate) fn new(n_workers: usize) -> io::Result<Self> {
        let processors = std::thread::available_parallelism().map_or(1, usize::from);
        let threads = THREADS_PER_PROCESSOR * processors / n_workers.max(1);
        let pool = Self {
            idle: Mutex::new(Vec::new()),
            threads: threads.clamp(1, processors),
        };
        let first = Process::start(pool.threads)?;
        match first.frames.recv_timeout(Duration::from_secs(30)) {
            Ok((READY, _)) => {}
            _ => return Err(io::Error::other(first.into_death().0)),
        }
        pool.idle().push(first);
        Ok(pool)
    }

    fn idle(&self) -> std::sync::MutexGuard<'_, Vec<Process>> {
        self.idle.lock().unwrap_or_else(PoisonError::into_inner)
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
        let kept = self.idle().pop();
        let mut process = match kept.map_or_else(|| Process::start(self.threads), Ok) {
            Ok(process) => process,
            Err(e) => {
                return Err(Ended::Died {
                    text: format!("a worker process cannot be started: {e}"),
                    out_of_memory: false,
                });
            }
        };
        let mut header = job.header();
        header["memory"] = json!(MEMORY_MARGIN + 2 * memory);
        if process.send(&header, job.bytes).is_err() {
            return Err(process.into_died());
        }
        loop {
            match process.frames.recv_timeout(LOOK) {
                Ok((STAGE, name)) => stage(&String::from_utf8_lossy(&name)),
                Ok((OUTCOME, bytes)) => {
                    let outcome = isolate::decode(&bytes);
                    return match outcome {
                        Ok(outcome) => {
                            if job.bytes.len() <= LARGE_FILE {
                                self.idle().push(process);
                            }
                            Ok(outcome)
                        }
                        Err(e) => Err(Ended::Died {
                            text: e.to_string(),
                            out_of_memory: false,
                        }),
                    };
                }
                Ok(_) | Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return Err(process.into_died()),
            }
            if !wanted() {
                return Err(Ended::Stopped);
            }
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

fn write_frame(kind: u8, bytes: &[u8]) -> io::Result<()> {
    let mut out = io::stdout().lock();
    out.write_all(&[kind])?;
    out.write_all(&(bytes.len() as u64).to_le_bytes())?;
    out.write_all(bytes)?;
    out.flush()
}

/// Is a worker until its input ends: the body of `coseg worker`.
pub fn run_worker() -> ExitCode {
    match work() {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) if e.kind() == io::ErrorKind::BrokenPipe => ExitCode::SUCCESS,
        Err(e) => {
            eprintln!("worker: {e}");
            ExitCode::FAILURE
        }
    }
}

fn work() -> io::Result<()> {
    // A worker writes no files and leaves no core.
    for resource in [Resource::Core, Resource::Fsize] {
        let none = Rlimit {
            current: Some(0),
            maximum: Some(0),
        };
        setrlimit(resource, none)?;
    }
    end_with_parent()?;
    let poisoned = std::env::var_os(POISON_VARIABLE).is_some();
    let mut input = BufReader::new(io::stdin().lock());
    write_frame(READY, &[])?;
    loop {
        let header = match read_bytes(&mut input) {
            Ok(header) => header,
            Err(e) if e.kind() == io::ErrorKind::UnexpectedEof => return Ok(()),
            Err(e) => return Err(e),
        };
        let header: Value = serde_json::from_slice(&header)?;
        limit_memory(header["memory"].as_u64().unwrap_or(MEMORY_MARGIN))?;
        let bytes = read_bytes(&mut input)?;
        let job = DescribeJob::from_header(&header, &bytes).map_err(io::Error::other)?;
        let stage = |name: &str| write_frame(STAGE, name.as_bytes()).is_ok();
        let described = catch_unwind(AssertUnwindSafe(|| {
            if poisoned {
                take_poison(&bytes);
            }
            job.run(&stage)
        }));
        let outcome = described.unwrap_or_else(|panic| {
            let text = super::panic_text(panic.as_ref());
            Err(Failure {
                code: "INTERNAL".to_owned(),
                reason: "PANIC".to_owned(),
                message: format!("the work on this shape panicked: {text}"),
                subject: None,
            })
        });
        write_frame(OUTCOME, &isolate::encode(&outcome))?;
    }
}

/// Allows `more` bytes of address space beyond what is in use.
fn limit_memory(more: u64) -> io::Result<()> {
    let status = std::fs::read_to_string("/proc/self/status")?;
    let in_use = status
        .lines()
        .find_map(|l| l.strip_prefix("VmSize:")?.trim().strip_suffix(" kB"))
        .and_then(|n| n.trim().parse::<u64>().ok())
        .ok_or_else(|| io::Error::other("the kernel does not say how large this process is"))?
        << 10;
    let maximum = getrlimit(Resource::As).maximum;
    let current = in_use + more;
    setrlimit(
        Resource::As,
        Rlimit {
            current: Some(maximum.map_or(current, |m| m.min(current))),
            maximum,
        },
    )?;
    Ok(())
}

/// Ends this process within a second after the daemon has, whatever it is at.
fn end_with_parent() -> io::Result<()> {
    let parent = getppid();
    std::thread::Builder::new()
        .name("parent".to_owned())
        .spawn(move || {
            while getppid() == parent {
                std::thread::sleep(Duration::from_millis(500));
            }
            std::process::exit(1);
        })?;
    Ok(())
}

/// Does what a test's mesh asks for in a comment.
fn take_poison(bytes: &[u8]) {
    let text = String::from_utf8_lossy(&bytes[..bytes.len().min(256)]);
    let Some((_, poison)) = text.split_once("poison: ") else {
        return;
    };
    match poison.split_whitespace().next().unwrap_or_default() {
        "panic" => panic!("poisoned"),
        "abort" => std::process::abort(),
        "loop" => loop {
            std::hint::spin_loop();
        },
        "alloc" => {
            let much = vec![1_u8; 100 << 30];
            std::hint::black_box(&much);
        }
        _ => {}
    }
}
