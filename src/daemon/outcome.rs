//! Reads what a worker reports of placing, relabelling or proposing.

use crate::daemon::failures::failed;
use crate::daemon::shared::Daemon;
use crate::daemon::worker;
use crate::library::{Code, LibraryError, Reason};
use crate::store::StoreError;

/// The outcome that a worker reports. The failure of its disk is the failure of this process's
/// disk.
pub(crate) fn outcome(
    daemon: &Daemon,
    report: &serde_json::Value,
) -> Result<worker::Outcome, LibraryError> {
    match worker::read_report(report) {
        Ok(worker::Report::Outcome(outcome)) => Ok(outcome),
        Ok(worker::Report::NoSpace(path)) => Err(StoreError::NoSpace { path }.into()),
        Ok(worker::Report::ReadOnly(cause)) => {
            Err(daemon.library.store().health().stop(cause).into())
        }
        Err(text) => Ok(worker::Outcome::Failed(failed(
            Code::Internal,
            Reason::WorkerDied,
            text,
        ))),
    }
}
