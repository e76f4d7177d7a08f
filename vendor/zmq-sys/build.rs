//! Builds libzmq, patched, with CURVE over the libsodium that `libsodium-sys-stable` has built.

use std::env;
use std::fs;
use std::path::{Path, PathBuf};

/// Applied in this order.
const PATCHES: [&str; 3] = ["1-connections.patch", "2-drop-peer.patch", "3-intake.patch"];
/// A file that the patches add.
const ADDED: &str = "intake.hpp";

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    println!("cargo:rerun-if-changed=patches");
    let out = PathBuf::from(variable("OUT_DIR"));
    let source = out.join("source");
    // What an earlier build has patched would stay.
    if source.exists() {
        fs::remove_dir_all(&source).expect("OUT_DIR can be written");
    }
    unpack();
    for name in PATCHES {
        apply(&Path::new("patches").join(name), &source.join("src"));
    }
    copy(
        &Path::new("patches").join(ADDED),
        &source.join("src").join(ADDED),
    );
    compile(&source, &out.join("lib"));
}

fn variable(name: &str) -> String {
    env::var(name).unwrap_or_else(|_| panic!("{} is not set", name))
}

/// Leaves the sources of libzmq in `OUT_DIR/source`, and tells cargo what to link. `zeromq-src` does both, but only
/// when it builds: what it builds is not patched, so it is given a compiler that does nothing.
fn unpack() {
    let target = variable("TARGET");
    let tools = ["CC", "CXX", "AR"].map(|tool| format!("{}_{}", tool, target));
    let before = tools.clone().map(env::var_os);
    for tool in &tools {
        env::set_var(tool, "true");
    }
    zeromq_src::Build::new().build();
    for (tool, value) in tools.iter().zip(before) {
        match value {
            Some(value) => env::set_var(tool, value),
            None => env::remove_var(tool),
        }
    }
}

/// Applies a unified diff of several files. Ends the build if one of them is not what the diff was made for.
fn apply(path: &Path, directory: &Path) {
    let text = read(path);
    for part in text.split("diff --git ").skip(1) {
        let diff = &part[part.find("--- ").expect("a diff names its files")..];
        let patch =
            diffy::Patch::from_str(diff).unwrap_or_else(|e| panic!("{}: {}", path.display(), e));
        let name = patch.modified().expect("a diff names its file");
        let file = directory.join(name.trim_start_matches("b/"));
        let patched = diffy::apply(&read(&file), &patch)
            .unwrap_or_else(|e| panic!("{} of {}: {}", file.display(), path.display(), e));
        fs::write(&file, patched).unwrap_or_else(|e| panic!("{}: {}", file.display(), e));
    }
}

fn read(path: &Path) -> String {
    fs::read_to_string(path).unwrap_or_else(|e| panic!("{}: {}", path.display(), e))
}

fn copy(from: &Path, to: &Path) {
    fs::copy(from, to).unwrap_or_else(|e| panic!("{}: {}", from.display(), e));
}

/// As `zeromq-src` does for Linux, the only system that is served.
fn compile(source: &Path, library: &Path) {
    let built = |what: &str| variable(&format!("DEP_SODIUM_{}", what));
    let mut files: Vec<PathBuf> = fs::read_dir(source.join("src"))
        .expect("the sources are there")
        .map(|entry| entry.expect("the sources can be listed").path())
        .filter(|path| path.extension().map_or(false, |e| e == "cpp"))
        // They need GnuTLS.
        .filter(|path| {
            !path
                .file_name()
                .map_or(false, |n| n.to_string_lossy().starts_with("wss_"))
        })
        .collect();
    files.sort();
    // All of it is compiled as C++, and clang refuses C++11 for a file whose name says C.
    let sha1 = source.join("external/sha1/sha1.cpp");
    copy(&source.join("external/sha1/sha1.c"), &sha1);
    let mut build = cc::Build::new();
    build
        .cpp(true)
        .std("c++11")
        // Warnings of somebody else's code are no news to whoever builds this.
        .warnings(false)
        .flag("-w")
        .files(files)
        .file(sha1)
        .include(source.join("include"))
        .include(source.join("src"))
        .include(source.join("external/sha1"))
        // An empty platform.hpp is there: definitions take its place.
        .include(variable("OUT_DIR"))
        .include(built("INCLUDE"))
        .out_dir(library);
    for (name, value) in [
        ("ZMQ_USE_LIBSODIUM", "1"),
        ("ZMQ_HAVE_CURVE", "1"),
        ("ZMQ_USE_CV_IMPL_STL11", "1"),
        ("ZMQ_STATIC", "1"),
        ("ZMQ_USE_BUILTIN_SHA1", "1"),
        ("ZMQ_HAVE_WS", "1"),
        ("ZMQ_HAVE_LINUX", "1"),
        ("ZMQ_IOTHREAD_POLLER_USE_EPOLL", "1"),
        ("ZMQ_POLL_BASED_ON_POLL", "1"),
        ("ZMQ_HAVE_IPC", "1"),
        ("HAVE_STRNLEN", "1"),
        ("ZMQ_HAVE_UIO", "1"),
        ("ZMQ_HAVE_STRUCT_SOCKADDR_UN", "1"),
        // Workers inherit no connection.
        ("ZMQ_HAVE_SOCK_CLOEXEC", "1"),
        ("HAVE_ACCEPT4", "1"),
    ] {
        build.define(name, value);
    }
    if has_strlcpy() {
        build.define("ZMQ_HAVE_STRLCPY", "1");
    }
    build.compile("zmq");
    println!("cargo:rustc-link-search={}", built("LIB"));
    println!("cargo:rustc-link-lib=static=sodium");
}

/// Whether the C library declares `strlcpy`, so that nobody else can.
fn has_strlcpy() -> bool {
    let probe = PathBuf::from(variable("OUT_DIR")).join("strlcpy.cpp");
    let text = "#include <string.h>\nsize_t (*f) (char *, const char *, size_t) = strlcpy;\n";
    fs::write(&probe, text).expect("OUT_DIR can be written");
    cc::Build::new()
        .cpp(true)
        .file(&probe)
        .cargo_output(false)
        // That it fails is an answer, not news.
        .cargo_warnings(false)
        .try_compile("strlcpy")
        .is_ok()
}
