//! Runs the real binary as a daemon in a folder of its own, and provides meshes.

use coseg::ipc::client::Client;
use coseg::ipc::wire::{self, ErrorCode, ErrorReason, reply, request};
use rustix::process::{Pid, Signal};
use std::io::{BufRead as _, BufReader};
use std::os::unix::net::UnixDatagram;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Output, Stdio};
use std::sync::mpsc;
use std::time::Duration;
use tempfile::TempDir;

/// A time limit that suffices on a machine that is busy with other tests; only failing tests wait
/// so long.
pub(crate) const DEADLINE: Duration = Duration::from_secs(60);

/// The binary without settings of this process.
pub(crate) fn coseg() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_coseg"));
    for (name, _) in std::env::vars_os() {
        if name.to_string_lossy().starts_with("COSEG") {
            command.env_remove(name);
        }
    }
    for name in [
        "NOTIFY_SOCKET",
        "WATCHDOG_USEC",
        "WATCHDOG_PID",
        "RUNTIME_DIRECTORY",
    ] {
        command.env_remove(name);
    }
    command.env("NO_COLOR", "1");
    command
}

/// A folder for a daemon: socket, library, notify socket.
pub(crate) struct Home {
    pub(crate) dir: TempDir,
}

impl Home {
    pub(crate) fn new() -> Self {
        Self {
            dir: tempfile::Builder::new().prefix("coseg").tempdir().unwrap(),
        }
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    pub(crate) fn endpoint(&self) -> String {
        format!("ipc://{}", self.path("s").display())
    }

    /// A client command for this home's daemon.
    pub(crate) fn coseg(&self, args: &[&str]) -> Output {
        let mut command = coseg();
        command.args(args).env("COSEG_ENDPOINT", self.endpoint());
        // A test machine may be slow; tests of the default timeout set it explicitly.
        if !args.contains(&"--timeout") {
            command.args(["--timeout", "60"]);
        }
        command.output().unwrap()
    }

    /// Writes a mesh file and returns its path.
    pub(crate) fn mesh(&self, name: &str, text: &str) -> String {
        let path = self.path(name);
        std::fs::write(&path, text).unwrap();
        path.display().to_string()
    }

    pub(crate) fn start(&self) -> Daemon {
        self.start_with(&[], &[])
    }

    /// Starts a daemon and waits until it is ready.
    pub(crate) fn start_with(&self, args: &[&str], env: &[(&str, &str)]) -> Daemon {
        let mut daemon = self.spawn(args, env);
        daemon.await_notice("READY=1");
        daemon
    }

    /// The same with a limit on the number of open files.
    pub(crate) fn start_limited(&self, n_files: u64, args: &[&str]) -> Daemon {
        let limited = format!("ulimit -n {n_files} && exec \"$0\" \"$@\"");
        let binary = coseg();
        let mut shell = Command::new("sh");
        shell.arg("-c").arg(limited).arg(binary.get_program());
        for (name, value) in binary.get_envs() {
            match value {
                Some(value) => shell.env(name, value),
                None => shell.env_remove(name),
            };
        }
        let mut daemon = self.spawn_by(shell, args, &[]);
        daemon.await_notice("READY=1");
        daemon
    }

    /// Starts a daemon that may refuse to start.
    pub(crate) fn spawn(&self, args: &[&str], env: &[(&str, &str)]) -> Daemon {
        self.spawn_by(coseg(), args, env)
    }

    fn spawn_by(&self, mut command: Command, args: &[&str], env: &[(&str, &str)]) -> Daemon {
        let notify_path = self.path("notify");
        let _ = std::fs::remove_file(&notify_path);
        let notify = UnixDatagram::bind(&notify_path).unwrap();
        notify.set_read_timeout(Some(DEADLINE)).unwrap();
        command
            .arg("serve")
            .arg("--library")
            .arg(self.path("library"));
        if !args.contains(&"--endpoint") {
            command.args(["--endpoint", &self.endpoint()]);
        }
        command
            .args(args)
            .env("NOTIFY_SOCKET", &notify_path)
            .envs(env.iter().copied());
        let mut child = command.stderr(Stdio::piped()).spawn().unwrap();
        let (lines_in, lines) = mpsc::channel();
        let stderr = BufReader::new(child.stderr.take().unwrap());
        std::thread::spawn(move || {
            for line in stderr.lines().map_while(Result::ok) {
                if lines_in.send(line).is_err() {
                    return;
                }
            }
        });
        Daemon {
            child,
            notify,
            lines,
            printed: Vec::new(),
            endpoint: self.endpoint(),
        }
    }
}

/// A running daemon; killed when dropped.
pub(crate) struct Daemon {
    pub(crate) child: Child,
    pub(crate) notify: UnixDatagram,
    lines: mpsc::Receiver<String>,
    /// Lines of stderr so far.
    pub(crate) printed: Vec<String>,
    pub(crate) endpoint: String,
}

impl Daemon {
    /// Waits for a message to the service manager with this line.
    pub(crate) fn await_notice(&mut self, line: &str) -> String {
        let mut buffer = [0_u8; 4096];
        loop {
            let n = self.notify.recv(&mut buffer).unwrap_or_else(|e| {
                panic!(
                    "no {line:?} ({e}); stderr: {:#?}",
                    self.lines.try_iter().collect::<Vec<_>>()
                )
            });
            let text = String::from_utf8(buffer[..n].to_vec()).unwrap();
            if text.lines().any(|l| l == line) {
                return text;
            }
        }
    }

    /// Waits for a line of stderr with this text.
    pub(crate) fn await_line(&mut self, text: &str) -> String {
        loop {
            let line = self.lines.recv_timeout(DEADLINE);
            let line =
                line.unwrap_or_else(|e| panic!("no {text:?} ({e}) after {:#?}", self.printed));
            self.printed.push(line.clone());
            if line.contains(text) {
                return line;
            }
        }
    }

    pub(crate) fn client(&self) -> Client {
        Client::connect(&self.endpoint, DEADLINE).unwrap()
    }

    pub(crate) fn signal(&self, signal: Signal) {
        let pid = Pid::from_child(&self.child);
        rustix::process::kill_process(pid, signal).unwrap();
    }

    /// Waits until the process has ended.
    pub(crate) fn ended(mut self) -> (ExitStatus, Vec<String>) {
        let pid = Pid::from_child(&self.child);
        let (over_in, over) = mpsc::channel::<()>();
        let guard = std::thread::spawn(move || {
            if over.recv_timeout(DEADLINE).is_err() {
                let _ = rustix::process::kill_process(pid, Signal::KILL);
            }
        });
        let status = self.child.wait().unwrap();
        let _ = over_in.send(());
        guard.join().unwrap();
        let mut printed = std::mem::take(&mut self.printed);
        printed.extend(self.lines.iter());
        (status, printed)
    }
}

impl Drop for Daemon {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Sends a request and returns the code and reason of the refusal.
pub(crate) fn refusal(client: &mut Client, body: request::Body) -> (ErrorCode, ErrorReason) {
    match client.call(body, Vec::new()) {
        Err(coseg::ipc::client::ClientError::Refused(e)) => (e.code(), e.reason()),
        Ok((result, _)) => panic!("not refused: {result:?}"),
        Err(e) => panic!("no reply: {e}"),
    }
}

/// Adds shapes and waits for the finished job.
pub(crate) fn add(client: &mut Client, collection: &str, shapes: &[(&str, &str)]) -> wire::Job {
    let (body, frames) = add_request(collection, shapes, wire::AddMode::Wait);
    match client.call(body, frames).unwrap().0 {
        reply::Result::AddShapes(reply) => reply.job.unwrap(),
        other => panic!("unexpected: {other:?}"),
    }
}

/// A request that adds OFF texts, creating the collection with two parts.
pub(crate) fn add_request(
    collection: &str,
    shapes: &[(&str, &str)],
    mode: wire::AddMode,
) -> (request::Body, Vec<bytes::Bytes>) {
    let (mut request, frames) = additions(collection, shapes, mode);
    request.create = Some(wire::CollectionSpec {
        n_parts: Some(2),
        ..Default::default()
    });
    (request::Body::AddShapes(request), frames)
}

/// The same for an existing collection.
pub(crate) fn additions(
    collection: &str,
    shapes: &[(&str, &str)],
    mode: wire::AddMode,
) -> (wire::AddShapesRequest, Vec<bytes::Bytes>) {
    let inputs = shapes
        .iter()
        .enumerate()
        .map(|(i, (name, _))| wire::ShapeInput {
            name: (*name).to_owned(),
            replace: false,
            source: Some(wire::shape_input::Source::Encoded(wire::EncodedMesh {
                format: wire::MeshFormat::Off.into(),
                bytes: Some(wire::BytesRef { frame: i as u32 }),
            })),
        });
    let request = wire::AddShapesRequest {
        collection: collection.to_owned(),
        shapes: inputs.collect(),
        mode: mode.into(),
        create: None,
    };
    let frames = shapes
        .iter()
        .map(|(_, text)| bytes::Bytes::from((*text).to_owned()));
    (request, frames.collect())
}

/// A closed surface of 2 × 16 × 23 triangles shaped like a skittle: a body and a head, with varying
/// proportions.
pub(crate) fn skittle(variant: u32) -> String {
    let (rings, sectors) = (24_u32, 16_u32);
    let mut vertices = vec![[0.0, 0.0, -1.0]];
    let vary = f64::from(variant);
    for ring in 1..rings {
        let t = f64::from(ring) / f64::from(rings);
        let z = -1.0 + t * (3.0 + 0.1 * vary);
        let body = (std::f64::consts::PI * t).sin();
        let neck = 1.0 - (0.55 + 0.02 * vary) * (-((t - 0.68) / 0.1).powi(2)).exp();
        for sector in 0..sectors {
            let angle = std::f64::consts::TAU * f64::from(sector) / f64::from(sectors);
            let r = body * neck * (1.0 + 0.05 * (angle * 2.0 + vary).sin());
            vertices.push([r * angle.cos(), r * angle.sin(), z]);
        }
    }
    vertices.push([0.0, 0.0, 2.0 + 0.1 * vary]);
    let at = |ring: u32, sector: u32| 1 + (ring - 1) * sectors + sector % sectors;
    let last = vertices.len() as u32 - 1;
    let mut faces = Vec::new();
    for s in 0..sectors {
        faces.push([0, at(1, s + 1), at(1, s)]);
        faces.push([last, at(rings - 1, s), at(rings - 1, s + 1)]);
        for ring in 1..rings - 1 {
            faces.push([at(ring, s), at(ring, s + 1), at(ring + 1, s)]);
            faces.push([at(ring, s + 1), at(ring + 1, s + 1), at(ring + 1, s)]);
        }
    }
    let mut text = format!("OFF\n{} {} 0\n", vertices.len(), faces.len());
    for [x, y, z] in vertices {
        text.push_str(&format!("{x} {y} {z}\n"));
    }
    for [a, b, c] in faces {
        text.push_str(&format!("3 {a} {b} {c}\n"));
    }
    text
}

/// Faces of a [`skittle`].
pub(crate) const SKITTLE_FACES: usize = 2 * 16 * 23;

/// Waits until a collection has no work left.
pub(crate) fn wait_idle(client: &mut Client, collection: &str) {
    let request = wire::WaitIdleRequest {
        collection: collection.to_owned(),
        wait_ms: 30_000,
    };
    while !coseg::call!(client, WaitIdle(request.clone()))
        .unwrap()
        .idle
    {}
}

/// A number from the environment, for longer runs of a test.
pub(crate) fn number(variable: &str, default: u64) -> u64 {
    std::env::var(variable).map_or(default, |text| {
        let read = text.parse();
        read.unwrap_or_else(|_| panic!("{variable} is {text:?}, which is no number"))
    })
}

/// The seed of random tests: constant, unless the environment sets another.
pub(crate) fn seed() -> u64 {
    number("COSEG_TEST_SEED", 1)
}

/// Standard output as text; the command must have ended with `code`.
pub(crate) fn stdout(output: &Output, code: i32) -> String {
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(code), "stderr: {stderr}");
    String::from_utf8(output.stdout.clone()).unwrap()
}

/// Standard output as JSON; it must be nothing else.
pub(crate) fn json(output: &Output, code: i32) -> serde_json::Value {
    let text = stdout(output, code);
    serde_json::from_str(&text).unwrap_or_else(|e| panic!("{e}: {text}"))
}

/// Whether a path exists, for assertions that read well.
pub(crate) fn exists(path: impl AsRef<Path>) -> bool {
    path.as_ref().exists()
}

/// The messy meshes of the benchmark data, by path; `None`, with a notice, if they are missing.
pub(crate) fn messy_files() -> Option<Vec<PathBuf>> {
    fn files(folder: &Path, into: &mut Vec<PathBuf>) {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                files(&path, into);
            } else {
                into.push(path);
            }
        }
    }
    let Some(data) = std::env::var_os("COSEG_TEST_DATA").map(PathBuf::from) else {
        println!("skipped: COSEG_TEST_DATA is not set");
        return None;
    };
    let mut paths = Vec::new();
    files(&data.join("messy"), &mut paths);
    paths.sort();
    Some(paths)
}
