//! `coseg rm` removes shapes from a collection.

use super::confirm::confirmed;
use super::session::Session;
use super::{CommandError, Outcome, json};
use crate::cli::Rm;
use coseg::call;
use coseg::ipc::client::ClientError;
use coseg::ipc::wire;
use coseg::library::shown;
use serde_json::json;

/// Maximum number of shapes that the question names; it counts the others.
const NAMED: usize = 5;

pub(crate) fn run(args: &Rm, mut session: Session) -> Outcome {
    let collection = session.collection(&args.within)?;
    if !confirmed(&question(&args.shapes, &collection), args.yes)? {
        eprintln!("nothing was removed");
        return Ok(false);
    }
    let (mut removed, mut failed) = (Vec::new(), Vec::new());
    for shape in &args.shapes {
        let request = wire::RemoveShapeRequest {
            collection: collection.clone(),
            shape: shape.clone(),
        };
        match call!(session.client, RemoveShape(request)) {
            Ok(_) => {
                if !session.json {
                    eprintln!("{shape}: removed from {collection}");
                }
                removed.push(shape.clone());
            }
            Err(ClientError::Refused(e)) => {
                eprintln!("coseg: {}: {}", shown(shape), e.message);
                failed.push(json!({ "name": shape, "error": json::error(&e) }));
            }
            Err(e) => return Err(CommandError::Client(e)),
        }
    }
    if session.json {
        session.print_json(&json!({ "removed": removed, "failed": failed }))?;
    }
    Ok(failed.is_empty())
}

fn question(shapes: &[String], collection: &str) -> String {
    let mut names = shapes[..shapes.len().min(NAMED)].join(", ");
    if shapes.len() > NAMED {
        names.push_str(&format!(" and {} more", shapes.len() - NAMED));
    }
    format!("Remove {names} from {collection}, with their corrections? It cannot be undone.")
}

#[cfg(test)]
mod tests {
    use super::question;

    #[test]
    fn the_question_names_a_few_shapes_and_counts_the_rest() {
        let names = |n: usize| (1..=n).map(|i| i.to_string()).collect::<Vec<_>>();
        assert!(question(&names(1), "c").starts_with("Remove 1 from c, "));
        assert!(question(&names(5), "c").starts_with("Remove 1, 2, 3, 4, 5 from c, "));
        assert!(question(&names(7), "c").starts_with("Remove 1, 2, 3, 4, 5 and 2 more from c, "));
    }
}
