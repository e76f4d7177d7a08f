//! Answers from what is stored: rows are read and arrays are copied, and nothing is computed from
//! shapes.

use crate::daemon::answer::{Answer, MAX_PAGE, page_size, refused};
use crate::daemon::operation::{Compute, Fetch, Look};
use crate::daemon::shared::Daemon;
use crate::daemon::status;
use crate::ipc::convert;
use crate::ipc::frames::FrameWriter;
use crate::ipc::wire::{self, ErrorReason, reply::Result as Reply};
use crate::library::{Job, JobFilter, Library, LibraryError, Resolution};
use bytes::Bytes;

/// Answers from rows.
pub(crate) fn look(daemon: &Daemon, look: Look) -> Answer {
    let library = &daemon.library;
    let mut frames = FrameWriter::default();
    let result = match look {
        Look::Stats(_) => Reply::Stats(status::stats(daemon).map_err(refused)?),
        Look::ListCollections(_) => {
            let collections = library.collections().map_err(refused)?;
            let collections = collections.iter().map(convert::collection).collect();
            Reply::ListCollections(wire::ListCollectionsReply { collections })
        }
        Look::DescribeCollection(r) => {
            let collection = library.collection(&r.collection).map_err(refused)?;
            let collection = Some(convert::collection(&collection));
            Reply::DescribeCollection(wire::DescribeCollectionReply { collection })
        }
        Look::GetJob(r) => {
            let job = library.job(r.job_id).map_err(refused)?;
            Reply::GetJob(wire::GetJobReply {
                job: Some(job_to_wire(daemon, &job)),
            })
        }
        Look::ListJobs(r) => Reply::ListJobs(list_jobs(daemon, &r)?),
        Look::ListShapes(r) => Reply::ListShapes(list_shapes(daemon, &r)?),
        Look::GetShape(r) => {
            let shape = library.shape(&r.collection, &r.shape).map_err(refused)?;
            Reply::GetShape(wire::GetShapeReply {
                shape: Some(convert::shape(&shape)),
            })
        }
        Look::GetLabels(r) => {
            let version = Some(r.version).filter(|&v| v > 0);
            let labels = library
                .labels(&r.collection, &r.shape, version)
                .map_err(refused)?;
            Reply::GetLabels(convert::labels(&labels, r.confidence, &mut frames))
        }
        Look::EventsSince(r) => Reply::EventsSince(events_since(daemon, &r)?),
        Look::ListLinks(r) => {
            let shape = Some(r.shape.as_str()).filter(|s| !s.is_empty());
            let links = library.links(&r.collection, shape).map_err(refused)?;
            let links = links.iter().map(convert::link).collect();
            Reply::ListLinks(wire::ListLinksReply { links })
        }
    };
    Ok((result, frames.finish()))
}

/// Copies whole files or arrays.
pub(crate) fn fetch(daemon: &Daemon, fetch: Fetch) -> Answer {
    let library = &daemon.library;
    let mut frames = FrameWriter::default();
    let result = match fetch {
        Fetch::GetOriginal(r) => {
            let (bytes, format) = library.original(&r.collection, &r.shape).map_err(refused)?;
            Reply::GetOriginal(convert::original(bytes, format, &mut frames))
        }
        Fetch::LabelsSnapshot(r) => {
            let (sequence, shapes) = library.labels_snapshot(&r.collection).map_err(refused)?;
            Reply::LabelsSnapshot(convert::labels_snapshot(sequence, &shapes, &mut frames))
        }
        Fetch::GetDescriptors(r) => {
            let description = library
                .description(&r.collection, &r.shape)
                .map_err(refused)?;
            Reply::GetDescriptors(convert::descriptors(&description.view(), &mut frames))
        }
        Fetch::Publish(r) => {
            let head = library.bundle_head(&r.collection).map_err(refused)?;
            Reply::Publish(convert::bundle_head(head, &mut frames))
        }
        Fetch::GetArrayFile(r) => {
            let blake3 = convert::array_file_digest(&r)?;
            let file = library.array_file(&r.collection, &r.shape, &blake3);
            let bytes = file.map_err(refused)?.file_bytes().to_vec();
            let bytes = Some(frames.file(bytes));
            Reply::GetArrayFile(wire::GetArrayFileReply { bytes })
        }
    };
    Ok((result, frames.finish()))
}

/// A stored answer that need not be computed.
pub(crate) type Stored = Option<(Reply, Vec<Bytes>)>;

/// The answer to a computation, if it is stored.
pub(crate) fn stored(daemon: &Daemon, compute: &Compute) -> Result<Stored, wire::Error> {
    let library = &daemon.library;
    let mut frames = FrameWriter::default();
    let reply = match compute {
        Compute::GetFunctionalMap(r) => {
            stored_map(library, r, &mut frames)?.map(Reply::GetFunctionalMap)
        }
        Compute::GetSpectrum(r) => {
            stored_spectrum(library, r, &mut frames)?.map(Reply::GetSpectrum)
        }
        Compute::GetHks(r) if on_proxy(r.resolution()) => {
            let description = library.description(&r.collection, &r.shape);
            let description = description.map_err(refused)?;
            Some(Reply::GetHks(convert::hks(
                &description.view(),
                &mut frames,
            )))
        }
        _ => None,
    };
    Ok(reply.map(|reply| (reply, frames.finish())))
}

/// Whether the rows that a request wants are those of the proxy, where arrays are stored.
fn on_proxy(wanted: wire::Resolution) -> bool {
    convert::resolution(wanted, Resolution::Proxy) == Resolution::Proxy
}

/// The requested spectrum, if its arrays are stored: the eigenvalues are, at every resolution.
fn stored_spectrum(
    library: &Library,
    r: &wire::GetSpectrumRequest,
    frames: &mut FrameWriter,
) -> Result<Option<wire::GetSpectrumReply>, wire::Error> {
    if r.eigenvectors && !on_proxy(r.resolution()) {
        return Ok(None);
    }
    let (collection, shape) = (&r.collection, &r.shape);
    let area = library.shape(collection, shape).map_err(refused)?.area;
    let description = library.description(collection, shape).map_err(refused)?;
    let reply = convert::spectrum(&description.view(), area, r.eigenvectors, frames);
    Ok(Some(wire::GetSpectrumReply {
        // Eigenvalues have no rows.
        resolution: match r.eigenvectors {
            true => reply.resolution,
            false => r.resolution,
        },
        ..reply
    }))
}

/// Whether landmarks are vertices of the meshes as sent.
fn names_vertices(points: &wire::PointMapOptions) -> bool {
    !points.landmarks.is_empty() && points.landmark_resolution() == wire::Resolution::Input
}

/// The requested map, if it is stored.
fn stored_map(
    library: &Library,
    r: &wire::GetFunctionalMapRequest,
    frames: &mut FrameWriter,
) -> Result<Option<wire::GetFunctionalMapReply>, wire::Error> {
    if !on_proxy(r.resolution()) {
        return Ok(None);
    }
    let (collection, from, to) = (&r.collection, &r.from, &r.to);
    let found = match &r.points {
        // Landmarks on the meshes as sent must be located first.
        Some(points) if names_vertices(points) => None,
        Some(points) => library
            .stored_point_maps(collection, from, to, &convert::point_request(points))
            .map_err(refused)?
            .map(|maps| convert::point_maps(&maps, frames)),
        // The comparison with the other maps must be computed.
        None if r.agreement => None,
        None => library
            .stored_map(collection, from, to)
            .map_err(refused)?
            .map(|map| convert::functional_map(&map, frames)),
    };
    let Some(found) = found else { return Ok(None) };
    let n1 = library
        .n_proxy_vertices(collection, from)
        .map_err(refused)?;
    Ok(Some(convert::from_rows(found, n1, Resolution::Proxy)))
}

fn list_shapes(
    daemon: &Daemon,
    r: &wire::ListShapesRequest,
) -> Result<wire::ListShapesReply, wire::Error> {
    let size = page_size("page_size", r.page_size, MAX_PAGE)?;
    let after = match r.page_token.as_str() {
        "" => 0,
        token => token.parse().map_err(|_| {
            let text = format!("page_token {token:?} was not made by this daemon");
            convert::field_error(ErrorReason::FieldRange, "page_token", text)
        })?,
    };
    // One more, to see whether there is another page.
    let mut shapes = daemon
        .library
        .shapes_reviewed(
            &r.collection,
            (after, size + 1),
            r.label,
            convert::wanted_review(r.review()),
        )
        .map_err(refused)?;
    let more = shapes.len() > size;
    shapes.truncate(size);
    let last = shapes
        .last()
        .filter(|_| more)
        .map(|s| s.ordinal.to_string());
    Ok(wire::ListShapesReply {
        shapes: shapes.iter().map(convert::shape).collect(),
        next_page_token: last.unwrap_or_default(),
    })
}

fn list_jobs(
    daemon: &Daemon,
    r: &wire::ListJobsRequest,
) -> Result<wire::ListJobsReply, wire::Error> {
    let size = page_size("page_size", r.page_size, MAX_PAGE)?;
    let filter = JobFilter {
        failed: r.failed,
        before: r.before,
        collection: Some(r.collection.clone()).filter(|c| !c.is_empty()),
    };
    let mut jobs = daemon.library.jobs(&filter, size + 1).map_err(refused)?;
    let more = jobs.len() > size;
    jobs.truncate(size);
    Ok(wire::ListJobsReply {
        jobs: jobs.iter().map(|j| job_to_wire(daemon, j)).collect(),
        more,
    })
}

fn events_since(
    daemon: &Daemon,
    r: &wire::EventsSinceRequest,
) -> Result<wire::EventsSinceReply, wire::Error> {
    let limit = page_size("limit", r.limit, MAX_PAGE)?;
    let mut events = daemon
        .library
        .events_since(&r.collection, r.sequence, limit + 1)
        .map_err(refused)?;
    let more = events.len() > limit;
    events.truncate(limit);
    let events = events
        .iter()
        .map(|e| convert::event(&r.collection, e))
        .collect();
    Ok(wire::EventsSinceReply { events, more })
}

/// A job, with the stages that this process knows of.
pub(crate) fn job_to_wire(daemon: &Daemon, job: &Job) -> wire::Job {
    let progress = daemon.work.progress();
    let items: Vec<_> = job
        .items
        .iter()
        .map(|i| convert::item(i, progress.stage(job.id, i.index)))
        .collect();
    let n_over = job
        .items
        .iter()
        .filter(|i| convert::job_finished(&i.state))
        .count();
    if let Some(carrying) = job.propagation {
        return convert::carrying_job(job, &carrying);
    }
    wire::Job {
        job_id: job.id,
        collection: job.collection.clone(),
        finished: n_over == job.items.len(),
        progress: n_over as f64 / job.items.len().max(1) as f64,
        // A finished job changes no more.
        revision: progress.revision(job.id).unwrap_or(u64::MAX),
        items,
        carrying: None,
    }
}

/// Stored shapes whose labels wait to be recomputed, of one collection or of all.
pub(crate) fn n_stale(daemon: &Daemon, collection: Option<&str>) -> Result<u64, LibraryError> {
    match collection {
        Some(name) => Ok(daemon.library.collection(name)?.n_stale),
        None => Ok(daemon.library.stats()?.n_stale),
    }
}
