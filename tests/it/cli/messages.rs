//! Tests that messages name the value, the limit and the remedy.

use super::{home_with_folder, stderr};
use crate::harness::{Home, coseg, json, skittle, stdout};
use std::fs::Permissions;
use std::os::unix::fs::PermissionsExt as _;

#[test]
fn a_folder_with_bad_and_double_names_adds_the_rest() {
    let (home, folder) = home_with_folder();
    let _daemon = home.start();
    let within = |name: &str| home.path("meshes").join(name);
    std::fs::write(within("a\nb.off"), skittle(3)).unwrap();
    std::fs::write(within("c\td.off"), skittle(4)).unwrap();
    std::fs::write(within("9.stl"), "solid\n").unwrap();
    let output = home.coseg(&["add", &folder, "-c", "c", "--parts", "2", "--json"]);
    let added = json(&output, 1);
    assert_eq!(
        (&added["n_added"], &added["n_failed"]),
        (&3.into(), &3.into())
    );
    let message = stderr(&output);
    for part in [
        "a\\nb.off: the shape name \"a\\nb\" has '\\n'",
        "c\\td.off: the shape name \"c\\td\" has '\\t'",
        "9.stl: would be named \"9\", as ",
    ] {
        assert!(message.contains(part), "{part}: {message}");
    }

    std::fs::create_dir_all(within("more/deep")).unwrap();
    std::fs::write(within("more/deep/1.off"), skittle(5)).unwrap();
    let output = home.coseg(&["add", &folder, "-c", "c"]);
    assert!(
        stderr(&output).contains("--recursive adds them"),
        "{}",
        stderr(&output)
    );
    let more = within("more").display().to_string();
    let output = home.coseg(&["add", &more, "-c", "c"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(
        stderr(&output).contains("deep/1.off: add --recursive"),
        "{}",
        stderr(&output)
    );
    let output = home.coseg(&["add", &more, "-c", "c", "--recursive"]);
    assert!(stdout(&output, 0).starts_with("deep__1: added"));
}

#[test]
fn sizes_have_units_and_the_key_that_raises_the_limit() {
    let home = Home::new();
    let limits = [("COSEG__LIMITS__MAX_SHAPE", "16KiB")];
    let _daemon = home.start_with(&[], &limits);
    let mesh = home.mesh("m.off", &skittle(0));
    let n = skittle(0).len();
    let output = home.coseg(&["add", &mesh]);
    assert_eq!(output.status.code(), Some(1));
    let message = stderr(&output);
    let size = format!(
        "m: the file has {:.1} KiB ({n} bytes), the limit is 16 KiB ",
        n as f64 / 1024.0
    );
    assert!(
        message.contains(&size) && message.contains("limits.max_shape"),
        "{message}"
    );
}

#[test]
fn a_wrong_name_hears_what_was_probably_meant() {
    let (home, folder) = home_with_folder();
    let _daemon = home.start();
    stdout(
        &home.coseg(&["add", &folder, "-c", "skittles", "--parts", "2"]),
        0,
    );
    for (args, message) in [
        (
            &["show", "-c", "skitles"][..],
            "no collection named \"skitles\"; did you mean \"skittles\"?",
        ),
        (
            &["collections", "delete", "Skittles"],
            "no collection named \"Skittles\"; did you mean \"skittles\"?",
        ),
        (
            &["labels", "big one"],
            "no shape named \"big one\"; did you mean \"Big One\"?",
        ),
        (
            &["rm", "Bg One"],
            "no shape named \"Bg One\"; did you mean \"Big One\"?",
        ),
        (&["labels", "armchair"], "no shape named \"armchair\"\n"),
    ] {
        let output = home.coseg(args);
        assert_eq!(output.status.code(), Some(1), "{args:?}");
        assert!(
            stderr(&output).contains(message),
            "{args:?}: {}",
            stderr(&output)
        );
    }
}

#[test]
fn labels_go_by_name_and_collections_by_place() {
    let (home, folder) = home_with_folder();
    let _daemon = home.start();
    stdout(&home.coseg(&["add", &folder, "-c", "c", "--parts", "2"]), 0);
    stdout(&home.coseg(&["collections", "create", "d"]), 0);
    let listed = json(&home.coseg(&["ls", "c", "--json"]), 0);
    assert_eq!(listed["shapes"].as_array().unwrap().len(), 3);
    assert_eq!(stdout(&home.coseg(&["wait", "c"]), 0), "");
    let shown = json(&home.coseg(&["show", "-c", "c", "--json"]), 0);
    let id = |i: usize| shown["labels"][i]["id"].to_string();
    let named = home.coseg(&["name", &id(0), "head", "-c", "c"]);
    assert_eq!(stdout(&named, 0), "");
    assert_eq!(
        stderr(&named),
        format!("label {} is named \"head\"\n", id(0))
    );
    let by_name = stdout(&home.coseg(&["ls", "c", "--label", "head"]), 0);
    assert_eq!(
        by_name,
        stdout(&home.coseg(&["ls", "c", "--label", &id(0)]), 0)
    );
    stdout(&home.coseg(&["name", "head", "Head", "-c", "c"]), 0);
    let corrected = home.coseg(&["correct", "9", "--part", "0", "--label", "Head", "-c", "c"]);
    stdout(&corrected, 0);
    let wrong = home.coseg(&["merge", &id(1), "haed", "-c", "c"]);
    assert_eq!(wrong.status.code(), Some(1));
    let expected = "coseg: no label is named \"haed\"; did you mean \"Head\"?\n";
    assert_eq!(stderr(&wrong), expected);
    let merged = home.coseg(&["merge", &id(1), "Head", "-c", "c"]);
    let expected = format!("label {} is {} now, on ", id(1), id(0));
    assert!(
        stderr(&merged).starts_with(&expected),
        "{}",
        stderr(&merged)
    );
}

#[test]
fn a_library_that_is_held_names_the_holder() {
    let home = Home::new();
    let daemon = home.start();
    let library = home.path("library").display().to_string();
    let other = format!("ipc://{}", home.path("other").display());
    let serve = || {
        let mut command = coseg();
        command.args(["serve", "--library", &library, "--endpoint", &other]);
        command.output().unwrap()
    };
    let refused = serve();
    assert_eq!(refused.status.code(), Some(1));
    let (pid, at) = (daemon.child.id(), home.endpoint());
    let holder = format!(
        "is held by process {pid}, the daemon at {at}; `coseg stop --endpoint {at}` ends it"
    );
    assert!(stderr(&refused).contains(&holder), "{}", stderr(&refused));
    // The same holds for the same socket.
    let mut command = coseg();
    command.args(["serve", "--library", &library, "--endpoint", &at]);
    let refused = command.output().unwrap();
    let holder = format!(
        "is in use by a running daemon, process {pid}; `coseg stop --endpoint {at}` ends it"
    );
    assert!(stderr(&refused).contains(&holder), "{}", stderr(&refused));
    let repair = home.coseg(&["check", "--repair", "--library", &library]);
    assert!(
        stderr(&repair).contains(&format!("process {pid}")),
        "{}",
        stderr(&repair)
    );
}

#[test]
fn a_default_folder_that_others_may_enter_is_not_trusted() {
    let home = Home::new();
    let folder = home.path("run/coseg");
    std::fs::create_dir_all(&folder).unwrap();
    let listed = |variable: &str, value: &std::path::Path| {
        let mut command = coseg();
        command.env_remove("XDG_RUNTIME_DIR").env(variable, value);
        command.args(["ls", "--timeout", "0.2"]).output().unwrap()
    };
    let user = || listed("XDG_RUNTIME_DIR", &home.path("run"));
    for (mode, status) in [(0o777, 2), (0o755, 2), (0o700, 3)] {
        std::fs::set_permissions(&folder, Permissions::from_mode(mode)).unwrap();
        let output = user();
        assert_eq!(
            output.status.code(),
            Some(status),
            "{mode:o}: {}",
            stderr(&output)
        );
        if status == 2 {
            let path = folder.display();
            let message = format!("{path} has mode {mode:04o}, which lets others enter");
            let cure = format!("`chmod 700 {path}` mends that");
            let text = stderr(&output);
            assert!(text.contains(&message) && text.contains(&cure), "{text}");
        }
    }
    // The folder of a service may let a group in, but not let it create sockets there.
    for (mode, status) in [(0o755, 3), (0o770, 2)] {
        std::fs::set_permissions(&folder, Permissions::from_mode(mode)).unwrap();
        let output = listed("RUNTIME_DIRECTORY", &folder);
        assert_eq!(
            output.status.code(),
            Some(status),
            "{mode:o}: {}",
            stderr(&output)
        );
    }
    // No daemon listens at a default endpoint that was named.
    std::fs::set_permissions(&folder, Permissions::from_mode(0o777)).unwrap();
    let endpoint = format!("ipc://{}/coseg.sock", folder.display());
    let mut named = coseg();
    named.args(["ls", "--timeout", "0.2", "--endpoint", &endpoint]);
    assert_eq!(named.output().unwrap().status.code(), Some(3));
}
