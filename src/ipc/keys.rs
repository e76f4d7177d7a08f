//! Reads and writes key files and the allow list, which names the clients that may connect over
//! CURVE and their roles.
//!
//! A folder of keys has `server.key` (secret, for its owner alone), `server.pub` (for clients) and
//! `allow`, with one line for each client: role, public key, name. Keys are Curve25519, written in
//! Z85 (ZeroMQ RFC 32), 40 characters.

use std::fmt;
use std::io::{Read as _, Write as _};
use std::os::unix::fs::{MetadataExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};
use std::str::FromStr;

/// The daemon's secret key in a folder of keys.
pub const SERVER_KEY_FILE: &str = "server.key";
/// The daemon's public key, which clients need.
pub const SERVER_PUBLIC_FILE: &str = "server.pub";
/// The list of clients that may connect.
pub const ALLOW_FILE: &str = "allow";
/// Maximum size of a key file or an allow list in bytes.
const MAX_FILE_BYTES: u64 = 4 << 20;
/// Maximum length of a client's name in characters.
const MAX_NAME_CHARS: usize = 128;

/// The reason why keys cannot be used.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)]
pub enum KeyError {
    #[error("{path}: {source}")]
    Io {
        path: String,
        source: std::io::Error,
    },
    #[error("{path} has mode {mode:04o}, others may read the secret key in it; expected 0600")]
    Readable { path: String, mode: u32 },
    #[error("{path}, line {line}: {message}")]
    Line {
        path: String,
        line: usize,
        message: String,
    },
    #[error("{path} has no line `{what} KEY`")]
    Lacks { path: String, what: &'static str },
    #[error("{path} has more than {limit} bytes")]
    TooLarge { path: String, limit: u64 },
    #[error("name {name:?} must be 1 to {limit} letters, digits, `.`, `_`, `-` or `@`")]
    Name { name: String, limit: usize },
    #[error("{key:?} is not a key: a key has 40 characters of Z85")]
    NoKey { key: String },
    #[error("{what} is on the allow list already, as {name:?}")]
    Taken { what: String, name: String },
    #[error("no client on the allow list has the name or key {who:?}")]
    Unknown { who: String },
    #[error("a pair of keys cannot be generated: {0}")]
    Generate(zmq::Error),
}

/// The permissions of a client; each role includes those before it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Role {
    /// Read shapes, labels, arrays and events.
    ReadOnly,
    /// Add and remove shapes, create collections, correct labels.
    Ingest,
    /// Delete collections, retry failed jobs, stop the daemon.
    Admin,
}

impl Role {
    const NAMES: [(Self, &'static str); 3] = [
        (Self::ReadOnly, "read-only"),
        (Self::Ingest, "ingest"),
        (Self::Admin, "admin"),
    ];
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = Self::NAMES.iter().find(|n| n.0 == *self);
        f.write_str(name.map_or("", |n| n.1))
    }
}

impl FromStr for Role {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let found = Self::NAMES.iter().find(|n| n.1 == text);
        found
            .map(|n| n.0)
            .ok_or_else(|| format!("role is {text:?}, but must be one of read-only, ingest, admin"))
    }
}

/// A public key in Z85.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct PublicKey(String);

impl PublicKey {
    /// Parses the 32 bytes that ZeroMQ provides.
    pub fn from_bytes(bytes: &[u8]) -> Option<Self> {
        (bytes.len() == 32)
            .then(|| zmq::z85_encode(bytes).ok())
            .flatten()
            .map(Self)
    }

    /// The 40 characters of the key.
    pub fn as_str(&self) -> &str {
        &self.0
    }

    fn bytes(&self) -> Vec<u8> {
        zmq::z85_decode(&self.0).expect("invariant: checked when it was read")
    }
}

impl fmt::Display for PublicKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl FromStr for PublicKey {
    type Err = KeyError;

    fn from_str(text: &str) -> Result<Self, KeyError> {
        match zmq::z85_decode(text) {
            Ok(bytes) if bytes.len() == 32 => Ok(Self(text.to_owned())),
            _ => Err(KeyError::NoKey {
                key: text.to_owned(),
            }),
        }
    }
}

/// A public and a secret key.
#[derive(Clone)]
pub struct KeyPair {
    public: PublicKey,
    secret: [u8; 32],
}

impl fmt::Debug for KeyPair {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // The secret key must not appear in a log.
        write!(f, "KeyPair({})", self.public)
    }
}

impl KeyPair {
    /// A new pair.
    pub fn generate() -> Result<Self, KeyError> {
        let pair = zmq::CurveKeyPair::new().map_err(KeyError::Generate)?;
        let public = PublicKey::from_bytes(&pair.public_key);
        Ok(Self {
            public: public.ok_or(KeyError::Generate(zmq::Error::EINVAL))?,
            secret: pair.secret_key,
        })
    }

    /// The public half.
    pub fn public(&self) -> &PublicKey {
        &self.public
    }

    /// Writes the pair to a new file that only its owner may read.
    pub fn write(&self, path: &Path) -> Result<(), KeyError> {
        let secret = zmq::z85_encode(&self.secret).expect("invariant: 32 bytes");
        let text = format!(
            "# coseg key pair: keep it secret\npublic {}\nsecret {secret}\n",
            self.public
        );
        write_new(path, &text, 0o600)
    }

    /// Reads a pair that only its owner may read.
    pub fn read(path: &Path) -> Result<Self, KeyError> {
        let text = read_text(path)?;
        let mode = std::fs::metadata(path).map_err(io(path))?.mode() & 0o7777;
        if mode & 0o077 != 0 {
            let path = path.display().to_string();
            return Err(KeyError::Readable { path, mode });
        }
        let secret = word_after(&text, "secret").ok_or_else(|| lacks(path, "secret"))?;
        let secret = zmq::z85_decode(secret)
            .ok()
            .and_then(|b| b.try_into().ok())
            .ok_or_else(|| lacks(path, "secret"))?;
        Ok(Self {
            public: read_public(path)?,
            secret,
        })
    }
}

/// Writes a public key for others to read.
pub fn write_public(path: &Path, key: &PublicKey) -> Result<(), KeyError> {
    write_new(path, &format!("public {key}\n"), 0o644)
}

/// The public key in a file of either kind.
pub fn read_public(path: &Path) -> Result<PublicKey, KeyError> {
    let text = read_text(path)?;
    word_after(&text, "public")
        .ok_or_else(|| lacks(path, "public"))?
        .parse()
}

/// The keys with which a client connects to a daemon with keys.
#[derive(Debug, Clone)]
pub struct ClientKeys {
    /// The daemon's public key; the connection fails if another daemon answers.
    pub server: PublicKey,
    /// The client's own keys.
    pub own: KeyPair,
}

impl ClientKeys {
    /// Makes the connections of a client socket encrypted and authenticated.
    pub fn apply(&self, socket: &zmq::Socket) -> Result<(), zmq::Error> {
        socket.set_curve_serverkey(&self.server.bytes())?;
        socket.set_curve_publickey(&self.own.public.bytes())?;
        socket.set_curve_secretkey(&self.own.secret)
    }
}

impl KeyPair {
    /// Makes a listening socket accept only encrypted and authenticated connections.
    pub fn serve(&self, socket: &zmq::Socket) -> Result<(), zmq::Error> {
        socket.set_zap_domain("coseg")?;
        socket.set_curve_server(true)?;
        socket.set_curve_secretkey(&self.secret)
    }
}

/// A client that may connect.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Allowed {
    /// Its role.
    pub role: Role,
    /// Its public key.
    pub key: PublicKey,
    /// Its name for people.
    pub name: String,
}

/// The clients that may connect.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct AllowList {
    clients: Vec<Allowed>,
}

impl AllowList {
    /// Reads the list; a missing list is empty.
    pub fn read(path: &Path) -> Result<Self, KeyError> {
        match read_text(path) {
            Ok(text) => Self::parse(&text, path),
            Err(KeyError::Io { source, .. }) if source.kind() == std::io::ErrorKind::NotFound => {
                Ok(Self::default())
            }
            Err(e) => Err(e),
        }
    }

    fn parse(text: &str, path: &Path) -> Result<Self, KeyError> {
        let mut list = Self::default();
        for (i, line) in text.lines().enumerate() {
            // A comment starts at the beginning of a line only, since keys may contain `#`.
            if line.trim().is_empty() || line.starts_with('#') {
                continue;
            }
            let refuse = |message: String| KeyError::Line {
                path: path.display().to_string(),
                line: i + 1,
                message,
            };
            let words: Vec<&str> = line.split_whitespace().collect();
            let [role, key, name] = words[..] else {
                return Err(refuse(format!(
                    "{} words, expected 3: role, key, name",
                    words.len()
                )));
            };
            let client = Allowed {
                role: role.parse().map_err(refuse)?,
                key: key.parse().map_err(|e: KeyError| refuse(e.to_string()))?,
                name: name.to_owned(),
            };
            list.add(client).map_err(|e| refuse(e.to_string()))?;
        }
        Ok(list)
    }

    /// Replaces the list atomically.
    pub fn write(&self, path: &Path) -> Result<(), KeyError> {
        let mut text =
            String::from("# Who may connect: role (read-only, ingest, admin), key, name\n");
        for client in &self.clients {
            text.push_str(&format!("{} {} {}\n", client.role, client.key, client.name));
        }
        let mut new = path.as_os_str().to_owned();
        new.push(format!(".{}", std::process::id()));
        let new = PathBuf::from(new);
        write_new(&new, &text, 0o640)?;
        std::fs::rename(&new, path).map_err(io(path))
    }

    /// The clients that may connect.
    pub fn clients(&self) -> &[Allowed] {
        &self.clients
    }

    /// The client with this key.
    pub fn find(&self, key: &str) -> Option<&Allowed> {
        self.clients.iter().find(|c| c.key.as_str() == key)
    }

    /// Adds a client; its name and key must be new.
    pub fn add(&mut self, client: Allowed) -> Result<(), KeyError> {
        check_name(&client.name)?;
        let other = self
            .clients
            .iter()
            .find(|c| c.name == client.name || c.key == client.key);
        if let Some(other) = other {
            let what = if other.name == client.name {
                format!("name {:?}", client.name)
            } else {
                format!("key {}", client.key)
            };
            let name = other.name.clone();
            return Err(KeyError::Taken { what, name });
        }
        self.clients.push(client);
        Ok(())
    }

    /// Removes a client from the list, by name or key.
    pub fn remove(&mut self, who: &str) -> Result<Allowed, KeyError> {
        let at = self
            .clients
            .iter()
            .position(|c| c.name == who || c.key.as_str() == who);
        let at = at.ok_or_else(|| KeyError::Unknown {
            who: who.to_owned(),
        })?;
        Ok(self.clients.remove(at))
    }
}

/// Rejects names that cannot be written in the list or used as a file name.
pub fn check_name(name: &str) -> Result<(), KeyError> {
    let fits = |c: char| c.is_alphanumeric() || "._-@".contains(c);
    let n = name.chars().count();
    if n == 0 || n > MAX_NAME_CHARS || !name.chars().all(fits) || name.starts_with('.') {
        return Err(KeyError::Name {
            name: name.to_owned(),
            limit: MAX_NAME_CHARS,
        });
    }
    Ok(())
}

fn word_after<'a>(text: &'a str, what: &str) -> Option<&'a str> {
    text.lines()
        .find_map(|l| l.strip_prefix(what)?.strip_prefix(' '))
        .map(str::trim)
}

fn lacks(path: &Path, what: &'static str) -> KeyError {
    KeyError::Lacks {
        path: path.display().to_string(),
        what,
    }
}

fn io(path: &Path) -> impl FnOnce(std::io::Error) -> KeyError {
    let path = path.display().to_string();
    move |source| KeyError::Io { path, source }
}

fn read_text(path: &Path) -> Result<String, KeyError> {
    let file = std::fs::File::open(path).map_err(io(path))?;
    let mut text = String::new();
    let n = file.take(MAX_FILE_BYTES + 1).read_to_string(&mut text);
    if n.map_err(io(path))? as u64 > MAX_FILE_BYTES {
        return Err(KeyError::TooLarge {
            path: path.display().to_string(),
            limit: MAX_FILE_BYTES,
        });
    }
    Ok(text)
}

fn write_new(path: &Path, text: &str, mode: u32) -> Result<(), KeyError> {
    let mut file = std::fs::OpenOptions::new()
        .write(true)
        .create_new(true)
        .mode(mode)
        .open(path)
        .map_err(io(path))?;
    file.write_all(text.as_bytes())
        .and_then(|()| file.sync_all())
        .map_err(io(path))
}

#[cfg(test)]
mod tests {
    use super::{AllowList, Allowed, KeyError, KeyPair, Role, read_public, write_public};
    use std::os::unix::fs::PermissionsExt as _;
    use std::path::Path;

    #[test]
    fn this_binary_can_encrypt() {
        assert_eq!(zmq::has("curve"), Some(true));
        assert!(KeyPair::generate().is_ok());
    }

    #[test]
    fn keys_are_read_back_and_secrets_are_for_their_owner() {
        let dir = tempfile::tempdir().unwrap();
        let (path, public) = (dir.path().join("a.key"), dir.path().join("a.pub"));
        let pair = KeyPair::generate().unwrap();
        pair.write(&path).unwrap();
        write_public(&public, pair.public()).unwrap();
        let mode = std::fs::metadata(&path).unwrap().permissions().mode();
        assert_eq!(mode & 0o777, 0o600);
        let read = KeyPair::read(&path).unwrap();
        assert_eq!((read.public(), read.secret), (pair.public(), pair.secret));
        assert_eq!(&read_public(&path).unwrap(), pair.public());
        assert_eq!(&read_public(&public).unwrap(), pair.public());
        assert!(matches!(pair.write(&path), Err(KeyError::Io { .. })));
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o640)).unwrap();
        assert!(matches!(
            KeyPair::read(&path),
            Err(KeyError::Readable { mode: 0o640, .. })
        ));
        let text = format!("{pair:?}");
        assert!(!text.contains(&zmq::z85_encode(&pair.secret).unwrap()));
    }

    #[test]
    fn the_allow_list_is_kept_and_refuses_what_is_not_one() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("allow");
        let mut list = AllowList::read(&path).unwrap();
        assert_eq!(list.clients(), []);
        let client = |name: &str, role| Allowed {
            role,
            key: KeyPair::generate().unwrap().public().clone(),
            name: name.to_owned(),
        };
        let (a, b) = (client("a", Role::Admin), client("b@host", Role::ReadOnly));
        list.add(a.clone()).unwrap();
        list.add(b.clone()).unwrap();
        assert!(list.add(client("a", Role::Ingest)).is_err());
        assert!(list.add(client("a b", Role::Ingest)).is_err());
        list.write(&path).unwrap();
        let mut list = AllowList::read(&path).unwrap();
        assert_eq!(list.clients(), [a.clone(), b.clone()]);
        assert_eq!(list.find(b.key.as_str()), Some(&b));
        assert_eq!(list.remove("a").unwrap(), a);
        assert_eq!(list.remove(b.key.as_str()).unwrap(), b);
        assert!(list.remove("a").is_err());
        for (text, message) in [
            ("admin\n", "line 1: 1 words, expected 3"),
            ("\n# x\nroot a b\n", "line 3: role is \"root\""),
            ("admin short b\n", "is not a key"),
        ] {
            let error = AllowList::parse(text, Path::new("allow")).unwrap_err();
            assert!(error.to_string().contains(message), "{error}");
        }
    }
}
