//! Requests in flight: each is answered once, when its work is done, its deadline passes, or its
//! client's key is revoked, whichever comes first.

use crate::daemon::answer::{Answer, ReplyTo, not_allowed};
use crate::daemon::fair::{Client, Pass};
use crate::daemon::incoming::Incoming;
use crate::daemon::shared::{Control, Daemon};
use crate::daemon::waits::wait_placed;
use crate::daemon::writes::Done;
use crate::ipc::convert;
use crate::ipc::keys::AllowList;
use crate::ipc::wire::{self, ErrorCode, ErrorReason, Reply, error::Subject, reply};
use std::sync::Arc;
use std::time::Instant;
use tokio::sync::OwnedSemaphorePermit;

/// A request in flight.
pub(crate) struct InFlight {
    pub(crate) incoming: Incoming,
    /// Bounds how many there are.
    permit: OwnedSemaphorePermit,
}

/// Why a request is answered before its work is done.
pub(crate) enum Interruption {
    DeadlinePassed,
    KeyRevoked,
}

/// The effect of an interrupted request.
pub(crate) enum Effect {
    /// It reads only.
    Nothing,
    /// Its change was not begun, and will not be.
    NotBegun,
    /// Its change continues.
    Continues,
    /// It was accepted: this job continues.
    Accepted(u64),
}

impl InFlight {
    pub(crate) fn new(incoming: Incoming, permit: OwnedSemaphorePermit) -> Self {
        Self { incoming, permit }
    }

    /// The client whose turn it takes.
    pub(crate) fn client(&self) -> &Client {
        self.incoming.ticket.client()
    }

    /// Sends the reply and gives back the permit.
    pub(crate) fn finish(self, daemon: &Daemon, answer: Answer) {
        drop(self.incoming.ticket);
        send_answer(
            daemon,
            self.incoming.reply_to,
            self.incoming.request_id,
            answer,
        );
        drop(self.permit);
    }

    /// Answers with the result of `work`, which is dropped if the request is interrupted.
    pub(crate) async fn respond<F: Future<Output = Answer>>(
        self,
        daemon: Arc<Daemon>,
        work: impl FnOnce(Arc<Daemon>) -> F,
    ) {
        let work = work(Arc::clone(&daemon));
        match self.until_interrupted(&daemon, work).await {
            Ok(answer) => self.finish(&daemon, answer),
            Err(why) => self.interrupt(&daemon, why, Effect::Nothing),
        }
    }

    /// Answers a change that has begun, when it is done.
    pub(crate) async fn answer_change(
        mut self,
        daemon: Arc<Daemon>,
        done: impl Future<Output = Result<Done, wire::Error>>,
    ) {
        let done = match self.until_interrupted(&daemon, done).await {
            Ok(done) => done,
            Err(why) => return self.interrupt(&daemon, why, Effect::Continues),
        };
        self.incoming.ticket.free_bytes();
        match done {
            Ok(Done::Now(result)) => self.finish(&daemon, Ok((*result, Vec::new()))),
            Ok(Done::ThenDrain(result)) => {
                self.finish(&daemon, Ok((*result, Vec::new())));
                // After the reply, which would else come too late for the sockets. An error means
                // that the main thread is gone: the daemon is ending already.
                let _ = daemon.control.send(Control::Drain);
            }
            Ok(Done::WhenPlaced(job)) => {
                let placed = wait_placed(&daemon, job);
                match self.until_interrupted(&daemon, placed).await {
                    Ok(answer) => self.finish(&daemon, answer),
                    Err(why) => self.interrupt(&daemon, why, Effect::Accepted(job)),
                }
            }
            Err(error) => self.finish(&daemon, Err(error)),
        }
    }

    /// Waits for the turn of the request.
    pub(crate) async fn turn(
        &self,
        daemon: &Daemon,
        turn: impl Future<Output = Pass>,
    ) -> Result<Pass, Interruption> {
        let pass = self.until_interrupted(daemon, turn).await?;
        if self
            .incoming
            .deadline()
            .is_some_and(|d| d <= Instant::now())
        {
            return Err(Interruption::DeadlinePassed);
        }
        if self.is_revoked(daemon) {
            return Err(Interruption::KeyRevoked);
        }
        Ok(pass)
    }

    fn is_revoked(&self, daemon: &Daemon) -> bool {
        let (Some(list), Some(key)) = (&daemon.admission.allowed, &self.incoming.user) else {
            return false;
        };
        list.borrow().find(key).is_none()
    }

    /// Completes when the client's key is taken off the list.
    async fn revoked(&self, daemon: &Daemon) {
        let (Some(list), Some(key)) = (&daemon.admission.allowed, &self.incoming.user) else {
            return std::future::pending().await;
        };
        let gone = |list: &Arc<AllowList>| list.find(key).is_none();
        if list.clone().wait_for(gone).await.is_err() {
            // The list went with the sockets: no client is answered any more.
            std::future::pending().await
        }
    }

    /// Completes with `work`, unless the request is interrupted before.
    pub(crate) async fn until_interrupted<T>(
        &self,
        daemon: &Daemon,
        work: impl Future<Output = T>,
    ) -> Result<T, Interruption> {
        let deadline = async {
            match self.incoming.deadline() {
                Some(deadline) => tokio::time::sleep_until(deadline.into()).await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            biased;
            done = work => Ok(done),
            () = deadline => Err(Interruption::DeadlinePassed),
            () = self.revoked(daemon) => Err(Interruption::KeyRevoked),
        }
    }

    /// Answers an interrupted request with what becomes of its change.
    pub(crate) fn interrupt(self, daemon: &Daemon, why: Interruption, effect: Effect) {
        let ms = self.incoming.deadline_ms;
        let has_key = self.incoming.key().is_some();
        let rest = match effect {
            Effect::Nothing => String::new(),
            Effect::NotBegun => "; it was not begun".to_owned(),
            Effect::Accepted(job) => format!("; job {job} goes on"),
            Effect::Continues if has_key => {
                "; the change goes on, and the same request, sent again with \
                its request_id, tells what came of it"
                    .to_owned()
            }
            Effect::Continues => "; the change goes on".to_owned(),
        };
        let mut error = match why {
            Interruption::DeadlinePassed => convert::error(
                ErrorCode::DeadlineExceeded,
                ErrorReason::Deadline,
                format!("no answer within the request's {ms} ms{rest}"),
            ),
            Interruption::KeyRevoked => not_allowed(&rest),
        };
        if let Effect::Accepted(job) = effect {
            error.subject = Some(Subject::JobId(job));
        }
        self.finish(daemon, Err(error));
    }
}

/// Gives an answer to the client or task that waits for it.
pub(crate) fn send_answer(daemon: &Daemon, reply_to: ReplyTo, request_id: String, answer: Answer) {
    if let Err(error) = &answer {
        daemon.telemetry.metrics.refused(error);
        if error.code() == ErrorCode::Internal || error.code() == ErrorCode::DataLoss {
            tracing::error!(request_id, message = error.message, "a request failed");
        }
    }
    let peer = match reply_to {
        ReplyTo::Peer(peer) => peer,
        ReplyTo::Task(task) => {
            // The task may have stopped waiting.
            let _ = task.send(answer);
            return;
        }
    };
    let (result, frames) = answer.unwrap_or_else(|error| (reply::Result::Error(error), Vec::new()));
    daemon.outbox.reply(
        peer,
        Reply {
            request_id,
            result: Some(result),
        },
        frames,
    );
}
