//! Merges defaults, a file, the environment and flags into one validated [`Config`].
//!
//! The compiled-in default is `config/coseg.toml` itself, so its comments cannot drift from the
//! code: a key is known if and only if that file has it.

mod size;
pub use size::ByteSize;

use config::{FileFormat, Source, Value, ValueKind};
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::path::PathBuf;

/// The default settings, commented.
pub const DEFAULT: &str = include_str!("../config/coseg.toml");
/// The file that is read if it exists and no other file is named.
pub const SYSTEM_FILE: &str = "/etc/coseg/coseg.toml";
/// Prefix of environment variables for settings: `COSEG__SECTION__KEY`.
const ENV_PREFIX: &str = "COSEG";
const ENV_SEPARATOR: &str = "__";
/// Memory that describing a shape takes regardless of its size, and memory for each byte of its
/// file. Text of about 30 bytes for each vertex and 20 for each face becomes parsed, cleaned and
/// indexed copies, then a proxy of fixed size with its spectrum.
const DESCRIBE_BASE: u64 = 64 << 20;
const DESCRIBE_PER_BYTE: u64 = 12;
/// Memory that the frames of a message take besides their contents.
const ARRIVING_BASE: u64 = 8 << 20;
/// Memory that a connection takes, regardless of its messages: 24 kB were measured.
const CONNECTION: u64 = 32 << 10;
/// Memory below which no shape could be described.
const MIN_MEMORY: u64 = 256 << 20;

/// The reason why there is no usable configuration.
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
    /// The addresses and the folder of the daemon.
    pub server: Server,
    /// The endpoint for browsers and monitoring.
    pub http: Http,
    /// The work on shapes.
    pub work: Work,
    /// The limits beyond which requests are refused.
    pub limits: Limits,
    /// The sources of shapes.
    pub ingest: Ingest,
    /// Access control.
    pub security: Security,
    /// The log for the operator.
    pub log: Log,
}

/// The addresses and the folder of the daemon.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Server {
    /// URI of the request socket; empty: the default.
    pub endpoint: String,
    /// The folder of the library; empty: the default.
    pub library: PathBuf,
}

/// The endpoint for browsers and monitoring.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Http {
    /// HOST:PORT to listen at; empty: no endpoint.
    pub listen: String,
    /// Whether `listen` may be an address that other machines reach.
    pub allow_remote: bool,
    /// Whether the viewer may change labels.
    pub edit: bool,
    /// File of the token that clients must send; empty: no token on loopback, and one in the folder
    /// of the library beyond it.
    pub token_file: PathBuf,
    /// Whether monitoring needs no token.
    pub open_monitoring: bool,
}

impl Http {
    /// The address to listen at, if one is set; `localhost` is 127.0.0.1.
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
                "{address} is not loopback; set http.allow_remote if other machines are to reach \
                 it: it asks for a token, but does not encrypt"
            )));
        }
        Ok(Some(address))
    }
}

/// The work on shapes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Work {
    /// Number of threads that describe shapes; 0: one for each processor.
    pub workers: usize,
    /// Time limit in seconds for describing one shape.
    pub shape_seconds: u64,
}

/// The limits beyond which requests are refused.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Limits {
    /// Memory for requests and unfinished work.
    pub memory: ByteSize,
    /// Maximum size of one message.
    pub max_message: ByteSize,
    /// Maximum size of one shape's file.
    pub max_shape: ByteSize,
    /// Maximum number of shapes of one request.
    pub max_shapes_per_request: usize,
    /// Maximum number of accepted shapes that are not yet placed.
    pub max_queued_shapes: usize,
    /// Maximum number of requests that are being answered or wait for it.
    pub max_requests: usize,
    /// Maximum number of these requests of one client.
    pub max_requests_per_client: usize,
    /// Maximum size of the unfinished requests of one client.
    pub max_bytes_per_client: ByteSize,
    /// Maximum size of the files of accepted shapes that are not yet placed.
    pub max_queued_bytes: ByteSize,
    /// Maximum estimated time in seconds for placing all accepted shapes.
    pub max_queued_seconds: u64,
}

/// The sources of shapes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Ingest {
    /// Directories below which AddShapes may name files.
    pub paths: Vec<PathBuf>,
}

/// Access control.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Security {
    /// Folder of keys; empty: no keys.
    pub keys: PathBuf,
}

/// The log for the operator.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Log {
    /// A level or a filter.
    pub level: String,
    /// The format of lines.
    pub format: LogFormat,
}

/// The formats of log lines.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LogFormat {
    /// Text for people.
    Human,
    /// One JSON object on each line.
    Json,
}

/// The values of flags, which override file and environment.
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
    /// Merges all layers and validates the result.
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

    /// Whether every connection must be encrypted and authenticated.
    pub fn has_keys(&self) -> bool {
        !self.security.keys.as_os_str().is_empty()
    }

    /// The library's folder: the configured one, or the default for this user.
    pub fn library(&self) -> Result<PathBuf, ConfigError> {
        library_directory(Some(&self.server.library).filter(|p| !p.as_os_str().is_empty()))
    }

    /// Number of threads that describe shapes.
    pub fn n_workers(&self) -> usize {
        match self.work.workers {
            0 => std::thread::available_parallelism().map_or(1, usize::from),
            n => n,
        }
    }
}

impl Limits {
    /// Bytes reserved for requests that have arrived.
    pub fn request_bytes(&self) -> u64 {
        self.memory.0 / 4
    }

    /// Bytes reserved for messages that are arriving, before they are read: at least one of the
    /// largest.
    pub fn arriving_bytes(&self) -> u64 {
        (self.memory.0 / 8).max(self.max_message.0 + ARRIVING_BASE)
    }

    /// Bytes reserved for replies that are not yet sent: at least one of the largest.
    pub fn reply_bytes(&self) -> u64 {
        (self.memory.0 / 8).max(self.max_message.0)
    }

    /// Number of simultaneous connections for which there is memory, beside messages.
    pub fn connections(&self) -> u64 {
        self.memory.0 / 8 / CONNECTION
    }

    /// Bytes reserved for shapes that are being described and for prepared ones.
    pub fn describe_bytes(&self) -> u64 {
        self.memory.0 / 2
    }

    /// Bytes reserved for prepared shapes that the placing workers keep between pieces of work.
    pub fn prepared_bytes(&self) -> u64 {
        self.memory.0 / 8
    }

    /// Bytes reserved for the work of HTTP: a share, and at least the largest answer.
    pub fn http_bytes(&self) -> u64 {
        self.max_message.0.max(self.memory.0 / 8)
    }

    /// Maximum size of one shape's file: the configured one, reduced if the shape could not be
    /// described.
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

/// Full names of the keys that a source sets.
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

/// The environment variable of a key: `COSEG__WORK__WORKERS` for `work.workers`.
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
