//! Tests properties of every family: closed shapes, all labels present, the same bytes for the same
//! seed.

use super::dice::Dice;
use super::{Family, LEAST_FACES, Labelled, Options, check, family, generate};
use crate::labels::score::pieces;
use crate::mesh::write::off;
use std::collections::BTreeSet;
use std::sync::LazyLock;

/// Number of members of each family in the tests.
const COUNT: u32 = 8;

/// An arbitrary seed.
const SEED: u64 = 3;

/// The members of every family, generated once for all tests.
static MEMBERS: LazyLock<Vec<Vec<Labelled>>> = LazyLock::new(|| {
    Family::ALL
        .map(|kind| family(kind, SEED, COUNT, &Options::default()))
        .into()
});

fn members(kind: Family) -> &'static [Labelled] {
    &MEMBERS[kind as usize]
}

fn used(shape: &Labelled) -> Vec<u32> {
    shape
        .labels
        .iter()
        .copied()
        .collect::<BTreeSet<_>>()
        .into_iter()
        .collect()
}

/// Number of connected pieces with a label.
fn n_pieces(shape: &Labelled, label: u32) -> usize {
    let labels: Vec<i32> = shape.labels.iter().map(|l| *l as i32).collect();
    let of = pieces(&shape.mesh.faces, &labels);
    let with = of
        .iter()
        .zip(&shape.labels)
        .filter(|(_, l)| **l == label)
        .map(|(piece, _)| piece);
    with.collect::<BTreeSet<_>>().len()
}

#[test]
fn shapes_are_closed_connected_outward_and_of_even_triangles() {
    for kind in Family::ALL {
        for shape in members(kind) {
            let (mesh, name) = (&shape.mesh, &shape.name);
            check::closed_manifold(mesh);
            assert_eq!(check::n_components(mesh), 1, "{name}");
            assert!(
                check::volume(mesh) > 0.005,
                "{name}: volume {}",
                check::volume(mesh)
            );
            assert_eq!(mesh.faces.len(), 6_000, "{name}");
            assert_eq!(shape.labels.len(), 6_000, "{name}");
            let angles = check::angles(mesh);
            let thin = angles.iter().filter(|a| **a < 20.0).count();
            let least = angles.iter().copied().fold(180.0, f64::min);
            assert!(
                least > 2.0 && thin < 60,
                "{name}: least {least}, {thin} below 20 degrees"
            );
        }
    }
}

#[test]
fn every_part_of_a_scene_is_labelled() {
    for kind in Family::ALL {
        let mut found = BTreeSet::new();
        for (index, shape) in (0..).zip(members(kind)) {
            let scene = kind.scene(&mut Dice::new(SEED, kind as u64, index, 0));
            assert_eq!(used(shape), scene.labels(), "{}", shape.name);
            found.extend(used(shape));
        }
        let all: BTreeSet<u32> = (0..kind.label_names().len() as u32).collect();
        assert_eq!(found, all, "{kind}: some label is never used");
    }
}

#[test]
fn parts_come_in_the_numbers_of_their_kind() {
    for shape in members(Family::Animal) {
        let counts: Vec<usize> = (0..6).map(|label| n_pieces(shape, label)).collect();
        // body, head, neck, leg, tail, ear
        assert_eq!(counts, [1, 1, 1, 4, 1, 2], "{}", shape.name);
    }
    for shape in members(Family::Pliers) {
        let counts: Vec<usize> = (0..2).map(|label| n_pieces(shape, label)).collect();
        assert_eq!(counts, [2, 2], "{}", shape.name);
    }
    for shape in members(Family::Bird) {
        // head, wing, tail
        let counts = [1, 3, 4].map(|label| n_pieces(shape, label));
        assert_eq!(counts, [1, 2, 1], "{}", shape.name);
    }
    for shape in members(Family::Guitar) {
        let counts: Vec<usize> = (0..3).map(|label| n_pieces(shape, label)).collect();
        assert_eq!(counts, [1, 1, 1], "{}", shape.name);
    }
}

#[test]
fn topology_varies_where_it_should() {
    let handles: BTreeSet<usize> = family(Family::Container, SEED, 12, &small())
        .iter()
        .map(|s| n_pieces(s, 2))
        .collect();
    assert_eq!(handles, BTreeSet::from([0, 1, 2]));
    let candles: BTreeSet<usize> = family(
        Family::Candelabra,
        SEED,
        12,
        &Options {
            n_faces: 4_000,
            ..small()
        },
    )
    .iter()
    .map(|s| n_pieces(s, 3))
    .collect();
    assert!(
        candles.len() >= 4 && candles.iter().all(|n| (1..=7).contains(n)),
        "{candles:?}"
    );
    for kind in [Family::Chair, Family::Container] {
        let genera: BTreeSet<i64> = family(
            kind,
            SEED,
            12,
            &Options {
                n_faces: 3_000,
                ..small()
            },
        )
        .iter()
        .map(|s| 1 - check::euler_characteristic(&s.mesh) / 2)
        .collect();
        assert!(genera.len() >= 3, "{kind}: {genera:?}");
    }
}

fn small() -> Options {
    Options {
        n_faces: 2_000,
        rotate: false,
    }
}

#[test]
fn a_container_has_as_many_holes_as_handles() {
    for shape in family(Family::Container, SEED, 12, &small()) {
        let genus = 1 - check::euler_characteristic(&shape.mesh) / 2;
        assert_eq!(genus, n_pieces(&shape, 2) as i64, "{}", shape.name);
    }
}

#[test]
fn the_same_seed_gives_the_same_bytes() {
    // These digests were computed on x86-64; other machines must agree. A deliberate change of a
    // grammar must replace them.
    let digests = Family::ALL.map(|kind| {
        let shape = generate(
            kind,
            1,
            0,
            &Options {
                n_faces: LEAST_FACES,
                rotate: true,
            },
        );
        let mut hasher = blake3::Hasher::new();
        hasher.update(off(&shape.mesh).as_bytes());
        for label in &shape.labels {
            hasher.update(&label.to_le_bytes());
        }
        hasher.finalize().to_hex()[..16].to_owned()
    });
    assert_eq!(digests, DIGESTS);
}

const DIGESTS: [&str; 7] = [
    "ace8e64752965681",
    "1aaa1d6a994246bc",
    "594ff21f326188ef",
    "ca06ff62109576ce",
    "c6b97430c721f22e",
    "9f25db38ed703c33",
    "5651c35fcfbfc722",
];

#[test]
fn members_do_not_depend_on_the_others_but_on_seed_and_index() {
    let all = family(Family::Pliers, 5, 3, &small());
    assert_eq!(all[2], generate(Family::Pliers, 5, 2, &small()));
    assert_eq!(all[2].name, "pliers-003");
    assert_ne!(all[0].mesh, all[1].mesh);
    assert_ne!(all[0].mesh, generate(Family::Pliers, 6, 0, &small()).mesh);
}

#[test]
fn turning_moves_a_shape_and_changes_nothing_else() {
    let upright = generate(Family::Guitar, 1, 4, &small());
    let turned = generate(
        Family::Guitar,
        1,
        4,
        &Options {
            rotate: true,
            ..small()
        },
    );
    assert_eq!(upright.mesh.faces, turned.mesh.faces);
    assert_eq!(upright.labels, turned.labels);
    assert_ne!(upright.mesh.vertices, turned.mesh.vertices);
    let (a, b) = (check::volume(&upright.mesh), check::volume(&turned.mesh));
    // Vertices are rounded to a millionth.
    assert!((a - b).abs() < 1e-5, "{a} {b}");
}

#[test]
fn few_and_many_faces_are_reached() {
    for n_faces in [0, 1_000, 12_001] {
        let shape = generate(
            Family::Animal,
            1,
            0,
            &Options {
                n_faces,
                rotate: false,
            },
        );
        check::closed_manifold(&shape.mesh);
        assert_eq!(
            shape.mesh.faces.len() as u32,
            n_faces.max(LEAST_FACES) / 2 * 2
        );
    }
}

#[test]
fn names_read_back() {
    for kind in Family::ALL {
        assert_eq!(kind.to_string().parse(), Ok(kind));
        let names: BTreeSet<_> = kind.label_names().iter().collect();
        assert_eq!(names.len(), kind.label_names().len());
    }
    let error = "dragon".parse::<Family>().unwrap_err().to_string();
    assert!(error.starts_with("no family is called 'dragon'; there are animal, bird, chair"));
}
