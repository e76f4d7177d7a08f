//! Why the daemon does not start.

use crate::config::ConfigError;
use crate::daemon::http::token::TokenError;
use crate::ipc::endpoint::EndpointError;
use crate::ipc::keys::KeyError;
use crate::library::LibraryError;

/// Why the daemon did not start.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)]
pub enum StartError {
    #[error(transparent)]
    Config(#[from] ConfigError),
    #[error(transparent)]
    Endpoint(#[from] EndpointError),
    #[error(transparent)]
    Keys(#[from] KeyError),
    #[error("this binary was built without CURVE; keys cannot be used")]
    NoCurve,
    #[error("library {path}: {source}")]
    Library { path: String, source: LibraryError },
    #[error("{endpoint}: {source}")]
    Socket {
        endpoint: String,
        source: zmq::Error,
    },
    #[error("a worker process cannot be started: {0}")]
    Worker(std::io::Error),
    #[error("http.listen {address}: {source}")]
    Http {
        address: std::net::SocketAddr,
        source: std::io::Error,
    },
    #[error(transparent)]
    Token(#[from] TokenError),
    #[error("threads cannot be started: {0}")]
    Threads(#[from] std::io::Error),
}

impl StartError {
    /// Whether the configuration or the command line must be changed.
    pub fn is_configuration(&self) -> bool {
        match self {
            Self::Config(_) | Self::Keys(_) | Self::NoCurve | Self::Token(_) => true,
            Self::Endpoint(e) => {
                !matches!(e, EndpointError::InUse { .. } | EndpointError::Io { .. })
            }
            Self::Library { .. }
            | Self::Socket { .. }
            | Self::Worker(_)
            | Self::Http { .. }
            | Self::Threads(_) => false,
        }
    }
}
