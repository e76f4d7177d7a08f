//! Tests that a shape can be cancelled in every stage, that it can end a worker but not the daemon,
//! and that it makes no request wait beyond its deadline.

use super::create_with;
use crate::harness::{Daemon, Home, add_request, skittle};
use coseg::call;
use coseg::daemon::POISON_VARIABLE;
use coseg::ipc::client::{Client, ClientError};
use coseg::ipc::wire::{self, ErrorCode, ErrorReason, ItemState, reply, request::Body};
use rustix::process::Signal;
use std::time::{Duration, Instant};

fn poisoned(poison: &str) -> String {
    skittle(3).replacen("OFF\n", &format!("OFF # poison: {poison}\n"), 1)
}

/// Submits one shape and returns the job.
fn submit(client: &mut Client, name: &str, text: &str) -> u64 {
    let (body, frames) = add_request("c", &[(name, text)], wire::AddMode::Job);
    match client.call(body, frames).unwrap().0 {
        reply::Result::AddShapes(accepted) => accepted.job_id,
        other => panic!("{other:?}"),
    }
}

fn item(client: &mut Client, job_id: u64) -> wire::JobItem {
    let job = call!(client, GetJob(wire::GetJobRequest { job_id })).unwrap();
    job.job.unwrap().items.swap_remove(0)
}

fn wait_for_stage(client: &mut Client, job_id: u64, stage: &str) {
    let begin = Instant::now();
    loop {
        let item = item(client, job_id);
        if item.stage == stage {
            return;
        }
        assert!(begin.elapsed() < Duration::from_secs(60), "{item:?}");
        std::thread::sleep(Duration::from_millis(20));
    }
}

fn cancel(client: &mut Client, job_id: u64) -> ItemState {
    let job = call!(client, CancelJob(wire::CancelJobRequest { job_id })).unwrap();
    job.job.unwrap().items[0].state()
}

/// Seconds until a good shape is placed.
fn placed_after(client: &mut Client, name: &str) -> Duration {
    let begin = Instant::now();
    let job = submit(client, name, &skittle(1));
    super::wait_idle(client, "c");
    assert_eq!(item(client, job).state(), ItemState::Done);
    begin.elapsed()
}

#[test]
fn work_is_cancelled_at_every_stage() {
    let home = Home::new();
    let daemon = home.start_with(&["--workers", "1"], &[(POISON_VARIABLE, "1")]);
    let client = &mut daemon.client();
    // Several shapes, so that the next one triggers a re-clustering.
    for name in ["a", "b"] {
        submit(client, name, &skittle(0));
    }
    super::wait_idle(client, "c");
    for poison in ["loop", "loop-placing"] {
        let endless = submit(client, poison, &poisoned(poison));
        let behind = submit(client, "behind", &skittle(2));
        if poison == "loop-placing" {
            wait_for_stage(client, endless, "place");
        }
        // The shape is queued, before any work on it; then the work that blocks it there starts.
        assert_eq!(cancel(client, behind), ItemState::Cancelled);
        assert_eq!(cancel(client, endless), ItemState::Cancelled);
        let next = placed_after(client, &format!("after {poison}"));
        println!("the shape after a cancelled {poison} is placed within {next:?}");
        assert!(next < Duration::from_secs(30), "its worker was not stopped");
        assert_eq!(item(client, endless).state(), ItemState::Cancelled);
    }
    let request = wire::ListShapesRequest {
        collection: "c".to_owned(),
        ..Default::default()
    };
    let shapes = call!(client, ListShapes(request)).unwrap().shapes;
    let names: Vec<_> = shapes.iter().map(|s| s.name.as_str()).collect();
    assert_eq!(names, ["a", "b", "after loop", "after loop-placing"]);
}

#[test]
fn what_poisons_the_placing_fails_alone() {
    let home = Home::new();
    let env = [(POISON_VARIABLE, "1"), ("COSEG__WORK__SHAPE_SECONDS", "6")];
    let daemon = home.start_with(&[], &env);
    let client = &mut daemon.client();
    let expected = [
        ("abort-placing", ErrorReason::WorkerDied),
        ("stack-placing", ErrorReason::WorkerDied),
        ("panic-placing", ErrorReason::Panic),
        ("alloc-placing", ErrorReason::ShapeMemory),
        ("loop-placing", ErrorReason::ShapeTimeout),
        ("stack", ErrorReason::WorkerDied),
    ];
    let jobs: Vec<u64> = expected
        .iter()
        .map(|(poison, _)| submit(client, poison, &poisoned(poison)))
        .collect();
    submit(client, "good", &skittle(0));
    super::wait_idle(client, "c");
    for ((poison, reason), job) in expected.iter().zip(jobs) {
        let item = item(client, job);
        assert_eq!(item.state(), ItemState::Failed, "{poison}: {item:?}");
        let error = item.error.unwrap();
        assert_eq!(error.reason(), *reason, "{poison}: {}", error.message);
        let thrice = error.message.contains("3 times");
        let once = matches!(reason, ErrorReason::Panic | ErrorReason::ShapeTimeout);
        assert_eq!(thrice, !once, "{poison}: {}", error.message);
    }
    let stats = call!(client, Stats(wire::StatsRequest {})).unwrap();
    assert_eq!(stats.pid, daemon.child.id(), "the same process");
    assert_eq!(stats.n_failed, 6);
    let next = placed_after(client, "next");
    println!("the next shape is placed within {next:?}");
}

/// A request with a deadline that the daemon cannot meet.
fn late(daemon: &Daemon, body: Body, ms: u64) -> wire::Error {
    use prost::Message as _;
    let request = wire::Request {
        request_id: "late".to_owned(),
        deadline_ms: ms,
        body: Some(body),
        ..Default::default()
    };
    let dealer = super::raw(zmq::DEALER, &daemon.endpoint);
    let begin = Instant::now();
    let error = super::raw_error(&dealer, &[&request.encode_to_vec()]);
    let took = begin.elapsed();
    assert!(took < Duration::from_secs(10), "answered after {took:?}");
    error
}

#[test]
fn deadlines_are_kept_whatever_keeps_the_collection_busy() {
    let home = Home::new();
    let daemon = home.start_with(&["--workers", "1"], &[(POISON_VARIABLE, "1")]);
    let client = &mut daemon.client();
    create_with(client, "c", 2);
    for name in ["a", "b"] {
        submit(client, name, &skittle(0));
    }
    super::wait_idle(client, "c");
    // While the shape is placed, the collection cannot change; requests that wait for it are
    // answered in time.
    let endless = submit(client, "endless", &poisoned("loop-placing"));
    wait_for_stage(client, endless, "place");
    let request = wire::GetJobRequest { job_id: endless };
    let revision = call!(client, GetJob(request))
        .unwrap()
        .job
        .unwrap()
        .revision;
    let c = || "c".to_owned();
    let part = wire::LabelledPart { part: 0, label: 7 };
    let waiting = [
        Body::CorrectLabels(wire::CorrectLabelsRequest {
            collection: c(),
            shape: "a".to_owned(),
            correction: Some(wire::correct_labels_request::Correction::Part(part)),
            by: String::new(),
            closed: None,
        }),
        // Behind the correction, waiting for the collection.
        Body::Undo(wire::UndoRequest { collection: c() }),
        Body::WaitIdle(wire::WaitIdleRequest {
            collection: c(),
            wait_ms: 30_000,
        }),
        Body::WatchJob(wire::WatchJobRequest {
            job_id: endless,
            revision,
            wait_ms: 30_000,
        }),
    ];
    for body in waiting {
        let what = format!("{body:?}");
        let error = late(&daemon, body, 300);
        assert_eq!(
            error.code(),
            ErrorCode::DeadlineExceeded,
            "{what}: {error:?}"
        );
    }
    // Reads do not wait, nor do requests for another collection.
    let nearest = wire::NearestRequest {
        collection: c(),
        shape: "a".to_owned(),
        ..Default::default()
    };
    let neighbors = call!(client, Nearest(nearest)).unwrap().neighbors;
    assert_eq!(neighbors.len(), 1);
    create_with(client, "d", 2);
    assert_eq!(cancel(client, endless), ItemState::Cancelled);
    // The correction was not dropped: it was late, and is made now that it is possible.
    super::wait_idle(client, "c");
    placed_after(client, "next");
}

#[test]
fn kills_while_a_start_takes_up_what_a_kill_left_lose_nothing() {
    let seed = crate::harness::seed();
    println!("COSEG_TEST_SEED={seed}");
    let mut random = <rand_pcg::Pcg64Mcg as rand::SeedableRng>::seed_from_u64(seed);
    let n_kills = crate::harness::number("COSEG_TEST_KILLS", 10);
    let home = Home::new();
    let daemon = home.start();
    let names: Vec<String> = (0..8).map(|i| format!("s{i}")).collect();
    let texts: Vec<String> = (0..8).map(skittle).collect();
    let pairs = names.iter().zip(&texts);
    let shapes: Vec<_> = pairs.map(|(n, t)| (n.as_str(), t.as_str())).collect();
    let (body, frames) = add_request("c", &shapes, wire::AddMode::Job);
    daemon.client().call(body, frames).unwrap();
    daemon.signal(Signal::KILL);
    drop(daemon.ended());
    for _ in 0..n_kills {
        let daemon = home.spawn(&[], &[]);
        // The kill comes between opening the library and the middle of placing.
        let ms = rand::Rng::random_range(&mut random, 0..600);
        std::thread::sleep(Duration::from_millis(ms));
        daemon.signal(Signal::KILL);
        drop(daemon.ended());
    }
    let begin = Instant::now();
    let daemon = home.start();
    println!("ready after {n_kills} kills in {:?}", begin.elapsed());
    let client = &mut daemon.client();
    super::wait_idle(client, "c");
    let events = super::events_since(client, "c");
    let added: Vec<_> = events
        .iter()
        .filter_map(|e| match &e.kind {
            Some(wire::event::Kind::ShapeAdded(a)) => Some(a.shape.clone()),
            _ => None,
        })
        .collect();
    assert_eq!(
        added, names,
        "seed {seed}: in order of acceptance, each once"
    );
    let numbers: Vec<u64> = events.iter().map(|e| e.sequence).collect();
    assert_eq!(numbers, (1..=events.len() as u64).collect::<Vec<_>>());
    drop(daemon);
    let findings = coseg::Library::check(&home.path("library")).unwrap();
    assert!(!findings.iter().any(|f| f.damage), "{findings:?}");
}

#[test]
fn a_full_disk_refuses_changes_serves_reads_and_passes() {
    let home = Home::new();
    let library = home.path("library");
    std::fs::create_dir(&library).unwrap();
    let Some(_mounted) = Mounted::small(&library) else {
        println!("skipped: a small file system cannot be mounted here");
        return;
    };
    let daemon = home.start();
    let client = &mut daemon.client();
    submit(client, "before", &skittle(0));
    submit(client, "gone", &skittle(4));
    super::wait_idle(client, "c");
    let labels = |client: &mut Client| {
        let request = wire::GetLabelsRequest {
            collection: "c".to_owned(),
            shape: "before".to_owned(),
            ..Default::default()
        };
        call!(client, GetLabels(request)).map(|_| ())
    };
    // The disk is filled to the last block.
    let filler = library.join("filler");
    let mut file = std::fs::File::create(&filler).unwrap();
    while std::io::Write::write_all(&mut file, &[0; 4096]).is_ok() {}
    let (body, frames) = add_request("c", &[("refused", &skittle(1))], wire::AddMode::Job);
    match client.call(body, frames) {
        Err(ClientError::Refused(e)) => {
            assert_eq!(e.reason(), ErrorReason::NoSpace, "{e:?}");
            assert!(e.retry_after_ms > 0, "{e:?}");
        }
        other => panic!("{other:?}"),
    }
    labels(client).unwrap();
    // Changes that free space use the reserved space, and the space becomes available again.
    remove(client, "gone");
    labels(client).unwrap();
    let begin = Instant::now();
    while n_objects(&library) > 1 {
        assert!(
            begin.elapsed() < Duration::from_secs(60),
            "nothing was freed"
        );
        std::thread::sleep(Duration::from_millis(100));
    }
    println!(
        "the space of a removed shape came back after {:?}",
        begin.elapsed()
    );
    while std::io::Write::write_all(&mut file, &[0; 4096]).is_ok() {}
    // There is room for the bytes and the job, but not for the placement: the shape waits, and
    // continues by itself.
    file.set_len(std::fs::metadata(&filler).unwrap().len() - (160 << 10))
        .unwrap();
    let job = submit(client, "waits", &skittle(2));
    std::thread::sleep(Duration::from_secs(3));
    let waiting = item(client, job);
    println!(
        "with 160 KiB left the shape is {:?} at {:?}",
        waiting.state(),
        waiting.stage
    );
    labels(client).unwrap();
    drop(file);
    std::fs::remove_file(&filler).unwrap();
    super::wait_idle(client, "c");
    assert_eq!(item(client, job).state(), ItemState::Done);
    submit(client, "after", &skittle(3));
    super::wait_idle(client, "c");
    let stats = call!(client, Stats(wire::StatsRequest {})).unwrap();
    assert_eq!((stats.pid, stats.n_failed), (daemon.child.id(), 0));
    drop(daemon);
    let findings = coseg::Library::check(&library).unwrap();
    assert!(!findings.iter().any(|f| f.damage), "{findings:?}");
}

fn remove(client: &mut Client, shape: &str) {
    let (collection, shape) = ("c".to_owned(), shape.to_owned());
    let request = wire::RemoveShapeRequest { collection, shape };
    call!(client, RemoveShape(request)).unwrap();
}

/// Descriptions on disk.
fn n_objects(library: &std::path::Path) -> usize {
    let prefixes = std::fs::read_dir(library.join("objects")).unwrap();
    prefixes
        .map(|p| std::fs::read_dir(p.unwrap().path()).unwrap().count())
        .sum()
}

#[test]
fn space_of_removed_shapes_comes_back_within_a_minute() {
    let home = Home::new();
    let daemon = home.start();
    let client = &mut daemon.client();
    let library = home.path("library");
    for (name, variant) in [("stays", 0), ("goes", 1), ("again", 2)] {
        submit(client, name, &skittle(variant));
    }
    super::wait_idle(client, "c");
    assert_eq!(n_objects(&library), 3);
    remove(client, "goes");
    remove(client, "again");
    // Data that are added again in the meantime exist afterwards.
    submit(client, "again", &skittle(2));
    super::wait_idle(client, "c");
    let begin = Instant::now();
    while n_objects(&library) > 2 {
        assert!(
            begin.elapsed() < Duration::from_secs(60),
            "nothing was freed"
        );
        std::thread::sleep(Duration::from_millis(100));
    }
    println!("the space came back after {:?}", begin.elapsed());
    assert_eq!(coseg::Library::check(&library).unwrap(), []);
    let request = wire::DeleteCollectionRequest {
        collection: "c".to_owned(),
    };
    call!(client, DeleteCollection(request)).unwrap();
    while n_objects(&library) > 0 {
        assert!(
            begin.elapsed() < Duration::from_secs(120),
            "nothing was freed"
        );
        std::thread::sleep(Duration::from_millis(100));
    }
    assert_eq!(coseg::Library::check(&library).unwrap(), []);
}

/// A file system of a few megabytes; unmounted when dropped.
struct Mounted(std::path::PathBuf);

impl Mounted {
    fn small(path: &std::path::Path) -> Option<Self> {
        let options = ["-t", "tmpfs", "-o", "size=32m", "tmpfs"];
        let done = std::process::Command::new("mount")
            .args(options)
            .arg(path)
            .output();
        done.is_ok_and(|o| o.status.success())
            .then(|| Self(path.to_path_buf()))
    }
}

impl Drop for Mounted {
    fn drop(&mut self) {
        let _ = std::process::Command::new("umount")
            .arg("-l")
            .arg(&self.0)
            .status();
    }
}
