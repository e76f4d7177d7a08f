//! Chooses each proposal of a streamed category in turn, and scores the labels that follow.

use crate::error::BenchError;
use crate::session::{COLLECTION, Session};
use crate::stream::{Category, labels_now, scored};
use coseg::call;
use coseg::ipc::wire;
use serde_json::{Value, json};
use std::time::{Duration, Instant};

/// How often it is asked whether the proposals are made.
const PACE: Duration = Duration::from_millis(250);
/// Time limit for making them.
const LIMIT: Duration = Duration::from_secs(3_600);

/// A proposal, and the accuracy of the library after it was chosen.
pub(crate) struct Scored {
    n_labels: u32,
    accuracy: f64,
    in_force: bool,
}

/// The proposals of one order of arrival.
pub(crate) struct ProposalScores {
    /// From coarse to fine.
    pub(crate) scored: Vec<Scored>,
    /// Seconds from the end of the stream until they were made.
    seconds: f64,
}

impl ProposalScores {
    /// Accuracy after the best of them was chosen.
    pub(crate) fn best(&self) -> f64 {
        let accuracies = self.scored.iter().map(|s| s.accuracy);
        accuracies.fold(0.0, f64::max)
    }

    pub(crate) fn report(&self) -> Value {
        let of = |s: &Scored| {
            json!({
                "n_labels": s.n_labels,
                "accuracy": s.accuracy,
                "in_force": s.in_force,
            })
        };
        json!({
            "best": self.best(),
            "seconds": self.seconds,
            "proposals": self.scored.iter().map(of).collect::<Vec<_>>(),
        })
    }
}

/// Waits for the proposals, chooses each of the first `most`, scores the library as for the stream,
/// and undoes the choice.
pub(crate) fn proposals(
    category: &Category,
    most: u32,
    session: &mut Session,
) -> Result<ProposalScores, BenchError> {
    session.wait_until_idle()?;
    let begin = Instant::now();
    let collection = || COLLECTION.to_owned();
    let made = loop {
        let collection = collection();
        let request = wire::ListProposalsRequest { collection };
        let found = call!(session.client, ListProposals(request))?;
        if found.n_steps == 0 {
            break found;
        }
        if begin.elapsed() > LIMIT {
            let text = format!("{}: no proposals in {} s", category.name, LIMIT.as_secs());
            return Err(BenchError::Failed(text));
        }
        std::thread::sleep(PACE);
    };
    let seconds = begin.elapsed().as_secs_f64();
    let mut all = Vec::new();
    for proposal in made.proposals.iter().take(most as usize) {
        let choice = wire::ChooseProposalRequest {
            collection: collection(),
            n: proposal.n,
            set: made.set.clone(),
        };
        call!(session.client, ChooseProposal(choice))?;
        let labels = labels_now(category, session)?;
        let score = scored(&category.name, category.shapes.iter(), &labels)?;
        all.push(Scored {
            n_labels: proposal.n_labels,
            accuracy: score.accuracy,
            in_force: proposal.in_force,
        });
        let collection = collection();
        call!(session.client, Undo(wire::UndoRequest { collection }))?;
    }
    Ok(ProposalScores {
        scored: all,
        seconds,
    })
}
