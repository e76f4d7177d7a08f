//! Tests memory over many operations: that of the daemon does not grow, and no healthy shape ends
//! its worker by a memory limit.

use super::wait_idle;
use crate::harness::{Daemon, Home, add, additions, number, refusal, skittle, stdout};
use coseg::call;
use coseg::ipc::client::Client;
use coseg::ipc::wire::{
    self, ErrorCode, ItemState, correct_labels_request::Correction, request::Body,
};
use std::time::{Duration, Instant};

/// Number of operations of a round.
const ROUND: u64 = 12;
/// Variation of the memory that allocators keep, independent of the number of operations.
const NOISE: u64 = 2 << 20;
/// The allocator returns memory that has been free for ten seconds, and a sweep of all of it takes
/// half a minute.
const SETTLING: Duration = Duration::from_secs(45);
/// Memory that an operation may leave behind permanently: less than the smallest leak.
const LEFT: u64 = 128;

/// Size of a process's own memory, without mapped files.
fn held(daemon: &Daemon) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{}/status", daemon.child.id())).unwrap();
    let line = status.lines().find_map(|l| l.strip_prefix("RssAnon:"));
    let kilobytes = line.unwrap().trim().trim_end_matches(" kB");
    kilobytes.parse::<u64>().unwrap() << 10
}

/// A mesh different from all others.
fn wedge(n: u64) -> String {
    format!("OFF\n4 4 0\n0 0 0\n1 0 0.{n:05}\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n3 1 2 3\n3 0 3 2\n")
}

fn put(
    client: &mut Client,
    collection: &str,
    name: &str,
    text: &str,
    mode: wire::AddMode,
) -> wire::AddShapesReply {
    let (mut request, frames) = additions(collection, &[(name, text)], mode);
    request.shapes[0].replace = true;
    call!(client, AddShapes(request), frames, with_frames)
        .unwrap()
        .0
}

/// The memory of the daemon once it is at most `enough`, or the least within the time in which the
/// allocator returns free memory and unreferenced files are removed.
fn settled(daemon: &Daemon, enough: u64) -> u64 {
    let begin = Instant::now();
    let mut least = u64::MAX;
    while least > enough && begin.elapsed() < SETTLING {
        std::thread::sleep(Duration::from_millis(100));
        least = least.min(held(daemon));
    }
    least
}

/// One of each kind of operation.
fn round(daemon: &Daemon, client: &mut Client, n: u64) {
    let (c, w) = (|| "c".to_owned(), || "w".to_owned());
    for kind in 0..ROUND {
        match kind {
            0 => {
                put(client, "w", "x", &wedge(n % 50_000), wire::AddMode::Wait);
            }
            1 => {
                let job_id = put(client, "w", "y", &wedge(n % 50_000), wire::AddMode::Job).job_id;
                let (mut revision, mut finished) = (0, false);
                while !finished {
                    let request = wire::WatchJobRequest {
                        job_id,
                        revision,
                        wait_ms: 10_000,
                    };
                    let job = call!(client, WatchJob(request)).unwrap().job.unwrap();
                    (revision, finished) = (job.revision, job.finished);
                }
            }
            2 => {
                let part = wire::LabelledPart {
                    part: 0,
                    label: (n % 3) as u32,
                };
                let correction = Some(Correction::Part(part));
                let request = wire::CorrectLabelsRequest {
                    collection: w(),
                    shape: "x".to_owned(),
                    correction,
                    by: String::new(),
                    closed: None,
                };
                call!(client, CorrectLabels(request)).unwrap();
            }
            3 => {
                call!(client, Undo(wire::UndoRequest { collection: w() })).unwrap();
            }
            4 => {
                let request = wire::RemoveShapeRequest {
                    collection: w(),
                    shape: "y".to_owned(),
                };
                call!(client, RemoveShape(request)).unwrap();
            }
            5 => {
                let request = wire::GetLabelsRequest {
                    collection: c(),
                    shape: "s1".to_owned(),
                    ..Default::default()
                };
                call!(client, GetLabels(request)).unwrap();
            }
            6 => {
                let request = wire::EventsSinceRequest {
                    collection: c(),
                    sequence: 0,
                    limit: 100,
                };
                call!(client, EventsSince(request)).unwrap();
            }
            7 => {
                let request = wire::NearestRequest {
                    collection: c(),
                    shape: "s1".to_owned(),
                    limit: 2,
                };
                call!(client, Nearest(request)).unwrap();
            }
            8 => {
                let request = wire::RemoveShapeRequest {
                    collection: c(),
                    shape: "none".to_owned(),
                };
                assert_eq!(
                    refusal(client, Body::RemoveShape(request)).0,
                    ErrorCode::NotFound
                );
            }
            9 => {
                // Another client uses another collection.
                let mut other = daemon.client();
                let name = format!("z{n}");
                let spec = wire::CollectionSpec {
                    name: name.clone(),
                    ..Default::default()
                };
                call!(
                    other,
                    CreateCollection(wire::CreateCollectionRequest { spec: Some(spec) })
                )
                .unwrap();
                call!(
                    other,
                    DeleteCollection(wire::DeleteCollectionRequest { collection: name })
                )
                .unwrap();
            }
            10 => {
                let job = put(client, "w", "bad", "OFF\nx", wire::AddMode::Wait)
                    .job
                    .unwrap();
                assert_eq!(job.items[0].state(), ItemState::Failed, "{job:?}");
            }
            _ => {
                call!(client, Stats(wire::StatsRequest {})).unwrap();
                call!(client, ListJobs(wire::ListJobsRequest::default())).unwrap();
            }
        }
    }
}

#[test]
fn memory_is_flat_over_operations() {
    let n = number("COSEG_TEST_OPERATIONS", 600).max(10 * ROUND);
    let home = Home::new();
    let daemon = home.start();
    let client = &mut daemon.client();
    let texts: Vec<_> = (0..4).map(|i| (format!("s{i}"), skittle(i))).collect();
    let shapes: Vec<_> = texts
        .iter()
        .map(|(n, t)| (n.as_str(), t.as_str()))
        .collect();
    add(client, "c", &shapes);
    add(client, "w", &[("x", &wedge(0))]);
    wait_idle(client, "c");
    // Caches fill up to their limits.
    let warm = (n / ROUND / 2).clamp(10, 100);
    (0..warm).for_each(|i| round(&daemon, client, i + 1));
    let before = settled(&daemon, 0);
    (warm..warm + n / ROUND).for_each(|i| round(&daemon, client, i + 1));
    let allowed = before + NOISE + LEFT * n;
    let after = settled(&daemon, allowed);
    let each = after.saturating_sub(before) / n;
    println!("{n} operations: {before} bytes before, {after} after, {each} an operation");
    assert!(after <= allowed, "{before} bytes, then {after}");
}

/// Meshes with `n_faces` faces, written by the program itself.
fn large(home: &Home, faces: u32) -> Vec<String> {
    let out = home.path("large");
    let (faces, folder) = (faces.to_string(), out.display().to_string());
    let args = [
        "synth",
        "chair",
        "--count",
        "4",
        "--faces",
        faces.as_str(),
        "--out",
        folder.as_str(),
    ];
    stdout(&home.coseg(&args), 0);
    let files = std::fs::read_dir(&out).unwrap().map(|e| e.unwrap().path());
    let mut meshes: Vec<_> = files
        .filter(|p| p.extension().is_some_and(|e| e == "off"))
        .collect();
    meshes.sort();
    meshes
        .iter()
        .map(|p| std::fs::read_to_string(p).unwrap())
        .collect()
}

fn assert_done_at_once(job: &wire::Job) {
    for item in &job.items {
        assert_eq!(item.state(), ItemState::Done, "{job:?}");
        assert_eq!(item.attempts, 0, "its worker ended: {job:?}");
    }
}

#[test]
fn healthy_meshes_cost_no_worker() {
    let n = number("COSEG_TEST_ADDITIONS", 6);
    let home = Home::new();
    let meshes = large(&home, 50_000);
    let daemon = home.start();
    let client = &mut daemon.client();
    add(client, "c", &[("x", &meshes[0])]);
    for i in 0..n {
        // Different bytes each time, so that nothing is reused.
        let text = format!("{}# {i}\n", meshes[i as usize % meshes.len()]);
        let reply = put(client, "c", "x", &text, wire::AddMode::Wait);
        assert_done_at_once(&reply.job.unwrap());
    }
    println!("{n} additions of 50,000 faces, no worker ended");
}

#[test]
fn kills_and_resumed_work_cost_no_worker() {
    let n = number("COSEG_TEST_KILLS", 6);
    let home = Home::new();
    let meshes = large(&home, 1_000);
    let mut daemon = home.start();
    add(&mut daemon.client(), "c", &[("x", &meshes[0])]);
    for i in 0..n {
        let client = &mut daemon.client();
        let text = format!("{}# {i}\n", meshes[i as usize % meshes.len()]);
        let job_id = put(client, "c", "x", &text, wire::AddMode::Job).job_id;
        // At a different moment each time: immediately, or after some of its stages have begun.
        let mut revision = 0;
        for _ in 0..i % 5 {
            let request = wire::WatchJobRequest {
                job_id,
                revision,
                wait_ms: 10_000,
            };
            let job = call!(client, WatchJob(request)).unwrap().job.unwrap();
            if job.finished {
                break;
            }
            revision = job.revision;
        }
        // The daemon is killed here.
        drop(daemon);
        daemon = home.start();
        let client = &mut daemon.client();
        wait_idle(client, "c");
        let job = call!(client, GetJob(wire::GetJobRequest { job_id }))
            .unwrap()
            .job
            .unwrap();
        assert_done_at_once(&job);
    }
    println!("{n} kills and resumptions, no worker ended");
}
