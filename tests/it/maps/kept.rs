//! Tests stored maps: found again, deleted with their shapes, and recomputed if they disagree with
//! the others.

use crate::pipeline::{COLLECTION, SMALL, library, stream};
use coseg::Library;
use coseg::fmap::Basis;
use coseg::fmap::convert::functional;
use coseg::library::{PointRequest, Up};
use coseg::store::{MapRow, Store};
use coseg::synth::{Family, family};

#[test]
fn maps_between_points_are_kept_and_go_with_their_shapes() {
    let shapes = family(Family::Animal, 3, 4, &SMALL);
    let (folder, library) = library(3, Up::Unknown);
    stream(&library, &shapes);
    let (a, b) = (shapes[0].name.as_str(), shapes[1].name.as_str());
    let request = PointRequest {
        alternative: true,
        ..PointRequest::default()
    };
    let found = library.point_maps(COLLECTION, a, b, &request).unwrap();
    let other = PointRequest {
        k: 30,
        ..request.clone()
    };
    let small = library.point_maps(COLLECTION, a, b, &other).unwrap();
    assert_ne!(found[0].k, small[0].k);
    drop(library);
    let keys = |library: &std::path::Path| {
        let store = Store::open(library).unwrap();
        store.catalog().read(|r| r.point_map_keys()).unwrap()
    };
    assert_eq!(keys(folder.path()).len(), 2);
    let found_wrong = Library::check(folder.path()).unwrap();
    assert!(found_wrong.iter().all(|f| !f.damage), "{found_wrong:?}");
    let library = Library::open(folder.path()).unwrap();
    assert_eq!(
        library.point_maps(COLLECTION, a, b, &request).unwrap(),
        found
    );
    assert_eq!(library.point_maps(COLLECTION, a, b, &other).unwrap(), small);
    library.remove(COLLECTION, b, None).unwrap();
    drop(library);
    assert!(keys(folder.path()).is_empty());
}

/// The map between two shapes, with the vertices of the second in reverse, which makes it
/// meaningless.
fn spoilt(library: &Library, row: &MapRow, names: (&str, &str)) -> MapRow {
    let (a, b) = (
        library.description(COLLECTION, names.0).unwrap(),
        library.description(COLLECTION, names.1).unwrap(),
    );
    let (one, two) = (a.view(), b.view());
    let one = Basis {
        eigenvalues: one.eigenvalues,
        eigenvectors: one.eigenvectors,
        n_eigenvectors: one.n_eigenvectors,
        mass: one.mass,
    };
    let two = Basis {
        eigenvalues: two.eigenvalues,
        eigenvectors: two.eigenvectors,
        n_eigenvectors: two.n_eigenvectors,
        mass: two.mass,
    };
    let p2p_21: Vec<u32> = row.p2p_21.iter().rev().copied().collect();
    let (k1, k2) = (row.k1 as usize, row.k2 as usize);
    MapRow {
        c_12: functional(&one, &two, &p2p_21, k1, k2),
        p2p_21,
        ..row.clone()
    }
}

#[test]
fn a_planted_wrong_map_is_found_and_recomputed() {
    let shapes = family(Family::Animal, 9, 6, &SMALL);
    let (folder, library) = library(4, Up::Unknown);
    stream(&library, &shapes);
    // A map that disagrees by itself is recomputed first.
    library.mend_maps(COLLECTION).unwrap();
    while library.relabel_next(Some(COLLECTION)).unwrap() {}
    let own = library.disagreements(COLLECTION).unwrap();
    let before = super::super::pipeline::all_labels(&library);
    drop(library);
    // For the last shape but one, the map from its first source.
    let store = Store::open(folder.path()).unwrap();
    let (row, ids) = store
        .catalog()
        .read(|r| -> Result<_, coseg::store::StoreError> {
            let collection = r.collection(COLLECTION)?.expect("there").id;
            let rows = r.shapes(collection, 0, usize::MAX, None)?;
            let to = rows[rows.len() - 2].id;
            let ids: Vec<_> = rows.into_iter().map(|s| (s.id, s.name)).collect();
            let mut into = r.maps_into(to)?;
            into.retain(|m| own.iter().all(|d| (d.from, d.to) != (m.from, m.to)));
            Ok((into.swap_remove(0), ids))
        })
        .unwrap();
    drop(store);
    let name = |id| ids.iter().find(|x| x.0 == id).unwrap().1.as_str();
    let names = (name(row.from), name(row.to));
    let library = Library::open(folder.path()).unwrap();
    let wrong = spoilt(&library, &row, names);
    drop(library);
    let store = Store::open(folder.path()).unwrap();
    store.catalog().write(|tx| tx.put_map(&wrong)).unwrap();
    drop(store);

    let notes = Library::check(folder.path()).unwrap();
    assert!(notes.iter().all(|f| !f.damage), "{notes:?}");
    let location = format!("maps {}, {}", row.from, row.to);
    assert!(notes.iter().any(|f| f.location == location), "{notes:?}");
    let library = Library::open(folder.path()).unwrap();
    let standing = |from: &str, to: &str| {
        let map = library.map(COLLECTION, from, to).unwrap();
        library.standing(COLLECTION, from, to, &map).unwrap()
    };
    let found = standing(names.0, names.1).unwrap();
    assert!(found.inconsistent && found.departure > 0.5, "{found:?}");
    drop(library);
    let repaired = Library::repair(folder.path()).unwrap();
    let line = format!("{} to {}: recomputed", names.0, names.1);
    let done = repaired.done.iter().find(|d| d.contains(&line));
    println!("{}", done.unwrap_or_else(|| panic!("{:?}", repaired.done)));
    assert!(
        repaired.left.iter().all(|f| f.location != location),
        "{:?}",
        repaired.left
    );

    let library = Library::open(folder.path()).unwrap();
    let map = library.map(COLLECTION, names.0, names.1).unwrap();
    let same = map
        .p2p_21
        .iter()
        .zip(&row.p2p_21)
        .filter(|(x, y)| x == y)
        .count();
    println!("{same} of {} vertices as before", row.p2p_21.len());
    let standing = library.standing(COLLECTION, names.0, names.1, &map);
    assert!(!standing.unwrap().unwrap().inconsistent);
    assert!(map.quality.confidence > 0.6, "{:?}", map.quality);
    while library.relabel_next(Some(COLLECTION)).unwrap() {}
    let after = super::super::pipeline::all_labels(&library);
    let (x, y) = (&before[names.1], &after[names.1]);
    let agree = x.iter().zip(y).filter(|(x, y)| x == y).count();
    assert!(
        agree as f64 > 0.9 * x.len() as f64,
        "{agree} of {}",
        x.len()
    );
}
