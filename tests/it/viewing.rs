//! Tests the HTTP endpoint, and the commands `view`, `top`, completions and manual page.

use crate::harness::{Daemon, Home, add, coseg, json, skittle, stdout};
use std::io::{Read as _, Write as _};
use std::net::{SocketAddr, TcpStream};

/// A daemon with an HTTP endpoint on a free port.
pub(crate) fn served(home: &Home, env: &[(&str, &str)]) -> (Daemon, SocketAddr) {
    let mut daemon = home.start_with(&["--http", "127.0.0.1:0"], env);
    let line = daemon.await_line("viewer and metrics at http://");
    let (_, rest) = line.split_once("http://").unwrap();
    (daemon, rest.trim_end_matches('/').parse().unwrap())
}

/// Status, headers and body of an answer.
pub(crate) fn exchange(
    address: SocketAddr,
    request: &str,
    headers: &str,
    body: &str,
) -> (u16, String, Vec<u8>) {
    let mut stream = TcpStream::connect(address).unwrap();
    let n = body.len();
    write!(
        stream,
        "{request} HTTP/1.1\r\nconnection: close\r\ncontent-length: {n}\r\n{headers}\r\n{body}"
    )
    .unwrap();
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).unwrap();
    let at = answer.windows(4).position(|w| w == b"\r\n\r\n").unwrap();
    let head = String::from_utf8(answer[..at].to_vec()).unwrap();
    let status = head.split(' ').nth(1).unwrap().parse().unwrap();
    (status, head.to_lowercase(), answer[at + 4..].to_vec())
}

pub(crate) fn get(address: SocketAddr, path: &str) -> (u16, String) {
    let host = format!("host: {address}\r\n");
    let (status, _, body) = exchange(address, &format!("GET {path}"), &host, "");
    (status, String::from_utf8_lossy(&body).into_owned())
}

fn fill(daemon: &Daemon) {
    let texts: Vec<String> = (0..2).map(skittle).collect();
    add(
        &mut daemon.client(),
        "skittles",
        &[("a", &texts[0]), ("b", &texts[1])],
    );
}

#[test]
fn health_and_metrics_are_told() {
    let home = Home::new();
    let (daemon, address) = served(&home, &[]);
    assert_eq!(get(address, "/healthz"), (200, "alive\n".to_owned()));
    assert_eq!(get(address, "/readyz"), (200, "ready\n".to_owned()));
    fill(&daemon);
    let (status, text) = get(address, "/metrics");
    assert_eq!(status, 200);
    for line in [
        "coseg_shapes 2",
        "coseg_collections 1",
        "coseg_shapes_queued 0",
        "coseg_shapes_finished_total{outcome=\"added\"} 2",
        "coseg_stage_duration_seconds_count{stage=\"spectrum\"} 2",
        "coseg_http_responses_total{path=\"/readyz\",status=\"200\"} 1",
        "# EOF",
    ] {
        assert!(text.lines().any(|l| l == line), "no {line} in\n{text}");
    }
    // The document lists every metric, and no other.
    let document = include_str!("../../docs/metrics.md");
    for line in text.lines().filter_map(|l| l.strip_prefix("# TYPE ")) {
        let name = line.split(' ').next().unwrap();
        assert!(
            document.contains(name),
            "docs/metrics.md does not have {name}"
        );
    }
    // The documented metrics exist; two families have no member while no work runs and nothing was
    // refused.
    const MAY_BE_EMPTY: [&str; 2] = ["coseg_shapes_at_stage", "coseg_requests_refused_total"];
    let is_name = |c: char| c.is_alphanumeric() || c == '_';
    let operations = include_str!("../../docs/operations.md");
    for name in [document, operations]
        .iter()
        .flat_map(|text| text.split(|c| !is_name(c)))
        .filter(|word| word.starts_with("coseg_") && !MAY_BE_EMPTY.contains(word))
    {
        let family = ["_total", "_info", "_bucket", "_count", "_sum"]
            .iter()
            .find_map(|end| name.strip_suffix(end));
        let family = format!("# TYPE {} ", family.unwrap_or(name));
        assert!(text.contains(&family), "{name} is not exposed");
    }
    let dashboard = include_str!("../../config/grafana/dashboard.json");
    let dashboard: serde_json::Value = serde_json::from_str(dashboard).unwrap();
    let panels = dashboard["panels"].as_array().unwrap();
    let targets = panels.iter().flat_map(|p| p["targets"].as_array().unwrap());
    let is_name = |c: char| c.is_alphanumeric() || c == '_';
    for query in targets.map(|t| t["expr"].as_str().unwrap()) {
        for name in query
            .split(|c| !is_name(c))
            .filter(|w| w.starts_with("coseg_"))
        {
            let of = ["_bucket", "_sum", "_count"];
            let base = of.iter().find_map(|end| name.strip_suffix(end));
            let known = document.contains(base.unwrap_or(name));
            assert!(known, "the dashboard asks for {name}");
        }
    }
}

#[test]
fn only_the_page_itself_may_change_anything() {
    let home = Home::new();
    let (daemon, address) = served(&home, &[]);
    fill(&daemon);
    let host = format!("host: {address}\r\n");
    let name = |headers: &str| {
        let body = r#"{"collection":"skittles","label":0,"name":"body"}"#;
        let (status, _, body) = exchange(address, "POST /api/name", headers, body);
        (status, String::from_utf8(body).unwrap())
    };
    let own = format!("{host}x-coseg: 1\r\norigin: http://{address}\r\n");
    for headers in [
        host.clone(),
        format!("{host}x-coseg: 1\r\norigin: http://example.org\r\n"),
        format!("{host}x-coseg: 1\r\norigin: null:\r\n"),
        format!("{host}x-coseg: 1\r\norigin: null\r\n"),
        format!("{host}x-coseg: 1\r\nsec-fetch-site: cross-site\r\n"),
        own.replace(&host, "host: [::1].evil.example\r\n"),
        own.replace(&host, "host: example.org\r\n"),
        own.replace(&host, ""),
    ] {
        let (status, reply) = name(&headers);
        assert!(
            status == 403 || status == 400,
            "{headers}: {status} {reply}"
        );
    }
    let shown = || json(&home.coseg(&["show", "-c", "skittles", "--json"]), 0);
    assert!(shown()["labels"][0]["name"].is_null());
    assert_eq!(name(&own).0, 200);
    assert_eq!(shown()["labels"][0]["name"], "body");
    // A refusal of the daemon has its reason.
    let wrong = r#"{"collection":"skittles","label":99,"name":"x"}"#;
    let (status, _, body) = exchange(address, "POST /api/name", &own, wrong);
    let body: serde_json::Value = serde_json::from_slice(&body).unwrap();
    assert_eq!(
        (status, &body["error"]["reason"]),
        (404, &"NO_LABEL".into())
    );
    assert_eq!(exchange(address, "POST /api/name", &own, "{").0, 400);
    assert_eq!(exchange(address, "POST /api/drain", &own, "{}").0, 404);
    assert_eq!(exchange(address, "DELETE /", &host, "").0, 405);
    // A page of another site that redirects here sees nothing, and triggers no computation.
    let status = |path: &str, headers: &str| exchange(address, path, headers, "").0;
    for host in ["example.org", "[::1].evil.example", "localhost:evil"] {
        let headers = format!("host: {host}\r\n");
        for path in ["/", "/api/library", "/metrics"] {
            assert_eq!(
                status(&format!("GET {path}"), &headers),
                403,
                "{path} {host}"
            );
        }
        // A probe may use any host name.
        assert_eq!(status("GET /healthz", &headers), 200);
        assert_eq!(status("GET /readyz", &headers), 200);
    }
    assert_eq!(status("GET http://example.org/api/library", &host), 403);
    let cross = format!("{host}sec-fetch-site: cross-site\r\n");
    assert_eq!(status("GET /api/library", &cross), 403);
    assert_eq!(status("GET /", &cross), 200);
}

#[test]
fn a_page_lists_chooses_and_links() {
    let home = Home::new();
    let (daemon, address) = served(&home, &[]);
    fill(&daemon);
    let own = format!("host: {address}\r\nx-coseg: 1\r\n");
    let post = |path: &str, body: &str| {
        let (status, _, reply) = exchange(address, &format!("POST /api/{path}"), &own, body);
        let reply: serde_json::Value = serde_json::from_slice(&reply).unwrap();
        (status, reply)
    };
    let read = |path: &str| -> serde_json::Value {
        let (status, text) = get(address, path);
        assert_eq!(status, 200, "{text}");
        serde_json::from_str(&text).unwrap()
    };
    // Why there are no proposals is an answer, too.
    let none = read("/api/proposals?collection=skittles");
    assert_eq!(none["proposals"], serde_json::json!([]));
    let why = none["why"].as_str().unwrap();
    assert!(why.contains("from 3 shapes on"), "{why}");
    let (status, refusal) = post("choose", r#"{"collection":"skittles","n":1,"set":""}"#);
    assert_eq!(
        (status, &refusal["error"]["reason"]),
        (409, &"NO_PROPOSALS".into())
    );
    let ends = r#""a":{"shape":"a","part":0},"b":{"shape":"b","part":0}"#;
    let link = |kind: &str| {
        let body = format!(r#"{{"collection":"skittles","kind":"{kind}",{ends},"by":"Ada"}}"#);
        post("link", &body)
    };
    let (status, refusal) = link("equal");
    let message = refusal["error"]["message"].as_str().unwrap();
    assert_eq!(
        (status, message),
        (400, "kind is \"equal\", not same or differ")
    );
    let (status, made) = link("same");
    assert_eq!((status, &made["changed"]), (200, &true.into()), "{made}");
    assert_eq!(link("same").1["changed"], false, "the same link is there");
    let (status, refusal) = link("differ");
    let message = refusal["error"]["message"].as_str().unwrap();
    assert_eq!(status, 409);
    assert!(
        message.contains("a:0 has the label of b:0 (link"),
        "{message}"
    );
    let listed = read("/api/links?collection=skittles");
    let found = &listed["links"][0];
    assert_eq!(
        (&found["kind"], &found["by"], &found["id"]),
        (&"same".into(), &"Ada".into(), &made["link"]["id"])
    );
    let unlink = format!(r#"{{"collection":"skittles","id":{}}}"#, found["id"]);
    assert_eq!(post("unlink", &unlink).0, 200);
    assert_eq!(post("unlink", &unlink).0, 404);
    let listed = read("/api/links?collection=skittles");
    assert_eq!(listed["links"], serde_json::json!([]));
    // A page says what it shows, of any collection, but not of more than fit on a screen.
    read("/api/library?collection=skittles&first=b&first=nobody");
    read("/api/library?collection=nowhere&first=b");
    let many = "&first=a".repeat(65);
    let (status, text) = get(address, &format!("/api/library?collection=skittles{many}"));
    assert_eq!(status, 400);
    assert!(text.contains("65 shapes, the limit is 64"), "{text}");
}

#[test]
fn the_viewer_is_served_with_all_it_needs() {
    let home = Home::new();
    let (daemon, address) = served(&home, &[("COSEG__HTTP__EDIT", "false")]);
    fill(&daemon);
    let host = format!("host: {address}\r\n");
    let (status, head, page) = exchange(address, "GET /", &host, "");
    assert_eq!(status, 200);
    assert!(
        head.contains("content-security-policy: default-src 'none'"),
        "{head}"
    );
    let page = String::from_utf8(page).unwrap();
    for file in ["viewer.css", "viewer.js"] {
        assert!(page.contains(file) && get(address, &format!("/{file}")).0 == 200);
    }
    let (_, library) = get(address, "/api/library");
    let library: serde_json::Value = serde_json::from_str(&library).unwrap();
    assert_eq!(library["edit"], false);
    assert_eq!(library["collections"][0]["name"], "skittles");
    let (_, found) = get(address, "/api/collection?collection=skittles");
    let found: serde_json::Value = serde_json::from_str(&found).unwrap();
    assert_eq!(found["shapes"][1]["name"], "b");
    for (path, kind) in [
        ("portraits?collection=skittles&after=1&limit=9", "proxy"),
        (
            "portraits?collection=skittles&shape=b&detail=surface",
            "surface",
        ),
        (
            "portraits?collection=skittles&shape=b&detail=functions",
            "functions",
        ),
    ] {
        let (status, _, pack) = exchange(address, &format!("GET /api/{path}"), &host, "");
        assert_eq!(status, 200, "{path}");
        let n = u32::from_le_bytes(pack[..4].try_into().unwrap()) as usize;
        let header: serde_json::Value = serde_json::from_slice(&pack[4..4 + n]).unwrap();
        let shapes = header["shapes"].as_array().unwrap();
        assert_eq!(
            (shapes.len(), &shapes[0]["name"]),
            (1, &"b".into()),
            "{path}"
        );
        assert_eq!(shapes[0]["kind"], kind);
    }
    let map = "/api/map?collection=skittles&from=a&to=b";
    assert_eq!(get(address, map).0, 200);
    assert_eq!(get(address, "/api/map?collection=skittles&from=a").0, 400);
    assert_eq!(get(address, "/api/nearest?collection=none&shape=a").0, 404);
    let own = format!("{host}x-coseg: 1\r\n");
    assert_eq!(
        exchange(
            address,
            "POST /api/undo",
            &own,
            r#"{"collection":"skittles"}"#
        )
        .0,
        403
    );
}

#[test]
fn a_collection_becomes_one_page() {
    let home = Home::new();
    let daemon = home.start();
    fill(&daemon);
    let file = home.path("page.html").display().to_string();
    let report = json(&home.coseg(&["view", "-o", &file, "--json"]), 0);
    let page = std::fs::read_to_string(&file).unwrap();
    assert_eq!(report["n_shapes"], 2);
    assert_eq!(report["n_bytes"], page.len());
    assert_eq!(page.matches("data-kind=\"functions\"").count(), 2);
    assert_eq!(
        page.matches("data-kind=\"map\"").count(),
        report["n_maps"].as_u64().unwrap() as usize
    );
    let less = [
        "view",
        "skittles",
        "-o",
        &file,
        "--max",
        "1",
        "--functions",
        "0",
        "--maps",
        "0",
        "--json",
    ];
    let report = json(&home.coseg(&less), 0);
    assert_eq!(
        (&report["n_shapes"], &report["n_left_out"]),
        (&1.into(), &1.into())
    );
    assert!((report["n_bytes"].as_u64().unwrap() as usize) < page.len());
    // The same library gives the same page.
    let text = |name: &str| {
        let path = home.path(name).display().to_string();
        stdout(&home.coseg(&["view", "-o", &path]), 0);
        std::fs::read(&path).unwrap()
    };
    assert_eq!(text("one.html"), text("two.html"));
}

#[test]
fn top_follows_the_daemon() {
    let home = Home::new();
    let daemon = home.start();
    fill(&daemon);
    let looks = stdout(
        &home.coseg(&["top", "-n", "2", "--interval", "0.1", "--json"]),
        0,
    );
    let looks: Vec<serde_json::Value> = looks
        .lines()
        .map(|l| serde_json::from_str(l).unwrap())
        .collect();
    assert_eq!((looks.len(), &looks[1]["n_placed"]), (2, &2.into()));
    let stages = looks[0]["stages"].as_array().unwrap();
    assert!(
        stages
            .iter()
            .any(|s| s["stage"] == "spectrum" && s["n_shapes"] == 2)
    );
    let text = stdout(&home.coseg(&["top", "-n", "1"]), 0);
    assert!(
        text.contains("2 shapes in 1 collection,") && !text.contains('\x1b'),
        "{text}"
    );
}

#[test]
fn shells_and_manuals_know_every_command() {
    let run = |args: &[&str]| stdout(&coseg().args(args).output().unwrap(), 0);
    for shell in ["bash", "zsh", "fish"] {
        let script = run(&["completions", shell]);
        assert!(
            script.contains("working-faces") && script.contains("suggest"),
            "{shell}"
        );
    }
    assert!(run(&["man"]).starts_with(".ie"));
    let home = Home::new();
    let pages = home.path("man").display().to_string();
    run(&["man", "--out", &pages]);
    for name in ["coseg.1", "coseg-view.1", "coseg-collections-create.1"] {
        assert!(home.path("man").join(name).is_file(), "{name}");
    }
}

#[test]
fn an_address_that_others_reach_must_be_allowed() {
    let home = Home::new();
    let refused = home.spawn(&["--http", "0.0.0.0:0"], &[]);
    let (status, printed) = refused.ended();
    assert_eq!(status.code(), Some(2));
    assert!(
        printed.iter().any(|l| l.contains("http.allow_remote")),
        "{printed:?}"
    );
}

#[test]
fn beyond_this_machine_a_token_opens_what_there_is() {
    let home = Home::new();
    let start = |env: &[(&str, &str)]| {
        let remote = [("COSEG__HTTP__ALLOW_REMOTE", "true")];
        let env: Vec<_> = remote.iter().chain(env).copied().collect();
        let mut daemon = home.start_with(&["--http", "0.0.0.0:0"], &env);
        let line = daemon.await_line("viewer and metrics at http://");
        let port = line.trim_end_matches('/').rsplit(':').next().unwrap();
        let address: SocketAddr = format!("127.0.0.1:{port}").parse().unwrap();
        (daemon, address)
    };
    let (daemon, address) = start(&[]);
    fill(&daemon);
    let token = std::fs::read_to_string(home.path("library/http.token")).unwrap();
    let token = token.trim().to_owned();
    let host = format!("host: {address}\r\n");
    let ask = |path: &str, more: &str| {
        let (status, head, body) = exchange(
            address,
            &format!("GET {path}"),
            &format!("{host}{more}"),
            "",
        );
        (status, head, String::from_utf8_lossy(&body).into_owned())
    };
    for path in [
        "/",
        "/viewer.js",
        "/api/library",
        "/healthz",
        "/readyz",
        "/metrics",
        "/x",
    ] {
        let (status, head, reply) = ask(path, "");
        assert_eq!(status, 401, "{path}");
        assert!(head.contains("www-authenticate: bearer") && reply.contains("?token="));
        let (status, _, reply) = ask(path, "authorization: Bearer 0123456789abcdef\r\n");
        assert!(status == 401 && !reply.contains("skittles"), "{path}");
    }
    assert_eq!(ask("/?token=0123456789abcdef", "").0, 401);
    assert_eq!(ask(&format!("/api/library?token={token}"), "").0, 401);
    let bearer = format!("authorization: Bearer {token}\r\n");
    assert_eq!(ask("/metrics", &bearer).0, 200);
    let (status, head, _) = ask(&format!("/?token={token}"), "");
    assert_eq!(status, 200);
    let cookie = head.lines().find_map(|l| l.strip_prefix("set-cookie: "));
    let cookie = cookie.unwrap();
    assert!(
        cookie.ends_with("; path=/; httponly; samesite=strict"),
        "{cookie}"
    );
    let cookie = format!("cookie: {}\r\n", cookie.split(';').next().unwrap());
    let (status, _, reply) = ask("/api/library", &cookie);
    assert!(status == 200 && reply.contains("skittles"), "{reply}");
    assert!(ask("/", &cookie).2.contains("viewer.js"));
    // A client with the cookie still needs the header for a change, as on loopback.
    let name = |headers: &str| {
        let body = r#"{"collection":"skittles","label":0,"name":"body"}"#;
        exchange(address, "POST /api/name", &format!("{host}{headers}"), body).0
    };
    let change = "x-coseg: 1\r\n";
    assert_eq!(name(change), 401);
    assert_eq!(name(&cookie), 403);
    let foreign = format!("{cookie}{change}origin: http://evil.example\r\n");
    assert_eq!(name(&foreign), 403);
    assert_eq!(name(&format!("{cookie}{change}")), 200);
    drop(daemon);
    // The same token works after a restart; monitoring needs none if so configured.
    let (_daemon, address) = start(&[("COSEG__HTTP__OPEN_MONITORING", "true")]);
    for path in ["/healthz", "/readyz", "/metrics"] {
        assert_eq!(get(address, path).0, 200, "{path}");
    }
    assert_eq!(get(address, "/api/library").0, 401);
    let bearer = format!("host: {address}\r\n{bearer}");
    assert_eq!(exchange(address, "GET /api/library", &bearer, "").0, 200);
}

#[test]
fn a_token_file_is_asked_for_on_loopback_too() {
    use std::os::unix::fs::PermissionsExt as _;
    let home = Home::new();
    let file = home.path("secret");
    let write = |text: &str, mode: u32| {
        std::fs::write(&file, text).unwrap();
        std::fs::set_permissions(&file, std::fs::Permissions::from_mode(mode)).unwrap();
    };
    let path = file.display().to_string();
    let env = [("COSEG__HTTP__TOKEN_FILE", path.as_str())];
    for (text, mode, expected) in [
        ("short", 0o600, "16 to 512"),
        ("a-secret-of-people", 0o644, "can be read by others"),
    ] {
        write(text, mode);
        let (status, lines) = home.spawn(&["--http", "127.0.0.1:0"], &env).ended();
        assert_eq!(status.code(), Some(2));
        assert!(lines.iter().any(|l| l.contains(expected)), "{lines:?}");
    }
    write("a-secret-of-people", 0o600);
    let (_daemon, address) = served(&home, &env);
    assert_eq!(get(address, "/metrics").0, 401);
    let bearer = format!("host: {address}\r\nauthorization: Bearer a-secret-of-people\r\n");
    assert_eq!(exchange(address, "GET /metrics", &bearer, "").0, 200);
}
