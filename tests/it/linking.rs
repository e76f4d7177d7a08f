//! A person links parts: they get the same label, or different ones, whether labels are discovered
//! or follow from corrections.

use crate::pipeline::{COLLECTION, SMALL, all_labels, library, propagate, stream};
use coseg::Library;
use coseg::library::{
    Answer, Code, Correction, EventKind, Failure, Link, LinkChanged, LinkKind, PartName, Reason, Up,
};
use coseg::synth::{Family, Labelled, family};
use std::collections::BTreeMap;

fn part(shape: &str, part: u32) -> PartName {
    let shape = shape.to_owned();
    PartName { shape, part }
}

fn link(library: &Library, kind: LinkKind, parts: &[PartName; 2]) -> Result<LinkChanged, Failure> {
    let done = library.link_parts(COLLECTION, kind, parts, "ada", None);
    done.map_err(|e| Failure::from(&e))
}

fn links(library: &Library) -> Vec<Link> {
    library.links(COLLECTION, None).unwrap()
}

/// The parts of a shape with a label, the largest first.
fn with_label(library: &Library, shape: &str, label: u32) -> Vec<PartName> {
    let parts = library.shape(COLLECTION, shape).unwrap().parts;
    let mut found: Vec<(f64, u32)> = (0..parts.len() as u32)
        .filter(|p| parts[*p as usize].label == label)
        .map(|p| (parts[p as usize].area_share, p))
        .collect();
    found.sort_by(|a, b| b.0.total_cmp(&a.0));
    found.into_iter().map(|(_, p)| part(shape, p)).collect()
}

/// The labels of a shape by falling area.
fn labels_by_area(library: &Library, shape: &str) -> Vec<u32> {
    let mut area = BTreeMap::<u32, f64>::new();
    for p in library.shape(COLLECTION, shape).unwrap().parts {
        *area.entry(p.label).or_default() += p.area_share;
    }
    let mut labels: Vec<u32> = area.keys().copied().collect();
    labels.sort_by(|a, b| area[b].total_cmp(&area[a]));
    labels
}

/// The polygons of a part, found by making a person label it and undoing that.
fn polygons(library: &Library, part: &PartName) -> Vec<usize> {
    let before = all_labels(library)[&part.shape].clone();
    let given = Correction::Part {
        part: part.part,
        label: 999,
    };
    let done = library.correct(COLLECTION, &part.shape, &given, None);
    done.unwrap();
    let marked = all_labels(library)[&part.shape].clone();
    library.undo(COLLECTION, None).unwrap();
    assert_eq!(all_labels(library)[&part.shape], before);
    let marked = marked.iter().enumerate();
    marked.filter(|p| *p.1 == 999).map(|p| p.0).collect()
}

/// The label of most of some polygons.
fn label_of(library: &Library, shape: &str, polygons: &[usize]) -> i32 {
    let labels = &all_labels(library)[shape];
    let mut counts = BTreeMap::<i32, usize>::new();
    for p in polygons {
        *counts.entry(labels[*p]).or_default() += 1;
    }
    counts.into_iter().max_by_key(|c| c.1).unwrap().0
}

fn pliers(seed: u64, n: u32) -> Vec<Labelled> {
    family(Family::Pliers, seed, n, &SMALL)
}

#[test]
fn parts_that_share_a_label_differ_after_a_link_and_are_equal_again_without_it() {
    let all = pliers(51, 9);
    let (shapes, more) = all.split_at(6);
    let (folder, library) = library(3, Up::Unknown);
    stream(&library, shapes);
    let before = all_labels(&library);
    let (a, b) = (&shapes[0].name, &shapes[3].name);
    let label = labels_by_area(&library, a)[0];
    let pair = [
        with_label(&library, a, label).remove(0),
        with_label(&library, b, label).remove(0),
    ];
    let faces = pair.each_ref().map(|p| polygons(&library, p));
    let labels = |library: &Library| {
        [
            label_of(library, a, &faces[0]),
            label_of(library, b, &faces[1]),
        ]
    };
    assert_eq!(labels(&library), [label as i32; 2]);

    let sequence = library.collection(COLLECTION).unwrap().sequence;
    let done = link(&library, LinkKind::Differ, &pair).unwrap();
    assert!(done.changed && done.link.holds && !done.link.overruled);
    assert_eq!((done.n_stale, done.link.by.as_str()), (0, "ada"));
    let [first, second] = labels(&library);
    assert_ne!(first, second);
    let events = library.events_since(COLLECTION, sequence, 1_000).unwrap();
    assert_eq!(
        events[0].kind,
        EventKind::PartsLinked {
            link: done.link.id,
            kind: LinkKind::Differ,
            parts: pair.clone(),
        }
    );

    // The same link again changes nothing, in either order; the opposite one is refused.
    let labelled = all_labels(&library);
    let [x, y] = done.link.parts.clone();
    let stored = links(&library);
    assert_eq!(stored, std::slice::from_ref(&done.link));
    drop(library);
    let library = Library::open(folder.path()).unwrap();
    assert_eq!(all_labels(&library), labelled);
    assert_eq!(links(&library), stored);
    assert_eq!(library.links(COLLECTION, Some(&x.shape)).unwrap(), stored);
    assert_eq!(
        library.links(COLLECTION, Some(&shapes[1].name)).unwrap(),
        []
    );
    assert_eq!((&x.shape, &y.shape), (a, b));

    // Shapes that are added later, and clustered together with these, obey as well.
    stream(&library, more);
    let [first, second] = labels(&library);
    assert_ne!(first, second);
    assert!(links(&library)[0].holds);

    let undone = library.undo(COLLECTION, None).unwrap();
    assert_eq!(undone.change, "differ");
    let [(a, a_part), (b, b_part)] = pair.each_ref().map(|p| (&p.shape, p.part));
    assert_eq!(undone.subject, format!("{a}:{a_part} {b}:{b_part}"));
    propagate(&library);
    let mut restored = all_labels(&library);
    more.iter()
        .for_each(|s| assert!(restored.remove(&s.name).is_some()));
    assert_eq!(restored, before);
    assert_eq!(links(&library), []);
    drop(library);
    let findings = Library::check(folder.path()).unwrap();
    assert!(findings.iter().all(|f| !f.damage), "{findings:?}");
}

#[test]
fn parts_with_different_labels_get_the_same_one_until_the_link_is_removed() {
    let shapes = pliers(53, 5);
    let (_folder, library) = library(3, Up::Unknown);
    stream(&library, &shapes);
    let name = &shapes[1].name;
    let kinds = labels_by_area(&library, name);
    let pair = [
        with_label(&library, name, kinds[0]).remove(0),
        with_label(&library, name, kinds[1]).remove(0),
    ];
    let faces = pair.each_ref().map(|p| polygons(&library, p));
    let done = link(&library, LinkKind::Same, &pair).unwrap();
    let now = faces.each_ref().map(|f| label_of(&library, name, f));
    assert_eq!(now[0], now[1]);
    assert!(links(&library)[0].holds);
    let same = all_labels(&library);

    let removed = library
        .unlink_parts(COLLECTION, done.link.id, None)
        .unwrap();
    assert_eq!(removed.link.parts, pair);
    assert_eq!(links(&library), []);
    let free = faces.each_ref().map(|f| label_of(&library, name, f));
    assert_ne!(free[0], free[1]);
    let gone = library.unlink_parts(COLLECTION, done.link.id, None);
    let gone = Failure::from(&gone.unwrap_err());
    assert_eq!((gone.code, gone.reason), (Code::NotFound, Reason::NoLink));

    // The removal can be undone, and the link has its number again.
    let undone = library.undo(COLLECTION, None).unwrap();
    assert_eq!(undone.change, "unlink");
    assert_eq!(all_labels(&library), same);
    assert_eq!(links(&library)[0].id, done.link.id);
    assert!(links(&library)[0].holds);
}

#[test]
fn a_contradiction_is_refused_with_its_chain() {
    let shapes = pliers(54, 4);
    let (_folder, library) = library(3, Up::Unknown);
    stream(&library, &shapes);
    let label = labels_by_area(&library, &shapes[0].name)[0];
    let of = |shape: usize| with_label(&library, &shapes[shape].name, label).remove(0);
    let (a, b, c) = (of(0), of(1), of(2));
    let text = |p: &PartName| format!("{}:{}", p.shape, p.part);
    let (a_text, b_text, c_text) = (text(&a), text(&b), text(&c));
    // These links hold already, so the parts keep their numbers.
    let first = link(&library, LinkKind::Same, &[a.clone(), b.clone()]).unwrap();
    let second = link(&library, LinkKind::Same, &[b.clone(), c.clone()]).unwrap();
    assert_eq!((first.n_stale, second.n_stale), (0, 0));
    let before = (all_labels(&library), links(&library));
    let refused = link(&library, LinkKind::Differ, &[c.clone(), a.clone()]).unwrap_err();
    assert_eq!(refused.reason, Reason::LinkContradicts);
    assert_eq!(refused.code, Code::FailedPrecondition);
    let (one, two) = (first.link.id, second.link.id);
    let chain = format!(
        "the parts cannot have different labels: {c_text} has the label of {b_text} (link {two}), \
         {b_text} has the label of {a_text} (link {one})"
    );
    assert_eq!(refused.message, chain);
    let itself = link(&library, LinkKind::Same, &[a.clone(), a.clone()]).unwrap_err();
    assert_eq!(itself.code, Code::InvalidArgument);
    let none = link(&library, LinkKind::Same, &[a.clone(), part(&b.shape, 400)]).unwrap_err();
    assert_eq!(none.reason, Reason::PartIndex);
    assert_eq!((all_labels(&library), links(&library)), before);
    let again = link(&library, LinkKind::Same, &[b, a]).unwrap();
    assert!(!again.changed);
    assert_eq!(again.link.id, one);
    assert_eq!(links(&library).len(), 2);
}

#[test]
fn more_parts_cannot_differ_from_each_other_than_there_are_labels() {
    let shapes = pliers(55, 4);
    let (_folder, library) = library(2, Up::Unknown);
    stream(&library, &shapes);
    let [x, y] = labels_by_area(&library, &shapes[0].name)[..] else {
        panic!("two labels");
    };
    let of = |shape: usize, label| with_label(&library, &shapes[shape].name, label).remove(0);
    let (a, b, c) = (of(0, x), of(1, y), of(2, x));
    link(&library, LinkKind::Differ, &[a.clone(), b.clone()]).unwrap();
    link(&library, LinkKind::Differ, &[b, c.clone()]).unwrap();
    let refused = link(&library, LinkKind::Differ, &[a, c]).unwrap_err();
    assert_eq!(refused.reason, Reason::LinkContradicts);
    assert!(
        refused.message.contains("at most 2 labels"),
        "{}",
        refused.message
    );
    // Labels of parts that must differ are not merged.
    let refused = library.merge_labels(COLLECTION, x, y, None).unwrap_err();
    let refused = Failure::from(&refused);
    assert_eq!(refused.reason, Reason::LinkContradicts);
    assert!(refused.message.contains("(link 1)"), "{}", refused.message);
}

#[test]
fn links_decide_by_what_a_person_labelled_and_yield_to_it() {
    let shapes = pliers(56, 6);
    let (_folder, library) = library(3, Up::Unknown);
    stream(&library, &shapes);
    let label = labels_by_area(&library, &shapes[0].name)[0];
    let of = |shape: usize| with_label(&library, &shapes[shape].name, label).remove(0);
    let (a, b, c) = (of(0), of(3), of(4));
    let faces = [&b, &c].map(|p| polygons(&library, p));
    // A person labels one part; a linked one follows, and one that must differ does not.
    let given = |part: u32, label| Correction::Part { part, label };
    let correct = |p: &PartName, label| {
        let done = library.correct(COLLECTION, &p.shape, &given(p.part, label), None);
        done.unwrap();
        propagate(&library);
    };
    link(&library, LinkKind::Same, &[a.clone(), b.clone()]).unwrap();
    correct(&a, 41);
    assert_eq!(label_of(&library, &b.shape, &faces[0]), 41);
    let parts = |shape: &str, label| with_label(&library, shape, label);
    let linked_c = part_of(&library, &c.shape, &faces[1]);
    let done = link(
        &library,
        LinkKind::Differ,
        &[parts(&a.shape, 41).remove(0), linked_c],
    );
    let done = done.unwrap();
    propagate(&library);
    assert_ne!(label_of(&library, &c.shape, &faces[1]), 41);
    assert!(links(&library).iter().all(|l| l.holds && !l.overruled));
    // What a person labels overrules a link, which is then listed as overruled.
    let faces_of_c = faces[1].iter().map(|f| *f as u32).collect();
    let overruling = Correction::Faces {
        faces: faces_of_c,
        label: 41,
    };
    library
        .correct(COLLECTION, &c.shape, &overruling, None)
        .unwrap();
    propagate(&library);
    assert_eq!(label_of(&library, &c.shape, &faces[1]), 41);
    let state: Vec<(u64, bool)> = links(&library)
        .iter()
        .map(|l| (l.id, l.overruled))
        .collect();
    assert_eq!(state, [(done.link.id - 1, false), (done.link.id, true)]);
    // And a link that labels of persons contradict is refused.
    library
        .unlink_parts(COLLECTION, done.link.id, None)
        .unwrap();
    propagate(&library);
    let pair = [
        parts(&a.shape, 41).remove(0),
        part_of(&library, &c.shape, &faces[1]),
    ];
    let refused = link(&library, LinkKind::Differ, &pair).unwrap_err();
    assert_eq!(refused.reason, Reason::LinkContradicts);
    assert!(
        refused.message.contains("a person gave"),
        "{}",
        refused.message
    );
}

/// The part with most of some polygons.
fn part_of(library: &Library, shape: &str, faces: &[usize]) -> PartName {
    let label = label_of(library, shape, faces) as u32;
    let candidates = with_label(library, shape, label);
    let common = |p: &PartName| {
        let of_part = polygons(library, p);
        of_part.iter().filter(|f| faces.contains(f)).count()
    };
    candidates.into_iter().max_by_key(common).unwrap()
}

#[test]
fn the_same_shapes_and_links_give_the_same_labels_in_any_order() {
    let shapes = pliers(57, 5);
    let orders = [[0, 1, 2, 3, 4], [4, 2, 0, 3, 1], [1, 4, 3, 0, 2]];
    let names = [0, 3].map(|i: usize| shapes[i].name.clone());
    let mut faces: Option<[Vec<usize>; 2]> = None;
    let mut found = Vec::new();
    for order in orders {
        let (_folder, library) = library(3, Up::Unknown);
        let shapes: Vec<Labelled> = order.iter().map(|i| shapes[*i].clone()).collect();
        stream(&library, &shapes);
        let faces = faces.get_or_insert_with(|| {
            let label = labels_by_area(&library, &names[0])[0];
            let of = |name: &String| with_label(&library, name, label).remove(0);
            names.each_ref().map(of).map(|p| polygons(&library, &p))
        });
        let pair = [0, 1].map(|i| part_of(&library, &names[i], &faces[i]));
        link(&library, LinkKind::Differ, &pair).unwrap();
        let now = [0, 1].map(|i| label_of(&library, &names[i], &faces[i]));
        assert_ne!(now[0], now[1]);
        // Ids depend on the order, so they are renamed by their first appearance.
        let mut renamed = BTreeMap::new();
        let of_face: Vec<usize> = all_labels(&library)
            .values()
            .flatten()
            .map(|l| {
                let n = renamed.len();
                *renamed.entry(*l).or_insert(n)
            })
            .collect();
        found.push(of_face);
    }
    assert_eq!(found[0], found[1]);
    assert_eq!(found[0], found[2]);
}

#[test]
fn links_of_a_removed_shape_go_with_it() {
    let shapes = pliers(58, 4);
    let (_folder, library) = library(3, Up::Unknown);
    stream(&library, &shapes);
    let label = labels_by_area(&library, &shapes[0].name)[0];
    let of = |shape: usize| with_label(&library, &shapes[shape].name, label).remove(0);
    let linked = link(&library, LinkKind::Same, &[of(0), of(1)]).unwrap();
    library
        .unlink_parts(COLLECTION, linked.link.id, None)
        .unwrap();
    library.remove(COLLECTION, &shapes[1].name, None).unwrap();
    // The removed link cannot come back without its shape.
    library.undo(COLLECTION, None).unwrap();
    assert_eq!(links(&library), []);
    library.undo(COLLECTION, None).unwrap();
    assert_eq!(links(&library), []);
    let answer = Answer::Skip;
    let part = (shapes[0].name.as_str(), 0);
    let passed = library.answer(COLLECTION, part, &answer, "", None);
    assert!(passed.is_ok(), "the collection goes on");
}
