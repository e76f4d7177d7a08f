//! Publishes collections of a real daemon, labels new meshes by the bundle in another process, and
//! compares every bit with the labels that the daemon then gives to the same meshes.

use super::wait_idle;
use crate::harness::{Daemon, Home, coseg, json, refusal, stdout};
use coseg::call;
use coseg::ipc::client::Client;
use coseg::ipc::frames::FrameReader;
use coseg::ipc::wire::{self, ErrorCode, ErrorReason, request::Body};
use coseg::mesh::write::off;
use coseg::synth::{Family, Labelled, Options, family};
use serde_json::Value;
use std::path::{Path, PathBuf};

const SMALL: Options = Options {
    n_faces: 1_000,
    rotate: false,
};
/// Finer than the proxy, so that boundaries are refined on the file's own faces.
const FINE: Options = Options {
    n_faces: 6_000,
    rotate: false,
};
const C: &str = "chairs";

/// What the daemon or a bundle says of one shape, bit for bit.
#[derive(Debug, PartialEq)]
struct Said {
    labels: Vec<i32>,
    confidence: Vec<u32>,
    parts: Value,
    sources: Value,
    report: Value,
    digest: Value,
}

/// Writes meshes to a folder.
fn folder(home: &Home, name: &str, shapes: &[Labelled]) -> PathBuf {
    let folder = home.path(name);
    std::fs::create_dir_all(&folder).unwrap();
    for s in shapes {
        std::fs::write(folder.join(format!("{}.off", s.name)), off(&s.mesh)).unwrap();
        let labels: String = s.labels.iter().map(|l| format!("{l}\n")).collect();
        std::fs::write(folder.join(format!("{}.labels.txt", s.name)), labels).unwrap();
    }
    folder
}

/// Chairs of which the first `n` are for the library, in `known`, and three others in `new`. One of
/// the others is finer than the proxies.
fn chairs(home: &Home, n: usize) -> (Vec<Labelled>, Vec<Labelled>) {
    let mut known = family(Family::Chair, 31, n as u32 + 2, &SMALL);
    let mut new = known.split_off(n);
    let fine = family(Family::Chair, 77, 1, &FINE);
    new.extend(fine.into_iter().map(|chair| Labelled {
        name: "fine".to_owned(),
        ..chair
    }));
    folder(home, "known", &known);
    folder(home, "new", &new);
    (known, new)
}

fn run(home: &Home, args: &[&str]) -> String {
    stdout(&home.coseg(args), 0)
}

fn publish(home: &Home, name: &str) -> Value {
    let out = home.path(name).display().to_string();
    json(&home.coseg(&["publish", C, "-o", &out, "--json"]), 0)
}

/// Labels a folder by a bundle, in a process that knows of no daemon.
fn label(home: &Home, bundle: &str, meshes: &str, out: &str, threads: &str) -> Value {
    let path = |name: &str| home.path(name).display().to_string();
    let mut command = coseg();
    command.args(["label", &path(meshes), "--bundle", &path(bundle)]);
    command.args(["--out", &path(out), "--threads", threads]);
    command.args(["--format", "json", "--confidence", "--json"]);
    command.env("COSEG_ENDPOINT", "ipc:///nobody/listens/here");
    json(&command.output().unwrap(), 0)
}

fn read(path: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

fn by_bundle(home: &Home, out: &str, name: &str) -> Said {
    let out = home.path(out);
    let labels = read(&out.join(format!("{name}.labels.json")));
    let report = read(&out.join(format!("{name}.report.json")));
    let bits = |x: &Value| (x.as_f64().unwrap() as f32).to_bits();
    Said {
        labels: serde_json::from_value(labels["labels"].clone()).unwrap(),
        confidence: report["confidence"]
            .as_array()
            .unwrap()
            .iter()
            .map(bits)
            .collect(),
        parts: report["parts"].clone(),
        sources: report["sources"].clone(),
        report: report["report"].clone(),
        digest: report["content_digest"].clone(),
    }
}

/// Labels that the bundle says are missing.
fn missing(home: &Home, out: &str, name: &str) -> Vec<i32> {
    let report = read(&home.path(out).join(format!("{name}.report.json")));
    serde_json::from_value(report["missing"].clone()).unwrap()
}

/// Adds a mesh to the daemon and returns what it says of it.
fn by_daemon(home: &Home, client: &mut Client, name: &str) -> Said {
    let path = home.path("new").join(format!("{name}.off"));
    run(home, &["add", &path.display().to_string(), "-c", C]);
    let request = wire::GetLabelsRequest {
        collection: C.to_owned(),
        shape: name.to_owned(),
        version: 1,
        confidence: true,
    };
    let (reply, frames) = call!(client, GetLabels(request), frames).unwrap();
    let reader = FrameReader::new(&frames);
    let labels = reader.i32_array(reply.labels.as_ref(), "labels").unwrap().0;
    let confidence = reader.f32_array(reply.confidence.as_ref(), "confidence");
    let shown = json(&home.coseg(&["show", name, "-c", C, "--json"]), 0);
    Said {
        confidence: confidence
            .unwrap()
            .0
            .into_iter()
            .map(f32::to_bits)
            .collect(),
        labels,
        parts: shown["parts"].clone(),
        sources: shown["sources"].clone(),
        report: shown["report"].clone(),
        digest: shown["content_digest"].clone(),
    }
}

/// Labels in use in the collection, ascending.
fn in_use(home: &Home) -> Vec<i32> {
    let shown = json(&home.coseg(&["show", "-c", C, "--json"]), 0);
    let labels = shown["labels"].as_array().unwrap().iter();
    let used = labels.filter(|l| l["n_shapes"].as_u64().unwrap() > 0);
    used.map(|l| l["id"].as_i64().unwrap() as i32).collect()
}

/// Publishes the collection, labels all new meshes by the bundle on one thread and on two, and
/// compares with the labels that the daemon gives to each of them when it is the next to arrive.
/// The library is copied for each, so that all of them meet the same collection.
fn compare(home: &Home, daemon: Daemon, new: &[Labelled], bundle: &str) -> (Daemon, Value) {
    let published = publish(home, bundle);
    let one = label(home, bundle, "new", "one", "1");
    let two = label(home, bundle, "new", "two", "2");
    assert_eq!(one["n_labelled"], 3, "{one}");
    assert_eq!(one["bundle"], published["bundle"]);
    assert_eq!(one["sequence"], published["sequence"]);
    assert_eq!(two["n_failed"], 0);
    let used = in_use(home);
    drop(daemon);
    for shape in new {
        let by_bundle = [
            by_bundle(home, "one", &shape.name),
            by_bundle(home, "two", &shape.name),
        ];
        assert_eq!(by_bundle[0], by_bundle[1], "on one thread and on two");
        let copy = Home::new();
        let library = [home.path("library"), copy.path("library")];
        let [from, to] = library.map(|l| l.display().to_string());
        let copied = coseg().args(["snapshot", &to, "--library", &from]).output();
        stdout(&copied.unwrap(), 0);
        folder(&copy, "new", std::slice::from_ref(shape));
        let daemon = copy.start();
        let by_daemon = self::by_daemon(&copy, &mut daemon.client(), &shape.name);
        assert!(by_daemon.labels.len() > 100 && !by_daemon.parts.as_array().unwrap().is_empty());
        assert_eq!(
            by_bundle[0], by_daemon,
            "{}: the bundle and the daemon",
            shape.name
        );
        let (missing, has) = (missing(home, "one", &shape.name), &by_daemon.labels);
        assert!(missing.iter().all(|l| !has.contains(l)), "{missing:?}");
        if published["clusters_next"] == false {
            let lacks = |l: &&i32| !has.contains(l);
            assert!(
                used.iter().filter(lacks).all(|l| missing.contains(l)),
                "{missing:?}"
            );
        }
    }
    (home.start(), published)
}

fn correct(home: &Home, shape: &Labelled, more: &[&str]) {
    let labels = home
        .path("known")
        .join(format!("{}.labels.txt", shape.name));
    let labels = labels.display().to_string();
    run(
        home,
        &[&["correct", &shape.name, &labels, "-c", C][..], more].concat(),
    );
}

#[test]
fn a_bundle_labels_as_the_daemon_does_while_labels_are_discovered_and_once_they_are_corrected() {
    let home = Home::new();
    let (known, new) = chairs(&home, 7);
    let daemon = home.start();
    let folder = home.path("known").display().to_string();
    run(
        &home,
        &["add", &folder, "-c", C, "--parts", "4", "--up", "+y"],
    );
    let (daemon, published) = compare(&home, daemon, &new, "discovered.coseg");
    assert_eq!(published["n_bundled"], 7);
    assert_eq!(published["clusters_next"], false);
    // A person labels one part: the vocabulary is open.
    run(
        &home,
        &[
            "correct",
            &known[1].name,
            "--part",
            "0",
            "--label",
            "0",
            "-c",
            C,
        ],
    );
    let (daemon, _) = compare(&home, daemon, &new[..1], "open.coseg");
    // A person labels one whole shape: the vocabulary is covered.
    correct(&home, &known[0], &[]);
    let (daemon, _) = compare(&home, daemon, &new, "covered.coseg");
    correct(&home, &known[2], &["--closed"]);
    let (_daemon, _) = compare(&home, daemon, &new, "closed.coseg");
    let digest = |name: &str| std::fs::read(home.path(name)).unwrap();
    assert_ne!(digest("covered.coseg"), digest("closed.coseg"));
}

#[test]
fn a_bundle_labels_as_the_daemon_does_when_the_next_shape_clusters_again_and_parts_are_linked() {
    let home = Home::new();
    let (_, new) = chairs(&home, 6);
    let daemon = home.start();
    let folder = home.path("known").display().to_string();
    run(
        &home,
        &["add", &folder, "-c", C, "--parts", "4", "--up", "auto"],
    );
    let (daemon, published) = compare(&home, daemon, &new[1..], "six.coseg");
    assert_eq!(
        published["clusters_next"], true,
        "the seventh shape clusters"
    );
    let rows = label(&home, "six.coseg", "new", "six", "2");
    assert!(rows["shapes"][0]["reclustered"].is_boolean(), "{rows}");
    let names: Vec<String> = {
        let shapes = json(&home.coseg(&["ls", C, "--json"]), 0);
        let shapes = shapes["shapes"].as_array().unwrap().iter();
        shapes
            .map(|s| s["name"].as_str().unwrap().to_owned())
            .collect()
    };
    let parts = [format!("{}:0", names[0]), format!("{}:1", names[1])];
    run(&home, &["differ", &parts[0], &parts[1], "-c", C]);
    compare(&home, daemon, &new[1..2], "linked.coseg");
}

#[test]
fn the_same_moment_gives_the_same_file_and_a_published_file_never_changes() {
    let home = Home::new();
    let (known, new) = chairs(&home, 5);
    let daemon = home.start();
    let folder = home.path("known").display().to_string();
    run(&home, &["add", &folder, "-c", C, "--parts", "4"]);
    let first = publish(&home, "a.coseg");
    let again = publish(&home, "b.coseg");
    let bytes = |name: &str| std::fs::read(home.path(name)).unwrap();
    assert_eq!(bytes("a.coseg"), bytes("b.coseg"));
    assert_eq!(first["bundle"], again["bundle"]);
    label(&home, "a.coseg", "new", "before", "2");
    let before = by_bundle(&home, "before", &new[0].name);
    correct(&home, &known[0], &[]);
    let later = publish(&home, "b.coseg");
    assert_ne!(first["bundle"], later["bundle"]);
    drop(daemon);
    label(&home, "a.coseg", "new", "after", "1");
    assert_eq!(by_bundle(&home, "after", &new[0].name), before);
    let leftovers = std::fs::read_dir(home.dir.path()).unwrap();
    let is_part = |e: std::io::Result<std::fs::DirEntry>| {
        e.unwrap().file_name().to_string_lossy().ends_with(".part")
    };
    assert!(!leftovers.into_iter().any(is_part));
}

#[test]
fn what_cannot_be_published_is_refused_with_what_to_do() {
    let home = Home::new();
    let daemon = home.start();
    let mut client = daemon.client();
    let publish = |client: &mut Client, name: &str| {
        let collection = name.to_owned();
        refusal(client, Body::Publish(wire::PublishRequest { collection }))
    };
    assert_eq!(
        publish(&mut client, "none"),
        (ErrorCode::NotFound, ErrorReason::NoCollection)
    );
    run(&home, &["collections", "create", C, "--parts", "4"]);
    let not_yet = (ErrorCode::FailedPrecondition, ErrorReason::NotPublishable);
    assert_eq!(publish(&mut client, C), not_yet);
    let (known, _) = chairs(&home, 4);
    let folder = home.path("known").display().to_string();
    run(&home, &["add", &folder, "-c", C, "--parts", "4"]);
    assert_eq!(publish(&mut client, C), not_yet);
    let out = home.path("x.coseg").display().to_string();
    let refused = home.coseg(&["publish", C, "-o", &out]);
    stdout(&refused, 1);
    let text = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(
        text.contains("has 4 shapes") && text.contains("label one by hand"),
        "{text}"
    );
    assert!(!home.path("x.coseg").exists());
    // One shape that a person labelled is enough, and so are four shapes then.
    correct(&home, &known[0], &[]);
    wait_idle(&mut client, C);
    self::publish(&home, "x.coseg");
    let request = wire::GetArrayFileRequest {
        collection: C.to_owned(),
        shape: known[0].name.clone(),
        blake3: "0".repeat(64),
    };
    assert_eq!(
        refusal(&mut client, Body::GetArrayFile(request.clone())),
        (ErrorCode::FailedPrecondition, ErrorReason::Gone)
    );
    let blake3 = "no digest".to_owned();
    let request = wire::GetArrayFileRequest { blake3, ..request };
    assert_eq!(
        refusal(&mut client, Body::GetArrayFile(request)),
        (ErrorCode::InvalidArgument, ErrorReason::FieldRange)
    );
}

#[test]
fn a_bad_mesh_costs_its_own_row_and_a_bad_bundle_the_command() {
    let home = Home::new();
    let (_, _) = chairs(&home, 5);
    let daemon = home.start();
    let folder = home.path("known").display().to_string();
    run(&home, &["add", &folder, "-c", C, "--parts", "4"]);
    publish(&home, "c.coseg");
    std::fs::write(
        home.path("new").join("bad.off"),
        "OFF\n3 1 0\n0 0 0\n1 0 0\n",
    )
    .unwrap();
    let path = |name: &str| home.path(name).display().to_string();
    let by = |bundle: &str, more: &[&str]| {
        let (new, bundle, out) = (path("new"), path(bundle), path("out"));
        let args = ["label", &new, "--bundle", &bundle, "--out", &out, "--json"];
        coseg().args(args).args(more).output().unwrap()
    };
    let done = by("c.coseg", &[]);
    let rows = json(&done, 1);
    assert_eq!(
        (&rows["n_labelled"], &rows["n_failed"]),
        (&3.into(), &1.into())
    );
    let bad = rows["shapes"]
        .as_array()
        .unwrap()
        .iter()
        .find(|r| r["name"] == "bad");
    assert_eq!(bad.unwrap()["error"]["reason"], "PARSE");
    // The message is that of the daemon for the same file.
    let added = home.coseg(&["add", &path("new/bad.off"), "-c", C, "--json"]);
    let added = json(&added, 1);
    assert_eq!(
        added["shapes"][0]["error"]["message"],
        bad.unwrap()["error"]["message"]
    );
    // Files are those of `coseg export` and no others.
    let mut files: Vec<String> = std::fs::read_dir(home.path("out"))
        .unwrap()
        .map(|e| e.unwrap().file_name().to_string_lossy().into_owned())
        .collect();
    files.sort();
    assert_eq!(files.len(), 6, "{files:?}");
    assert!(files.contains(&"fine.labels.txt".to_owned()));
    assert!(files.contains(&"fine.report.json".to_owned()));
    drop(daemon);
    std::fs::write(
        home.path("cut.coseg"),
        &std::fs::read(home.path("c.coseg")).unwrap()[..5000],
    )
    .unwrap();
    for (bundle, expected) in [
        ("none.coseg", "none.coseg: No such file"),
        ("cut.coseg", "is no bundle of `coseg publish`"),
        ("new/fine.off", "is no bundle of `coseg publish`"),
    ] {
        let refused = by(bundle, &[]);
        assert_eq!(refused.status.code(), Some(1));
        let text = String::from_utf8_lossy(&refused.stderr).into_owned();
        assert!(text.contains(expected), "{text}");
        assert!(refused.stdout.is_empty());
    }
    assert_eq!(by("c.coseg", &["--format", "obj"]).status.code(), Some(2));
}
