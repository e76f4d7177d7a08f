//! What a worker does: the same program in its other role.

use super::{
    MEMORY_MARGIN, OUTCOME, READY, STAGE, answers, joined, read_bytes, subjects, taken_apart,
};
use crate::daemon::panic_text;
use crate::daemon::requests::Answer;
use crate::ipc::convert;
use crate::ipc::size;
use crate::ipc::wire::{self, ErrorCode, ErrorReason, reply};
use crate::library::isolate::{self, DescribeJob};
use crate::library::{Failure, ItemState, LibraryError};
use crate::store::StoreError;
use crate::{Library, library};
use bytes::Bytes;
use prost::Message as _;
use rustix::process::{Resource, Rlimit, getrlimit, nice, setrlimit};
use serde_json::{Value, json};
use std::io::{self, Read, Write as _};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::mpsc;
use std::time::Duration;

/// If it is set for the daemon, a comment `poison: abort` (or panic, loop, alloc, grow, reserve,
/// stack) in a mesh does as it says while the shape is described, `poison: abort-placing` (and so
/// on) while it is placed, and `poison: abort-answering` while a request that names the shape is
/// answered, in the worker. `slow` goes on after some seconds, `reserve` with address space that it
/// does not use. For tests of the isolation; no client can set it.
pub const POISON_VARIABLE: &str = "COSEG_TEST_POISON";
/// Workers give way to the daemon, which has to answer meanwhile.
const NICENESS: i32 = 5;
/// Address space that a worker may reserve beyond the memory that its work may hold, which the
/// daemon watches. Arenas and stacks of hundreds of threads stay far below it, so that only a
/// request for memory without sense meets this limit.
const RESERVATIONS: u64 = 64 << 30;
/// Where the kernel is told how gladly it may end this process when memory runs out, and what:
/// rather than the daemon.
const OOM_SCORE: (&str, &str) = ("/proc/self/oom_score_adj", "500");
/// What growing poison takes at most, far beyond what any work may hold: where nobody watches, the
/// machine goes on.
const GROWN: usize = 4 << 30;
/// What reserving poison takes: more than a small shape may hold.
const RESERVED: usize = 8 << 30;
/// How long slow poison takes.
const SLOW: Duration = Duration::from_secs(2);
/// Bytes at the beginning of a mesh that poison is looked for in.
const POISON_BYTES: usize = 256;

/// The library that a worker has opened, and where.
type Opened = Option<(PathBuf, Library)>;

/// A header with the bytes that belong to it.
type Work = (Value, Vec<u8>);

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
    // A worker leaves no core.
    forbid(Resource::Core)?;
    // Where it is not allowed the kernel chooses by size alone.
    let _ = std::fs::write(OOM_SCORE.0, OOM_SCORE.1);
    start_threads().map_err(io::Error::other)?;
    let poisoned = std::env::var_os(POISON_VARIABLE).is_some();
    let (mut library, mut gives_way) = (None, false);
    let work = read_ahead()?;
    write_frame(READY, &[])?;
    for next in work {
        let (header, bytes) = next?;
        limit_reservations(header["memory"].as_u64().unwrap_or(MEMORY_MARGIN))?;
        let max_answer = header["answer"].as_u64();
        if max_answer.is_none() && !gives_way {
            gives_way = true;
            // Refused where the service manager does not let it: then it is as urgent as the daemon.
            let _ = nice(NICENESS);
        }
        let outcome = if let Some(max_bytes) = max_answer {
            answer(&header, bytes, max_bytes, &mut library, poisoned)
        } else if header["library"].is_string() {
            place(&header, &mut library, poisoned)
                .to_string()
                .into_bytes()
        } else {
            // One that describes writes no files.
            forbid(Resource::Fsize)?;
            describe(&header, &bytes, poisoned)?
        };
        write_frame(OUTCOME, &outcome)?;
        if let Some((_, library)) = &library {
            // What is mapped takes up space on disk even when it is removed.
            library.store().objects().unmap();
        }
    }
    Ok(())
}

/// Starts the threads that share the work on one shape. Were they started when the work needs them,
/// the shape would be blamed for the want of them.
fn start_threads() -> Result<(), rayon::ThreadPoolBuildError> {
    let wanted = std::env::var("RAYON_NUM_THREADS").ok();
    let wanted = wanted.and_then(|n| n.parse().ok()).unwrap_or(1);
    // Tried beforehand: the pool of the whole process can be started once only.
    let tried = |n| rayon::ThreadPoolBuilder::new().num_threads(n).build();
    let n = affordable(wanted, |n| tried(n).is_ok());
    let pool = rayon::ThreadPoolBuilder::new().num_threads(n);
    let pool = match n {
        1 => pool.use_current_thread(),
        _ => pool,
    };
    pool.build_global()
}

/// So many threads or, where the machine has no more of them, half as many, down to the one that
/// is there.
fn affordable(mut wanted: usize, mut can_start: impl FnMut(usize) -> bool) -> usize {
    while wanted > 1 && !can_start(wanted) {
        wanted /= 2;
    }
    wanted.max(1)
}

/// Reads in a thread of its own, which ends this process as soon as the input ends, because the daemon has, whatever
/// the process is at.
fn read_ahead() -> io::Result<mpsc::Receiver<io::Result<Work>>> {
    let (sender, work) = mpsc::sync_channel(0);
    std::thread::Builder::new()
        .name("input".to_owned())
        .spawn(move || {
            let mut input = io::stdin().lock();
            loop {
                let next = read_work(&mut input);
                let ended = |e: &io::Error| e.kind() == io::ErrorKind::UnexpectedEof;
                if next.as_ref().is_err_and(ended) {
                    std::process::exit(0);
                }
                if sender.send(next).is_err() {
                    return;
                }
            }
        })?;
    Ok(work)
}

fn read_work(input: &mut impl Read) -> io::Result<Work> {
    let header = serde_json::from_slice(&read_bytes(input)?)?;
    Ok((header, read_bytes(input)?))
}

fn describe(header: &Value, bytes: &[u8], poisoned: bool) -> io::Result<Vec<u8>> {
    let job = DescribeJob::from_header(header, bytes).map_err(io::Error::other)?;
    let stage = |name: &str| write_frame(STAGE, name.as_bytes()).is_ok();
    let described = catch_unwind(AssertUnwindSafe(|| {
        if poisoned {
            take_poison(bytes, "");
        }
        job.run(&stage)
    }));
    let outcome = described.unwrap_or_else(|panic| Err(panicked(&panic_text(panic.as_ref()))));
    Ok(isolate::encode(&outcome))
}

/// The failure of a shape that something panicked over, which may be for want of memory.
pub(crate) fn panicked(text: &str) -> Failure {
    let out_of_memory = ["AllocError", "out of memory"]
        .iter()
        .any(|said| text.contains(said));
    let (code, reason) = match out_of_memory {
        true => ("RESOURCE_EXHAUSTED", "SHAPE_MEMORY"),
        false => ("INTERNAL", "PANIC"),
    };
    Failure {
        code: code.to_owned(),
        reason: reason.to_owned(),
        message: format!("the work on this shape panicked: {text}"),
        subject: None,
    }
}

/// The library that the header names, opened if it is not.
fn opened<'a>(header: &Value, open: &'a mut Opened) -> Result<&'a Library, LibraryError> {
    let dir = Path::new(header["library"].as_str().unwrap_or_default());
    if open.as_ref().is_none_or(|(of, _)| of != dir) {
        *open = Some((dir.to_path_buf(), Library::open_beside(dir)?));
    }
    let library = open.as_ref().map(|(_, library)| library);
    Ok(library.expect("invariant: it was just opened"))
}

/// Answers a request; why this library is not to be written any more (if so), the reply, and its frames, as
/// [`read_answer`] reads them.
fn answer(
    header: &Value,
    bytes: Vec<u8>,
    max_bytes: u64,
    open: &mut Opened,
    poisoned: bool,
) -> Vec<u8> {
    let answered = catch_unwind(AssertUnwindSafe(|| {
        let library = opened(header, open).map_err(|e| convert::library_error(&e))?;
        let malformed = |e: &dyn std::fmt::Display| {
            let code = ErrorCode::Internal;
            convert::error(code, ErrorReason::MalformedMessage, e.to_string())
        };
        let mut frames = taken_apart(bytes).map_err(|e| malformed(&e))?;
        if frames.is_empty() {
            return Err(malformed(&"no request"));
        }
        let request = wire::Request::decode(frames.remove(0)).map_err(|e| malformed(&e))?;
        if poisoned && let Some(body) = &request.body {
            let (collection, shapes) = subjects(body);
            for shape in shapes {
                if let Ok((mesh, _)) = library.original(collection, shape) {
                    take_poison(&mesh, "-answering");
                }
            }
        }
        let (result, frames) = answers::answer(library, &request, &frames)?;
        let found = frames.iter().map(|f| f.len() as u64).sum::<u64>();
        if found > max_bytes {
            let text = size::beyond("the answer", found, max_bytes, "limits.max_message");
            let code = ErrorCode::InvalidArgument;
            return Err(convert::error(code, ErrorReason::MessageTooLarge, text));
        }
        Ok((result, frames))
    }));
    let answered = answered.unwrap_or_else(|panic| {
        // What is kept of a collection may be half-way: it is read anew.
        *open = None;
        let text = panic_text(panic.as_ref());
        Err(convert::failure(&Failure {
            message: format!("the work on this request panicked: {text}"),
            ..panicked(&text)
        }))
    });
    let library = open.as_ref().map(|(_, library)| library);
    let stopped = library.and_then(|l| l.store().health().read_only());
    let cause = stopped.map_or("", |(_, cause)| cause);
    let (result, frames) = answered.unwrap_or_else(|e| (reply::Result::Error(e), Vec::new()));
    let reply = wire::Reply {
        request_id: String::new(),
        result: Some(result),
    };
    let reply = reply.encode_to_vec();
    let head = [cause.as_bytes(), &reply];
    joined(head.into_iter().chain(frames.iter().map(Bytes::as_ref)))
}

/// Reads what [`answer`] made: why the library must not be written any more, if so, and the answer. The error is for
/// people.
pub(crate) fn read_answer(mut pieces: Vec<Bytes>) -> Result<(Option<String>, Answer), String> {
    if pieces.len() < 2 {
        return Err(format!("a worker said {} pieces", pieces.len()));
    }
    let frames = pieces.split_off(2);
    let cause = String::from_utf8_lossy(&pieces[0]).into_owned();
    let reply = wire::Reply::decode(pieces.remove(1)).map_err(|e| e.to_string())?;
    let answer = match reply.result {
        Some(reply::Result::Error(error)) => Err(error),
        Some(result) => Ok((result, frames)),
        None => return Err("a worker said nothing".to_owned()),
    };
    Ok((Some(cause).filter(|c| !c.is_empty()), answer))
}

/// Places a shape, or labels one anew; what came of it, as [`outcome`] reads it.
fn place(header: &Value, open: &mut Opened, poisoned: bool) -> Value {
    let placed = catch_unwind(AssertUnwindSafe(|| {
        let library = opened(header, open)?;
        if let Some(collection) = header["relabel"].as_str() {
            let more = library.relabel_next(Some(collection))?;
            return Ok(json!({ "more": more }));
        }
        let handed = &header["place"];
        if poisoned {
            take_poison(&library.handed_bytes(handed)?, "-placing");
        }
        let state = library.place_handed(handed)?;
        Ok(json!({ "state": library::state_to_json(&state) }))
    }));
    match placed {
        Ok(Ok(outcome)) => outcome,
        Ok(Err(error)) => told(&error),
        // The lane may be half-way: it is read anew.
        Err(panic) => {
            *open = None;
            json!({ "panic": panic_text(panic.as_ref()) })
        }
    }
}

fn told(error: &LibraryError) -> Value {
    match error {
        LibraryError::Store(StoreError::NoSpace { path }) => json!({ "no_space": path }),
        LibraryError::Store(StoreError::ReadOnly { cause, .. }) => json!({ "read_only": cause }),
        other => json!({ "error": convert::library_failure(other) }),
    }
}

/// What came of work that needs the library.
#[derive(Debug)]
pub(crate) enum Outcome {
    /// The shape is placed, or is over otherwise.
    State(ItemState),
    /// Whether a shape was stale, and was labelled anew.
    Relabelled(bool),
    /// The library refused or failed.
    Failed(Failure),
}

/// What a worker says.
#[derive(Debug)]
pub(crate) enum Said {
    /// Of its work.
    Outcome(Outcome),
    /// The disk is full: nothing was changed.
    NoSpace(String),
    /// A sync failed in the worker, which ends the writing of the daemon too.
    ReadOnly(String),
}

/// Reads what a worker says; the error is for people.
pub(crate) fn outcome(value: &Value) -> Result<Said, String> {
    let text = |name: &str| value[name].as_str().map(str::to_owned);
    if let Some(path) = text("no_space") {
        return Ok(Said::NoSpace(path));
    }
    if let Some(cause) = text("read_only") {
        return Ok(Said::ReadOnly(cause));
    }
    let bad = |e: &dyn std::fmt::Display| format!("a worker said {value}: {e}");
    Ok(Said::Outcome(if let Some(more) = value["more"].as_bool() {
        Outcome::Relabelled(more)
    } else if let Some(text) = text("panic") {
        Outcome::Failed(panicked(&text))
    } else if let Some(failure) = value.get("error") {
        Outcome::Failed(serde_json::from_value(failure.clone()).map_err(|e| bad(&e))?)
    } else {
        Outcome::State(library::state_from_json(&value["state"]).map_err(|e| bad(&e))?)
    }))
}

fn write_frame(kind: u8, bytes: &[u8]) -> io::Result<()> {
    let mut out = io::stdout().lock();
    out.write_all(&[kind])?;
    out.write_all(&(bytes.len() as u64).to_le_bytes())?;
    out.write_all(bytes)?;
    out.flush()
}

fn forbid(resource: Resource) -> io::Result<()> {
    let none = Rlimit {
        current: Some(0),
        maximum: Some(0),
    };
    Ok(setrlimit(resource, none)?)
}

/// Lets a request for far more address space than `memory` fail at once, before any of it is used.
fn limit_reservations(memory: u64) -> io::Result<()> {
    let status = std::fs::read_to_string("/proc/self/status")?;
    let in_use = status
        .lines()
        .find_map(|l| l.strip_prefix("VmSize:")?.trim().strip_suffix(" kB"))
        .and_then(|n| n.trim().parse::<u64>().ok())
        .ok_or_else(|| io::Error::other("the kernel does not say how large this process is"))?
        << 10;
    let maximum = getrlimit(Resource::As).maximum;
    let current = in_use + memory + RESERVATIONS;
    setrlimit(
        Resource::As,
        Rlimit {
            current: Some(maximum.map_or(current, |m| m.min(current))),
            maximum,
        },
    )?;
    Ok(())
}

/// Does what a test's mesh asks for in a comment, at the time that `when` says.
fn take_poison(bytes: &[u8], when: &str) {
    let text = String::from_utf8_lossy(&bytes[..bytes.len().min(POISON_BYTES)]);
    let Some((_, poison)) = text.split_once("poison: ") else {
        return;
    };
    let poison = poison.split_whitespace().next().unwrap_or_default();
    let Some(poison) = poison.strip_suffix(when) else {
        return;
    };
    match poison {
        "panic" => panic!("poisoned"),
        "abort" => std::process::abort(),
        "loop" => loop {
            std::hint::spin_loop();
        },
        "alloc" => {
            let much = vec![1_u8; 100 << 30];
            std::hint::black_box(&much);
        }
        "grow" => grow(),
        "reserve" => {
            let much: Vec<u8> = Vec::with_capacity(RESERVED);
            std::mem::forget(std::hint::black_box(much));
        }
        "slow" => std::thread::sleep(SLOW),
        "stack" => {
            std::hint::black_box(deeper(1));
        }
        _ => {}
    }
}

/// Takes memory at no more than a MiB in a millisecond, so that what was held beyond a limit says
/// how long nobody looked.
fn grow() {
    let mut taken = Vec::new();
    while taken.len() < GROWN >> 20 {
        taken.push(std::hint::black_box(vec![1_u8; 1 << 20]));
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// Does not come back.
fn deeper(depth: u64) -> u64 {
    let here = std::hint::black_box([depth; 512]);
    if here[0] == u64::MAX {
        return 0;
    }
    deeper(depth + 1).wrapping_add(here[511])
}

#[cfg(test)]
mod tests {
    use super::affordable;

    #[test]
    fn a_machine_short_of_threads_gives_fewer() {
        for (wanted, granted, expected) in [
            (8, 8, 8),
            (8, 3, 2),
            (8, 0, 1),
            (3, 2, 1),
            (1, 0, 1),
            (0, 0, 1),
        ] {
            assert_eq!(affordable(wanted, |n| n <= granted), expected, "{wanted}");
        }
    }
}
