//! Long work runs on a thread of its own; the caller waits without the interpreter's lock, looks
//! for signals and reports progress.

use crate::failure::Failure;
use coseg_geometry::spectrum::Progress;
use pyo3::prelude::{Py, PyAny, PyErr, PyResult, Python};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError, mpsc};
use std::thread;
use std::time::Duration;

/// How long a signal or a report of progress may wait.
const POLL: Duration = Duration::from_millis(50);
/// As much as a main thread usually has: recursions were tested with it.
const STACK_BYTES: usize = 8 << 20;

/// What the waiting caller and the work tell each other.
#[derive(Debug, Default)]
pub(crate) struct Control {
    is_cancelled: AtomicBool,
    stage: Mutex<Option<Stage>>,
}

type Stage = (String, usize, usize);

impl Control {
    /// Notes where the work is; `false`: it is to stop.
    pub(crate) fn enter(&self, stage: &str, done: usize, expected: usize) -> bool {
        let mut noted = self.stage.lock().unwrap_or_else(PoisonError::into_inner);
        *noted = Some((stage.to_owned(), done, expected));
        !self.is_cancelled.load(Ordering::Relaxed)
    }

    /// The same for the solver of spectra.
    pub(crate) fn at(&self, progress: &Progress) -> bool {
        self.enter(progress.stage, progress.done, progress.expected)
    }

    fn stage(&self) -> Option<Stage> {
        let mut noted = self.stage.lock().unwrap_or_else(PoisonError::into_inner);
        noted.take()
    }
}

/// The result of `work`. `progress(stage, done, expected)` is called now and then, in the calling
/// thread; an exception of it, or of a signal's handler, stops the work and is raised.
pub(crate) fn interruptible<T: Send + 'static>(
    py: Python<'_>,
    progress: Option<Py<PyAny>>,
    work: impl FnOnce(&Control) -> Result<T, Failure> + Send + 'static,
) -> PyResult<T> {
    let control = Arc::new(Control::default());
    let (sender, mut receiver) = mpsc::channel();
    let theirs = Arc::clone(&control);
    let job = move || {
        let done = catch_unwind(AssertUnwindSafe(|| work(&theirs)));
        let done = done.unwrap_or_else(|payload| Err(Failure::panic(&*payload)));
        // A caller that was interrupted has gone.
        let _ = sender.send(done);
    };
    thread::Builder::new()
        .name("coseg".to_owned())
        .stack_size(STACK_BYTES)
        .spawn(job)
        .map_err(PyErr::from)?;
    loop {
        let waited = py.detach(move || {
            let got = receiver.recv_timeout(POLL);
            (receiver, got)
        });
        receiver = waited.0;
        match waited.1 {
            Ok(done) => {
                report(py, &control, progress.as_ref())?;
                return done.map_err(|failure| failure.raise(py));
            }
            Err(mpsc::RecvTimeoutError::Timeout) => {
                let called = py
                    .check_signals()
                    .and_then(|()| report(py, &control, progress.as_ref()));
                if let Err(error) = called {
                    control.is_cancelled.store(true, Ordering::Relaxed);
                    return Err(error);
                }
            }
            Err(mpsc::RecvTimeoutError::Disconnected) => {
                unreachable!("invariant: the work sends its result, or that it panicked")
            }
        }
    }
}

fn report(py: Python<'_>, control: &Control, progress: Option<&Py<PyAny>>) -> PyResult<()> {
    if let (Some(progress), Some((stage, done, expected))) = (progress, control.stage()) {
        progress.call1(py, (stage, done, expected))?;
    }
    Ok(())
}

/// Runs `work` with this many threads; 0: as many as there are processors. A pool of its own each
/// time: one that is kept would not survive a fork of the process.
pub(crate) fn with_threads<T: Send>(
    threads: usize,
    work: impl FnOnce(usize) -> T + Send,
) -> Result<T, Failure> {
    let threads = match threads {
        0 => thread::available_parallelism().map_or(1, usize::from),
        n => n,
    };
    if threads == 1 {
        return Ok(work(1));
    }
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .map_err(|error| Failure::argument(format!("{threads} threads: {error}")))?;
    Ok(pool.install(|| work(threads)))
}
