//! `coseg jobs` lists jobs and failures, `coseg retry` queues failed shapes again, and `coseg
//! cancel` cancels shapes.

use super::session::Session;
use super::{CommandError, Outcome, interrupt};
use crate::cli::{Cancel, Jobs, Retry};
use coseg::call;
use coseg::ipc::wire::{self, ItemState};
use coseg::library::shown;
use coseg::text::counted;
use coseg::text::table;
use serde_json::{Value, json};

pub(crate) fn jobs(args: &Jobs, mut session: Session) -> Outcome {
    let mut before = 0;
    let mut jobs = Vec::new();
    loop {
        let request = wire::ListJobsRequest {
            failed: args.failed,
            before,
            page_size: 0,
            collection: args.of.named().cloned().unwrap_or_default(),
        };
        let reply = call!(session.client, ListJobs(request))?;
        before = reply.jobs.last().map_or(0, |j| j.job_id);
        jobs.extend(reply.jobs);
        if !reply.more || args.limit.is_some_and(|n| jobs.len() as u64 >= n) {
            break;
        }
    }
    if let Some(limit) = args.limit {
        jobs.truncate(usize::try_from(limit).unwrap_or(usize::MAX));
    }
    if session.json {
        let jobs: Vec<_> = jobs.iter().map(to_json).collect();
        session.print_json(&json!({ "jobs": jobs }))?;
        return Ok(true);
    }
    if args.failed {
        for job in &jobs {
            for item in &job.items {
                session.line(&format!(
                    "job {} {}/{}: {}",
                    job.job_id,
                    job.collection,
                    item.name,
                    why(item)
                ))?;
            }
        }
        return Ok(true);
    }
    let heading = ["job", "collection", "shapes", "done", "failed", "left"];
    let mut rows = vec![heading.map(str::to_owned).to_vec()];
    for job in &jobs {
        let count = |states: &[ItemState]| {
            let n = job.items.iter().filter(|i| states.contains(&i.state()));
            n.count().to_string()
        };
        if let Some(carrying) = job.carrying {
            rows.push(vec![
                job.job_id.to_string(),
                format!("{} (a correction)", job.collection),
                carrying.n_shapes.to_string(),
                (carrying.n_shapes - carrying.n_left).to_string(),
                String::new(),
                carrying.n_left.to_string(),
            ]);
            continue;
        }
        rows.push(vec![
            job.job_id.to_string(),
            job.collection.clone(),
            job.items.len().to_string(),
            count(&[ItemState::Done]),
            count(&[ItemState::Failed, ItemState::Cancelled]),
            count(&[ItemState::Queued, ItemState::Running]),
        ]);
    }
    session.line(&table(&rows))?;
    Ok(true)
}

pub(crate) fn retry(args: &Retry, mut session: Session) -> Outcome {
    let request = wire::RetryJobRequest { job_id: args.job };
    let reply = call!(session.client, RetryJob(request))?;
    let mut job = reply.job.unwrap_or_default();
    let mut revision = 0;
    if !args.no_wait && !job.finished {
        let id = args.job;
        interrupt::set_note(format!(
            "coseg: interrupted; the daemon continues with job {id}\n  to follow: coseg wait -c \
             {:?}\n  to cancel: coseg cancel {id}",
            job.collection
        ));
    }
    while !args.no_wait && !job.finished {
        job = session.watch_job(args.job, &mut revision)?;
    }
    interrupt::clear_note();
    let failed: Vec<_> = job
        .items
        .iter()
        .filter(|i| i.state() == ItemState::Failed)
        .collect();
    if session.json {
        session.print_json(&json!({ "n_queued": reply.n_queued, "job": to_json(&job) }))?;
    } else {
        for item in &failed {
            eprintln!("{}: {}", shown(&item.name), why(item));
        }
        eprintln!("queued {} again", counted(reply.n_queued.into(), "shape"));
    }
    if reply.n_queued == 0 && !session.json {
        return Err(CommandError::Failed(format!(
            "no shape of job {} has failed",
            args.job
        )));
    }
    Ok(args.no_wait || failed.is_empty())
}

pub(crate) fn cancel(args: &Cancel, mut session: Session) -> Outcome {
    let jobs = match &args.collection {
        Some(collection) => unfinished(collection, &mut session)?,
        None => args.jobs.clone(),
    };
    let mut cancelled = Vec::new();
    for job_id in jobs {
        let request = wire::CancelJobRequest { job_id };
        let job = call!(session.client, CancelJob(request))?.job;
        let job = job.unwrap_or_default();
        if !session.json {
            eprintln!("{}", after_cancelling(&job));
        }
        cancelled.push(to_json(&job));
    }
    if session.json {
        session.print_json(&json!({ "jobs": cancelled }))?;
    } else if cancelled.is_empty() {
        eprintln!("no job is unfinished, so nothing was cancelled");
    }
    Ok(true)
}

/// Jobs with shapes that are not yet placed, oldest first.
fn unfinished(collection: &str, session: &mut Session) -> Result<Vec<u64>, CommandError> {
    // A misspelt name would find no jobs, and report no error.
    session.describe(collection)?;
    let (mut found, mut before) = (Vec::new(), 0);
    loop {
        let request = wire::ListJobsRequest {
            failed: false,
            before,
            page_size: 0,
            collection: collection.to_owned(),
        };
        let reply = call!(session.client, ListJobs(request))?;
        before = reply.jobs.last().map_or(0, |j| j.job_id);
        let open = reply
            .jobs
            .iter()
            .filter(|j| !j.finished && j.carrying.is_none());
        found.extend(open.map(|j| j.job_id));
        if !reply.more {
            found.reverse();
            return Ok(found);
        }
    }
}

/// `job 7 of "chairs": 3 cancelled, 2 done`.
fn after_cancelling(job: &wire::Job) -> String {
    let states = [
        (ItemState::Cancelled, "cancelled"),
        (ItemState::Done, "done before that"),
        (ItemState::Failed, "failed"),
        (ItemState::Running, "still in work"),
        (ItemState::Queued, "queued"),
    ];
    let counted = states.map(|(state, word)| {
        let n = job.items.iter().filter(|i| i.state() == state).count();
        (n > 0).then(|| format!("{n} {word}"))
    });
    let counted: Vec<String> = counted.into_iter().flatten().collect();
    let (id, collection) = (job.job_id, &job.collection);
    format!("job {id} of {collection:?}: shapes {}", counted.join(", "))
}

fn why(item: &wire::JobItem) -> String {
    item.error
        .as_ref()
        .map_or_else(String::new, |e| e.message.clone())
}

fn to_json(job: &wire::Job) -> Value {
    let items = job.items.iter().map(|i| {
        let error = i.error.as_ref().map(|e| {
            json!({
                "code": e.code().as_str_name().trim_start_matches("ERROR_CODE_"),
                "reason": e.reason().as_str_name().trim_start_matches("ERROR_REASON_"),
                "message": e.message,
            })
        });
        json!({
            "name": i.name,
            "state": i.state().as_str_name().trim_start_matches("ITEM_STATE_").to_lowercase(),
            "attempts": i.attempts,
            "error": error,
        })
    });
    json!({
        "job": job.job_id,
        "collection": job.collection,
        "finished": job.finished,
        "shapes": items.collect::<Vec<_>>(),
        "carrying": job.carrying.map(|c| json!({ "n_shapes": c.n_shapes, "n_left": c.n_left })),
    })
}
