//! What every family owes its users: closed shapes, all their labels, the same bytes for the same seed.

use super::dice::Dice;
use super::{Family, Labelled, Options, check, family, generate};
use crate::mesh::write::off;
use std::collections::BTreeSet;

/// Members of each family that are looked at.
const COUNT: u32 = 8;

fn used(labelled: &Labelled) -> Vec<u32> {
    labelled
        .labels
        .iter()
        .copied()
        .collect::<BTreeSet<_>>()
        .into_iter()
        .collect()
}

#[test]
fn shapes_are_closed_connected_and_outward() {
    for kind in Family::ALL {
        for shape in family(kind, 3, COUNT, &Options::default()) {
            let (mesh, name) = (&shape.mesh, &shape.name);
            check::closed_manifold(mesh);
            assert_eq!(check::n_components(mesh), 1, "{name}");
            assert!(
                check::volume(mesh) > 0.005,
                "{name}: volume {}",
                check::volume(mesh)
            );
            assert_eq!(shape.labels.len(), mesh.faces.len());
            let n = mesh.faces.len();
            assert!((5_900..=6_000).contains(&n), "{name}: {n} faces");
        }
    }
}
