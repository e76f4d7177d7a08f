//! A worker as the daemon sees it: a process that takes work, and is ended when it holds more
//! memory than the work may.
//!
//! The bound is on the memory that a worker *holds*, not on the address space that it reserves: an
//! allocator with arenas for many threads, and their stacks, reserve many times what they use. The
//! daemon checks it several times a second, from outside, where the work cannot stop the check.

use super::pipe::{OUTCOME, READY, STAGE, WORKER_COMMAND, read_frame};
use serde_json::Value;
use std::collections::VecDeque;
use std::io::{self, BufRead as _, BufReader, Write as _};
use std::os::unix::process::{CommandExt as _, ExitStatusExt as _};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

/// Between checks whether the work is still wanted and what its process holds. A process takes at
/// most about 5 GB from the kernel in a second, so it is ended before it holds 250 MB beyond what
/// it may.
const LOOK: Duration = Duration::from_millis(50);
/// Last lines of stderr, which tell why a worker ended.
const LAST_LINES: usize = 4;

/// Why a worker gave no outcome.
#[derive(Debug)]
pub(crate) enum Ended {
    /// The work was not wanted any more; the process was killed.
    Stopped,
    /// The process died.
    Died {
        /// The cause, as far as it is known.
        text: String,
        /// It held more memory than the work may, or asked for far more.
        out_of_memory: bool,
    },
}

/// Why a process gave no outcome.
pub(super) enum Fallen {
    /// It had taken the work.
    AtWork(Ended),
    /// It ended before it was ready to take any, which no work is to blame for.
    BeforeWork(String),
}

/// A worker.
pub(super) struct Process {
    child: Child,
    input: ChildStdin,
    frames: mpsc::Receiver<(u8, Vec<u8>)>,
    /// The last lines of its stderr, added by the thread that reads them.
    last_lines: Arc<Mutex<VecDeque<String>>>,
    is_ready: bool,
}

impl Ended {
    pub(super) fn died(text: String) -> Self {
        Self::Died {
            text,
            out_of_memory: false,
        }
    }
}

impl Process {
    pub(super) fn start(threads: usize) -> io::Result<Self> {
        // The program that runs, also if another version has been installed in its place.
        let mut child = Command::new("/proc/self/exe")
            .arg0("coseg")
            .arg(WORKER_COMMAND)
            .env("RAYON_NUM_THREADS", threads.to_string())
            // A backtrace would push the lines before it out of the last ones.
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
        let last_lines = Arc::new(Mutex::new(VecDeque::new()));
        let lines = Arc::clone(&last_lines);
        // From here on dropping it ends the process.
        let process = Self {
            child,
            input,
            frames,
            last_lines,
            is_ready: false,
        };
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
        std::thread::Builder::new()
            .name("worker err".to_owned())
            .spawn(move || {
                for line in BufReader::new(errors).lines().map_while(Result::ok) {
                    tracing::debug!(line, "stderr of a worker");
                    let mut lines = lines.lock().unwrap_or_else(PoisonError::into_inner);
                    if lines.len() == LAST_LINES {
                        lines.pop_front();
                    }
                    lines.push_back(line);
                }
            })?;
        Ok(process)
    }

    /// Waits until it can take work. The error is why it ended.
    pub(super) fn ready(mut self, within: Duration) -> Result<Self, String> {
        match self.frames.recv_timeout(within) {
            Ok((READY, _)) => {
                self.is_ready = true;
                Ok(self)
            }
            _ => Err(self.death().0),
        }
    }

    /// The process, unless it has ended.
    pub(super) fn still_running(mut self) -> Option<Self> {
        matches!(self.child.try_wait(), Ok(None)).then_some(self)
    }

    /// Sends work that may take so many bytes of `memory`, and returns the outcome with the
    /// process, which can take more work.
    pub(super) fn run(
        mut self,
        header: &Value,
        bytes: &[u8],
        memory: u64,
        stage: &dyn Fn(&str),
        wanted: &dyn Fn() -> bool,
    ) -> Result<(Vec<u8>, Self), Fallen> {
        let Some(before) = held(self.child.id()) else {
            return Err(Fallen::BeforeWork(self.death().0));
        };
        let limit = before + memory;
        if self.send(header, bytes).is_err() {
            // It cannot have begun the work without having all of it.
            return Err(Fallen::BeforeWork(self.death().0));
        }
        loop {
            match self.frames.recv_timeout(LOOK) {
                Ok((STAGE, name)) => stage(&String::from_utf8_lossy(&name)),
                Ok((OUTCOME, outcome)) => return Ok((outcome, self)),
                Ok((READY, _)) => self.is_ready = true,
                Ok(_) | Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return Err(self.fallen()),
            }
            if !wanted() {
                return Err(Fallen::AtWork(Ended::Stopped));
            }
            // A process that has just ended holds nothing, and its frames end too.
            let now = held(self.child.id()).unwrap_or_default();
            if now > limit {
                return Err(Fallen::AtWork(outgrown(now, limit)));
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

    /// Why it gave no outcome, now that its output is closed.
    fn fallen(mut self) -> Fallen {
        let (text, out_of_memory) = self.death();
        if self.is_ready {
            return Fallen::AtWork(Ended::Died {
                text,
                out_of_memory,
            });
        }
        Fallen::BeforeWork(text)
    }

    /// The cause of its end, and whether it wanted too much memory.
    fn death(&mut self) -> (String, bool) {
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
        // It may have written that it is ready just before.
        self.is_ready |= self.frames.try_iter().any(|(kind, _)| kind == READY);
        let lines = self
            .last_lines
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        let last = lines
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
        // It has nothing that could be lost.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn outgrown(held: u64, limit: u64) -> Ended {
    let (held, limit) = (held >> 20, limit >> 20);
    Ended::Died {
        text: format!(
            "it held {held} MiB of memory, the limit for a file of this size is {limit} MiB"
        ),
        out_of_memory: true,
    }
}

/// Bytes of memory that a process holds alone, swapped out or not. Pages of mapped files are not
/// among them, since the kernel can take those back. `None`: it has ended.
fn held(pid: u32) -> Option<u64> {
    held_of(&std::fs::read_to_string(format!("/proc/{pid}/status")).ok()?)
}

fn held_of(status: &str) -> Option<u64> {
    let kilobytes = |name: &str| {
        let value = status.lines().find_map(|l| l.strip_prefix(name))?;
        value.trim().strip_suffix(" kB")?.parse::<u64>().ok()
    };
    // Without swap the kernel may not report it.
    let swapped = kilobytes("VmSwap:").unwrap_or_default();
    Some((kilobytes("RssAnon:")? + kilobytes("RssShmem:")? + swapped) << 10)
}

#[cfg(test)]
mod tests {
    use super::{held, held_of};

    #[test]
    fn what_is_touched_is_held_and_what_is_reserved_is_not() {
        let own = || held(std::process::id()).unwrap();
        let before = own();
        let mut reserved: Vec<u8> = Vec::with_capacity(1 << 30);
        std::hint::black_box(&mut reserved);
        let after = own();
        assert!(after < before + (512 << 20), "{before}, then {after}");
        let touched = vec![1_u8; 512 << 20];
        let with = own();
        std::hint::black_box(&touched);
        assert!(with > after + (384 << 20), "{after}, then {with}");
    }

    #[test]
    fn a_process_that_has_ended_holds_nothing() {
        let mut child = std::process::Command::new("true").spawn().unwrap();
        // It stays in the table until it is waited for.
        let pid = child.id();
        child.wait().unwrap();
        assert_eq!(held(pid), None);
        assert_eq!(held_of("Name:\tcoseg\nState:\tZ (zombie)\n"), None);
        let status =
            "VmSwap:\t  3 kB\nRssAnon:\t  1024 kB\nRssFile:\t  99999 kB\nRssShmem:\t  1 kB\n";
        assert_eq!(held_of(status), Some(1028 << 10));
    }
}
