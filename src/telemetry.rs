//! Writes log events as lines to stderr, for people or as JSON; the filter can be changed while the
//! program runs.

use coseg::config::{Log, LogFormat};
use std::io::IsTerminal as _;
use tracing_subscriber::layer::SubscriberExt as _;
use tracing_subscriber::reload;
use tracing_subscriber::util::SubscriberInitExt as _;
use tracing_subscriber::{EnvFilter, Registry, fmt};

/// Changes the filter of a running daemon.
#[derive(Clone)]
pub(crate) struct Telemetry {
    filter: reload::Handle<EnvFilter, Registry>,
}

/// The reason why logging cannot be set up or changed.
#[derive(Debug, thiserror::Error)]
pub(crate) enum TelemetryError {
    /// The level is neither a level nor a filter.
    #[error("log.level {level:?}: {source}")]
    Level {
        /// The configured level.
        level: String,
        /// The parser's error.
        source: tracing_subscriber::filter::ParseError,
    },
    /// A logger exists already, or exists no more.
    #[error("logging: {0}")]
    Setup(String),
}

fn filter(level: &str) -> Result<EnvFilter, TelemetryError> {
    EnvFilter::try_new(level).map_err(|source| TelemetryError::Level {
        level: level.to_owned(),
        source,
    })
}

/// Sets up logging for the whole process.
pub(crate) fn start(log: &Log) -> Result<Telemetry, TelemetryError> {
    let (filter, handle) = reload::Layer::new(filter(&log.level)?);
    let registry = tracing_subscriber::registry().with(filter);
    let colour = std::io::stderr().is_terminal() && std::env::var_os("NO_COLOR").is_none();
    let started = match log.format {
        LogFormat::Human => {
            let lines = fmt::layer().with_writer(std::io::stderr).with_ansi(colour);
            registry.with(lines.with_target(false)).try_init()
        }
        LogFormat::Json => registry
            .with(fmt::layer().json().with_writer(std::io::stderr))
            .try_init(),
    };
    started.map_err(|e| TelemetryError::Setup(e.to_string()))?;
    Ok(Telemetry { filter: handle })
}

impl Telemetry {
    /// Changes the level.
    pub(crate) fn set_level(&self, level: &str) -> Result<(), TelemetryError> {
        let filter = filter(level)?;
        self.filter
            .reload(filter)
            .map_err(|e| TelemetryError::Setup(e.to_string()))
    }
}
