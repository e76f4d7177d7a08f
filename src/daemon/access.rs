//! Decides which clients may connect and what each may request: the ZAP handler and the roles.
//!
//! Without keys, the socket's directory or the loopback interface decides who can connect. With
//! keys, every connection is CURVE, and the allow list is checked twice: when a connection is made
//! (ZAP, ZeroMQ RFC 27), and for each request, so that a revoked key is refused at once.

use crate::daemon::answer::not_allowed;
use crate::ipc::convert;
use crate::ipc::keys::{
    ALLOW_FILE, AllowList, KeyError, KeyPair, PublicKey, Role, SERVER_KEY_FILE,
};
use crate::ipc::wire::{self, ErrorCode, ErrorReason};
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use tokio::sync::watch;

/// The endpoint for ZeroMQ's questions about connections.
pub(crate) const ZAP_ENDPOINT: &str = "inproc://zeromq.zap.01";

/// Inode, length and time of change of the allow list; none where it is missing.
type Stamp = Option<(u64, u64, i64, i64)>;

/// How clients are authorized.
pub(crate) enum Access {
    /// Every client that can connect has this role.
    Open(Role),
    /// The keys on the allow list have the roles that it gives them.
    Keys(Keys),
}

/// The daemon's key, and the list.
pub(crate) struct Keys {
    server: KeyPair,
    path: PathBuf,
    /// The stamp of the list as it was last read. Locked while the list is read again.
    stamp: Mutex<Stamp>,
    list: watch::Sender<Arc<AllowList>>,
}

impl Access {
    /// Reads the folder of keys; without one, access is open.
    pub(crate) fn new(keys: &Path) -> Result<Self, KeyError> {
        if keys.as_os_str().is_empty() {
            // Over TCP, draining is refused nevertheless: every user of the machine can connect.
            return Ok(Self::Open(Role::Admin));
        }
        let path = keys.join(ALLOW_FILE);
        let list = Arc::new(AllowList::read(&path)?);
        Ok(Self::Keys(Keys {
            server: KeyPair::read(&keys.join(SERVER_KEY_FILE))?,
            stamp: Mutex::new(stamp(&path)),
            list: watch::Sender::new(list),
            path,
        }))
    }

    /// Reads the allow list again if its file has changed, or if `always`. Returns true if a key
    /// was taken off it.
    pub(crate) fn reload(&self, always: bool) -> bool {
        let Self::Keys(keys) = self else { return false };
        let found = stamp(&keys.path);
        let mut read = keys.stamp.lock().unwrap_or_else(PoisonError::into_inner);
        if *read == found && !always {
            return false;
        }
        *read = found;
        match AllowList::read(&keys.path) {
            Ok(new) => {
                let old = keys.list();
                let gone = old
                    .clients()
                    .iter()
                    .any(|old| new.find(old.key.as_str()).is_none());
                if *old != new {
                    tracing::info!(
                        clients = new.clients().len(),
                        "the allow list was read again"
                    );
                }
                keys.list.send_replace(Arc::new(new));
                gone
            }
            Err(e) => {
                // Logged once for each change of the file.
                tracing::error!(error = %e, "the allow list stays as it was");
                false
            }
        }
    }

    /// Lets a socket that is to be bound accept authenticated connections only.
    pub(crate) fn protect(&self, socket: &zmq::Socket) -> Result<(), zmq::Error> {
        match self {
            Self::Open(_) => Ok(()),
            Self::Keys(keys) => keys.server.serve(socket),
        }
    }

    /// Answers a question of ZeroMQ: its frames, and those of the reply. The user id is the key.
    pub(crate) fn zap(&self, question: &[Vec<u8>]) -> Vec<Vec<u8>> {
        let id = question.get(1).cloned().unwrap_or_default();
        let [_, _, _, address, _, mechanism, key] = question else {
            return zap_reply(id, "500", "the question has another number of frames", "");
        };
        let key = PublicKey::from_bytes(key).filter(|_| mechanism == b"CURVE");
        let (Self::Keys(keys), Some(key)) = (self, key) else {
            return zap_reply(id, "400", "only keys are let in", "");
        };
        let address = String::from_utf8_lossy(address);
        match keys.list().find(key.as_str()) {
            Some(client) => {
                tracing::debug!(name = client.name, %address, "a client connects");
                zap_reply(id, "200", "", key.as_str())
            }
            None => {
                tracing::warn!(%key, %address, "a key that is not on the allow list was refused");
                zap_reply(id, "400", "the key is not on the allow list", "")
            }
        }
    }

    /// Refuses a request for which the client's role does not suffice. `user` is the key that
    /// ZeroMQ has authenticated.
    pub(crate) fn check(&self, user: Option<&str>, needed: Role) -> Result<(), wire::Error> {
        let (role, name) = match self {
            Self::Open(role) => (*role, String::new()),
            Self::Keys(keys) => {
                let list = keys.list();
                let Some(client) = user.and_then(|key| list.find(key)) else {
                    return Err(not_allowed(""));
                };
                (client.role, client.name.clone())
            }
        };
        if role >= needed {
            return Ok(());
        }
        let text = format!("{name:?} has the role {role}, but this request needs {needed}");
        Err(convert::error(
            ErrorCode::PermissionDenied,
            ErrorReason::RoleTooLow,
            text,
        ))
    }

    /// The current list, for requests in flight that must notice when their key is taken off it.
    pub(crate) fn allowed(&self) -> Option<watch::Receiver<Arc<AllowList>>> {
        match self {
            Self::Open(_) => None,
            Self::Keys(keys) => Some(keys.list.subscribe()),
        }
    }

    /// Whether every connection is authenticated.
    pub(crate) fn has_keys(&self) -> bool {
        matches!(self, Self::Keys(_))
    }
}

impl Keys {
    fn list(&self) -> Arc<AllowList> {
        Arc::clone(&self.list.borrow())
    }
}

fn zap_reply(id: Vec<u8>, status: &str, text: &str, user: &str) -> Vec<Vec<u8>> {
    let frame = |text: &str| text.as_bytes().to_vec();
    vec![
        frame("1.0"),
        id,
        frame(status),
        frame(text),
        frame(user),
        Vec::new(),
    ]
}

fn stamp(path: &Path) -> Stamp {
    let m = std::fs::metadata(path).ok()?;
    Some((m.ino(), m.len(), m.mtime(), m.mtime_nsec()))
}
