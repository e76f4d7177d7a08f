//! Accepts connections, and bounds their number and the time that a peer may keep the daemon
//! waiting.
//!
//! The purpose of a connection is unknown until a request is read, so no place can be reserved for
//! monitoring. Instead, a new connection always gets in: if all places are taken, the connection
//! that has kept the daemon waiting for longest is closed.

use super::connection::{Connection, PEER_TIME};
use super::route::respond;
use super::server::Server;
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use std::collections::HashMap;
use std::convert::Infallible;
use std::io;
use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll, ready};
use std::time::Duration;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Notify;
use tokio::task::AbortHandle;
use tokio::time::Sleep;

/// Connections at a time.
const MAX_CONNECTIONS: usize = 128;
/// Time after which a connection ends, whatever its state.
const CONNECTION_TIME: Duration = Duration::from_secs(900);
/// Bytes of a request's head, and of what is read ahead of it.
const MAX_HEAD: usize = 64 << 10;
/// Bytes of an answer that a peer must take within [`PEER_TIME`].
const PACE: usize = 64 << 10;

struct Place {
    connection: Arc<Connection>,
    task: AbortHandle,
}

#[derive(Default)]
struct Door {
    places: Mutex<HashMap<u64, Place>>,
    /// A connection left, or began to wait.
    changed: Arc<Notify>,
}

impl Door {
    fn places(&self) -> MutexGuard<'_, HashMap<u64, Place>> {
        self.places.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Frees a place if none is free, and returns whether one is.
    fn has_room(&self) -> bool {
        let mut places = self.places();
        if places.len() < MAX_CONNECTIONS {
            return true;
        }
        let waiting = places
            .iter()
            .filter_map(|(&number, place)| Some((place.connection.waiting_since()?, number)));
        let Some((since, number)) = waiting.min() else {
            return false;
        };
        if let Some(place) = places.remove(&number) {
            tracing::debug!(waited = ?since.elapsed(), "a connection makes way for a new one");
            place.task.abort();
        }
        true
    }
}

/// Gives the place of a connection back when it ends, however it does.
struct Leaving {
    door: Arc<Door>,
    number: u64,
}

impl Drop for Leaving {
    fn drop(&mut self) {
        self.door.places().remove(&self.number);
        self.door.changed.notify_one();
    }
}

/// Serves connections until the runtime ends.
pub(super) async fn serve(server: Arc<Server>, listener: TcpListener) {
    let door = Arc::new(Door::default());
    for number in 0_u64.. {
        let stream = match listener.accept().await {
            Ok((stream, _)) => stream,
            Err(e) => {
                // Out of file descriptors, mostly: some come back.
                tracing::warn!(error = %e, "a connection cannot be accepted");
                tokio::time::sleep(Duration::from_millis(200)).await;
                continue;
            }
        };
        while !door.has_room() {
            door.changed.notified().await;
        }
        let connection = Arc::new(Connection::new(Arc::clone(&door.changed)));
        let leaving = Leaving {
            door: Arc::clone(&door),
            number,
        };
        let attended = attend(Arc::clone(&server), stream, Arc::clone(&connection));
        // Within the lock: the task cannot remove its place before it is inserted.
        let mut places = door.places();
        let task = tokio::spawn(async move {
            let _leaving = leaving;
            attended.await;
        });
        let task = task.abort_handle();
        places.insert(number, Place { connection, task });
    }
}

async fn attend(server: Arc<Server>, stream: TcpStream, connection: Arc<Connection>) {
    // Answers are written whole; without it the last piece of each could wait for an
    // acknowledgement.
    let _ = stream.set_nodelay(true);
    let service = service_fn(|request| async {
        connection.works();
        let page = respond(&server, request, &connection).await;
        connection.waits();
        Ok::<_, Infallible>(page)
    });
    let served = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(PEER_TIME)
        .max_buf_size(MAX_HEAD)
        .serve_connection(TokioIo::new(Paced::new(stream)), service);
    match tokio::time::timeout(CONNECTION_TIME, served).await {
        Ok(Ok(())) | Err(_) => {}
        Ok(Err(e)) => tracing::debug!(error = %e, "an HTTP connection ended early"),
    }
}

/// A stream that fails when its peer does not take what is written.
struct Paced {
    stream: TcpStream,
    /// Runs while bytes wait to be taken.
    until: Option<Pin<Box<Sleep>>>,
    /// Bytes that were taken since it began to run.
    taken: usize,
}

impl Paced {
    fn new(stream: TcpStream) -> Self {
        Self {
            stream,
            until: None,
            taken: 0,
        }
    }

    fn take_breath(&mut self) {
        self.until = None;
        self.taken = 0;
    }

    fn keep_pace(
        &mut self,
        context: &mut Context<'_>,
        wrote: Poll<io::Result<usize>>,
    ) -> Poll<io::Result<usize>> {
        if let Poll::Ready(wrote) = wrote {
            self.taken += *wrote.as_ref().unwrap_or(&0);
            if self.taken >= PACE {
                self.take_breath();
            }
            return Poll::Ready(wrote);
        }
        let until = self
            .until
            .get_or_insert_with(|| Box::pin(tokio::time::sleep(PEER_TIME)));
        ready!(until.as_mut().poll(context));
        Poll::Ready(Err(io::ErrorKind::TimedOut.into()))
    }
}

impl AsyncRead for Paced {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_read(context, buffer)
    }
}

impl AsyncWrite for Paced {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        let wrote = Pin::new(&mut self.stream).poll_write(context, bytes);
        self.keep_pace(context, wrote)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        pieces: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let wrote = Pin::new(&mut self.stream).poll_write_vectored(context, pieces);
        self.keep_pace(context, wrote)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        // Called when everything was written.
        self.take_breath();
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }
}
