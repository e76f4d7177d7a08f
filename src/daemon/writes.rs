//! Requests that change something, carried out one after the other.

use crate::daemon::progress::Waiting;
use crate::daemon::publish::Notice;
use crate::daemon::requests::draining;
use crate::daemon::{Daemon, asked};
use crate::ipc::convert;
use crate::ipc::endpoint::Endpoint;
use crate::ipc::wire::{self, ErrorCode, ErrorReason, reply::Result as Reply, request::Body};
use crate::library::{LibraryError, RequestKey};
use bytes::Bytes;
use std::sync::Arc;

/// How a change is answered.
#[allow(clippy::large_enum_variant)] // returned once, never in a collection
pub(crate) enum Done {
    /// With this.
    Now(Box<Reply>),
    /// With this job, once it is finished.
    WhenPlaced(u64),
}

/// The idempotency key of a request, if its client has a name. The name belongs to the key of its
/// `owner`, if connections are authenticated: another one's client of the same name is another
/// client.
pub(crate) fn key(request: &wire::Request, owner: Option<&str>) -> Option<RequestKey> {
    (!request.client_id.is_empty()).then(|| RequestKey {
        client_id: match owner {
            // Keys have no space, and one length.
            Some(owner) => format!("{owner} {}", request.client_id),
            None => request.client_id.clone(),
        },
        request_id: request.request_id.clone(),
    })
}

/// Carries out one change, durably.
pub(crate) fn change(
    daemon: &Arc<Daemon>,
    body: &Body,
    frames: &[Bytes],
    key: Option<&RequestKey>,
) -> Result<Done, wire::Error> {
    if let Body::Drain(_) = body {
        return drain(daemon).map(|reply| Done::Now(Box::new(reply)));
    }
    may_change(daemon, key)?;
    let library = &daemon.library;
    let reply = match body {
        Body::CreateCollection(r) => {
            let spec = r.spec.as_ref().ok_or_else(|| {
                convert::field_error(ErrorReason::FieldMissing, "spec", "spec is missing")
            })?;
            let spec = convert::collection_spec(spec, "spec")?;
            let info = library.create_collection(&spec, key).map_err(refuse)?;
            daemon.notice(Notice::Created(spec.name, info.sequence));
            let collection = Some(convert::collection(&info));
            Reply::CreateCollection(wire::CreateCollectionReply { collection })
        }
        Body::DeleteCollection(r) => {
            library
                .delete_collection(&r.collection, key)
                .map_err(refuse)?;
            daemon.work.progress().remove_idle_lane(&r.collection);
            daemon.freed();
            daemon.notice(Notice::Changed(r.collection.clone()));
            Reply::DeleteCollection(wire::DeleteCollectionReply {})
        }
        Body::NameLabel(r) => {
            let label = library
                .name_label(&r.collection, r.label, &r.name, key)
                .map_err(refuse)?;
            daemon.notice(Notice::Changed(r.collection.clone()));
            Reply::NameLabel(wire::NameLabelReply {
                label: Some(convert::label_info(&label)),
            })
        }
        Body::UpdateCollection(_)
        | Body::CorrectLabels(_)
        | Body::MergeLabels(_)
        | Body::SplitLabel(_)
        | Body::Undo(_)
        | Body::RemoveShape(_) => {
            let changed = asked::change(daemon, body, frames, key);
            // Also where it failed: a worker may have ended just after the commit.
            daemon.freed();
            changed?
        }
        Body::CancelJob(r) => {
            let job = library.cancel(r.job_id).map_err(refuse)?;
            daemon.forget_cancelled(&job);
            daemon.freed();
            Reply::CancelJob(wire::CancelJobReply {
                job: Some(daemon.job_to_wire(&job)),
            })
        }
        Body::RetryJob(r) => {
            let (job, items) = library.retry(r.job_id).map_err(refuse)?;
            let n_queued = items.len() as u32;
            let mut waiting = Vec::new();
            for item in items {
                let n_bytes = library.item_bytes(&item).map_err(refuse)?;
                waiting.push(Waiting { item, n_bytes });
            }
            daemon.take_up_items(waiting);
            Reply::RetryJob(wire::RetryJobReply {
                job: Some(daemon.job_to_wire(&job)),
                n_queued,
            })
        }
        other => unreachable!("invariant: dispatch sends only changes here, not {other:?}"),
    };
    Ok(Done::Now(Box::new(reply)))
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

pub(crate) fn refuse(e: LibraryError) -> wire::Error {
    convert::library_error(&e)
}

fn drain(daemon: &Daemon) -> Result<Reply, wire::Error> {
    if !daemon.has_keys() && matches!(daemon.endpoint, Endpoint::Tcp { .. }) {
        return Err(convert::error(
            ErrorCode::PermissionDenied,
            ErrorReason::AdminIpcOnly,
            "without keys, only a client on an ipc endpoint may drain the daemon",
        ));
    }
    let n_queued = daemon.work.progress().n_live(None) as u64;
    Ok(Reply::Drain(wire::DrainReply { n_queued }))
}
