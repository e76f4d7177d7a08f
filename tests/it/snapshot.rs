//! Tests snapshots while shapes are added, restoring, and repairs of damage.

use crate::harness::{Home, add, add_request, coseg, json, skittle};
use coseg::call;
use coseg::ipc::client::Client;
use coseg::ipc::wire;
use std::path::{Path, PathBuf};
use std::process::Output;

fn run(args: &[&str]) -> Output {
    coseg().args(args).output().unwrap()
}

fn texts(n: u32) -> Vec<(String, String)> {
    (0..n).map(|i| (format!("s{i}"), skittle(i % 9))).collect()
}

fn borrowed(texts: &[(String, String)]) -> Vec<(&str, &str)> {
    texts
        .iter()
        .map(|(n, t)| (n.as_str(), t.as_str()))
        .collect()
}

#[test]
fn a_snapshot_while_shapes_come_in_restores_to_the_byte() {
    let home = Home::new();
    let daemon = home.start();
    let client = &mut daemon.client();
    let texts = texts(12);
    add(client, "c", &borrowed(&texts)[..4]);
    let (body, frames) = add_request("c", &borrowed(&texts)[4..], wire::AddMode::Job);
    client.call(body, frames).unwrap();
    let library = home.path("library").display().to_string();
    let at = |name: &str| home.path(name).display().to_string();
    // Several snapshots, one after the other, while the daemon commits.
    for i in 0..4 {
        let copy = at(&format!("copy{i}"));
        let link = if i == 3 { "--link" } else { "--json" };
        let out = run(&["snapshot", &copy, "--library", &library, link]);
        assert!(
            out.status.success(),
            "{}",
            String::from_utf8_lossy(&out.stderr)
        );
        assert!(!Path::new(&format!("{copy}.partial")).exists());
    }
    super::harness::wait_idle(client, "c");
    // The newest snapshot equals the library at these versions.
    let other = Home::new();
    let restored = other.path("library").display().to_string();
    let out = run(&["restore", &at("copy3"), "--library", &restored]);
    assert!(
        out.status.success(),
        "{}",
        String::from_utf8_lossy(&out.stderr)
    );
    let again = run(&["restore", &at("copy3"), "--library", &restored]);
    assert_eq!(again.status.code(), Some(1), "a library is not overwritten");
    // After restoring, its queued shapes are placed as in the library itself.
    let copy = other.start();
    let twin = &mut copy.client();
    super::harness::wait_idle(twin, "c");
    for (name, _) in &texts {
        let get = |client: &mut Client| {
            let (collection, shape) = ("c".to_owned(), name.clone());
            let labels = wire::GetLabelsRequest {
                collection: collection.clone(),
                shape: shape.clone(),
                confidence: true,
                ..Default::default()
            };
            let spectrum = wire::GetSpectrumRequest {
                collection,
                shape,
                eigenvectors: true,
                ..Default::default()
            };
            let labels = call!(client, GetLabels(labels), frames).unwrap();
            (
                labels,
                call!(client, GetSpectrum(spectrum), frames).unwrap(),
            )
        };
        assert_eq!(get(client).0.1, get(twin).0.1, "labels of {name}");
        assert_eq!(get(client).1, get(twin).1, "spectrum of {name}");
    }
}

fn damaged(library: &Path, folder: &str) -> PathBuf {
    let mut found = Vec::new();
    for prefix in std::fs::read_dir(library.join(folder)).unwrap() {
        for file in std::fs::read_dir(prefix.unwrap().path()).unwrap() {
            found.push(file.unwrap().path());
        }
    }
    found.sort();
    let mut bytes = std::fs::read(&found[0]).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 4;
    std::fs::write(&found[0], bytes).unwrap();
    found.swap_remove(0)
}

#[test]
fn what_can_be_computed_again_is_repaired_and_the_rest_is_named() {
    let home = Home::new();
    let texts = texts(4);
    let daemon = home.start();
    add(&mut daemon.client(), "c", &borrowed(&texts));
    super::harness::wait_idle(&mut daemon.client(), "c");
    let library = home.path("library");
    let name = library.display().to_string();
    let held = run(&["check", "--repair", "--library", &name]);
    assert_eq!(held.status.code(), Some(1), "a daemon holds it");
    drop(daemon);
    let check = |args: &[&str], code| {
        let args = [&["check", "--json", "--library", &name], args].concat();
        json(&run(&args), code)
    };
    let findings = |value: &serde_json::Value| {
        let list = value["findings"].as_array().unwrap().clone();
        let damage = list.into_iter().filter(|f| f["damage"] == true);
        damage
            .map(|f| f["place"].as_str().unwrap().to_owned())
            .collect::<Vec<_>>()
    };
    assert_eq!(findings(&check(&[], 0)), [""; 0]);

    // The damage: the description of one shape, the signature of another, a map, and an index.
    let whole = damaged(&library, "objects");
    let whole_name = whole.strip_prefix(&library).unwrap().display().to_string();
    let connection = rusqlite::Connection::open(library.join("catalog.db")).unwrap();
    for table in ["shape_signatures", "maps"] {
        connection
            .execute_batch(&format!(
                "DROP TRIGGER {table}_updated; UPDATE {table} SET sum = sum + 1 WHERE rowid =
                 (SELECT max(rowid) FROM {table})"
            ))
            .unwrap();
    }
    drop(connection);
    let found = findings(&check(&[], 1));
    assert!(found.contains(&whole_name), "{found:?}");
    assert!(
        found.iter().any(|f| f.starts_with("shape_signatures")),
        "{found:?}"
    );
    assert!(found.iter().any(|f| f.starts_with("maps")), "{found:?}");
    let repaired = check(&["--repair"], 0);
    println!("{}", repaired["repaired"]);
    assert_eq!(findings(&repaired), [""; 0]);
    assert!(whole.exists(), "computed again, to the bit");
    assert_eq!(
        std::fs::read_dir(library.join("quarantine"))
            .unwrap()
            .count(),
        1
    );

    // The original bytes cannot be recomputed: they are reported, and everything else is served.
    let original = damaged(&library, "originals");
    let original = original
        .strip_prefix(&library)
        .unwrap()
        .display()
        .to_string();
    assert_eq!(findings(&check(&["--repair"], 1)), [original]);
    let daemon = home.start();
    let client = &mut daemon.client();
    let mut n_lost = 0;
    for (shape, _) in &texts {
        let (collection, shape) = ("c".to_owned(), shape.clone());
        let request = wire::GetLabelsRequest {
            collection: collection.clone(),
            shape: shape.clone(),
            ..Default::default()
        };
        call!(client, GetLabels(request)).unwrap();
        let request = wire::GetOriginalRequest { collection, shape };
        match call!(client, GetOriginal(request)) {
            Ok(_) => {}
            Err(coseg::ipc::client::ClientError::Refused(e)) => {
                assert_eq!(e.code(), wire::ErrorCode::DataLoss);
                n_lost += 1;
            }
            Err(e) => panic!("{e}"),
        }
    }
    assert_eq!(n_lost, 1);
    add(client, "c", &[("new", &skittle(8))]);
}

#[test]
fn what_a_killed_copy_left_is_taken_over_and_nothing_else() {
    let home = Home::new();
    let daemon = home.start();
    add(&mut daemon.client(), "c", &[("a", &skittle(0))]);
    let library = home.path("library").display().to_string();
    let copy = home.path("copy");
    let snapshot = || {
        run(&[
            "snapshot",
            &copy.display().to_string(),
            "--library",
            &library,
        ])
    };
    let partial = home.path("copy.partial");
    std::fs::create_dir_all(partial.join("objects/ab")).unwrap();
    std::fs::write(partial.join("objects/ab/half"), "half").unwrap();
    std::fs::write(partial.join("catalog.db"), "half").unwrap();
    // Another copy is still running.
    let other = std::fs::File::open(&partial).unwrap();
    rustix::fs::flock(&other, rustix::fs::FlockOperation::LockExclusive).unwrap();
    let refused = snapshot();
    let message = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert_eq!(refused.status.code(), Some(1), "{message}");
    assert!(message.contains("another process is writing"), "{message}");
    drop(other);
    // It contains files that no copy leaves.
    let mine = partial.join("mine.txt");
    std::fs::write(&mine, "mine").unwrap();
    let refused = snapshot();
    let message = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert_eq!(refused.status.code(), Some(1), "{message}");
    assert!(
        message.contains("contains files that no copy leaves"),
        "{message}"
    );
    assert!(partial.join("objects/ab/half").exists());
    std::fs::remove_file(mine).unwrap();
    let done = snapshot();
    let message = String::from_utf8_lossy(&done.stderr).into_owned();
    assert!(done.status.success(), "{message}");
    assert!(!partial.exists() && !copy.join("objects/ab/half").exists());
    // A folder that another user has replaced by a link is not written through.
    let elsewhere = home.path("elsewhere");
    std::fs::create_dir(&elsewhere).unwrap();
    std::os::unix::fs::symlink(&elsewhere, home.path("linked.partial")).unwrap();
    let linked = home.path("linked").display().to_string();
    let refused = run(&["snapshot", &linked, "--library", &library]);
    assert_eq!(refused.status.code(), Some(1));
    assert_eq!(std::fs::read_dir(&elsewhere).unwrap().count(), 0);
}
