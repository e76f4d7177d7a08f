//! Provides the functions that commands share: selecting the collection, waiting, printing.

use super::{CommandError, interrupt};
use crate::cli::{Global, InCollection, OneCollection};
use coseg::call;
use coseg::ipc::client::{Client, ClientError};
use coseg::ipc::endpoint::Endpoint;
use coseg::ipc::keys::{ClientKeys, KeyPair, read_public};
use coseg::ipc::wire::{self, ErrorReason};
use coseg::library::likely::{did_you_mean, likeliest};
use coseg::library::shown;
use coseg::text::{Pace, counted};
use indicatif::{ProgressBar, ProgressStyle};
use serde_json::Value;
use std::io::IsTerminal as _;
use std::time::{Duration, Instant};

/// Longest single wait in the daemon, so that an answer arrives well within the timeout.
const LONGEST_WAIT: Duration = Duration::from_secs(1);

/// A connection to the daemon, and the form of output.
pub(crate) struct Session {
    pub(crate) client: Client,
    pub(crate) json: bool,
}

impl Session {
    /// Opens a connection to the named endpoint, or to the default one.
    pub(crate) fn open(global: &Global) -> Result<Self, CommandError> {
        let uri = match &global.endpoint {
            Some(uri) => uri.clone(),
            None => Endpoint::default_for_client()?.to_string(),
        };
        let keys = match (&global.server_key, &global.client_key) {
            (Some(server), Some(own)) => Some(ClientKeys {
                server: read_public(server)?,
                own: KeyPair::read(own)?,
            }),
            (None, None) => None,
            _ => {
                return Err(CommandError::Usage(
                    "a client needs both keys: --server-key and --client-key".to_owned(),
                ));
            }
        };
        let client = Client::connect_with(&uri, global.timeout, keys)?;
        Ok(Self {
            client,
            json: global.json,
        })
    }

    /// Milliseconds that the daemon may wait before it answers that nothing has changed.
    pub(crate) fn wait_ms(&self) -> u64 {
        let wait = (self.client.timeout() / 4).min(LONGEST_WAIT);
        u64::try_from(wait.as_millis()).unwrap_or(u64::MAX)
    }

    /// Returns a job once it has changed after `revision`, or after some time; `revision` becomes
    /// that of the answer.
    pub(crate) fn watch_job(
        &mut self,
        job_id: u64,
        revision: &mut u64,
    ) -> Result<wire::Job, CommandError> {
        let request = wire::WatchJobRequest {
            job_id,
            revision: *revision,
            wait_ms: self.wait_ms(),
        };
        let job = call!(self.client, WatchJob(request))?
            .job
            .unwrap_or_default();
        *revision = job.revision;
        Ok(job)
    }

    /// The named collection, or the only one that exists.
    pub(crate) fn collection(&mut self, within: &InCollection) -> Result<String, CommandError> {
        if let Some(name) = &within.collection {
            return Ok(name.clone());
        }
        let mut names = self.collection_names()?;
        match (names.pop(), names.is_empty()) {
            (Some(only), true) => Ok(only),
            (None, _) => Err(CommandError::Failed(
                "there is no collection yet".to_owned(),
            )),
            (Some(last), false) => {
                names.push(last);
                Err(ambiguous(&names))
            }
        }
    }

    /// Explains a failure to find `shape` by the collection of that name, if there is one: people
    /// type a collection where a shape is expected.
    pub(crate) fn explain_shape(&mut self, error: CommandError, shape: &str) -> CommandError {
        let is_missing = match &error {
            CommandError::Client(ClientError::Refused(e)) => e.reason() == ErrorReason::NoShape,
            CommandError::Ambiguous(_) => true,
            _ => false,
        };
        if !is_missing {
            return error;
        }
        match self.collection_names() {
            Ok(names) if names.iter().any(|name| name == shape) => CommandError::Usage(format!(
                "{shape:?} is a collection, but a shape is expected here; `coseg show --collection \
                 {shape}` shows the collection, `coseg ls {shape}` lists its shapes"
            )),
            _ => error,
        }
    }

    /// Names of all collections.
    pub(crate) fn collection_names(&mut self) -> Result<Vec<String>, CommandError> {
        let reply = call!(
            self.client,
            ListCollections(wire::ListCollectionsRequest {})
        )?;
        Ok(reply
            .collections
            .into_iter()
            .filter_map(|c| c.spec)
            .map(|s| s.name)
            .collect())
    }

    /// The id of a label on the command line: an id, or the name of a label in use.
    pub(crate) fn label(&mut self, collection: &str, typed: &str) -> Result<u32, CommandError> {
        if !typed.is_empty() && typed.bytes().all(|b| b.is_ascii_digit()) {
            let id = typed.parse();
            return id.map_err(|_| {
                CommandError::Usage(format!(
                    "{typed} is not a label id, which is at most {}",
                    u32::MAX
                ))
            });
        }
        let labels = self.describe(collection)?.labels;
        label_named(typed, &labels).map_err(CommandError::Failed)
    }

    /// One collection.
    pub(crate) fn describe(&mut self, name: &str) -> Result<wire::Collection, CommandError> {
        let request = wire::DescribeCollectionRequest {
            collection: name.to_owned(),
        };
        let reply = call!(self.client, DescribeCollection(request))?;
        Ok(reply.collection.unwrap_or_default())
    }

    /// All shapes of a collection, or those that have `label`.
    pub(crate) fn shapes(
        &mut self,
        collection: &str,
        label: Option<u32>,
    ) -> Result<Vec<wire::Shape>, CommandError> {
        self.shapes_reviewed(collection, label, wire::ReviewState::Unspecified)
    }

    /// As [`Session::shapes`], with this verdict if one is specified.
    pub(crate) fn shapes_reviewed(
        &mut self,
        collection: &str,
        label: Option<u32>,
        review: wire::ReviewState,
    ) -> Result<Vec<wire::Shape>, CommandError> {
        let mut shapes = Vec::new();
        let mut page_token = String::new();
        loop {
            let collection = collection.to_owned();
            let request = wire::ListShapesRequest {
                collection,
                page_size: 0,
                page_token,
                label,
                review: review.into(),
            };
            let reply = call!(self.client, ListShapes(request))?;
            shapes.extend(reply.shapes);
            page_token = reply.next_page_token;
            if page_token.is_empty() {
                return Ok(shapes);
            }
        }
    }

    /// The named collection, or the only one; waits until it is idle unless `no_wait`.
    pub(crate) fn settled_collection(
        &mut self,
        of: &OneCollection,
        no_wait: bool,
    ) -> Result<String, CommandError> {
        let collection = self.collection(&of.within())?;
        if !no_wait {
            self.wait_until_idle(&collection)?;
        }
        Ok(collection)
    }

    /// Waits until the collection has no work left, as long as the daemon answers.
    pub(crate) fn wait_until_idle(&mut self, collection: &str) -> Result<(), CommandError> {
        let mut bar = None;
        let (begin, mut pace) = (Instant::now(), Pace::default());
        loop {
            let request = wire::WaitIdleRequest {
                collection: collection.to_owned(),
                wait_ms: self.wait_ms(),
            };
            let reply = call!(self.client, WaitIdle(request))?;
            if reply.idle {
                interrupt::clear_note();
                return Ok(());
            }
            let bar = bar.get_or_insert_with(|| {
                interrupt::set_note(format!(
                    "coseg: interrupted; the daemon continues with the queue of {collection:?}\n  \
                     to follow: coseg wait -c {collection:?}\n  to cancel: coseg cancel -c \
                     {collection:?}"
                ));
                spinner("waiting")
            });
            let left = pace.left(reply.n_stale, begin.elapsed());
            let left = left.map(|left| format!(", about {} s left", left.as_secs() + 1));
            bar.set_message(format!(
                "{} to place, {} to relabel{}",
                counted(reply.n_queued, "shape"),
                reply.n_stale,
                left.filter(|_| reply.n_queued == 0).unwrap_or_default()
            ));
            bar.tick();
        }
    }

    /// Prints a line of data for people.
    pub(crate) fn line(&self, text: &str) -> Result<(), CommandError> {
        print_line(&shown(text))
    }

    /// Prints JSON, the only output on stdout.
    pub(crate) fn print_json(&self, value: &Value) -> Result<(), CommandError> {
        print_line(&value.to_string())
    }
}

/// Prints a line of data to stdout.
pub(crate) fn print_line(text: &str) -> Result<(), CommandError> {
    coseg::text::print_line(text).map_err(CommandError::Output)
}

/// The label with this name; a label that was merged into another is out of use.
fn label_named(name: &str, labels: &[wire::LabelInfo]) -> Result<u32, String> {
    let in_use = || labels.iter().filter(|l| l.merged_into.is_none());
    let has_it = |l: &&wire::LabelInfo| !name.is_empty() && l.name == name;
    let ids: Vec<u32> = in_use().filter(has_it).map(|l| l.id).collect();
    match ids[..] {
        [id] => Ok(id),
        [] => {
            let names = in_use().map(|l| l.name.as_str()).filter(|n| !n.is_empty());
            let meant = did_you_mean(likeliest(name, names));
            Err(format!("no label is named {name:?}{meant}"))
        }
        _ => {
            let ids: Vec<String> = ids.iter().map(u32::to_string).collect();
            Err(format!(
                "{} labels are named {name:?}, choose one by its id: {}",
                ids.len(),
                ids.join(", ")
            ))
        }
    }
}

/// The error if several collections are possible.
pub(crate) fn ambiguous(names: &[String]) -> CommandError {
    let names = names.join(", ");
    CommandError::Ambiguous(shown(&names).into_owned())
}

/// A progress bar on stderr if stderr is a terminal, else one that draws nothing.
pub(crate) fn bar(length: u64) -> ProgressBar {
    if !std::io::stderr().is_terminal() {
        return ProgressBar::hidden();
    }
    let style = ProgressStyle::with_template("{bar:30} {pos}/{len} {elapsed} {wide_msg}")
        .expect("invariant: the template is valid");
    ProgressBar::new(length).with_style(style)
}

fn spinner(message: &'static str) -> ProgressBar {
    if !std::io::stderr().is_terminal() {
        return ProgressBar::hidden();
    }
    ProgressBar::new_spinner().with_message(message)
}

#[cfg(test)]
mod tests {
    use super::label_named;
    use coseg::ipc::wire::LabelInfo;

    #[test]
    fn labels_are_found_by_name_if_one_has_it() {
        let label = |id, name: &str, merged_into| LabelInfo {
            id,
            name: name.to_owned(),
            merged_into,
            ..LabelInfo::default()
        };
        let labels = [
            label(0, "seat", None),
            label(1, "leg", None),
            label(2, "leg", Some(1)),
            label(3, "back", None),
            label(4, "back", None),
            label(5, "", None),
        ];
        assert_eq!(label_named("leg", &labels), Ok(1));
        for (name, expected) in [
            (
                "back",
                "2 labels are named \"back\", choose one by its id: 3, 4",
            ),
            ("seta", "no label is named \"seta\"; did you mean \"seat\"?"),
            ("wing", "no label is named \"wing\""),
        ] {
            assert_eq!(label_named(name, &labels), Err(expected.to_owned()));
        }
        assert!(label_named("", &labels).is_err());
    }
}
