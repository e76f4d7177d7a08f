//! Tests the output, the files and the exit codes of the command line.

mod messages;
mod terminal;

use crate::harness::{Home, SKITTLE_FACES, coseg, exists, json, skittle, stdout};
use std::process::Output;
use std::time::{Duration, Instant};

fn stderr(output: &Output) -> String {
    String::from_utf8(output.stderr.clone()).unwrap()
}

/// A home with a folder of three meshes and other files beside them.
fn home_with_folder() -> (Home, String) {
    let home = Home::new();
    let folder = home.path("meshes");
    std::fs::create_dir(&folder).unwrap();
    for (name, variant) in [("10", 2), ("9", 1), ("Big One", 0)] {
        std::fs::write(folder.join(format!("{name}.off")), skittle(variant)).unwrap();
    }
    std::fs::write(folder.join("9.labels.txt"), "0\n").unwrap();
    std::fs::write(folder.join("part.step"), "ISO-10303").unwrap();
    let folder = folder.display().to_string();
    (home, folder)
}

#[test]
fn help_tells_the_commands_and_the_exit_codes() {
    let text = stdout(&coseg().arg("--help").output().unwrap(), 0);
    for command in [
        "serve",
        "add",
        "wait",
        "ls",
        "show",
        "labels",
        "export",
        "map",
        "transfer",
        "nearest",
        "rm",
        "watch",
        "events",
        "name",
        "collections",
        "stats",
        "top",
        "view",
        "completions",
        "man",
        "stop",
        "cancel",
        "check",
        "config",
        "synth",
        "demo",
    ] {
        let at_start = |l: &str| l.trim_start().starts_with(command);
        assert!(text.lines().any(at_start), "{command}: {text}");
    }
    assert!(
        text.contains("3  no answer from a daemon within --timeout"),
        "{text}"
    );
}

#[test]
fn wrong_command_lines_exit_2() {
    for args in [
        &["frobnicate"][..],
        &["ls", "--timeout", "soon"],
        &["ls", "--endpoint", "udp://127.0.0.1:1"],
        &["add"],
        &["add", "/nonexistent/x.off"],
        &["add", "--up", "sideways", "x.off"],
        &["export", "--format", "fbx", "--out", "x"],
        &["serve", "--config", "/nonexistent.toml"],
    ] {
        let output = coseg().args(args).output().unwrap();
        assert_eq!(
            output.status.code(),
            Some(2),
            "{args:?}: {}",
            stderr(&output)
        );
        assert!(output.stdout.is_empty(), "{args:?}");
    }
}

#[test]
fn no_daemon_exits_3_in_time_and_says_so() {
    let home = Home::new();
    let begin = Instant::now();
    let output = home.coseg(&["ls", "--timeout", "0.3"]);
    assert_eq!(output.status.code(), Some(3));
    let message = stderr(&output);
    let expected = format!(
        "coseg: no answer from {} within 0.3 s; is a daemon running there?\n  \
         start one with `coseg serve`, or give its address with --endpoint\n",
        home.endpoint()
    );
    assert_eq!(message, expected);
    assert!(begin.elapsed() >= Duration::from_millis(300));
}

#[test]
fn the_configuration_is_checked_and_shown() {
    let home = Home::new();
    let run = |args: &[&str], env: &[(&str, &str)]| {
        let mut command = coseg();
        command
            .args(args)
            .env("HOME", home.dir.path())
            .env_remove("XDG_DATA_HOME");
        command
            .env("XDG_RUNTIME_DIR", "/run/user/7")
            .envs(env.iter().copied())
            .output()
            .unwrap()
    };
    let file = home.mesh("c.toml", "[work]\nworkers = 3\n");
    let shown = json(
        &run(&["config", "show", "--config", &file, "--json"], &[]),
        0,
    );
    assert_eq!(
        shown["in_use"]["endpoint"],
        "ipc:///run/user/7/coseg/coseg.sock"
    );
    assert_eq!(
        shown["in_use"]["events"],
        "ipc:///run/user/7/coseg/coseg.sock.events"
    );
    let library = home
        .path(".local/share/coseg/library")
        .display()
        .to_string();
    assert_eq!(shown["in_use"]["library"], library);
    assert_eq!(shown["in_use"]["workers"], 3);
    assert_eq!(shown["settings"]["limits"]["memory"], "2GiB");
    // The output is a valid configuration file.
    let text = stdout(&run(&["config", "show", "--config", &file], &[]), 0);
    let again = home.mesh("again.toml", &text);
    assert_eq!(
        stdout(&run(&["config", "show", "--config", &again], &[]), 0),
        text
    );
    let layered = run(
        &["config", "show", "--config", &file, "--json"],
        &[("COSEG__WORK__WORKERS", "5")],
    );
    assert_eq!(json(&layered, 0)["settings"]["work"]["workers"], 5);

    assert_eq!(
        stdout(&run(&["config", "check", "--config", &file], &[]), 0),
        "the configuration is valid\n"
    );
    let wrong = home.mesh("wrong.toml", "[work]\nworker = 3\n");
    let output = run(&["config", "check", "--config", &wrong], &[]);
    assert_eq!(output.status.code(), Some(2));
    let expected = format!(
        "coseg: {wrong}: unknown key \"work.worker\"; the nearest known one is \"work.workers\"\n"
    );
    assert_eq!(stderr(&output), expected);
    let output = run(&["config", "check"], &[("COSEG__LIMITS__MEMROY", "1GiB")]);
    assert_eq!(
        stderr(&output),
        "coseg: environment: unknown key \"COSEG__LIMITS__MEMROY\"; \
         the nearest known one is \"COSEG__LIMITS__MEMORY\"\n"
    );
    // Neither of these is a setting.
    let output = run(
        &["config", "check"],
        &[("COSEG_ENDPOINT", "ipc:///x/y"), ("COSEG_TEST_DATA", "/x")],
    );
    assert_eq!(output.status.code(), Some(0), "{}", stderr(&output));
}

#[test]
fn a_folder_becomes_labelled_shapes_and_files() {
    let (home, folder) = home_with_folder();
    let _daemon = home.start();
    let output = home.coseg(&[
        "add",
        &folder,
        "--collection",
        "skittles",
        "--parts",
        "2",
        "--json",
    ]);
    let added = json(&output, 0);
    assert!(
        stderr(&output).contains("part.step is skipped"),
        "{}",
        stderr(&output)
    );
    assert!(!stderr(&output).contains("labels.txt"));
    let names = |value: &serde_json::Value| {
        let shapes = value["shapes"].as_array().unwrap().iter();
        shapes
            .map(|s| s["name"].as_str().unwrap().to_owned())
            .collect::<Vec<_>>()
    };
    assert_eq!(names(&added), ["9", "10", "Big One"]);
    assert_eq!(added["n_added"], 3);
    assert!(
        added["shapes"][0]["stages_ms"]["spectrum"]
            .as_f64()
            .unwrap()
            > 0.0
    );

    // The same command again, with the settings of the collection, or with none.
    let again = home.coseg(&[
        "add",
        &folder,
        "--collection",
        "skittles",
        "--parts",
        "2",
        "--json",
    ]);
    assert_eq!(json(&again, 0)["n_unchanged"], 3);
    let again = stdout(&home.coseg(&["add", &folder]), 0);
    assert_eq!(again, "9: unchanged\n10: unchanged\nBig One: unchanged\n");
    let differs = home.coseg(&["add", &folder, "--collection", "skittles", "--parts", "3"]);
    assert_eq!(differs.status.code(), Some(1));
    assert!(stderr(&differs).ends_with("coseg: collection \"skittles\" has n_parts 2, not 3\n"));
    let differs = home.coseg(&["add", &folder, "--collection", "skittles", "--up", "+y"]);
    assert!(stderr(&differs).ends_with("coseg: collection \"skittles\" has up unknown, not +y\n"));

    assert_eq!(
        stdout(&home.coseg(&["wait", "--collection", "skittles"]), 0),
        ""
    );
    let listed = json(
        &home.coseg(&["ls", "--collection", "skittles", "--json"]),
        0,
    );
    assert_eq!(names(&listed), ["9", "10", "Big One"]);
    let table = stdout(&home.coseg(&["ls"]), 0);
    let heading = "collection  shapes  stale  labels  parts  up       sequence  unseen  \
         corrected  approved  doubtful\nskittles    3       0 ";
    assert!(table.starts_with(heading), "{table}");

    let labels = stdout(&home.coseg(&["labels", "Big One"]), 0);
    assert_eq!(labels.lines().count(), SKITTLE_FACES);
    let as_json = json(
        &home.coseg(&["labels", "Big One", "--json", "--confidence"]),
        0,
    );
    assert_eq!(
        as_json["confidence"].as_array().unwrap().len(),
        SKITTLE_FACES
    );

    let out = home.path("out/deep").display().to_string();
    let args = [
        "export",
        "--collection",
        "skittles",
        "--format",
        "labels",
        "--out",
        &out,
    ];
    assert_eq!(stdout(&home.coseg(&args), 0), "");
    assert_eq!(
        std::fs::read_to_string(format!("{out}/Big One.labels.txt")).unwrap(),
        labels
    );
    let files = json(
        &home.coseg(&["export", "--format", "ply", "--out", &out, "10", "--json"]),
        0,
    );
    assert_eq!(files["files"], serde_json::json!([format!("{out}/10.ply")]));
    let ply = std::fs::read(format!("{out}/10.ply")).unwrap();
    let ply = String::from_utf8_lossy(&ply);
    assert!(ply.contains(&format!("element face {SKITTLE_FACES}\n")));
    stdout(
        &home.coseg(&["export", "--format", "obj", "--out", &out]),
        0,
    );
    assert!(exists(format!("{out}/9.obj")) && exists(format!("{out}/labels.mtl")));
}

#[test]
fn usd_says_what_it_needs() {
    let missing = "/nowhere/python3";
    let mut command = coseg();
    command.args(["usd", "label", "a.usd", "--collection", "c", "-o", "b.usda"]);
    let output = command.env("COSEG_PYTHON", missing).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    let text = String::from_utf8(output.stderr).unwrap();
    for part in [missing, "pip install 'coseg[usd]'", "COSEG_PYTHON"] {
        assert!(text.contains(part), "{text}");
    }
}

#[test]
fn shapes_are_compared_named_and_removed() {
    let (home, folder) = home_with_folder();
    let _daemon = home.start();
    stdout(
        &home.coseg(&["add", &folder, "--collection", "c", "--parts", "2"]),
        0,
    );
    let nearest = json(&home.coseg(&["nearest", "9", "--json"]), 0);
    assert_eq!(nearest["nearest"].as_array().unwrap().len(), 2);
    let file = home.path("map.safetensors").display().to_string();
    let map = json(&home.coseg(&["map", "9", "10", "--json", "-o", &file]), 0);
    assert_eq!((&map["from"], &map["to"]), (&"9".into(), &"10".into()));
    let bytes = std::fs::read(&file).unwrap();
    let arrays = safetensors::SafeTensors::deserialize(&bytes).unwrap();
    let shape: Vec<u64> = serde_json::from_value(map["c_12_shape"].clone()).unwrap();
    let c_12 = arrays.tensor("c_12").unwrap();
    assert_eq!(
        c_12.shape().iter().map(|&n| n as u64).collect::<Vec<_>>(),
        shape
    );
    assert!(stdout(&home.coseg(&["map", "9", "10"]), 0).starts_with("9 to 10: c_12 ("));

    let labels = stdout(&home.coseg(&["labels", "9"]), 0);
    let (given, carried) = (home.path("given.txt"), home.path("carried.npy"));
    std::fs::write(&given, &labels).unwrap();
    let (given, carried) = (given.display().to_string(), carried.display().to_string());
    let transfer = ["transfer", "9", "10", "--values", &given];
    let text = stdout(&home.coseg(&transfer), 0);
    let kinds: Vec<&str> = labels.split_whitespace().collect();
    assert_eq!(text.lines().count(), 736);
    assert!(text.lines().all(|l| l == "-1" || kinds.contains(&l)));
    let report = json(
        &home.coseg(&[&transfer[..], &["--json", "-o", &carried]].concat()),
        0,
    );
    assert_eq!(report["rows"], 736);
    let numpy = std::fs::read(&carried).unwrap();
    assert_eq!(numpy.len(), 128 + 4 * 736);
    std::fs::write(&given, "1 2\n3\n").unwrap();
    let refused = stderr(&home.coseg(&transfer));
    assert!(refused.contains("row 2 has 1 values"), "{refused}");

    let shown = json(&home.coseg(&["show", "--json"]), 0);
    let label = shown["labels"][0]["id"].to_string();
    let named = json(&home.coseg(&["name", &label, "head", "--json"]), 0);
    assert_eq!(named["name"], "head");
    assert!(stdout(&home.coseg(&["show"]), 0).contains(&format!("{label}      head")));
    assert!(
        stdout(&home.coseg(&["show", "9"]), 0)
            .starts_with("9: shape 1 of its collection, 736 faces")
    );

    let events = json(&home.coseg(&["events", "--json"]), 0);
    let events = events["events"].as_array().unwrap().clone();
    assert_eq!(events[0]["kind"], "collection_created");
    assert_eq!(events.last().unwrap()["kind"], "label_named");
    // The command prints all past events, then ends.
    let n = events.len().to_string();
    let watched = home.coseg(&[
        "watch",
        "--collection",
        "c",
        "--since",
        "0",
        "-n",
        &n,
        "--json",
    ]);
    let watched = stdout(&watched, 0);
    let watched: Vec<serde_json::Value> = watched
        .lines()
        .map(|l| serde_json::from_str(l).unwrap())
        .collect();
    assert_eq!(watched, events);

    assert_eq!(stdout(&home.coseg(&["rm", "9"]), 0), "");
    let gone = home.coseg(&["labels", "9"]);
    assert_eq!(
        (gone.status.code(), stderr(&gone).as_str()),
        (
            Some(1),
            "coseg: no shape named \"9\"\n  `coseg ls NAME` lists the shapes of a collection\n"
        )
    );
    let gone = home.coseg(&["rm", "9", "10", "--json"]);
    let removed = json(&gone, 1);
    assert_eq!(removed["removed"], serde_json::json!(["10"]));
    assert_eq!(removed["failed"][0]["error"]["reason"], "NO_SHAPE");
}

#[test]
fn one_refused_shape_fails_the_command_and_not_the_others() {
    let home = Home::new();
    let _daemon = home.start();
    let good = home.mesh("good.off", &skittle(0));
    let bad = home.mesh("bad.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 9\n");
    let output = home.coseg(&["add", &bad, &good]);
    assert_eq!(output.status.code(), Some(1));
    let message = stderr(&output);
    assert!(
        message.contains("coseg: bad: face 0 names vertex 9, but the mesh has 3\n"),
        "{message}"
    );
    assert!(
        message.contains("default: 1 added, 1 failed in "),
        "{message}"
    );
    // Other bytes under the same name are refused, or replace the shape.
    home.mesh("good.off", &skittle(1));
    let taken = json(&home.coseg(&["add", &good, "--json"]), 1);
    assert_eq!(taken["shapes"][0]["error"]["code"], "ALREADY_EXISTS");
    let replaced = json(&home.coseg(&["add", &good, "--replace", "--json"]), 0);
    assert_eq!(
        (&replaced["n_replaced"], &replaced["n_added"]),
        (&1.into(), &0.into())
    );
}

#[test]
fn collections_must_be_named_when_there_are_several() {
    let home = Home::new();
    let _daemon = home.start();
    let none = home.coseg(&["show"]);
    assert_eq!(
        (none.status.code(), stderr(&none).as_str()),
        (Some(1), "coseg: there is no collection yet\n")
    );
    for name in ["a", "b"] {
        stdout(
            &home.coseg(&["collections", "create", name, "--up", "-z"]),
            0,
        );
    }
    let mesh = home.mesh("m.off", &skittle(0));
    for args in [&["show"][..], &["add", &mesh]] {
        let output = home.coseg(args);
        assert_eq!(output.status.code(), Some(2));
        let expected = "coseg: there are several collections, choose one with --collection: a, b\n";
        assert_eq!(stderr(&output), expected);
    }
    for args in [
        &["show", "b"][..],
        &["labels", "b", "-c", "a"],
        &["nearest", "b"],
    ] {
        let output = home.coseg(args);
        assert_eq!(output.status.code(), Some(2));
        let text = stderr(&output);
        assert!(
            text.starts_with("coseg: \"b\" is a collection, but a shape is expected here; ")
                && text.contains("`coseg ls b` lists its shapes"),
            "{text}"
        );
    }
    assert_eq!(
        json(&home.coseg(&["show", "-c", "a", "--json"]), 0)["up"],
        "-z"
    );
    stdout(&home.coseg(&["collections", "delete", "b"]), 0);
    assert_eq!(stdout(&home.coseg(&["add", &mesh, "--no-wait"]), 0), "");
    stdout(&home.coseg(&["wait", "-c", "a"]), 0);
    assert_eq!(json(&home.coseg(&["stats", "--json"]), 0)["n_shapes"], 1);
}

#[test]
fn a_library_is_checked_with_and_without_a_daemon() {
    let home = Home::new();
    let mesh = home.mesh("m.off", &skittle(0));
    let daemon = home.start();
    stdout(&home.coseg(&["add", &mesh]), 0);
    let library = home.path("library").display().to_string();
    let beside = json(&home.coseg(&["check", "--library", &library, "--json"]), 0);
    assert_eq!(beside["ok"], true);
    let nowhere = home.coseg(&["check", "--library", &format!("{library}/none")]);
    assert_eq!(nowhere.status.code(), Some(1), "{}", stderr(&nowhere));
    stdout(&home.coseg(&["stop"]), 0);
    assert_eq!(daemon.ended().0.code(), Some(0));
    let good = json(&home.coseg(&["check", "--library", &library, "--json"]), 0);
    assert_eq!(
        (&good["ok"], &good["findings"]),
        (&true.into(), &serde_json::json!([]))
    );
    // The damage is found.
    let objects = home.path("library/objects");
    let file = files_below(&objects)
        .into_iter()
        .find(|f| f.extension().is_some_and(|e| e == "safetensors"));
    let file = file.unwrap();
    let mut bytes = std::fs::read(&file).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    let mut permissions = std::fs::metadata(&file).unwrap().permissions();
    std::os::unix::fs::PermissionsExt::set_mode(&mut permissions, 0o600);
    std::fs::set_permissions(&file, permissions).unwrap();
    std::fs::write(&file, bytes).unwrap();
    let output = home.coseg(&["check", "--library", &library]);
    let name = file.file_name().unwrap().to_string_lossy().into_owned();
    assert!(stdout(&output, 1).contains(&name));
}

fn files_below(directory: &std::path::Path) -> Vec<std::path::PathBuf> {
    let entries = std::fs::read_dir(directory)
        .unwrap()
        .map(|e| e.unwrap().path());
    entries
        .flat_map(|p| if p.is_dir() { files_below(&p) } else { vec![p] })
        .collect()
}

#[test]
fn the_demonstration_labels_a_family_and_leaves_meshes_to_look_at() {
    let home = Home::new();
    let out = home.path("demo").display().to_string();
    let demo = ["demo", "pliers", "--count", "3", "--faces", "1000"];
    let report = json(
        &home.coseg(&[&demo[..], &["--out", &out, "--json"]].concat()),
        0,
    );
    assert_eq!(report["shapes"].as_array().unwrap().len(), 3);
    for shape in report["shapes"].as_array().unwrap() {
        assert_eq!(shape["outcome"], "added");
        assert!(shape["stages_ms"]["spectrum"].as_f64().unwrap() > 0.0);
    }
    // One label for everything would be right on about 0.6 of the area.
    assert!(report["accuracy"].as_f64().unwrap() > 0.7, "{report}");
    for name in ["pliers-001.ply", "pliers-003.ply", "all.ply"] {
        assert!(exists(format!("{out}/{name}")), "{name}");
    }
    let words = stdout(
        &home.coseg(&[&demo[..], &["--out", &out, "--rotate"]].concat()),
        0,
    );
    assert!(
        words.contains("pliers-003") && words.contains("ms: parse"),
        "{words}"
    );
}
