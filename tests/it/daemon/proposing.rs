//! Tests proposals over the real socket and the command line: they are made in the background, one
//! is chosen, that is undone, and all of it outlives the daemon.

use super::{events_since, wait_idle};
use crate::harness::{DEADLINE, Home, add, json, refusal, skittle, stdout};
use coseg::call;
use coseg::ipc::client::Client;
use coseg::ipc::frames::FrameReader;
use coseg::ipc::wire::{self, ErrorCode, ErrorReason, event::Kind, request::Body};
use coseg::mesh::write::off;
use coseg::synth::{Family, Options, family};
use rustix::process::Signal;
use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

const FEW_FACES: Options = Options {
    n_faces: 1_000,
    rotate: false,
};

/// Off files of chairs, by name.
fn chairs(n: u32) -> Vec<(String, String)> {
    let chairs = family(Family::Chair, 31, n, &FEW_FACES).into_iter();
    chairs.map(|c| (c.name, off(&c.mesh))).collect()
}

fn add_chairs(client: &mut Client, chairs: &[(String, String)]) {
    for (name, text) in chairs {
        add(client, "c", &[(name.as_str(), text.as_str())]);
    }
    wait_idle(client, "c");
}

fn list(client: &mut Client) -> wire::ListProposalsReply {
    let collection = "c".to_owned();
    call!(
        client,
        ListProposals(wire::ListProposalsRequest { collection })
    )
    .unwrap()
}

/// The proposals once `until` holds for them.
fn list_until(
    client: &mut Client,
    until: impl Fn(&wire::ListProposalsReply) -> bool,
) -> wire::ListProposalsReply {
    let begin = Instant::now();
    loop {
        let found = list(client);
        if until(&found) {
            return found;
        }
        assert!(begin.elapsed() < 4 * DEADLINE, "{found:?}");
        std::thread::sleep(Duration::from_millis(50));
    }
}

fn made(client: &mut Client) -> wire::ListProposalsReply {
    list_until(client, |found| found.n_steps == 0)
}

fn choose(client: &mut Client, n: u32, set: &str) -> wire::ChooseProposalReply {
    let (collection, set) = ("c".to_owned(), set.to_owned());
    let request = wire::ChooseProposalRequest { collection, n, set };
    let chosen = call!(client, ChooseProposal(request)).unwrap();
    wait_idle(client, "c");
    chosen
}

fn labels(client: &mut Client, shapes: &[(String, String)]) -> BTreeMap<String, Vec<i32>> {
    let of = |(name, _): &(String, String)| {
        let request = wire::GetLabelsRequest {
            collection: "c".to_owned(),
            shape: name.clone(),
            version: 0,
            confidence: false,
        };
        let (reply, frames) = call!(client, GetLabels(request), frames).unwrap();
        let read = FrameReader::new(&frames).i32_array(reply.labels.as_ref(), "labels");
        (name.clone(), read.unwrap().0)
    };
    shapes.iter().map(of).collect()
}

/// The classes of a proposal, by shape.
fn classes(client: &mut Client, n: u32) -> BTreeMap<String, Vec<i32>> {
    let collection = "c".to_owned();
    let request = wire::GetProposalRequest { collection, n };
    let (reply, frames) = call!(client, GetProposal(request), frames).unwrap();
    let reader = FrameReader::new(&frames);
    let of = |s: wire::ProposedLabels| {
        let read = reader.i32_array(s.labels.as_ref(), "labels").unwrap().0;
        (s.shape, read)
    };
    reply.shapes.into_iter().map(of).collect()
}

fn portraits(names: &[&str], proposal: u32) -> wire::GetPortraitsRequest {
    wire::GetPortraitsRequest {
        collection: "c".to_owned(),
        shapes: names.iter().map(|n| (*n).to_owned()).collect(),
        detail: wire::PortraitDetail::Proxy.into(),
        proposal,
    }
}

/// Portraits have the classes of a proposal, of each of its shapes alone.
fn are_drawn(client: &mut Client, found: &wire::ListProposalsReply) {
    let name = found.shapes[2].as_str();
    for p in &found.proposals {
        let request = portraits(&[name], p.n);
        let (reply, frames) = call!(client, GetPortraits(request), frames).unwrap();
        let reader = FrameReader::new(&frames);
        let pack = reader.file(reply.pack.as_ref(), "pack").unwrap();
        let n = u32::from_le_bytes(pack[..4].try_into().unwrap()) as usize;
        let header: serde_json::Value = serde_json::from_slice(&pack[4..4 + n]).unwrap();
        let shape = &header["shapes"][0];
        assert_eq!(shape["name"], name);
        let palette: Vec<i64> = shape["palette"]
            .as_array()
            .unwrap()
            .iter()
            .map(|label| label.as_i64().unwrap())
            .collect();
        let of_polygons: BTreeSet<i64> = classes(client, p.n)[name]
            .iter()
            .map(|l| (*l).into())
            .collect();
        assert_eq!(palette, of_polygons.into_iter().collect::<Vec<_>>());
    }
    let last = found.proposals.len() as u32;
    let unknown = refusal(client, Body::GetPortraits(portraits(&["nobody"], 1)));
    assert_eq!(unknown.0, ErrorCode::NotFound);
    let beyond = refusal(client, Body::GetPortraits(portraits(&[name], last + 1)));
    let range = (ErrorCode::InvalidArgument, ErrorReason::FieldRange);
    assert_eq!(beyond, range);
    let mut functions = portraits(&[name], 1);
    functions.detail = wire::PortraitDetail::Functions.into();
    assert_eq!(refusal(client, Body::GetPortraits(functions)), range);
}

fn refused(client: &mut Client, n: u32, set: &str) -> (ErrorCode, ErrorReason) {
    let (collection, set) = ("c".to_owned(), set.to_owned());
    let request = wire::ChooseProposalRequest { collection, n, set };
    refusal(client, Body::ChooseProposal(request))
}

/// The proposal that differs most from the labels in force.
fn other(found: &wire::ListProposalsReply) -> &wire::Proposal {
    let all = found.proposals.iter();
    all.max_by(|a, b| a.differs.total_cmp(&b.differs)).unwrap()
}

#[test]
fn a_proposal_is_chosen_undone_and_still_there_after_a_kill() {
    let home = Home::new();
    let daemon = home.start();
    let client = &mut daemon.client();
    let chairs = chairs(5);
    add_chairs(client, &chairs);
    let before = labels(client, &chairs);
    let found = made(client);
    assert_eq!(found.n_shapes, 5);
    assert!((4..=8).contains(&found.proposals.len()), "{found:?}");
    let numbers: Vec<u32> = found.proposals.iter().map(|p| p.n).collect();
    assert_eq!(numbers, (1..=numbers.len() as u32).collect::<Vec<_>>());
    assert!(found.proposals.is_sorted_by_key(|p| p.n_labels));
    assert!(
        found
            .proposals
            .iter()
            .all(|p| (2..=12).contains(&p.n_labels))
    );
    assert!(found.proposals.iter().filter(|p| p.in_force).count() <= 1);
    let all: Vec<_> = numbers.iter().map(|n| classes(client, *n)).collect();
    let distinct: BTreeSet<_> = all.iter().collect();
    assert_eq!(distinct.len(), all.len());
    let names: Vec<&String> = chairs.iter().map(|(name, _)| name).collect();
    assert_eq!(found.shapes.iter().collect::<Vec<_>>(), names);
    are_drawn(client, &found);

    let chosen = *other(&found);
    assert!(chosen.differs > 0.05 && !chosen.in_force, "{chosen:?}");
    let done = choose(client, chosen.n, &found.set);
    assert_eq!(done.n_labels, chosen.n_labels);
    let after = labels(client, &chairs);
    assert!(after != before, "no label changed");
    // Classes and labels are the same up to names.
    let proposed = classes(client, chosen.n);
    let mut pairs = BTreeSet::new();
    for (shape, classes) in &proposed {
        pairs.extend(classes.iter().zip(&after[shape]));
    }
    let n_classes = pairs.iter().map(|p| p.0).collect::<BTreeSet<_>>().len();
    assert_eq!(
        (n_classes, pairs.len()),
        (chosen.n_labels as usize, n_classes)
    );
    let now = made(client);
    assert_eq!(now.set, found.set);
    let in_force: Vec<u32> = now
        .proposals
        .iter()
        .filter(|p| p.in_force)
        .map(|p| p.n)
        .collect();
    assert_eq!(in_force, [chosen.n]);
    let events = events_since(client, "c");
    let said = events.iter().filter_map(|e| match &e.kind {
        Some(Kind::Chosen(c)) => Some((c.proposal, c.n_labels)),
        _ => None,
    });
    assert_eq!(said.collect::<Vec<_>>(), [(chosen.n, chosen.n_labels)]);

    let undone = json(&home.coseg(&["undo", "c", "--json"]), 0);
    assert_eq!(undone["undone"], "choose");
    assert_eq!(undone["subject"], chosen.n.to_string());
    assert!(labels(client, &chairs) == before, "labels are not restored");

    // New labels have ids that were never used.
    choose(client, chosen.n, "");
    let after = labels(client, &chairs);
    daemon.signal(Signal::KILL);
    daemon.ended();
    let again = home.start();
    let client = &mut again.client();
    let kept = list(client);
    assert_eq!((kept.n_steps, &kept.set), (0, &found.set));
    assert_eq!(kept.proposals, now.proposals);
    assert!(
        labels(client, &chairs) == after,
        "labels did not outlive the kill"
    );
}

#[test]
fn added_shapes_get_new_proposals_and_do_not_overrule_the_choice() {
    let home = Home::new();
    let daemon = home.start();
    let client = &mut daemon.client();
    let chairs = chairs(8);
    add_chairs(client, &chairs[..5]);
    let found = made(client);
    let chosen = *other(&found);
    choose(client, chosen.n, &found.set);
    let sequence = events_since(client, "c").last().unwrap().sequence;
    add_chairs(client, &chairs[5..]);
    let events = events_since(client, "c");
    let new = events.iter().filter(|e| e.sequence > sequence);
    assert!(
        new.clone()
            .any(|e| matches!(e.kind, Some(Kind::ShapeAdded(_))))
    );
    for event in new {
        let overruled = matches!(
            event.kind,
            Some(Kind::Reclustered(_) | Kind::LabelMerged(_) | Kind::LabelSplit(_))
        );
        assert!(!overruled, "{event:?}");
    }
    let used: BTreeSet<i32> = labels(client, &chairs).into_values().flatten().collect();
    assert!(used.len() <= chosen.n_labels as usize, "{used:?}");
    let offered = made(client);
    assert_ne!(offered.set, found.set);
    assert_eq!(
        offered.n_shapes, 7,
        "at 7 shapes the collection would be clustered again"
    );
    let seven: Vec<&String> = chairs[..7].iter().map(|(name, _)| name).collect();
    assert_eq!(offered.shapes.iter().collect::<Vec<_>>(), seven);
    assert_eq!(
        refusal(client, Body::GetPortraits(portraits(&[&chairs[7].0], 1))),
        (ErrorCode::InvalidArgument, ErrorReason::FieldRange)
    );
    assert_eq!(
        refused(client, 1, &found.set),
        (ErrorCode::FailedPrecondition, ErrorReason::ProposalsChanged)
    );
    assert_eq!(
        choose(client, 1, &offered.set).n_labels,
        offered.proposals[0].n_labels
    );
}

#[test]
fn proposals_are_refused_where_they_mean_nothing() {
    let home = Home::new();
    let daemon = home.start();
    let client = &mut daemon.client();
    add(client, "c", &[("a", &skittle(0)), ("b", &skittle(1))]);
    wait_idle(client, "c");
    let few = home.coseg(&["proposals", "c"]);
    let text = String::from_utf8_lossy(&few.stderr).into_owned();
    assert_eq!(few.status.code(), Some(1));
    assert!(
        text.contains("proposals are made from 3 shapes on"),
        "{text}"
    );
    let precondition = ErrorCode::FailedPrecondition;
    assert_eq!(
        refused(client, 1, ""),
        (precondition, ErrorReason::NoProposals)
    );
    add(client, "c", &[("d", &skittle(2)), ("e", &skittle(3))]);
    wait_idle(client, "c");
    let found = made(client);
    let beyond = found.proposals.len() as u32 + 1;
    let range = (ErrorCode::InvalidArgument, ErrorReason::FieldRange);
    assert_eq!(refused(client, beyond, ""), range);
    assert_eq!(refused(client, 0, ""), range);
    assert_eq!(
        refused(client, 1, "another"),
        (precondition, ErrorReason::ProposalsChanged)
    );
    stdout(
        &home.coseg(&[
            "correct",
            "a",
            "--part",
            "0",
            "--label",
            "7",
            "--collection",
            "c",
        ]),
        0,
    );
    assert_eq!(
        refused(client, 1, ""),
        (precondition, ErrorReason::LabelledByPerson)
    );
    // Those that were made stay listed, and can be chosen again once the correction is undone.
    assert_eq!(list(client).proposals.len(), found.proposals.len());
    stdout(&home.coseg(&["undo", "c"]), 0);
    assert_eq!(
        choose(client, 1, &found.set).n_labels,
        found.proposals[0].n_labels
    );
}

#[test]
fn a_killed_daemon_resumes_at_the_step_it_was_at() {
    let chairs = chairs(4);
    let made_in = |kill: bool| {
        let home = Home::new();
        let mut daemon = home.start();
        add_chairs(&mut daemon.client(), &chairs);
        if kill {
            let at_work = list_until(&mut daemon.client(), |found| found.n_done >= 2);
            daemon.signal(Signal::KILL);
            daemon.ended();
            daemon = home.start();
            let resumed = list(&mut daemon.client());
            assert!(
                resumed.n_done >= at_work.n_done || resumed.n_steps == 0,
                "{resumed:?}"
            );
        }
        let client = &mut daemon.client();
        let found = made(client);
        let all = found.proposals.iter().map(|p| classes(client, p.n));
        let all: Vec<_> = all.collect();
        (found.proposals, all)
    };
    let ((proposals, labels), (others, other_labels)) = (made_in(true), made_in(false));
    assert_eq!(proposals, others);
    assert!(labels == other_labels, "labels depend on the kill");
}

#[test]
fn the_command_line_lists_draws_and_chooses() {
    let home = Home::new();
    let daemon = home.start();
    add_chairs(&mut daemon.client(), &chairs(4));
    let folder = home.path("sheets");
    let args = [
        "proposals",
        "c",
        "--png",
        folder.to_str().unwrap(),
        "--json",
    ];
    let found = json(&home.coseg(&args), 0);
    let proposals = found["proposals"].as_array().unwrap();
    assert!(proposals.len() >= 4, "{found}");
    for p in proposals {
        let png = std::fs::read(p["png"].as_str().unwrap()).unwrap();
        let mut reader = png::Decoder::new(std::io::Cursor::new(png))
            .read_info()
            .unwrap();
        let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
        reader.next_frame(&mut pixels).unwrap();
        // The legend begins with the colour of the first class, which shapes have as well.
        let is_orange = |c: &&[u8]| c[0] > c[1] && c[1] > c[2] && c[0] - c[2] > 60;
        let n_orange = pixels.chunks(3).filter(is_orange).count();
        assert!(n_orange > 500, "{n_orange} of {} pixels", pixels.len() / 3);
        assert!(p["value"].is_f64() && p["in_force"].is_boolean() && p["differs"].is_f64());
    }
    let (first, last) = (&proposals[0], proposals.len());
    let chosen = json(&home.coseg(&["choose", "c", "1", "--json"]), 0);
    assert_eq!(chosen["n_labels"], first["n_labels"]);
    let text = stdout(&home.coseg(&["proposals", "c"]), 0);
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!(lines.len(), last);
    assert!(lines[0].ends_with("in force"), "{text}");
    let beyond = home.coseg(&["choose", "c", "99"]);
    assert_eq!(beyond.status.code(), Some(1));
    let text = String::from_utf8_lossy(&beyond.stderr).into_owned();
    assert!(
        text.contains(&format!(
            "proposal 99 is named, but collection \"c\" has {last}"
        )),
        "{text}"
    );
}
