//! Parses and checks endpoint URIs: the addresses where the daemon listens and clients connect.

use super::folder::{DefaultFolder, private_directory};
use rustix::fs::OFlags;
use std::fmt;
use std::fs;
use std::io::Write as _;
use std::net::IpAddr;
use std::os::unix::fs::{MetadataExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};

/// Maximum length in bytes of the path of a Unix socket: the kernel's `sockaddr_un`, less the final
/// NUL.
pub const MAX_SOCKET_PATH_BYTES: usize = 107;
/// Suffix of the request socket's path that gives the event socket's path.
const EVENTS_SUFFIX: &str = ".events";

/// The reason why an endpoint cannot be used.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)]
pub enum EndpointError {
    #[error("endpoint {uri:?} is neither ipc://PATH nor tcp://HOST:PORT")]
    Scheme { uri: String },
    #[error("endpoint {uri:?}: {message}")]
    Malformed { uri: String, message: String },
    #[error("endpoint {uri:?}: its socket path has {found} bytes, the limit is {limit}")]
    PathTooLong {
        uri: String,
        found: usize,
        limit: usize,
    },
    #[error(
        "endpoint {uri:?} is not loopback, which needs keys (security.keys, `coseg keys \
         generate`); without them only ipc:// and tcp on 127.0.0.0/8, [::1] or localhost are served"
    )]
    NotLoopback { uri: String },
    #[error("{path} {message}")]
    Directory { path: String, message: String },
    #[error(
        "{path} is in use by a running daemon{holder}; `coseg stop --endpoint ipc://{path}` ends it"
    )]
    InUse { path: String, holder: String },
    #[error("{path} exists and is not a socket")]
    NotASocket { path: String },
    #[error("{path}: {source}")]
    Io {
        path: String,
        source: std::io::Error,
    },
}

/// An address to listen at or to connect to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Endpoint {
    /// Path of a Unix socket.
    Ipc(PathBuf),
    /// A TCP port; 0 selects any free one.
    Tcp {
        /// Name or address; an IPv6 address is in brackets.
        host: String,
        /// Port.
        port: u16,
    },
}

impl fmt::Display for Endpoint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Ipc(path) => write!(f, "ipc://{}", path.display()),
            Self::Tcp { host, port } => write!(f, "tcp://{host}:{port}"),
        }
    }
}

impl Endpoint {
    /// Parses `ipc://PATH` (made absolute) or `tcp://HOST:PORT` (`*` as port: any free one).
    pub fn parse(uri: &str) -> Result<Self, EndpointError> {
        let malformed = |message: &str| EndpointError::Malformed {
            uri: uri.to_owned(),
            message: message.to_owned(),
        };
        if let Some(path) = uri.strip_prefix("ipc://") {
            if path.is_empty() || path == "*" {
                return Err(malformed("name the path of a socket"));
            }
            if path.starts_with('@') {
                return Err(malformed(
                    "an abstract socket has no permissions, name a path",
                ));
            }
            if path.ends_with('/') || path.contains('\0') {
                return Err(malformed("the path must name a file"));
            }
            let path = std::path::absolute(path).map_err(|source| EndpointError::Io {
                path: path.to_owned(),
                source,
            })?;
            // The path of the event socket is the longer one.
            let found = path.as_os_str().len() + EVENTS_SUFFIX.len();
            if found > MAX_SOCKET_PATH_BYTES {
                return Err(EndpointError::PathTooLong {
                    uri: uri.to_owned(),
                    found: found - EVENTS_SUFFIX.len(),
                    limit: MAX_SOCKET_PATH_BYTES - EVENTS_SUFFIX.len(),
                });
            }
            return Ok(Self::Ipc(path));
        }
        if let Some(address) = uri.strip_prefix("tcp://") {
            let (host, port) = address
                .rsplit_once(':')
                .ok_or_else(|| malformed("expected tcp://HOST:PORT"))?;
            let port = if port == "*" {
                0
            } else {
                port.parse()
                    .map_err(|_| malformed("the port is not a number from 0 to 65535"))?
            };
            if host.is_empty() {
                return Err(malformed("the host is missing"));
            }
            return Ok(Self::Tcp {
                host: host.to_owned(),
                port,
            });
        }
        Err(EndpointError::Scheme {
            uri: uri.to_owned(),
        })
    }

    /// The default endpoint of daemons and clients: `$RUNTIME_DIRECTORY/coseg.sock` under a service
    /// manager, else `$XDG_RUNTIME_DIR/coseg/coseg.sock`, else `/tmp/coseg-UID/coseg.sock`.
    pub fn default_for_user() -> Self {
        Self::Ipc(DefaultFolder::of_this_process().path().join("coseg.sock"))
    }

    /// The default endpoint for a client, which must not connect to a folder that another user
    /// created first. The folder must belong to this user or to root and be closed to others; the
    /// folder of a service may let a group in.
    pub fn default_for_client() -> Result<Self, EndpointError> {
        DefaultFolder::of_this_process().check()?;
        Ok(Self::default_for_user())
    }

    /// The address of the events of this endpoint: the path with `.events`, or the next port (any
    /// free one if this port is 0).
    pub fn events(&self) -> Result<Self, EndpointError> {
        match self {
            Self::Ipc(path) => {
                let mut events = path.clone().into_os_string();
                events.push(EVENTS_SUFFIX);
                Ok(Self::Ipc(events.into()))
            }
            Self::Tcp { host, port: 0 } => Ok(Self::Tcp {
                host: host.clone(),
                port: 0,
            }),
            Self::Tcp { host, port } => {
                let port = port
                    .checked_add(1)
                    .ok_or_else(|| EndpointError::Malformed {
                        uri: self.to_string(),
                        message: "the next port is for events, and there is none".to_owned(),
                    })?;
                Ok(Self::Tcp {
                    host: host.clone(),
                    port,
                })
            }
        }
    }

    /// Rejects addresses at which a daemon must not listen: those beyond this machine, unless every
    /// connection is encrypted and authenticated.
    pub fn check_servable(&self, has_keys: bool) -> Result<(), EndpointError> {
        let Self::Tcp { host, .. } = self else {
            return Ok(());
        };
        let bare = host.trim_start_matches('[').trim_end_matches(']');
        let loopback =
            host == "localhost" || bare.parse::<IpAddr>().is_ok_and(|ip| ip.is_loopback());
        if loopback || has_keys {
            Ok(())
        } else {
            Err(EndpointError::NotLoopback {
                uri: self.to_string(),
            })
        }
    }
}

/// Prepares to bind a Unix socket at `path`: checks for a private directory and for a live daemon,
/// and removes a stale socket. The returned lock excludes other daemons as long as it is held.
pub fn claim_socket(path: &Path) -> Result<fs::File, EndpointError> {
    let io = |path: &Path| {
        let path = path.display().to_string();
        move |source| EndpointError::Io { path, source }
    };
    let directory = path.parent().unwrap_or(Path::new("/"));
    private_directory(directory)?;
    let mut lock_path = path.as_os_str().to_owned();
    lock_path.push(".lock");
    let lock_path = PathBuf::from(lock_path);
    let lock = fs::OpenOptions::new()
        .create(true)
        .truncate(false)
        .write(true)
        // In a folder that others may write to, somebody may have placed a link or a pipe.
        .custom_flags((OFlags::NOFOLLOW | OFlags::NONBLOCK).bits().cast_signed())
        .open(&lock_path)
        .map_err(io(&lock_path))?;
    let in_use = || EndpointError::InUse {
        path: path.display().to_string(),
        holder: match fs::read_to_string(&lock_path).map(|text| text.trim().parse()) {
            Ok(Ok::<u32, _>(pid)) => format!(", process {pid}"),
            _ => String::new(),
        },
    };
    rustix::fs::flock(&lock, rustix::fs::FlockOperation::NonBlockingLockExclusive)
        .map_err(|_| in_use())?;
    match fs::symlink_metadata(path) {
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => {}
        Err(e) => return Err(io(path)(e)),
        Ok(metadata) => {
            use std::os::unix::fs::FileTypeExt;
            if !metadata.file_type().is_socket() {
                return Err(EndpointError::NotASocket {
                    path: path.display().to_string(),
                });
            }
            // A process that ignores the lock may listen there.
            if std::os::unix::net::UnixStream::connect(path).is_ok() {
                return Err(in_use());
            }
            fs::remove_file(path).map_err(io(path))?;
        }
    }
    tell_holder(&lock).map_err(io(&lock_path))?;
    Ok(lock)
}

/// Writes this process's id for a daemon that finds the lock taken; the id of a daemon that has
/// ended is never read. It does not write to a file that somebody else created, since the folder
/// may be open to others.
fn tell_holder(mut lock: &fs::File) -> std::io::Result<()> {
    let found = lock.metadata()?;
    let is_ours = found.uid() == rustix::process::getuid().as_raw() && found.nlink() == 1;
    if !is_ours || !found.is_file() {
        return Ok(());
    }
    lock.set_len(0)?;
    lock.write_all(std::process::id().to_string().as_bytes())
}

#[cfg(test)]
mod tests {
    use super::{Endpoint, EndpointError, claim_socket};
    use std::os::unix::fs::PermissionsExt;

    #[test]
    fn uris_are_read_and_refused() {
        let ipc = Endpoint::parse("ipc:///run/x/coseg.sock").unwrap();
        assert_eq!(
            ipc.events().unwrap().to_string(),
            "ipc:///run/x/coseg.sock.events"
        );
        let tcp = Endpoint::parse("tcp://127.0.0.1:7000").unwrap();
        assert_eq!(tcp.events().unwrap().to_string(), "tcp://127.0.0.1:7001");
        for uri in [
            "udp://127.0.0.1:1",
            "inproc://x",
            "x",
            "",
            "pgm://eth0;239.0.0.1:1",
        ] {
            assert!(
                matches!(Endpoint::parse(uri), Err(EndpointError::Scheme { .. })),
                "{uri}"
            );
        }
        for uri in [
            "ipc://",
            "ipc://*",
            "ipc://@x",
            "ipc:///tmp/",
            "tcp://h",
            "tcp://h:70000",
            "tcp://:1",
        ] {
            assert!(
                matches!(Endpoint::parse(uri), Err(EndpointError::Malformed { .. })),
                "{uri}"
            );
        }
    }

    #[test]
    fn socket_paths_have_a_length_limit() {
        let fits = format!("ipc:///{}", "x".repeat(99));
        assert!(Endpoint::parse(&fits).is_ok());
        let error = Endpoint::parse(&format!("{fits}x")).unwrap_err();
        assert!(
            error
                .to_string()
                .ends_with("its socket path has 101 bytes, the limit is 100"),
            "{error}"
        );
    }

    #[test]
    fn only_loopback_is_served() {
        for host in ["127.0.0.1", "127.8.8.8", "localhost", "[::1]"] {
            Endpoint::parse(&format!("tcp://{host}:1"))
                .unwrap()
                .check_servable(false)
                .unwrap();
        }
        for host in [
            "0.0.0.0",
            "*",
            "10.0.0.1",
            "[::]",
            "eth0",
            "example.org",
            "localhost.example.org",
        ] {
            let endpoint = Endpoint::parse(&format!("tcp://{host}:1")).unwrap();
            assert!(
                matches!(
                    endpoint.check_servable(false),
                    Err(EndpointError::NotLoopback { .. })
                ),
                "{host}"
            );
        }
    }

    #[test]
    fn stale_sockets_go_and_live_ones_stay() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("sub/s.sock");
        let lock = claim_socket(&path).unwrap();
        let mode = std::fs::metadata(path.parent().unwrap())
            .unwrap()
            .permissions()
            .mode();
        assert_eq!(mode & 0o777, 0o700);
        assert!(matches!(
            claim_socket(&path),
            Err(EndpointError::InUse { .. })
        ));
        drop(lock);
        let listener = std::os::unix::net::UnixListener::bind(&path).unwrap();
        assert!(matches!(
            claim_socket(&path),
            Err(EndpointError::InUse { .. })
        ));
        drop(listener);
        assert!(path.exists());
        let _lock = claim_socket(&path).unwrap();
        assert!(!path.exists());
    }

    #[test]
    fn a_lock_that_leads_elsewhere_is_neither_followed_nor_written() {
        let directory = tempfile::tempdir().unwrap();
        let (path, victim) = (directory.path().join("s"), directory.path().join("victim"));
        let lock = directory.path().join("s.lock");
        std::fs::write(&victim, "precious").unwrap();
        std::os::unix::fs::symlink(&victim, &lock).unwrap();
        assert!(matches!(claim_socket(&path), Err(EndpointError::Io { .. })));
        std::fs::remove_file(&lock).unwrap();
        std::fs::hard_link(&victim, &lock).unwrap();
        drop(claim_socket(&path).unwrap());
        assert_eq!(std::fs::read_to_string(&victim).unwrap(), "precious");
        std::fs::remove_file(&lock).unwrap();
        let _lock = claim_socket(&path).unwrap();
        let message = claim_socket(&path).unwrap_err().to_string();
        let pid = std::process::id();
        assert!(
            message.contains(&format!("running daemon, process {pid}; ")),
            "{message}"
        );
    }

    #[test]
    fn directories_that_others_may_write_are_refused() {
        let directory = tempfile::tempdir().unwrap();
        let open = directory.path().join("open");
        std::fs::create_dir(&open).unwrap();
        std::fs::set_permissions(&open, std::fs::Permissions::from_mode(0o777)).unwrap();
        let error = claim_socket(&open.join("s.sock")).unwrap_err();
        assert!(error.to_string().contains("has mode 0777"), "{error}");
        let file = directory.path().join("file");
        std::fs::write(&file, "x").unwrap();
        assert!(matches!(
            claim_socket(&file),
            Err(EndpointError::NotASocket { .. })
        ));
    }
}
