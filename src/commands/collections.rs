//! `coseg collections` creates, changes and deletes collections.

use super::confirm::confirmed;
use super::session::Session;
use super::{Outcome, json};
use crate::cli::Collections;
use coseg::call;
use coseg::ipc::convert::up_name;
use coseg::ipc::wire;
use coseg::text::counted;
use serde_json::json;

pub(crate) fn run(command: &Collections, mut session: Session) -> Outcome {
    match command {
        Collections::Create { name, settings } => {
            let request = wire::CreateCollectionRequest {
                spec: Some(settings.to_spec(name)),
            };
            let reply = call!(session.client, CreateCollection(request))?;
            if session.json {
                session.print_json(&json::collection(&reply.collection.unwrap_or_default()))?;
            } else {
                eprintln!("{name}: created");
            }
        }
        Collections::Set { name, up, no_wait } => {
            let request = wire::UpdateCollectionRequest {
                collection: name.clone(),
                up: (*up).into(),
            };
            let done = call!(session.client, UpdateCollection(request))?;
            if !no_wait {
                session.wait_until_idle(name)?;
            }
            let described = session.describe(name)?;
            if session.json {
                let mut value = json::collection(&described);
                value["changed"] = done.changed.into();
                session.print_json(&value)?;
            } else {
                let axis = up_name(*up);
                let undo = format!("`coseg undo -c {name}` undoes this");
                eprintln!(
                    "{}",
                    match done.changed {
                        true => format!("{name}: up is {axis} now; {undo}"),
                        false => format!("{name}: up is {axis} already"),
                    }
                );
            }
            warn_of_up(&described);
        }
        Collections::Delete { name, yes } => {
            let about = session.describe(name)?;
            let n_labels = about.labels.iter().filter(|l| l.n_shapes > 0).count();
            let with = format!(
                "{} and {}",
                counted(about.n_shapes, "shape"),
                counted(n_labels as u64, "label")
            );
            let question =
                format!("Delete {name} with its {with}, and all corrections? It cannot be undone.");
            if !confirmed(&question, *yes)? {
                eprintln!("nothing was deleted");
                return Ok(false);
            }
            let request = wire::DeleteCollectionRequest {
                collection: name.clone(),
            };
            call!(session.client, DeleteCollection(request))?;
            if session.json {
                let n_shapes = about.n_shapes;
                session.print_json(&json!({ "deleted": name, "n_shapes": n_shapes }))?;
            } else {
                eprintln!("{name}: deleted, with {with}");
            }
        }
    }
    Ok(true)
}

/// Warns on stderr if shapes seem to stand along another axis than the collection's.
pub(crate) fn warn_of_up(c: &wire::Collection) {
    if let Some(text) = up_warning(c) {
        eprintln!("coseg: warning: {text}");
    }
}

/// The warning if shapes seem to stand along another axis than the given one, with the command that
/// changes it.
pub(crate) fn up_warning(c: &wire::Collection) -> Option<String> {
    let other = c.up_disagrees.as_ref()?;
    let spec = c.spec.as_ref()?;
    let (given, axis) = (up_name(spec.up()), up_name(other.up()));
    let percent = 100.0 * other.agreement;
    let name = &spec.name;
    let word = |c: char| c.is_alphanumeric() || "-_.".contains(c);
    let quoted = match name.chars().all(word) && !name.starts_with('-') {
        true => name.clone(),
        false => format!("'{}'", name.replace('\'', r"'\''")),
    };
    Some(format!(
        "{name} was given up {given}, but {percent:.0} % of its shapes stand along {axis}; if \
         they do, `coseg collections set {quoted} --up {axis}` finds the labels again"
    ))
}

#[cfg(test)]
mod tests {
    use super::up_warning;
    use coseg::ipc::wire;

    #[test]
    fn the_warning_names_both_axes_and_the_command() {
        let mut c = wire::Collection {
            spec: Some(wire::CollectionSpec {
                name: "old chairs".to_owned(),
                up: wire::Up::PlusY.into(),
                ..wire::CollectionSpec::default()
            }),
            ..wire::Collection::default()
        };
        assert_eq!(up_warning(&c), None);
        c.up_disagrees = Some(wire::UpEstimate {
            up: wire::Up::PlusZ.into(),
            agreement: 0.9,
        });
        let text = up_warning(&c).unwrap();
        for part in ["+y", "90 %", "+z", "collections set 'old chairs' --up +z"] {
            assert!(text.contains(part), "{text}");
        }
    }
}
