//! Changes that the daemon makes itself, each durable before it is answered.

use crate::daemon::answer::{draining, refused};
use crate::daemon::operation::{Change, Settle};
use crate::daemon::progress::Waiting;
use crate::daemon::reads::job_to_wire;
use crate::daemon::shared::{Daemon, Notice};
use crate::ipc::convert;
use crate::ipc::endpoint::Endpoint;
use crate::ipc::wire::{self, ErrorCode, ErrorReason, reply::Result as Reply};
use crate::library::RequestKey;
use std::sync::Arc;

/// How a change is answered.
pub(crate) enum Done {
    /// With this.
    Now(Box<Reply>),
    /// With this, and then the daemon drains.
    ThenDrain(Box<Reply>),
    /// With this job, once it is finished.
    WhenPlaced(u64),
}

/// Changes a collection.
pub(crate) fn change(
    daemon: &Arc<Daemon>,
    change: Change,
    key: Option<&RequestKey>,
) -> Result<Done, wire::Error> {
    may_change(daemon, key)?;
    let library = &daemon.library;
    let reply = match change {
        Change::DeleteCollection(r) => {
            library
                .delete_collection(&r.collection, key)
                .map_err(refused)?;
            daemon.work.progress().remove_idle_queue(&r.collection);
            daemon.needs_sweep();
            daemon.notice(Notice::Changed(r.collection));
            Reply::DeleteCollection(wire::DeleteCollectionReply {})
        }
        Change::NameLabel(r) => {
            let label = library
                .name_label(&r.collection, r.label, &r.name, key)
                .map_err(refused)?;
            daemon.notice(Notice::Changed(r.collection));
            Reply::NameLabel(wire::NameLabelReply {
                label: Some(convert::label_info(&label)),
            })
        }
    };
    Ok(Done::Now(Box::new(reply)))
}

/// Makes a change that waited for all additions before it.
pub(crate) fn settle(
    daemon: &Arc<Daemon>,
    settle: Settle,
    key: Option<&RequestKey>,
) -> Result<Done, wire::Error> {
    may_change(daemon, key)?;
    let library = &daemon.library;
    let reply = match settle {
        Settle::CreateCollection(r) => {
            let spec = r.spec.as_ref().ok_or_else(|| {
                convert::field_error(ErrorReason::FieldMissing, "spec", "spec is missing")
            })?;
            let spec = convert::collection_spec(spec, "spec")?;
            let info = library.create_collection(&spec, key).map_err(refused)?;
            daemon.notice(Notice::Created(spec.name, info.sequence));
            let collection = Some(convert::collection(&info));
            Reply::CreateCollection(wire::CreateCollectionReply { collection })
        }
        Settle::CancelJob(r) => {
            let job = library.cancel(r.job_id).map_err(refused)?;
            daemon.forget_cancelled(&job);
            daemon.needs_sweep();
            Reply::CancelJob(wire::CancelJobReply {
                job: Some(job_to_wire(daemon, &job)),
            })
        }
        Settle::RetryJob(r) => {
            let (job, items) = library.retry(r.job_id).map_err(refused)?;
            let n_queued = items.len() as u32;
            let mut waiting = Vec::new();
            for item in items {
                let n_bytes = library.item_bytes(&item).map_err(refused)?;
                waiting.push(Waiting { item, n_bytes });
            }
            daemon.resume_items(waiting);
            Reply::RetryJob(wire::RetryJobReply {
                job: Some(job_to_wire(daemon, &job)),
                n_queued,
            })
        }
    };
    Ok(Done::Now(Box::new(reply)))
}

/// Lets the daemon drain, once this is answered.
pub(crate) fn drain(daemon: &Daemon) -> Result<Done, wire::Error> {
    if !daemon.has_keys() && matches!(daemon.identity.endpoint, Endpoint::Tcp { .. }) {
        return Err(convert::error(
            ErrorCode::PermissionDenied,
            ErrorReason::AdminIpcOnly,
            "without keys, only a client on an ipc endpoint may drain the daemon",
        ));
    }
    let n_queued = daemon.work.progress().n_live(None) as u64;
    let reply = Reply::Drain(wire::DrainReply { n_queued });
    Ok(Done::ThenDrain(Box::new(reply)))
}

/// Refuses changes while the daemon drains, and those of a named client without an id.
pub(crate) fn may_change(daemon: &Daemon, key: Option<&RequestKey>) -> Result<(), wire::Error> {
    if daemon.is_draining() {
        return Err(draining());
    }
    if key.is_some_and(|k| k.request_id.is_empty()) {
        let text = "a change by a named client needs a request_id";
        return Err(convert::field_error(
            ErrorReason::FieldMissing,
            "request_id",
            text,
        ));
    }
    Ok(())
}
