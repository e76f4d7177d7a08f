//! Defaults, a file, the environment and flags become one validated [`Config`].
//!
//! The compiled-in default is `config/coseg.toml` itself, so its comments cannot drift from the code:
//! a key is known if and only if that file has it.

mod size;
pub use size::ByteSize;

use config::{FileFormat, Source, Value, ValueKind};
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::path::PathBuf;

/// The default settings, commented.
pub const DEFAULT: &str = include_str!("../config/coseg.toml");
/// Read if it exists and no other file is named.
pub const SYSTEM_FILE: &str = "/etc/coseg/coseg.toml";
/// What environment variables of settings begin with: `COSEG__SECTION__KEY`.
const ENV_PREFIX: &str = "COSEG";
const ENV_SEPARATOR: &str = "__";
/// Bytes that describing a shape takes whatever its size, and per byte of its file: text of about 30
/// bytes a vertex and 20 a face becomes parsed, cleaned and indexed copies, then a proxy of fixed size
/// with its spectrum.
const DESCRIBE_BASE: u64 = 64 << 20;
const DESCRIBE_PER_BYTE: u64 = 12;
/// Bytes that frames of a message take beside what is in them.
const ARRIVING_BASE: u64 = 8 << 20;
/// Bytes that a connection takes, whatever comes over it: 24 kB were measured.
const CONNECTION: u64 = 32 << 10;
/// Memory below which no shape could be described.
const MIN_MEMORY: u64 = 256 << 20;

/// Why there is no usable configuration.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)]
pub enum ConfigError {
    #[error("{origin}: {message}")]
    Unreadable { origin: String, message: String },
    #[error("{origin}: unknown key {key:?}; the nearest known one is {nearest:?}")]
    UnknownKey {
        origin: String,
        key: String,
        nearest: String,
    },
    #[error("{key}: {message}")]
    Value { key: String, message: String },
}

/// All settings.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Config {
    /// Where the daemon listens and keeps things.
    pub server: Server,
    /// What browsers and monitoring reach.
    pub http: Http,
    /// How work is done.
    pub work: Work,
    /// What is refused beyond.
    pub limits: Limits,
    /// What may come in.
    pub ingest: Ingest,
    /// Who may connect.
    pub security: Security,
    /// What is told to the operator.
    pub log: Log,
}

/// Where the daemon listens and keeps things.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Server {
    /// URI of the request socket; empty: the default.
    pub endpoint: String,
    /// The folder of the library; empty: the default.
    pub library: PathBuf,
}

/// What browsers and monitoring reach.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Http {
    /// HOST:PORT to listen at; empty: nowhere.
    pub listen: String,
    /// Whether that may be an address that other machines reach.
    pub allow_remote: bool,
    /// Whether the viewer may change labels.
    pub edit: bool,
    /// File of the token that is asked for; empty: none on loopback, beyond it one in the folder of
    /// the library.
    pub token_file: PathBuf,
    /// Whether monitoring needs no token.
    pub open_monitoring: bool,
}

impl Http {
    /// The address to listen at, if there is one; `localhost` is 127.0.0.1.
    pub fn address(&self) -> Result<Option<SocketAddr>, ConfigError> {
        if self.listen.is_empty() {
            return Ok(None);
        }
        let refuse = |message: String| ConfigError::Value {
            key: "http.listen".to_owned(),
            message,
        };
        let numeric = match self.listen.strip_prefix("localhost:") {
            Some(port) => format!("127.0.0.1:{port}"),
            None => self.listen.clone(),
        };
        let address: SocketAddr = numeric
            .parse()
            .map_err(|_| refuse(format!("{:?} is not IP-ADDRESS:PORT", self.listen)))?;
        if !address.ip().is_loopback() && !self.allow_remote {
            return Err(refuse(format!(
                "{address} is not loopback; set http.allow_remote if other machines are to reach it: it asks for \
                 a token, but does not encrypt"
            )));
        }
        Ok(Some(address))
    }
}

/// How work is done.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Work {
    /// Threads that describe shapes; 0: one for each processor.
    pub workers: usize,
    /// Seconds that describing one shape may take.
    pub shape_seconds: u64,
}

/// What is refused beyond.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Limits {
    /// Memory for requests and work in hand.
    pub memory: ByteSize,
    /// Bytes of one message.
    pub max_message: ByteSize,
    /// Bytes of one shape's file.
    pub max_shape: ByteSize,
    /// Shapes of one request.
    pub max_shapes_per_request: usize,
    /// Accepted shapes that are not placed yet.
    pub max_queued_shapes: usize,
    /// Requests being answered or waiting for it.
    pub max_requests: usize,
    /// The same, of one client.
    pub max_requests_per_client: usize,
    /// Bytes of requests in hand of one client.
    pub max_bytes_per_client: ByteSize,
    /// Bytes of the files of accepted shapes that are not placed yet.
    pub max_queued_bytes: ByteSize,
    /// Seconds that placing all accepted shapes may take, as estimated.
    pub max_queued_seconds: u64,
}

/// What may come in.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Ingest {
    /// Directories below which AddShapes may name files.
    pub paths: Vec<PathBuf>,
}

/// Who may connect.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Security {
    /// Folder of keys; empty: none.
    pub keys: PathBuf,
}

/// What is told to the operator.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Log {
    /// A level or a filter.
    pub level: String,
    /// How lines look.
    pub format: LogFormat,
}

/// How log lines look.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LogFormat {
    /// For people.
    Human,
    /// One JSON object a line.
    Json,
}

/// What flags say, over file and environment.
#[derive(Debug, Clone, Default)]
pub struct Overrides {
    /// `--config`.
    pub file: Option<PathBuf>,
    /// `--endpoint` or COSEG_ENDPOINT.
    pub endpoint: Option<String>,
    /// `--library`.
    pub library: Option<PathBuf>,
    /// `--keys`.
    pub keys: Option<PathBuf>,
    /// `--http`.
    pub http: Option<String>,
    /// `--workers`.
    pub workers: Option<usize>,
    /// `--log-level`.
    pub log_level: Option<String>,
}

impl Default for Config {
    fn default() -> Self {
        let config = config::Config::builder()
            .add_source(config::File::from_str(DEFAULT, FileFormat::Toml))
            .build()
            .and_then(config::Config::try_deserialize);
        config.expect("invariant: the compiled-in default is valid, a test says so")
    }
}

impl Config {
    /// All layers, checked.
    pub fn load(overrides: &Overrides) -> Result<Self, ConfigError> {
        let known = keys_of(
            &config::File::from_str(DEFAULT, FileFormat::Toml),
            "defaults",
        )?;
        let mut builder =
            config::Config::builder().add_source(config::File::from_str(DEFAULT, FileFormat::Toml));
        let named = overrides.file.clone();
        let file = named.or_else(|| Some(SYSTEM_FILE.into()).filter(|f: &PathBuf| f.exists()));
        if let Some(file) = file {
            let origin = file.display().to_string();
            let text = std::fs::read_to_string(&file).map_err(|e| ConfigError::Unreadable {
                origin: origin.clone(),
                message: e.to_string(),
            })?;
            let source = config::File::from_str(&text, FileFormat::Toml);
            check_keys(&keys_of(&source, &origin)?, &known, &origin)?;
            builder = builder.add_source(source);
        }
        let environment = config::Environment::with_prefix(ENV_PREFIX)
            .prefix_separator(ENV_SEPARATOR)
            .separator(ENV_SEPARATOR)
            .list_separator(":")
            .with_list_parse_key("ingest.paths")
            .try_parsing(true);
        check_keys(
            &keys_of(&environment, "environment")?,
            &known,
            "environment",
        )?;
        builder = builder.add_source(environment);
        let merged = builder.build().and_then(config::Config::try_deserialize);
        let mut config: Self = merged.map_err(|e| ConfigError::Unreadable {
            origin: "configuration".to_owned(),
            message: e.to_string(),
        })?;
        if let Some(endpoint) = &overrides.endpoint {
            config.server.endpoint.clone_from(endpoint);
        }
        if let Some(library) = &overrides.library {
            config.server.library.clone_from(library);
        }
        if let Some(keys) = &overrides.keys {
            config.security.keys.clone_from(keys);
        }
        if let Some(listen) = &overrides.http {
            config.http.listen.clone_from(listen);
        }
        if let Some(workers) = overrides.workers {
            config.work.workers = workers;
        }
        if let Some(level) = &overrides.log_level {
            config.log.level.clone_from(level);
        }
        config.check()?;
        Ok(config)
    }

    fn check(&self) -> Result<(), ConfigError> {
        let refuse = |key: &str, message: String| {
            Err(ConfigError::Value {
                key: key.to_owned(),
                message,
            })
        };
        let at_least = |key: &str, found: usize, limit: usize| {
            if found >= limit {
                return Ok(());
            }
            refuse(key, format!("{found} is below the least value, {limit}"))
        };
        at_least(
            "limits.max_shapes_per_request",
            self.limits.max_shapes_per_request,
            1,
        )?;
        at_least("limits.max_queued_shapes", self.limits.max_queued_shapes, 1)?;
        at_least("limits.max_requests", self.limits.max_requests, 1)?;
        let per_client = self.limits.max_requests_per_client;
        at_least("limits.max_requests_per_client", per_client, 1)?;
        if self.limits.max_queued_seconds == 0 {
            let message = "0 is below the least value, 1".to_owned();
            return refuse("limits.max_queued_seconds", message);
        }
        if self.limits.memory.0 < MIN_MEMORY {
            let (found, limit) = (self.limits.memory, ByteSize(MIN_MEMORY));
            return refuse(
                "limits.memory",
                format!("{found} is below the least value, {limit}"),
            );
        }
        let quarter = ByteSize(self.limits.memory.0 / 4);
        if self.limits.max_message > quarter {
            let found = self.limits.max_message;
            let message = format!("{found} is above a quarter of limits.memory, {quarter}");
            return refuse("limits.max_message", message);
        }
        if self.limits.max_message.0 < 1 << 16 {
            let found = self.limits.max_message;
            return refuse(
                "limits.max_message",
                format!("{found} is below the least value, 64KiB"),
            );
        }
        for (key, found) in [
            (
                "limits.max_bytes_per_client",
                self.limits.max_bytes_per_client,
            ),
            ("limits.max_queued_bytes", self.limits.max_queued_bytes),
        ] {
            if found < self.limits.max_message {
                let limit = self.limits.max_message;
                return refuse(key, format!("{found} is below limits.max_message, {limit}"));
            }
        }
        if self.work.shape_seconds == 0 {
            return refuse(
                "work.shape_seconds",
                "0 is below the least value, 1".to_owned(),
            );
        }
        if let Err(e) = tracing_subscriber::EnvFilter::try_new(&self.log.level) {
            return refuse(
                "log.level",
                format!("{:?} is no level or filter: {e}", self.log.level),
            );
        }
        if let Some(path) = self.ingest.paths.iter().find(|p| !p.is_absolute()) {
            return refuse(
                "ingest.paths",
                format!("{:?} is not absolute", path.display()),
            );
        }
        self.http.address()?;
        if !self.server.endpoint.is_empty() {
            crate::ipc::endpoint::Endpoint::parse(&self.server.endpoint)
                .and_then(|e| e.check_servable(self.has_keys()))
                .map_err(|e| ConfigError::Value {
                    key: "server.endpoint".to_owned(),
                    message: e.to_string(),
                })?;
        }
        Ok(())
    }

    /// Whether every connection is to be encrypted and authenticated.
    pub fn has_keys(&self) -> bool {
        !self.security.keys.as_os_str().is_empty()
    }

    /// The library's folder: as set, or the default for this user.
    pub fn library(&self) -> Result<PathBuf, ConfigError> {
        library_directory(Some(&self.server.library).filter(|p| !p.as_os_str().is_empty()))
    }

    /// Threads that describe shapes.
    pub fn n_workers(&self) -> usize {
        match self.work.workers {
            0 => std::thread::available_parallelism().map_or(1, usize::from),
            n => n,
        }
    }
}

impl Limits {
    /// Bytes set aside for requests that have arrived.
    pub fn request_bytes(&self) -> u64 {
        self.memory.0 / 4
    }

    /// Bytes set aside for messages that arrive, before they are looked at: at least one of the largest.
    pub fn arriving_bytes(&self) -> u64 {
        (self.memory.0 / 8).max(self.max_message.0 + ARRIVING_BASE)
    }

    /// Bytes set aside for replies that are not sent yet: at least one of the largest.
    pub fn reply_bytes(&self) -> u64 {
        (self.memory.0 / 8).max(self.max_message.0)
    }

    /// Connections at a time for which there is memory, beside messages.
    pub fn connections(&self) -> u64 {
        self.memory.0 / 8 / CONNECTION
    }

    /// Bytes set aside for shapes being described and for prepared ones.
    pub fn describe_bytes(&self) -> u64 {
        self.memory.0 / 2
    }

    /// Bytes set aside for prepared shapes that the placing workers keep between pieces of work.
    pub fn prepared_bytes(&self) -> u64 {
        self.memory.0 / 8
    }

    /// Bytes set aside for what HTTP has in hand: a share, and the largest answer at least.
    pub fn http_bytes(&self) -> u64 {
        self.max_message.0.max(self.memory.0 / 8)
    }

    /// Bytes of one shape's file: as set, and so that it can be described at all.
    pub fn shape_bytes(&self) -> u64 {
        let describable = (self.describe_bytes() - DESCRIBE_BASE) / DESCRIBE_PER_BYTE;
        self.max_shape.0.min(describable)
    }

    /// Bytes of memory that describing a shape of `file_bytes` may take.
    pub fn to_describe(file_bytes: u64) -> u64 {
        DESCRIBE_BASE + DESCRIBE_PER_BYTE * file_bytes
    }
}

/// `named`, or the library's default folder for this user.
pub fn library_directory(named: Option<&PathBuf>) -> Result<PathBuf, ConfigError> {
    if let Some(path) = named {
        return Ok(path.clone());
    }
    let variable = |name: &str| {
        std::env::var_os(name)
            .filter(|v| !v.is_empty())
            .map(PathBuf::from)
            .filter(|p| p.is_absolute())
    };
    if let Some(state) = variable("STATE_DIRECTORY") {
        return Ok(state.join("library"));
    }
    variable("XDG_DATA_HOME")
        .or_else(|| variable("HOME").map(|home| home.join(".local/share")))
        .map(|data| data.join("coseg/library"))
        .ok_or_else(|| ConfigError::Value {
            key: "server.library".to_owned(),
            message: "neither it nor XDG_DATA_HOME nor HOME is set; name a folder with --library"
                .to_owned(),
        })
}

/// Full names of the keys a source sets.
fn keys_of(source: &dyn Source, origin: &str) -> Result<BTreeSet<String>, ConfigError> {
    fn flatten(prefix: &str, value: &Value, keys: &mut BTreeSet<String>) {
        match &value.kind {
            ValueKind::Table(table) => {
                for (key, value) in table {
                    flatten(&format!("{prefix}.{key}"), value, keys);
                }
            }
            _ => {
                keys.insert(prefix.trim_start_matches('.').to_owned());
            }
        }
    }
    let collected = source.collect().map_err(|e| ConfigError::Unreadable {
        origin: origin.to_owned(),
        message: e.to_string(),
    })?;
    let mut keys = BTreeSet::new();
    for (key, value) in &collected {
        flatten(key, value, &mut keys);
    }
    Ok(keys)
}

fn check_keys(
    keys: &BTreeSet<String>,
    known: &BTreeSet<String>,
    origin: &str,
) -> Result<(), ConfigError> {
    let Some(key) = keys.difference(known).next() else {
        return Ok(());
    };
    let nearest = known
        .iter()
        .min_by_key(|k| strsim::damerau_levenshtein(k, key));
    let nearest = nearest.expect("invariant: there are known keys").clone();
    let (key, nearest) = if origin == "environment" {
        (variable_name(key), variable_name(&nearest))
    } else {
        (key.clone(), nearest)
    };
    Err(ConfigError::UnknownKey {
        origin: origin.to_owned(),
        key,
        nearest,
    })
}

/// `work.workers` as `COSEG__WORK__WORKERS`.
fn variable_name(key: &str) -> String {
    format!(
        "{ENV_PREFIX}{ENV_SEPARATOR}{}",
        key.to_uppercase().replace('.', ENV_SEPARATOR)
    )
}

#[cfg(test)]
mod tests {
    use super::{ByteSize, Config, ConfigError, Limits, Overrides};
    use std::io::Write as _;

    fn load(text: &str) -> Result<Config, ConfigError> {
        let mut file = tempfile::NamedTempFile::new().unwrap();
        file.write_all(text.as_bytes()).unwrap();
        let overrides = Overrides {
            file: Some(file.path().to_owned()),
            ..Overrides::default()
        };
        Config::load(&overrides)
    }

    #[test]
    fn the_default_is_valid_and_a_file_overrides_it() {
        let default = load("").unwrap();
        assert_eq!(default, Config::default());
        let config = load("[limits]\nmemory = \"1GiB\"\n[work]\nworkers = 3\n").unwrap();
        assert_eq!(config.limits.memory, ByteSize(1 << 30));
        assert_eq!(config.n_workers(), 3);
        assert_eq!(config.log, default.log);
        let open = load("[http]\nlisten = \"[::]:80\"\nallow_remote = true\n").unwrap();
        assert!(open.http.address().unwrap().is_some());
    }

    #[test]
    fn unknown_keys_name_the_nearest_known_one() {
        let error = load("[work]\nworker = 3\n").unwrap_err().to_string();
        assert!(
            error.ends_with(
                "unknown key \"work.worker\"; the nearest known one is \"work.workers\""
            )
        );
        let error = load("memory = 3\n").unwrap_err().to_string();
        assert!(error.contains("unknown key \"memory\""), "{error}");
    }

    #[test]
    fn values_out_of_range_are_refused() {
        for (text, message) in [
            (
                "[limits]\nmemory = \"1MiB\"",
                "limits.memory: 1MiB is below the least value, 256MiB",
            ),
            (
                "[limits]\nmemory = \"lots\"",
                "\"lots\" is not a size such as 512MiB or 2GiB",
            ),
            (
                "[limits]\nmax_message = \"1GiB\"",
                "limits.max_message: 1GiB is above a quarter of limits.memory, 512MiB",
            ),
            (
                "[server]\nendpoint = \"tcp://0.0.0.0:1\"",
                "is not loopback",
            ),
            (
                "[server]\nendpoint = \"udp://127.0.0.1:1\"",
                "neither ipc://PATH nor tcp://HOST:PORT",
            ),
            (
                "[http]\nlisten = \"0.0.0.0:80\"",
                "http.listen: 0.0.0.0:80 is not loopback",
            ),
            (
                "[http]\nlisten = \"80\"",
                "http.listen: \"80\" is not IP-ADDRESS:PORT",
            ),
            ("[log]\nlevel = \"coseg=loud\"", "log.level"),
            ("[log]\nformat = \"xml\"", "format"),
            ("[ingest]\npaths = [\"relative\"]", "is not absolute"),
            ("[work]\nworkers = \"many\"", "workers"),
            ("[work", "TOML"),
        ] {
            let error = load(text).unwrap_err().to_string();
            assert!(error.contains(message), "{text}: {error}");
        }
    }

    #[test]
    fn a_shape_of_the_largest_size_can_be_described() {
        let limits = Config::default().limits;
        assert!(Limits::to_describe(limits.shape_bytes()) <= limits.describe_bytes());
    }
}
