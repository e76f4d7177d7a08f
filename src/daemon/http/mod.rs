//! A small HTTP endpoint: health and metrics for monitoring, the viewer and its interface for
//! browsers.
//!
//! Without a token it listens on loopback only; elsewhere it requires one ([`guard`], [`token`]).
//! It has its own runtime, memory and connections ([`door`], [`hands`]), so whatever a page
//! requests, the sockets and signals are served.

mod api;
mod choices;
mod connection;
mod door;
mod exchange;
mod guard;
mod hands;
mod page;
mod questions;
mod route;
mod runs;
mod server;
pub(in crate::daemon) mod token;

pub use token::TokenError;

use crate::config::Config;
use crate::daemon::error::StartError;
use crate::daemon::incoming::Incoming;
use crate::daemon::running::Ticks;
use crate::daemon::shared::Daemon;
use guard::Guard;
use server::{Server, Thread};
use std::net::{SocketAddr, TcpListener};
use std::path::Path;
use std::sync::Arc;
use tokio::runtime::Runtime;
use tokio::sync::mpsc;

/// A bound address, and the checks of its clients.
pub(crate) struct Bound {
    listener: TcpListener,
    guard: Guard,
}

/// Binds the configured address, if there is one. The token, if one is needed and there is none, is
/// made in the folder of the library, which must exist.
pub(crate) fn bind(config: &Config, library: &Path) -> Result<Option<Bound>, StartError> {
    let Some(address) = config.http.address()? else {
        return Ok(None);
    };
    let failed = |source| StartError::Http { address, source };
    let listener = TcpListener::bind(address).map_err(failed)?;
    listener.set_nonblocking(true).map_err(failed)?;
    let local = address.ip().is_loopback();
    let path = token::path(&config.http.token_file, library);
    let asks = !local || !config.http.token_file.as_os_str().is_empty();
    let token = asks
        .then(|| token::Token::read_or_make(&path))
        .transpose()?;
    if asks {
        let file = path.display();
        tracing::info!(%file, "HTTP asks for the token of this file: /?token=… opens the viewer");
    }
    let guard = Guard {
        local,
        token,
        open_monitoring: config.http.open_monitoring,
    };
    Ok(Some(Bound { listener, guard }))
}

impl Bound {
    /// The address, with the port that was chosen.
    pub(crate) fn address(&self) -> Option<SocketAddr> {
        self.listener.local_addr().ok()
    }

    /// Serves connections in a runtime of its own, until that is dropped.
    pub(crate) fn serve(
        self,
        daemon: Arc<Daemon>,
        requests: mpsc::Sender<Incoming>,
        ticks: &Ticks,
    ) -> std::io::Result<Runtime> {
        let own = hands::runtime()?;
        let threads = [
            Thread::new("the socket thread", &ticks.sockets),
            Thread::new("the runtime", &ticks.runtime),
        ];
        let server = Server::new(daemon, requests, self.guard, threads);
        let guard = own.enter();
        let listener = tokio::net::TcpListener::from_std(self.listener)?;
        tokio::spawn(server::watch(Arc::clone(&server)));
        tokio::spawn(door::serve(server, listener));
        drop(guard);
        Ok(own)
    }
}
