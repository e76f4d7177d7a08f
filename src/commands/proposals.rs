//! `coseg proposals` lists divisions of the shapes of a collection into labels and draws them;
//! `coseg choose` makes one of them the labels.

use super::export::{Original, bad_reply};
use super::render::{Cell, axis, contact_sheet, picture};
use super::session::{Session, bar};
use super::{CommandError, Outcome, json};
use crate::cli::{Choose, Proposals};
use coseg::call;
use coseg::ipc::frames::FrameReader;
use coseg::ipc::wire;
use coseg::library::label_colour;
use coseg::mesh::ParsedMesh;
use coseg::text::counted;
use serde_json::{Value, json};
use std::collections::HashMap;
use std::path::Path;
use std::time::{Duration, Instant};

/// How often it is asked whether the proposals are made.
const PACE: Duration = Duration::from_millis(250);
/// How long a step of making them may take before the command gives up.
const PATIENCE: Duration = Duration::from_secs(300);

pub(crate) fn run(args: &Proposals, mut session: Session) -> Outcome {
    let collection = session.settled_collection(&args.of, args.no_wait)?;
    let found = match args.no_wait {
        true => list(&mut session, &collection)?,
        false => made(&mut session, &collection)?,
    };
    let mut pictures = HashMap::new();
    if let Some(folder) = &args.png {
        pictures = draw(&mut session, &collection, (folder, args.max), &found)?;
    }
    if session.json {
        let of = |p: &wire::Proposal| {
            let mut value = json::proposal(p);
            if let Some(path) = pictures.get(&p.n) {
                value["png"] = path.as_str().into();
            }
            value
        };
        session.print_json(&json!({
            "collection": collection,
            "set": found.set,
            "n_shapes": found.n_shapes,
            "n_steps": found.n_steps,
            "n_done": found.n_done,
            "proposals": found.proposals.iter().map(of).collect::<Vec<Value>>(),
        }))?;
        return Ok(true);
    }
    for p in &found.proposals {
        let labels = counted(p.n_labels.into(), "label");
        let (n, value, differs) = (p.n, p.value, p.differs);
        let in_force = if p.in_force { "  in force" } else { "" };
        session.line(&format!(
            "{n}  {labels:<9}  value {value:5.2}  differs {differs:.2}{in_force}"
        ))?;
    }
    if found.n_steps > 0 {
        let (n_done, n_steps) = (found.n_done, found.n_steps);
        eprintln!("{n_done} of {n_steps} steps of making new proposals are done");
    }
    if !found.proposals.is_empty() {
        let shapes = counted(found.n_shapes, "shape");
        eprintln!("found on {shapes}; `coseg choose {collection} N` makes one of them the labels");
    }
    Ok(true)
}

pub(crate) fn choose(args: &Choose, mut session: Session) -> Outcome {
    let collection = args.collection.clone();
    let request = wire::ChooseProposalRequest {
        collection: collection.clone(),
        n: args.proposal,
        set: String::new(),
    };
    let done = call!(session.client, ChooseProposal(request))?;
    if !args.no_wait {
        session.wait_until_idle(&collection)?;
    }
    if session.json {
        session.print_json(&json!({
            "collection": collection,
            "proposal": args.proposal,
            "n_labels": done.n_labels,
            "n_stale": done.n_stale,
            "sequence": done.sequence,
        }))?;
    } else {
        let labels = counted(done.n_labels.into(), "label");
        eprintln!(
            "{collection} has the {labels} of proposal {} now; `coseg undo {collection}` restores \
             the labels before",
            args.proposal
        );
    }
    Ok(true)
}

fn list(session: &mut Session, collection: &str) -> Result<wire::ListProposalsReply, CommandError> {
    let request = wire::ListProposalsRequest {
        collection: collection.to_owned(),
    };
    Ok(call!(session.client, ListProposals(request))?)
}

/// The proposals for the present labels, once they are made.
fn made(session: &mut Session, collection: &str) -> Result<wire::ListProposalsReply, CommandError> {
    let mut progress = None;
    let (mut n_done, mut since) = (0, Instant::now());
    loop {
        let found = list(session, collection)?;
        if found.n_steps == 0 {
            return Ok(found);
        }
        if found.n_done != n_done {
            (n_done, since) = (found.n_done, Instant::now());
        }
        if since.elapsed() > PATIENCE {
            return Err(CommandError::Failed(format!(
                "{n_done} of {} steps of making proposals are done, and none in the last {} s; \
                 the daemon's log says why, and --no-wait lists the previous proposals",
                found.n_steps,
                PATIENCE.as_secs()
            )));
        }
        let progress = progress.get_or_insert_with(|| bar(found.n_steps.into()));
        progress.set_message("making proposals");
        progress.set_position(found.n_done.into());
        std::thread::sleep(PACE);
    }
}

/// Draws each proposal, with at most so many shapes, to a file in a folder. Returns the files.
fn draw(
    session: &mut Session,
    collection: &str,
    (folder, max): (&Path, Option<usize>),
    found: &wire::ListProposalsReply,
) -> Result<HashMap<u32, String>, CommandError> {
    let failed = |path: &Path, source| CommandError::File {
        path: path.display().to_string(),
        source,
    };
    std::fs::create_dir_all(folder).map_err(|e| failed(folder, e))?;
    let about = session.describe(collection)?;
    let up = about.spec.as_ref().and_then(|s| axis(s.up()));
    let mut meshes: HashMap<String, ParsedMesh> = HashMap::new();
    let mut pictures = HashMap::new();
    let progress = bar(found.proposals.len() as u64);
    for p in &found.proposals {
        let (reply, frames) = {
            let collection = collection.to_owned();
            let request = wire::GetProposalRequest { collection, n: p.n };
            call!(session.client, GetProposal(request), frames)?
        };
        let reader = FrameReader::new(&frames);
        let mut cells = Vec::new();
        for shape in reply.shapes.iter().take(max.unwrap_or(usize::MAX)) {
            let labels = reader.i32_array(shape.labels.as_ref(), "labels");
            let (labels, _) = labels.map_err(|e| bad_reply(e.to_string()))?;
            if !meshes.contains_key(&shape.shape) {
                let original = Original::receive(session, collection, &shape.shape)?;
                let mesh = original.mesh(&shape.shape, labels.len())?;
                meshes.insert(shape.shape.clone(), mesh);
            }
            let colours: Vec<[u8; 3]> = labels.iter().map(|l| label_colour(*l as u32)).collect();
            cells.push(Cell {
                name: shape.shape.clone(),
                picture: picture(&meshes[&shape.shape], &colours, up),
            });
        }
        let classes = 0..p.n_labels;
        let legend: Vec<(String, [u8; 3])> =
            classes.map(|c| (c.to_string(), label_colour(c))).collect();
        let path = folder.join(format!("{}.png", p.n));
        let png = contact_sheet(&legend, &cells).png();
        let written = png.and_then(|png| std::fs::write(&path, png));
        written.map_err(|e| failed(&path, e))?;
        pictures.insert(p.n, path.display().to_string());
        progress.inc(1);
    }
    progress.finish_and_clear();
    Ok(pictures)
}
