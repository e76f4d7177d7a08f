//! `coseg suggest` names the shape that is most worth labelling by hand.

use super::Outcome;
use super::session::Session;
use crate::cli::Suggest;
use coseg::call;
use coseg::ipc::wire;
use serde_json::json;

pub(crate) fn run(args: &Suggest, mut session: Session) -> Outcome {
    let collection = session.collection(&args.of.within())?;
    if !args.no_wait {
        session.wait_until_idle(&collection)?;
    }
    let request = wire::SuggestNextRequest { collection };
    let found = call!(session.client, SuggestNext(request))?;
    if session.json {
        session.print_json(&json!({
            "shape": found.shape,
            "gain": found.gain,
            "uncertainty": found.uncertainty,
            "n_nearest": found.n_nearest,
            "n_corrected": found.n_corrected,
            "reason": found.reason,
        }))?;
    } else {
        session.line(&found.shape)?;
        eprintln!("{}", found.reason);
    }
    Ok(true)
}
