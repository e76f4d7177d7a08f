//! The daemon as a service: signals, and notifications of the service manager.

use crate::config::{Config, ConfigError};
use crate::daemon::error::StartError;
use crate::daemon::running::Running;
use crate::daemon::shared::Control;
use crate::daemon::start::start;
use sd_notify::NotifyState;
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::sync::mpsc::RecvTimeoutError;
use std::time::{Duration, Instant};

/// The longest drain, as documented for the operator; part of it is left for closing.
const DRAIN: Duration = Duration::from_secs(25);
/// Between checks of the state, unless the watchdog must be fed sooner.
const LOOK: Duration = Duration::from_secs(1);
/// Open files are enough at this many.
const MAX_FILES: u64 = 65_536;
/// Exit status after a second SIGTERM or SIGINT, as the shell would report the signal.
const AT_ONCE: i32 = 143;

/// Why the daemon could not serve.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)]
pub enum ServeError {
    #[error(transparent)]
    Start(#[from] StartError),
    #[error("signals cannot be handled: {0}")]
    Signals(std::io::Error),
}

/// Serves until SIGTERM, SIGINT or a Drain request; a second signal ends the process at once. On
/// SIGHUP `reload` reads the configuration again.
pub fn serve(
    config: Config,
    reload: impl Fn() -> Result<Config, ConfigError>,
) -> Result<(), ServeError> {
    // Sockets, locks and library files are this user's alone; the sockets' mode is set explicitly.
    rustix::process::umask(rustix::fs::Mode::from_raw_mode(0o077));
    // Connections are files: as many as the operator's hard limit allows.
    let files = rustix::process::getrlimit(rustix::process::Resource::Nofile);
    let raised = rustix::process::Rlimit {
        current: files.maximum.or(Some(MAX_FILES)).map(|m| m.min(MAX_FILES)),
        maximum: files.maximum,
    };
    if let Err(e) = rustix::process::setrlimit(rustix::process::Resource::Nofile, raised) {
        tracing::warn!(error = %e, "the number of open files stays as it was");
    }
    zmq_bounds::give_back_freed_memory();
    let stopping = Arc::new(AtomicBool::new(false));
    for signal in [SIGTERM, SIGINT] {
        // In this order: the first signal arms the second.
        signal_hook::flag::register_conditional_shutdown(signal, AT_ONCE, Arc::clone(&stopping))
            .and_then(|_| signal_hook::flag::register(signal, Arc::clone(&stopping)))
            .map_err(ServeError::Signals)?;
    }
    let mut signals = signal_hook::iterator::Signals::new([SIGTERM, SIGINT, SIGHUP])
        .map_err(ServeError::Signals)?;
    std::panic::set_hook(Box::new(|panic| tracing::error!(%panic, "panic")));
    let running = start(config)?;
    let control = running.daemon.control.clone();
    std::thread::Builder::new()
        .name("signals".to_owned())
        .spawn(move || {
            for signal in signals.forever() {
                let message = if signal == SIGHUP {
                    Control::Reload
                } else {
                    Control::Drain
                };
                if control.send(message).is_err() {
                    return;
                }
            }
        })
        .map_err(ServeError::Signals)?;
    tracing::info!(
        endpoint = %running.endpoint(), events = %running.events(),
        version = env!("CARGO_PKG_VERSION"), "serving"
    );
    if let Some(address) = running.http() {
        tracing::info!("viewer and metrics at http://{address}/");
    }
    notify(&[NotifyState::Ready, NotifyState::Status("serving")]);
    attend(&running, reload);
    tracing::info!("draining");
    notify(&[NotifyState::Stopping, NotifyState::Status("draining")]);
    running.drain(DRAIN);
    tracing::info!("drained");
    Ok(())
}

/// Feeds the watchdog and reloads the configuration, until the daemon is to drain.
fn attend(running: &Running, reload: impl Fn() -> Result<Config, ConfigError>) {
    let watchdog = sd_notify::watchdog_enabled();
    let look = watchdog.map_or(LOOK, |w| (w / 3).min(LOOK));
    let mut ticks = running.ticks();
    let mut fed = Instant::now();
    let mut status = String::new();
    loop {
        match running.control.recv_timeout(look) {
            Ok(Control::Drain) | Err(RecvTimeoutError::Disconnected) => return,
            Ok(Control::Reload) => reload_now(running, &reload),
            Err(RecvTimeoutError::Timeout) => {}
        }
        let now = running.ticks();
        // Both must have advanced, so that a thread that hangs is noticed.
        if now.0 != ticks.0 && now.1 != ticks.1 {
            ticks = now;
            fed = Instant::now();
            if watchdog.is_some() {
                notify(&[NotifyState::Watchdog]);
            }
        } else if fed.elapsed() > Duration::from_secs(10) {
            tracing::error!(sockets = now.0, runtime = now.1, "a thread does not answer");
            fed = Instant::now();
        }
        let n_queued = running.daemon.work.progress().n_live(None);
        let text = format!("serving, {n_queued} shapes queued");
        if text != status {
            notify(&[NotifyState::Status(&text)]);
            status = text;
        }
    }
}

fn reload_now(running: &Running, reload: &impl Fn() -> Result<Config, ConfigError>) {
    let mut state = vec![NotifyState::Reloading];
    state.extend(NotifyState::monotonic_usec_now());
    notify(&state);
    match reload() {
        Ok(config) => {
            let waiting = running.reload(&config);
            tracing::info!(next_start = ?waiting, "configuration reloaded");
        }
        Err(e) => tracing::error!(error = %e, "the configuration stays as it was"),
    }
    notify(&[NotifyState::Ready]);
}

/// Notifies the service manager, if there is one.
fn notify(state: &[NotifyState<'_>]) {
    if let Err(e) = sd_notify::notify(state) {
        tracing::warn!(error = %e, "the service manager cannot be notified");
    }
}
