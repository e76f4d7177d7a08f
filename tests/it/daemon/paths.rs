//! Tests files that requests name by path.

use super::{create, create_with, raw};
use crate::harness::{Home, add, skittle};
use coseg::call;
use coseg::ipc::client::ClientError;
use coseg::ipc::wire::{self, ErrorCode, ErrorReason, ItemState, Request, reply, request};
use prost::Message as _;
use std::time::Duration;

#[test]
fn paths_are_read_only_where_the_configuration_allows() {
    let home = Home::new();
    let allowed = home.path("allowed");
    std::fs::create_dir(&allowed).unwrap();
    std::fs::write(allowed.join("in.off"), skittle(0)).unwrap();
    let outside = home.mesh("out.off", &skittle(0));
    std::os::unix::fs::symlink(&outside, allowed.join("link.off")).unwrap();
    let roots = allowed.display().to_string();
    let daemon = home.start_with(&[], &[("COSEG__INGEST__PATHS", &roots)]);
    let client = &mut daemon.client();
    create(client, "c");
    let mut by_path = |path: String| {
        let shape = wire::ShapeInput {
            name: "a".to_owned(),
            replace: false,
            source: Some(wire::shape_input::Source::Path(path)),
        };
        let request = wire::AddShapesRequest {
            collection: "c".to_owned(),
            shapes: vec![shape],
            mode: wire::AddMode::Wait.into(),
            create: None,
        };
        call!(client, AddShapes(request))
    };
    for forbidden in [
        outside,
        format!("{roots}/../out.off"),
        format!("{roots}/link.off"),
        format!("{roots}/missing.off"),
        "in.off".to_owned(),
    ] {
        match by_path(forbidden.clone()) {
            Err(ClientError::Refused(e)) => {
                assert_eq!(e.reason(), ErrorReason::PathForbidden, "{forbidden}");
            }
            other => panic!("{forbidden}: {other:?}"),
        }
    }
    let job = by_path(format!("{roots}/in.off")).unwrap().job.unwrap();
    assert_eq!(job.items[0].state(), ItemState::Done);
}

/// Adds one shape by its path.
fn by_path(name: &str, path: &std::path::Path, mode: wire::AddMode) -> request::Body {
    let shape = wire::ShapeInput {
        name: name.to_owned(),
        replace: false,
        source: Some(wire::shape_input::Source::Path(path.display().to_string())),
    };
    request::Body::AddShapes(wire::AddShapesRequest {
        collection: "c".to_owned(),
        shapes: vec![shape],
        mode: mode.into(),
        create: None,
    })
}

#[test]
fn a_file_that_hangs_stalls_the_request_that_names_it_and_no_other() {
    let home = Home::new();
    let allowed = home.path("allowed");
    std::fs::create_dir(&allowed).unwrap();
    let good = allowed.join("good.off");
    std::fs::write(&good, skittle(0)).unwrap();
    let roots = allowed.display().to_string();
    let daemon = home.start_with(&[], &[("COSEG__INGEST__PATHS", &roots)]);
    let client = &mut daemon.client();
    create_with(client, "c", 2);
    // A pipe without a writer does not make the daemon wait.
    let pipe = allowed.join("pipe.off");
    let mode = rustix::fs::Mode::RUSR | rustix::fs::Mode::WUSR;
    rustix::fs::mknodat(rustix::fs::CWD, &pipe, rustix::fs::FileType::Fifo, mode, 0).unwrap();
    let error = crate::harness::refusal(client, by_path("p", &pipe, wire::AddMode::Job));
    assert_eq!(
        error,
        (ErrorCode::InvalidArgument, ErrorReason::PathUnreadable)
    );

    // Opening a file that another process has leased and does not release hangs, like a file on an
    // unreachable network file system.
    // does that is away.
    let hangs = allowed.join("hangs.off");
    std::fs::write(&hangs, skittle(1)).unwrap();
    let lease = "import fcntl, signal, sys, time\n\
                 signal.signal(signal.SIGIO, signal.SIG_IGN)\n\
                 f = open(sys.argv[1], 'r+')\n\
                 fcntl.fcntl(f, fcntl.F_SETLEASE, fcntl.F_WRLCK)\n\
                 print('leased', flush=True)\n\
                 sys.stdin.read()\n";
    let holder = std::process::Command::new("python3")
        .args(["-c", lease])
        .arg(&hangs)
        .stdin(std::process::Stdio::piped())
        .stdout(std::process::Stdio::piped())
        .spawn();
    let Ok(mut holder) = holder else {
        println!("skipped: no python3");
        return;
    };
    let mut line = String::new();
    let mut printed = std::io::BufReader::new(holder.stdout.take().unwrap());
    std::io::BufRead::read_line(&mut printed, &mut line).unwrap();
    if line.trim() != "leased" {
        println!("skipped: files cannot be leased here");
        holder.wait().unwrap();
        return;
    }
    let dealer = raw(zmq::DEALER, &daemon.endpoint);
    let late = |id: &str, ms| {
        let request = Request {
            request_id: id.to_owned(),
            deadline_ms: ms,
            body: Some(by_path(id, &hangs, wire::AddMode::Job)),
            ..Default::default()
        };
        request.encode_to_vec()
    };
    let begin = std::time::Instant::now();
    for n in 0..20 {
        dealer.send(late(&format!("hangs{n}"), 4_000), 0).unwrap();
    }
    // Other requests continue meanwhile, with bytes and with paths.
    assert_eq!(
        add(client, "c", &[("bytes", &skittle(2))]).items[0].state(),
        ItemState::Done
    );
    let added = client.call(by_path("path", &good, wire::AddMode::Wait), Vec::new());
    added.unwrap();
    let took = begin.elapsed();
    println!("others were placed within {took:?}");
    assert!(took < Duration::from_secs(4), "{took:?}");
    for _ in 0..20 {
        let reply = dealer.recv_multipart(0).unwrap();
        let reply = wire::Reply::decode(&*reply[0]).unwrap();
        let Some(reply::Result::Error(error)) = reply.result else {
            panic!("{reply:?}");
        };
        assert_eq!(error.code(), ErrorCode::DeadlineExceeded, "{error:?}");
    }
    let took = begin.elapsed();
    assert!(took < Duration::from_secs(12), "{took:?}");
    // Once released, it is an ordinary file.
    drop(holder.stdin.take());
    holder.wait().unwrap();
    let added = client.call(by_path("free", &hangs, wire::AddMode::Wait), Vec::new());
    added.unwrap();
}
