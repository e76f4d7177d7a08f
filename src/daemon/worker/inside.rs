//! The worker's side: the same program in its other role.

use super::pipe::{
    MEMORY_MARGIN, OUTCOME, READY, STAGE, join_pieces, read_bytes, split_pieces, write_frame,
};
use super::poison::{POISON_VARIABLE, named_shapes, take_poison};
use super::{answers, report};
use crate::Library;
use crate::daemon::answer::{Answer, panic_text, refused};
use crate::daemon::failures::panicked;
use crate::daemon::operation::{Operation, Remote, request_key, unknown_request};
use crate::ipc::convert;
use crate::ipc::size;
use crate::ipc::wire::{self, ErrorCode, ErrorReason, reply};
use crate::library::isolate::{self, DescribeJob};
use crate::library::{Failure, LibraryError};
use bytes::Bytes;
use prost::Message as _;
use rustix::process::{Resource, Rlimit, getrlimit, nice, setrlimit};
use serde_json::Value;
use std::io::{self, Read};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::mpsc::{self, RecvTimeoutError};
use std::time::Duration;

/// Workers have a lower priority than the daemon, which has to answer meanwhile.
const NICENESS: i32 = 5;
/// Address space that a worker may reserve beyond the memory that its work may hold, which the
/// daemon watches. Arenas and stacks of hundreds of threads stay far below it, so that only a
/// senseless request for memory meets this limit.
const RESERVATIONS: u64 = 64 << 30;
/// The file and the score that let the kernel end this process before the daemon when memory runs
/// out.
const OOM_SCORE: (&str, &str) = ("/proc/self/oom_score_adj", "500");
/// Array files stay mapped until no work has arrived for so long.
const IDLE: Duration = Duration::from_millis(200);
/// Bytes of array files that stay mapped between pieces of work: those of the shapes that vote in a
/// collection of the default working faces. They are no memory that this process holds alone.
const MAPPED_BYTES: usize = 256 << 20;
/// The library that a worker has opened, with its folder.
type Opened = Option<(PathBuf, Library)>;

/// A header with its bytes.
type Work = (Value, Vec<u8>);

/// Works until the input ends: the body of `coseg worker`.
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
    // If it is not allowed, the kernel chooses by size alone.
    let _ = std::fs::write(OOM_SCORE.0, OOM_SCORE.1);
    start_threads().map_err(io::Error::other)?;
    let poisoned = std::env::var_os(POISON_VARIABLE).is_some();
    let (mut library, mut is_nice): (Opened, bool) = (None, false);
    let work = read_ahead()?;
    write_frame(READY, &[])?;
    loop {
        let next = match work.recv_timeout(IDLE) {
            Err(RecvTimeoutError::Timeout) => {
                if let Some((_, library)) = &library {
                    // Mapped files take up disk space even when they are removed.
                    library.store().objects().unmap();
                }
                work.recv().ok()
            }
            received => received.ok(),
        };
        let Some(next) = next else {
            return Ok(());
        };
        let (header, bytes) = next?;
        limit_reservations(header["memory"].as_u64().unwrap_or(MEMORY_MARGIN))?;
        let max_answer = header["answer"].as_u64();
        if max_answer.is_none() && !is_nice {
            is_nice = true;
            // The service manager may refuse it; the worker then has the daemon's priority.
            let _ = nice(NICENESS);
        }
        let outcome = if let Some(max_bytes) = max_answer {
            answer(&header, bytes, max_bytes, &mut library, poisoned)
        } else if header["library"].is_string() {
            place(&header, &mut library, poisoned)
                .to_string()
                .into_bytes()
        } else {
            // A worker that describes writes no files.
            forbid(Resource::Fsize)?;
            describe(&header, &bytes, poisoned)?
        };
        write_frame(OUTCOME, &outcome)?;
    }
}

/// Starts the threads that share the work on one shape, before the work, so that the shape is not
/// blamed if the machine has no more of them.
fn start_threads() -> Result<(), rayon::ThreadPoolBuildError> {
    let wanted = std::env::var("RAYON_NUM_THREADS").ok();
    let wanted = wanted.and_then(|n| n.parse().ok()).unwrap_or(1);
    // Tried before: the pool of the whole process can be started once only.
    let tried = |n| rayon::ThreadPoolBuilder::new().num_threads(n).build();
    let n = affordable(wanted, |n| tried(n).is_ok());
    let pool = rayon::ThreadPoolBuilder::new().num_threads(n);
    let pool = match n {
        1 => pool.use_current_thread(),
        _ => pool,
    };
    pool.build_global()
}

/// The wanted number of threads or, if the machine has no more of them, half as many, and so on
/// down to the one that exists.
fn affordable(mut wanted: usize, mut can_start: impl FnMut(usize) -> bool) -> usize {
    while wanted > 1 && !can_start(wanted) {
        wanted /= 2;
    }
    wanted.max(1)
}

/// Reads in a thread of its own, which ends this process as soon as the input ends, since the
/// daemon has ended then.
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

/// The library that the header names, opened if it is not.
fn opened<'a>(header: &Value, open: &'a mut Opened) -> Result<&'a Library, LibraryError> {
    let dir = Path::new(header["library"].as_str().unwrap_or_default());
    if open.as_ref().is_none_or(|(of, _)| of != dir) {
        let library = Library::open_beside(dir)?;
        library.store().objects().set_cache_bytes(MAPPED_BYTES);
        // A worker that answers keeps none.
        let prepared_bytes = header["prepared"].as_u64().unwrap_or(0);
        library
            .store()
            .prepared()
            .set_max_bytes(prepared_bytes as usize);
        *open = Some((dir.to_path_buf(), library));
    }
    let library = open.as_ref().map(|(_, library)| library);
    Ok(library.expect("invariant: it was just opened"))
}

/// Carries out a computation or an edit. Returns the pieces that [`report::read_answer`] reads: why
/// the library must not be written any more (if so), the reply, and its frames.
fn answer(
    header: &Value,
    bytes: Vec<u8>,
    max_bytes: u64,
    open: &mut Opened,
    poisoned: bool,
) -> Vec<u8> {
    let answered = catch_unwind(AssertUnwindSafe(|| {
        let library = opened(header, open).map_err(refused)?;
        carry_out(library, bytes, max_bytes, poisoned)
    }));
    let answered = answered.unwrap_or_else(|panic| {
        // The collection's state in memory may be half-way, and is read again.
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
    join_pieces(head.into_iter().chain(frames.iter().map(Bytes::as_ref)))
}

/// Carries out the request in `bytes`, which came with its raw frames.
fn carry_out(library: &Library, bytes: Vec<u8>, max_bytes: u64, poisoned: bool) -> Answer {
    let malformed = |e: &dyn std::fmt::Display| {
        let code = ErrorCode::Internal;
        convert::error(code, ErrorReason::MalformedMessage, e.to_string())
    };
    let mut frames = split_pieces(bytes).map_err(|e| malformed(&e))?;
    if frames.is_empty() {
        return Err(malformed(&"no request"));
    }
    let request = wire::Request::decode(frames.remove(0)).map_err(|e| malformed(&e))?;
    // The daemon has put the owner into the name of the client.
    let key = request_key(&request.client_id, &request.request_id, None);
    let operation = request.body.map(Operation::from);
    let operation = operation.ok_or_else(unknown_request)?;
    let work = Remote::try_from(operation)
        .map_err(|other| malformed(&format_args!("not the work of a worker: {other:?}")))?;
    if poisoned {
        for shape in named_shapes(&work) {
            if let Ok((mesh, _)) = library.original(work.collection(), shape) {
                take_poison(&mesh, "-answering");
            }
        }
    }
    let (result, frames) = match work {
        Remote::Compute(compute) => answers::compute(library, compute, &frames)?,
        Remote::Edit(edit) => (
            answers::edit(library, edit, &frames, key.as_ref())?,
            Vec::new(),
        ),
    };
    let found = frames.iter().map(|f| f.len() as u64).sum::<u64>();
    if found > max_bytes {
        let text = size::beyond("the answer", found, max_bytes, "limits.max_message");
        let code = ErrorCode::InvalidArgument;
        return Err(convert::error(code, ErrorReason::MessageTooLarge, text));
    }
    Ok((result, frames))
}

/// Places or relabels a shape, or makes a step towards proposals, and returns the report.
fn place(header: &Value, open: &mut Opened, poisoned: bool) -> Value {
    let placed = catch_unwind(AssertUnwindSafe(|| {
        let library = opened(header, open)?;
        if let Some(collection) = header["relabel"].as_str() {
            let most = header["most"].as_u64().unwrap_or(1) as usize;
            let first = header["first"].as_array().into_iter().flatten();
            let first: Vec<String> = first.filter_map(|n| n.as_str()).map(String::from).collect();
            let n_shapes = library.relabel_first(Some(collection), most, &first)?;
            return Ok(report::relabelled(n_shapes));
        }
        if let Some(collection) = header["propose"].as_str() {
            return Ok(report::proposed(library.propose_next(collection)?));
        }
        let ticket = &header["place"];
        if poisoned {
            take_poison(&library.ticket_bytes(ticket)?, "-placing");
        }
        Ok(report::placed(&library.place_ticket(ticket)?))
    }));
    match placed {
        Ok(Ok(outcome)) => outcome,
        Ok(Err(error)) => report::refusal(&error),
        // The collection's state in memory may be half-way, and is read again.
        Err(panic) => {
            *open = None;
            report::panic(&panic_text(panic.as_ref()))
        }
    }
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
