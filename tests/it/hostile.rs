//! Tests meshes that have crashed other programs, generated here: each is refused with a reason or
//! served, by the parsers, by a description, and through the socket.

use crate::harness::{Home, number, seed, skittle};
use bytes::Bytes;
use coseg::call;
use coseg::ipc::client::Client;
use coseg::ipc::wire::{self, ItemState};
use coseg::mesh::{self, Format};
use rand::{Rng as _, SeedableRng as _};
use std::cell::RefCell;
use std::fmt::Write as _;
use std::panic::catch_unwind;
use std::time::{Duration, Instant};

pub(crate) struct Hostile {
    pub(crate) name: String,
    pub(crate) format: Format,
    pub(crate) bytes: Vec<u8>,
}

/// A tetrahedron as OBJ and as OFF, for damaging.
const OBJ: &str = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n";
const OFF: &str = "OFF\n4 4 6\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n3 1 2 3\n3 0 3 2\n";

/// At least 150 of them, each with a name.
pub(crate) fn corpus() -> Vec<Hostile> {
    let all = RefCell::new(Vec::new());
    let put = |format: Format, name: &str, bytes: Vec<u8>| {
        all.borrow_mut().push(Hostile {
            name: format!(
                "{name}.{}",
                if format == Format::Obj { "obj" } else { "off" }
            ),
            format,
            bytes,
        });
    };
    let obj = |name: &str, text: String| put(Format::Obj, name, text.into_bytes());
    for (name, face) in [
        ("index past the end", "f 1 2 9"),
        ("index zero", "f 0 1 2"),
        ("relative zero", "f -0 1 2"),
        ("relative past the beginning", "f -5 -1 -2"),
        ("index of 2^31", "f 2147483648 1 2"),
        ("index of 2^32 plus 1", "f 4294967297 2 3"),
        ("index of 2^63", "f 9223372036854775808 1 2"),
        ("index of 2^64", "f 18446744073709551616 1 2"),
        ("index of -2^63", "f -9223372036854775808 1 2"),
        ("index with a fraction", "f 1.5 2 3"),
        ("index of words", "f one two three"),
        ("index hexadecimal", "f 0x1 2 3"),
        ("index nan", "f nan 1 2"),
        ("slashes alone", "f / / /"),
        ("many slashes", "f 1//// 2//// 3////"),
        ("texture past the end", "f 1/99/99 2/99/99 3/99/99"),
        ("one corner", "f 1"),
        ("two corners", "f 1 2"),
        ("no corners", "f"),
        ("the same corner", "f 1 1 1"),
        ("a point", "p 1"),
        ("a line", "l 1 2 3"),
        ("a nul", "f 1 2\u{0} 3"),
        ("a comma", "f 1,2,3"),
        ("a surface", "surf 0 1 0 1 1 2 3"),
        ("a call", "call /etc/passwd"),
        ("a library", "mtllib file:///etc/passwd\nusemtl ../../../x"),
        ("continued for ever", "f 1 2 \\"),
    ] {
        obj(name, format!("{OBJ}{face}\n"));
    }
    obj("faces without vertices", "f 1 1 1\n".into());
    obj(
        "vertices without faces",
        "v 0 0 0\nv 1 0 0\nv 0 1 0\n".into(),
    );
    obj("nothing", String::new());
    obj("comments alone", "# x\n".repeat(10_000));
    obj("blank lines", "\n".repeat(100_000));
    obj("face before its vertices", format!("f 1 2 3\n{OBJ}"));
    for (name, value) in [
        ("nan", "nan"),
        ("infinity", "inf"),
        ("minus infinity", "-inf"),
        ("1e38", "1e38"),
        ("1e308", "1e308"),
        ("1e400", "1e400"),
        ("denormal", "1e-310"),
        ("minus zero", "-0.0"),
        ("a long number", &"9".repeat(400)),
        ("a long fraction", &format!("0.{}", "1".repeat(100_000))),
        ("an exponent", "1e2147483648"),
        ("empty", ""),
        ("a word", "x"),
        ("hexadecimal", "0x10"),
        ("a decimal comma", "0,5"),
        ("plus", "+"),
        ("dots", "1.2.3"),
    ] {
        obj(
            &format!("coordinate {name}"),
            OBJ.replacen("v 1 0 0", &format!("v {value} 0 0"), 1),
        );
        let off = OFF.replacen("\n1 0 0", &format!("\n{value} 0 0"), 1);
        put(Format::Off, &format!("coordinate {name}"), off.into_bytes());
    }
    let off = |name: &str, text: String| put(Format::Off, name, text.into_bytes());
    for n in [
        "-1",
        "0",
        "5",
        "2147483647",
        "2147483648",
        "4294967295",
        "4294967296",
        "9223372036854775807",
        "18446744073709551615",
        "18446744073709551616",
        "1e9",
        "x",
        "",
    ] {
        off(
            &format!("{n:?} vertices"),
            OFF.replacen("4 4 6", &format!("{n} 4 6"), 1),
        );
        off(
            &format!("{n:?} faces"),
            OFF.replacen("4 4 6", &format!("4 {n} 6"), 1),
        );
        off(
            &format!("a face of {n:?}"),
            OFF.replacen("3 0 2 1", &format!("{n} 0 2 1"), 1),
        );
        off(
            &format!("a corner at {n:?}"),
            OFF.replacen("3 0 2 1", &format!("3 {n} 2 1"), 1),
        );
    }
    for header in [
        "",
        "off",
        "OFF BINARY",
        "COFF",
        "NOFF",
        "4OFF",
        "nOFF\n5",
        "STOFF",
        "OFFOFF",
        "PLY",
    ] {
        off(
            &format!("header {header:?}"),
            OFF.replacen("OFF", header, 1),
        );
    }
    off(
        "more than it says",
        format!("{OFF}{}", "3 0 1 2\n".repeat(1_000)),
    );
    off("counts on one line", OFF.replace('\n', " "));
    off("all equal", OFF.replace("1", "0"));
    off(
        "on a line",
        "OFF\n4 2 0\n0 0 0\n1 0 0\n2 0 0\n3 0 0\n3 0 1 2\n3 1 2 3\n".into(),
    );
    off(
        "one triangle",
        "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n".into(),
    );
    off(
        "one triangle twice",
        "OFF\n3 2 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n3 0 1 2\n".into(),
    );
    off(
        "both sides of a triangle",
        "OFF\n3 2 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n3 0 2 1\n".into(),
    );
    off(
        "far away",
        OFF.replace("0 0 0\n1 0 0", "1e15 0 0\n1e15 1 0"),
    );
    let mut fan = String::from("OFF\n10002 10000 0\n0 0 0\n0 0 1\n");
    let mut valence = String::from("OFF\n20001 20000 0\n0 0 1\n");
    let mut components = String::from("OFF\n30000 10000 0\n");
    for i in 0..10_000 {
        let a = f64::from(i) * 6.28e-4;
        let _ = writeln!(fan, "{} {} 0", a.cos(), a.sin());
        let _ = write!(components, "{i} 0 0\n{i}.5 0 0\n{i} 0.5 0\n");
    }
    for i in 0..20_000 {
        let a = f64::from(i) * 3.14e-4;
        let _ = writeln!(valence, "{} {} 0", a.cos(), a.sin());
    }
    for i in 0..10_000 {
        let _ = writeln!(fan, "3 0 1 {}", i + 2);
        let _ = writeln!(components, "3 {} {} {}", 3 * i, 3 * i + 1, 3 * i + 2);
    }
    for i in 0..20_000 {
        let _ = writeln!(valence, "3 0 {} {}", 1 + i, 1 + (i + 1) % 20_000);
    }
    off("an edge of 10000 faces", fan);
    off("a vertex of valence 20000", valence);
    off("10000 components", components);
    let mut polygon = String::from("OFF\n1000000 1 0\n");
    for i in 0..1_000_000 {
        let a = f64::from(i) * 6.283e-6;
        let _ = writeln!(polygon, "{:.7} {:.7} 0", a.cos(), a.sin());
    }
    polygon.push_str("1000000");
    for i in 0..1_000_000 {
        let _ = write!(polygon, " {i}");
    }
    off("a polygon of 1000000 corners", polygon);
    let flat = |name: &str, points: &[[f64; 2]]| {
        let n = points.len();
        let mut text = format!("OFF\n{n} 1 0\n");
        for [x, y] in points {
            let _ = writeln!(text, "{x} {y} 0");
        }
        let corners: Vec<String> = (0..n).map(|i| i.to_string()).collect();
        let _ = writeln!(text, "{n} {}", corners.join(" "));
        off(&format!("a polygon that is {name}"), text);
    };
    // The maximum number of corners, in the orders that are slowest for some method of
    // triangulation.
    let circle = |i: usize, radius: f64| {
        let a = i as f64 * 6.283_185e-4;
        [radius * a.cos(), radius * a.sin()]
    };
    let corners = 0..10_000;
    let star = |i: usize| circle(i, if i.is_multiple_of(2) { 1.0 } else { 0.1 });
    flat("a star", &corners.clone().map(star).collect::<Vec<_>>());
    let knot = |i| circle(i * 7919 % 10_000, 1.0);
    flat("a knot", &corners.clone().map(knot).collect::<Vec<_>>());
    // Teeth of all lengths cross nearly all edges of the triangulation, hence quadratically many.
    let comb = |i: usize| {
        [
            i as f64,
            if i.is_multiple_of(2) {
                0.0
            } else {
                1.0 + i as f64
            },
        ]
    };
    flat(
        "a comb",
        &corners.clone().take(2_000).map(comb).collect::<Vec<_>>(),
    );
    flat(
        "a zigzag",
        &corners
            .map(|i| [(i % 2) as f64, i as f64])
            .collect::<Vec<_>>(),
    );
    flat(
        "a bow-tie",
        &[[0.0, 0.0], [1.0, 1.0], [1.0, 0.0], [0.0, 1.0]],
    );
    flat("a point", &[[0.0; 2]; 7]);
    flat(
        "a line there and back",
        &[[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [1.0, 0.0]],
    );
    let square = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]];
    flat("around twice", &[square, square].concat());
    flat(
        "of absurd size",
        &square.map(|p| p.map(|x| (x - 0.5) * 1e308)),
    );
    flat(
        "of no size",
        &[
            [0.0, 0.0],
            [4e-310, 0.0],
            [1e-310, 1e-310],
            [0.0, 4e-310],
            [-1e-310, 0.0],
        ],
    );
    for prefix in ["NC", "STNC4n", "nnnn", "4444", "STST", "n", "4"] {
        off(
            &format!("header {prefix}OFF"),
            OFF.replacen("OFF", &format!("{prefix}OFF"), 1),
        );
    }
    off("an endless header", format!("{}OFF\n", "N".repeat(1 << 20)));
    off("returns alone", OFF.replace('\n', "\r"));
    off("returns without end", "\r".repeat(1 << 20));
    put(Format::Obj, "a zip", b"PK\x03\x04\x14\0\0\0\x08\0".to_vec());
    put(
        Format::Off,
        "a picture",
        b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR".to_vec(),
    );
    put(
        Format::Off,
        "utf-16",
        OFF.encode_utf16().flat_map(u16::to_be_bytes).collect(),
    );
    put(Format::Obj, "half of utf-16", b"\xff\xfev".to_vec());
    obj("comments that end in a backslash", "# \\\n".repeat(100_000));
    obj("words without end", "x ".repeat(1 << 20));
    off(
        "a line of 4 MB",
        format!("OFF\n4 4 0\n{}\n", "0 ".repeat(2 << 20)),
    );
    obj(
        "a line of 4 MB",
        format!("{OBJ}f {}\n", "1 ".repeat(2 << 20)),
    );
    // Files cut at every offset, and meaningless bytes.
    for (format, text) in [(Format::Obj, OBJ), (Format::Off, OFF)] {
        for end in (0..text.len()).step_by(3) {
            put(
                format,
                &format!("cut at {end}"),
                text.as_bytes()[..end].to_vec(),
            );
        }
    }
    let mut random = rand_pcg::Pcg64Mcg::seed_from_u64(7);
    for i in 0..6 {
        let noise: Vec<u8> = (0..1 << 14).map(|_| random.random()).collect();
        put(
            [Format::Obj, Format::Off][i % 2],
            &format!("noise {i}"),
            noise,
        );
    }
    put(
        Format::Off,
        "an invalid utf-8",
        b"OFF\n\xff\xfe 4 0\n".to_vec(),
    );
    put(
        Format::Obj,
        "a byte order mark",
        [b"\xef\xbb\xbf", OBJ.as_bytes()].concat(),
    );
    put(
        Format::Obj,
        "utf-16",
        OBJ.encode_utf16().flat_map(u16::to_le_bytes).collect(),
    );
    put(Format::Obj, "nuls", vec![0; 1 << 16]);
    all.into_inner()
}

#[test]
fn the_corpus_is_parsed_or_refused_without_a_panic() {
    let corpus = corpus();
    assert!(corpus.len() >= 150, "{}", corpus.len());
    let mut names: Vec<_> = corpus.iter().map(|h| h.name.as_str()).collect();
    names.sort_unstable();
    names.dedup();
    assert_eq!(names.len(), corpus.len(), "names are unique");
    for hostile in &corpus {
        let begin = Instant::now();
        let parsed = catch_unwind(|| mesh::parse(&hostile.bytes, hostile.format));
        let parsed = parsed.unwrap_or_else(|_| panic!("{} panics", hostile.name));
        if let Ok(parsed) = parsed {
            catch_unwind(|| drop(mesh::clean(&parsed)))
                .unwrap_or_else(|_| panic!("cleaning {} panics", hostile.name));
        }
        let limit = Duration::from_secs(5);
        assert!(
            begin.elapsed() < limit,
            "{}: {:?}",
            hostile.name,
            begin.elapsed()
        );
    }
}

/// Bytes of the corpus, damaged at random; `COSEG_TEST_MUTATIONS` makes the test longer.
#[test]
fn spoilt_meshes_and_requests_do_not_panic() {
    use prost::Message as _;
    let (n, seed) = (number("COSEG_TEST_MUTATIONS", 20_000), seed());
    println!("{n} mutations, COSEG_TEST_SEED={seed}");
    let mut random = rand_pcg::Pcg64Mcg::seed_from_u64(seed);
    let small: Vec<Hostile> = corpus()
        .into_iter()
        .filter(|h| h.bytes.len() < 4_096)
        .collect();
    let (body, _) = crate::harness::add_request("c", &[("a", "")], wire::AddMode::Wait);
    let request = wire::Request {
        request_id: "1".into(),
        client_id: "x".into(),
        body: Some(body),
        ..Default::default()
    }
    .encode_to_vec();
    for i in 0..n {
        let from = &small[random.random_range(0..small.len())];
        let mut bytes = if i % 4 == 0 {
            request.clone()
        } else {
            from.bytes.clone()
        };
        for _ in 0..random.random_range(1..6) {
            if bytes.is_empty() {
                break;
            }
            let at = random.random_range(0..bytes.len());
            match random.random_range(0..5) {
                0 => bytes[at] ^= 1 << random.random_range(0..8),
                1 => bytes[at] = b"0123456789-+.e \n/f"[random.random_range(0..18)],
                2 => bytes.truncate(at),
                3 => {
                    let end = bytes.len().min(at + random.random_range(1..20));
                    let piece = bytes[at..end].to_vec();
                    bytes.splice(at..at, piece);
                }
                _ => {
                    bytes.remove(at);
                }
            }
        }
        let spoilt = catch_unwind(|| {
            if i % 4 == 0 {
                let _ = wire::Request::decode(bytes.as_slice());
            } else if let Ok(parsed) = mesh::parse(&bytes, from.format) {
                let _ = mesh::clean(&parsed);
            }
        });
        assert!(
            spoilt.is_ok(),
            "seed {seed}, mutation {i} of {}: {bytes:?}",
            from.name
        );
    }
}

#[test]
fn the_corpus_through_the_socket_leaves_the_daemon_as_it_was() {
    let home = Home::new();
    let daemon = home.start();
    let client = &mut daemon.client();
    let resident = |client: &mut Client| {
        let stats = call!(client, Stats(wire::StatsRequest {})).unwrap();
        assert_eq!(stats.pid, daemon.child.id());
        stats.resident_bytes
    };
    let spec = wire::CollectionSpec {
        name: "c".into(),
        n_parts: Some(2),
        ..Default::default()
    };
    call!(
        client,
        CreateCollection(wire::CreateCollectionRequest { spec: Some(spec) })
    )
    .unwrap();
    let before = resident(client);
    let (mut n_refused, mut n_served, mut largest) = (0, 0, 0);
    let corpus = corpus();
    // One request for each, like a client, so that each refusal is seen separately.
    for hostile in &corpus {
        // Cleaning and describing these in detail is tested elsewhere.
        if hostile.name.starts_with("cut at") && !hostile.name.contains('7') {
            continue;
        }
        let format = match hostile.format {
            Format::Obj => wire::MeshFormat::Obj,
            _ => wire::MeshFormat::Off,
        };
        let shape = wire::ShapeInput {
            name: hostile.name.replace('/', "-"),
            replace: false,
            source: Some(wire::shape_input::Source::Encoded(wire::EncodedMesh {
                format: format.into(),
                bytes: Some(wire::BytesRef { frame: 0 }),
            })),
        };
        let request = wire::AddShapesRequest {
            collection: "c".into(),
            shapes: vec![shape],
            mode: wire::AddMode::Wait.into(),
            create: None,
        };
        let frames = vec![Bytes::from(hostile.bytes.clone())];
        largest = largest.max(hostile.bytes.len() as u64);
        let done = call!(client, AddShapes(request), frames, with_frames);
        let item = done.unwrap().0.job.unwrap().items[0].clone();
        match item.state() {
            ItemState::Done => n_served += 1,
            ItemState::Failed => {
                let e = item.error.unwrap();
                // A worker that ends would show a bug in the parsers or in the numerics.
                let why = format!("{}: {:?} {}", hostile.name, e.reason(), e.message);
                assert!(e.message.len() < 4_096, "{why:.300}");
                assert!(
                    !matches!(
                        e.reason(),
                        wire::ErrorReason::Panic
                            | wire::ErrorReason::WorkerDied
                            | wire::ErrorReason::ShapeTimeout
                            | wire::ErrorReason::ShapeMemory
                    ),
                    "{why}"
                );
                n_refused += 1;
            }
            other => panic!("{}: {other:?}", hostile.name),
        }
    }
    let grown = resident(client).saturating_sub(before);
    println!(
        "{n_refused} refused, {n_served} served; {} MB more resident",
        grown >> 20
    );
    assert!(
        grown <= 8 * largest + (64 << 20),
        "{grown}, the largest file has {largest}"
    );
    assert!(n_refused > 60 && n_served > 10, "{n_refused} {n_served}");
    crate::harness::add(client, "d", &[("good", &skittle(0))]);
}
