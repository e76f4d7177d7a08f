//! `coseg stop` lets the daemon finish its current work and end.

use super::session::Session;
use super::{CommandError, Outcome, interrupt};
use crate::cli::Stop;
use coseg::call;
use coseg::ipc::endpoint::Endpoint;
use coseg::ipc::wire::{self, ItemState};
use serde_json::json;
use std::net::TcpStream;
use std::os::unix::net::UnixStream;
use std::time::{Duration, Instant};

/// Number of jobs, the newest, that are searched for running shapes.
const JOBS_LOOKED_AT: u32 = 50;
/// Interval between tests whether the endpoint still has a listener; the kernel has no event for
/// that.
const LOOK: Duration = Duration::from_millis(50);
/// Time limit for the end of the daemon, which drains for at most half of it.
const LONGEST_WAIT: Duration = Duration::from_secs(60);

pub(crate) fn run(args: &Stop, mut session: Session) -> Outcome {
    // The list only serves the message, so the daemon is stopped even if it cannot be obtained.
    let in_work = in_work(&mut session).unwrap_or_default();
    let reply = call!(session.client, Drain(wire::DrainRequest {}))?;
    if !session.json {
        eprintln!("{}", what_is_waited_for(&in_work, reply.n_queued));
    }
    if !args.no_wait {
        interrupt::set_note(
            "coseg: interrupted; the daemon finishes its current work, then ends".to_owned(),
        );
        wait_until_gone(session.client.endpoint())?;
        interrupt::clear_note();
    }
    if session.json {
        let ended = !args.no_wait;
        session.print_json(&json!({ "n_queued": reply.n_queued, "ended": ended }))?;
    } else if !args.no_wait {
        eprintln!("the daemon has ended");
    }
    Ok(true)
}

/// Shapes that are being described or placed, each with its stage.
fn in_work(session: &mut Session) -> Result<Vec<String>, CommandError> {
    let request = wire::ListJobsRequest {
        page_size: JOBS_LOOKED_AT,
        ..Default::default()
    };
    let jobs = call!(session.client, ListJobs(request))?.jobs;
    let items = jobs.into_iter().flat_map(|j| j.items);
    let running = items.filter(|i| i.state() == ItemState::Running);
    Ok(running
        .map(|i| format!("{} ({})", i.name, i.stage))
        .collect())
}

fn what_is_waited_for(in_work: &[String], n_queued: u64) -> String {
    let first = match in_work {
        [] => "the daemon answers pending requests, then ends".to_owned(),
        some => format!("the daemon finishes {}, then ends", some.join(", ")),
    };
    let n_left = n_queued.saturating_sub(in_work.len() as u64);
    match n_left {
        0 => first,
        1 => format!("{first}; 1 shape that it has not begun remains for the next start"),
        n => format!("{first}; {n} shapes that it has not begun remain for the next start"),
    }
}

/// Waits until the endpoint has no listener. There is a time limit, since a supervisor may have
/// started another daemon.
fn wait_until_gone(endpoint: &Endpoint) -> Result<(), CommandError> {
    let begin = Instant::now();
    while listens(endpoint) {
        if begin.elapsed() > LONGEST_WAIT {
            let seconds = LONGEST_WAIT.as_secs();
            return Err(CommandError::Failed(format!(
                "{endpoint} still has a listener after {seconds} s: the daemon, or one that was \
                 started in its place"
            )));
        }
        std::thread::sleep(LOOK);
    }
    Ok(())
}

fn listens(endpoint: &Endpoint) -> bool {
    match endpoint {
        Endpoint::Ipc(path) => UnixStream::connect(path).is_ok(),
        Endpoint::Tcp { host, port } => {
            TcpStream::connect((host.trim_matches(['[', ']']), *port)).is_ok()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::what_is_waited_for;

    #[test]
    fn what_is_in_work_is_named_and_what_is_left_is_counted() {
        let of = |names: &[&str], n| {
            let names: Vec<String> = names.iter().map(|n| (*n).to_owned()).collect();
            what_is_waited_for(&names, n)
        };
        assert_eq!(of(&[], 0), "the daemon answers pending requests, then ends");
        assert_eq!(
            of(&["a (describe)", "b (place)"], 5),
            "the daemon finishes a (describe), b (place), then ends; 3 shapes that it has \
             not begun remain for the next start"
        );
    }
}
