//! Tests arrays at the vertices and faces of meshes as they were sent, through the library and the
//! daemon.

use crate::harness::{Home, add, skittle};
use crate::pipeline::{SMALL, file};
use coseg::call;
use coseg::ipc::client::{Client, ClientError};
use coseg::ipc::frames::{FrameReader, FrameWriter};
use coseg::ipc::wire::{self, ErrorCode, ErrorReason};
use coseg::library::{CollectionSpec, PointRequest, PolygonValues, Reason, Resolution};
use coseg::synth::{Family, Labelled, family};
use coseg::{Library, library::LibraryError};
use tempfile::TempDir;

const PETS: &str = "pets";

/// Two shapes whose proxies have fewer vertices than their files.
fn pets() -> (TempDir, Library, Vec<Labelled>) {
    let folder = tempfile::tempdir().unwrap();
    let library = Library::open(folder.path()).unwrap();
    let spec = CollectionSpec {
        name: PETS.into(),
        n_parts: Some(4),
        working_faces: 600,
        ..CollectionSpec::default()
    };
    library.create_collection(&spec, None).unwrap();
    let shapes = family(Family::Animal, 7, 2, &SMALL);
    for shape in &shapes {
        library.add(PETS, file(&shape.name, &shape.mesh)).unwrap();
    }
    (folder, library, shapes)
}

fn functions(values: &PolygonValues) -> &[f32] {
    let PolygonValues::Functions(values, _) = values else {
        panic!("functions stay functions");
    };
    values
}

fn refusal<T>(result: Result<T, LibraryError>) -> String {
    let Err(error) = result else {
        panic!("it was not refused");
    };
    let LibraryError::InvalidArgument { reason, message } = error else {
        panic!("{error:?}");
    };
    assert_eq!(reason, Reason::FieldRange);
    message
}

#[test]
fn functions_and_maps_are_at_the_vertices_and_faces_of_the_file() {
    let (_folder, library, shapes) = pets();
    let (a, b) = (shapes[0].name.as_str(), shapes[1].name.as_str());
    let one = library.input_shape(PETS, a).unwrap();
    let (n, m) = (shapes[0].mesh.vertices.len(), shapes[0].mesh.faces.len());
    let n_proxy = one.view().vertices.len();
    assert!(2 * n_proxy < n, "{n_proxy} of {n}");
    for (resolution, rows) in [
        (Resolution::Proxy, n_proxy),
        (Resolution::Vertices, n),
        (Resolution::Polygons, m),
    ] {
        assert_eq!(one.n_rows(resolution), rows);
        let ones = one.interpolate(&vec![1.0; 2 * n_proxy], 2, resolution);
        assert_eq!(ones.len(), 2 * rows);
        assert!(ones.iter().all(|x| (x - 1.0).abs() < 1e-6));
        let mass = one.mass(resolution);
        assert_eq!(mass.len(), rows);
        assert!((mass.iter().sum::<f32>() - 1.0).abs() < 1e-3);
    }
    // Simplification keeps vertices: each has its value at a vertex of the file, and only there.
    let numbers: Vec<f32> = (0..n_proxy).map(|v| v as f32).collect();
    let mut found = one.interpolate(&numbers, 1, Resolution::Vertices);
    found.retain(|x| x.fract() == 0.0);
    found.sort_unstable_by(f32::total_cmp);
    found.dedup();
    assert!(
        found.len() as f64 > 0.95 * n_proxy as f64,
        "{}",
        found.len()
    );

    let request = PointRequest::default();
    let pair = library.input_pair(PETS, a, b).unwrap();
    let (n2, m2) = (shapes[1].mesh.vertices.len(), shapes[1].mesh.faces.len());
    let map = library.point_maps(PETS, a, b, &request).unwrap().remove(0);
    let dense = pair.point_map(map.clone(), Resolution::Vertices);
    assert_eq!((dense.p2p_21.len(), dense.matched.len()), (n2, n2));
    assert!(dense.p2p_21.iter().all(|v| (*v as usize) < n));
    let faces = pair.point_map(map.clone(), Resolution::Polygons);
    assert_eq!(faces.p2p_21.len(), m2);
    assert!(faces.p2p_21.iter().all(|f| (*f as usize) < m));
    assert_eq!(pair.point_map(map.clone(), Resolution::Proxy), map);
    let parts = library.map(PETS, a, b).unwrap();
    let at = pair.part_map(parts.clone(), Resolution::Vertices);
    assert_eq!((at.p2p_21.len(), at.confidence.of_vertex.len()), (n2, n2));
    assert_eq!((at.c_12, at.quality), (parts.c_12, parts.quality));

    // More than one vertex of a fine mesh has no double on the other.
    let distinct: std::collections::BTreeSet<u32> = dense.p2p_21.iter().copied().collect();
    assert!(distinct.len() > n_proxy, "{} of {n}", distinct.len());
}

#[test]
fn constants_transfer_to_constants_at_every_vertex() {
    let (_folder, library, shapes) = pets();
    let (a, b) = (shapes[0].name.as_str(), shapes[1].name.as_str());
    let (n, n2) = (shapes[0].mesh.vertices.len(), shapes[1].mesh.vertices.len());
    let request = PointRequest::default();
    let transfer = |values: &PolygonValues, resolution| {
        library.transfer_at(PETS, (a, b), values, &request, resolution)
    };
    let ones = PolygonValues::Functions(vec![1.0; 2 * n], 2);
    let (moved, map) = transfer(&ones, Resolution::Vertices).unwrap();
    let moved = functions(&moved);
    assert_eq!(moved.len(), 2 * n2);
    let known = moved.iter().filter(|x| !x.is_nan()).count();
    assert!(known as f64 > 0.7 * moved.len() as f64, "{known}");
    assert!(moved.iter().all(|x| x.is_nan() || (x - 1.0).abs() < 1e-5));
    // Labels are those of the corresponding vertices.
    let ids = PolygonValues::Labels((0..n as i32).collect());
    let (labels, _) = transfer(&ids, Resolution::Vertices).unwrap();
    let pair = library.input_pair(PETS, a, b).unwrap();
    let dense = pair.point_map(map.clone(), Resolution::Vertices);
    let expected = dense.p2p_21.iter().zip(&dense.matched);
    let expected = expected.map(|(v, matched)| if *matched { *v as i32 } else { -1 });
    assert_eq!(labels, PolygonValues::Labels(expected.collect()));
    // On the proxies it is the pointwise map itself.
    let n1 = library.n_proxy_vertices(PETS, a).unwrap();
    let numbers = PolygonValues::Functions((0..n1).map(|v| v as f32).collect(), 1);
    let (moved, _) = transfer(&numbers, Resolution::Proxy).unwrap();
    for ((x, v), matched) in functions(&moved).iter().zip(&map.p2p_21).zip(&map.matched) {
        assert!(if *matched {
            *x == *v as f32
        } else {
            x.is_nan()
        });
    }
    for (resolution, rows) in [(Resolution::Vertices, n), (Resolution::Proxy, n1)] {
        let wrong = PolygonValues::Labels(vec![0; rows + 1]);
        let text = refusal(transfer(&wrong, resolution));
        assert!(text.contains(&format!("{} rows", rows + 1)), "{text}");
        assert!(text.contains(&format!("has {rows} vertices")), "{text}");
    }

    // A landmark at vertices of the files is one at the proxy vertices nearest to them.
    let named = |landmarks| {
        let request = PointRequest {
            landmarks,
            ..PointRequest::default()
        };
        library.landmarks_on_proxy(PETS, (a, b), request)
    };
    let found = named(vec![[5, 9]]).unwrap().landmarks[0];
    for (name, (vertex, proxy)) in [(a, (5, found[0])), (b, (9, found[1]))] {
        let shape = library.input_shape(PETS, name).unwrap();
        let view = shape.view();
        let at = shape.interpolate(view.vertices.as_flattened(), 3, Resolution::Vertices);
        let distance = |v: usize| {
            let (p, q) = (&at[3 * vertex..3 * vertex + 3], view.vertices[v]);
            (0..3).map(|i| (p[i] - q[i]).powi(2)).sum::<f32>()
        };
        let nearer = (0..view.vertices.len()).filter(|v| distance(*v) < distance(proxy as usize));
        assert!(nearer.count() <= 2, "{name}");
    }
    let text = refusal(named(vec![[5, n2 as u32]]));
    assert!(text.contains(&format!("vertex {n2}")), "{text}");
    assert!(text.contains(&format!("has {n2} vertices")), "{text}");
}

#[test]
fn the_daemon_answers_at_each_resolution_and_as_before_without_one() {
    let home = Home::new();
    let daemon = home.start();
    let client = &mut daemon.client();
    let texts = [skittle(0), skittle(1)];
    let spec = wire::CollectionSpec {
        name: "c".to_owned(),
        n_parts: Some(2),
        working_faces: 300,
        ..Default::default()
    };
    let create = wire::CreateCollectionRequest { spec: Some(spec) };
    call!(client, CreateCollection(create)).unwrap();
    add(client, "c", &[("a", &texts[0]), ("b", &texts[1])]);
    let n: usize = texts[0].split_whitespace().nth(1).unwrap().parse().unwrap();
    let rows = |client: &mut Client, resolution: wire::Resolution| {
        let request = wire::GetHksRequest {
            collection: "c".to_owned(),
            shape: "a".to_owned(),
            resolution: resolution.into(),
        };
        let (reply, frames) = call!(client, GetHks(request), frames).unwrap();
        let reader = FrameReader::new(&frames);
        let (_, extents) = reader.f32_array(reply.hks.as_ref(), "hks").unwrap();
        (extents[0], reply.resolution())
    };
    let unset = rows(client, wire::Resolution::Unspecified);
    assert_ne!(unset.0, n);
    assert_eq!(unset.1, wire::Resolution::Proxy);
    assert_eq!(rows(client, wire::Resolution::Proxy), unset);
    assert_eq!(
        rows(client, wire::Resolution::Input),
        (n, wire::Resolution::Input)
    );

    let transfer = |client: &mut Client, resolution: wire::Resolution, length: usize| {
        let mut frames = FrameWriter::default();
        let values = frames.i32_array(&vec![3; length], &[length]);
        let request = wire::TransferFunctionRequest {
            collection: "c".to_owned(),
            from: "a".to_owned(),
            to: "b".to_owned(),
            values: Some(values),
            resolution: resolution.into(),
            ..Default::default()
        };
        let frames = frames.finish();
        call!(client, TransferFunction(request), frames, with_frames)
    };
    let (reply, _) = transfer(client, wire::Resolution::Input, n).unwrap();
    assert_eq!(reply.resolution(), wire::Resolution::Input);
    let wrong = transfer(client, wire::Resolution::Input, n - 1);
    let Err(ClientError::Refused(error)) = wrong else {
        panic!("{wrong:?}");
    };
    assert_eq!(
        (error.code(), error.reason()),
        (ErrorCode::InvalidArgument, ErrorReason::FieldRange)
    );
    let text = &error.message;
    assert!(text.contains(&format!("{} rows", n - 1)), "{text}");
    assert!(text.contains(&format!("has {n} vertices")), "{text}");
}
