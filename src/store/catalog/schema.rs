//! Defines the catalog's tables, their versions, and a checksum for every row.
//!
//! SQLite checks the structure of its pages, but not the values in them. So every row has a column
//! `sum`, the first eight bytes of a BLAKE3 over its other columns. Triggers maintain it, and every
//! read compares it: a flipped bit becomes an error that names the row, never a wrong answer.

use crate::store::StoreError;
use crate::store::error::CATALOG_FILE;
use rusqlite::functions::FunctionFlags;
use rusqlite::types::ValueRef;
use rusqlite::{Connection, params};

/// Version of the catalog's tables; newer ones are rejected.
pub const CATALOG_FORMAT: u32 = 6;

/// The format before corrections: it lacks the tables in [`SINCE_FORMAT_2`].
const WITHOUT_CORRECTIONS: u32 = 1;

/// The format before maps had a confidence for each vertex: it lacks the tables in
/// [`SINCE_FORMAT_3`].
const WITHOUT_CONFIDENCE: u32 = 2;

/// The format before verdicts of persons: it lacks the tables in [`SINCE_FORMAT_4`].
const WITHOUT_REVIEWS: u32 = 3;

/// The format before proposals: it lacks the tables in [`SINCE_FORMAT_5`].
const WITHOUT_PROPOSALS: u32 = 4;
/// The format before links between parts: it lacks the table in [`SINCE_FORMAT_6`].
const WITHOUT_LINKS: u32 = 5;

/// `cseg`, the application id in the header of the SQLite file.
const APPLICATION_ID: u32 = u32::from_be_bytes(*b"cseg");

/// A table: its key, all its columns except `sum`, and the rest of its definition.
pub(crate) struct Table {
    pub(crate) name: &'static str,
    /// The first `n_key` columns name a row.
    pub(crate) n_key: usize,
    pub(crate) columns: &'static [&'static str],
    definition: &'static str,
}

impl Table {
    /// `SELECT` of all columns, and of whether the sum is right.
    pub(crate) fn select(&self, tail: &str) -> String {
        let columns = self.columns.join(", ");
        format!(
            "SELECT {columns}, row_sum({columns}) IS sum FROM {} {tail}",
            self.name
        )
    }

    /// `INSERT` of all columns, numbered in order.
    pub(crate) fn insert(&self) -> String {
        let places: Vec<String> = (1..=self.columns.len()).map(|i| format!("?{i}")).collect();
        let (columns, places) = (self.columns.join(", "), places.join(", "));
        format!("INSERT INTO {} ({columns}) VALUES ({places})", self.name)
    }

    fn create(&self) -> String {
        let Self {
            name,
            definition,
            columns,
            ..
        } = self;
        let new: Vec<String> = columns
            .iter()
            .map(|column| format!("NEW.{column}"))
            .collect();
        let (columns, new) = (columns.join(", "), new.join(", "));
        let set =
            format!("BEGIN UPDATE {name} SET sum = row_sum({new}) WHERE rowid = NEW.rowid; END;");
        format!(
            "CREATE TABLE {name} ({definition}) STRICT;
             CREATE TRIGGER {name}_inserted AFTER INSERT ON {name} {set}
             CREATE TRIGGER {name}_updated AFTER UPDATE OF {columns} ON {name} {set}"
        )
    }
}

macro_rules! tables {
    ($(
        $const:ident $name:literal key $n_key:literal
        [$($column:literal),+ $(,)?] $definition:literal
    )+) => {
        $(pub(crate) const $const: Table = Table {
            name: $name,
            n_key: $n_key,
            columns: &[$($column),+],
            definition: $definition,
        };)+
        /// All tables, referenced ones before those that refer to them.
        pub(crate) const TABLES: &[&Table] = &[$(&$const),+];
    };
}

tables! {
    META "meta" key 1 ["key", "value"]
    "key TEXT PRIMARY KEY, value TEXT NOT NULL, sum INTEGER"

    STREAMS "streams" key 1 ["id", "name", "sequence"]
    "id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE, sequence INTEGER NOT NULL, sum INTEGER"

    EVENTS "events" key 2 ["stream_id", "sequence", "kind", "payload"]
    "stream_id INTEGER NOT NULL REFERENCES streams, sequence INTEGER NOT NULL,
     kind TEXT NOT NULL, payload TEXT NOT NULL, sum INTEGER, PRIMARY KEY (stream_id, sequence)"

    COLLECTIONS "collections" key 1 [
        "id", "name", "stream_id", "n_parts", "up", "operator", "working_faces", "next_ordinal",
        "next_label", "epoch", "state",
    ]
    "id INTEGER PRIMARY KEY AUTOINCREMENT, name TEXT NOT NULL UNIQUE,
     stream_id INTEGER NOT NULL REFERENCES streams, n_parts INTEGER, up TEXT NOT NULL,
     operator TEXT NOT NULL, working_faces INTEGER NOT NULL, next_ordinal INTEGER NOT NULL,
     next_label INTEGER NOT NULL, epoch INTEGER NOT NULL, state BLOB NOT NULL, sum INTEGER"

    MODELS "models" key 1 ["collection_id", "model"]
    "collection_id INTEGER PRIMARY KEY REFERENCES collections ON DELETE CASCADE,
     model BLOB NOT NULL, sum INTEGER"

    LABELS "labels" key 2 ["collection_id", "id", "name", "colour", "merged_into"]
    "collection_id INTEGER NOT NULL REFERENCES collections ON DELETE CASCADE, id INTEGER NOT NULL,
     name TEXT, colour INTEGER NOT NULL, merged_into INTEGER, sum INTEGER,
     PRIMARY KEY (collection_id, id)"

    OBJECTS "objects" key 2 ["kind", "digest", "file", "length", "blake3"]
    "kind TEXT NOT NULL, digest TEXT NOT NULL, file TEXT NOT NULL UNIQUE, length INTEGER NOT NULL,
     blake3 TEXT NOT NULL, sum INTEGER, PRIMARY KEY (kind, digest)"

    SHAPES "shapes" key 1 [
        "id", "collection_id", "name", "ordinal", "content_digest", "format", "description_digest",
        "n_polygons", "area", "report", "version", "label_epoch", "stale", "parts", "sources",
        "stored_bytes",
    ]
    "id INTEGER PRIMARY KEY AUTOINCREMENT,
     collection_id INTEGER NOT NULL REFERENCES collections ON DELETE CASCADE, name TEXT NOT NULL,
     ordinal INTEGER NOT NULL, content_digest TEXT NOT NULL, format TEXT NOT NULL,
     description_digest TEXT NOT NULL, n_polygons INTEGER NOT NULL, area REAL NOT NULL,
     report TEXT NOT NULL, version INTEGER NOT NULL, label_epoch INTEGER NOT NULL,
     stale INTEGER NOT NULL, parts TEXT NOT NULL, sources TEXT NOT NULL,
     stored_bytes INTEGER NOT NULL, sum INTEGER,
     UNIQUE (collection_id, name), UNIQUE (collection_id, ordinal)"

    SHAPE_LABELS "shape_labels" key 2 ["shape_id", "label", "area_share"]
    "shape_id INTEGER NOT NULL REFERENCES shapes ON DELETE CASCADE, label INTEGER NOT NULL,
     area_share REAL NOT NULL, sum INTEGER, PRIMARY KEY (shape_id, label)"

    SHAPE_SIGNATURES "shape_signatures" key 1 ["shape_id", "signature"]
    "shape_id INTEGER PRIMARY KEY REFERENCES shapes ON DELETE CASCADE, signature BLOB NOT NULL,
     sum INTEGER"

    SHAPE_STATS "shape_stats" key 1 ["shape_id", "epoch", "stats"]
    "shape_id INTEGER PRIMARY KEY REFERENCES shapes ON DELETE CASCADE, epoch INTEGER NOT NULL,
     stats BLOB NOT NULL, sum INTEGER"

    LABEL_VERSIONS "label_versions" key 2 [
        "shape_id", "version", "sequence", "cause", "proxy_labels", "proxy_probabilities",
        "polygon_labels", "polygon_confidence", "sources",
    ]
    "shape_id INTEGER NOT NULL REFERENCES shapes ON DELETE CASCADE, version INTEGER NOT NULL,
     sequence INTEGER NOT NULL, cause TEXT NOT NULL, proxy_labels BLOB NOT NULL,
     proxy_probabilities BLOB NOT NULL, polygon_labels BLOB NOT NULL,
     polygon_confidence BLOB NOT NULL, sources TEXT NOT NULL, sum INTEGER,
     PRIMARY KEY (shape_id, version)"

    PINS "pins" key 1 ["shape_id", "polygon_labels"]
    "shape_id INTEGER PRIMARY KEY REFERENCES shapes ON DELETE CASCADE,
     polygon_labels BLOB NOT NULL, sum INTEGER"

    CORRECTIONS "corrections" key 1 ["id", "collection_id", "kind", "detail", "before"]
    "id INTEGER PRIMARY KEY AUTOINCREMENT,
     collection_id INTEGER NOT NULL REFERENCES collections ON DELETE CASCADE, kind TEXT NOT NULL,
     detail TEXT NOT NULL, before BLOB NOT NULL, sum INTEGER"

    REVIEWS "reviews" key 1 ["shape_id", "state", "reviewer", "unix_ms"]
    "shape_id INTEGER PRIMARY KEY REFERENCES shapes ON DELETE CASCADE, state TEXT NOT NULL,
     reviewer TEXT NOT NULL, unix_ms INTEGER NOT NULL, sum INTEGER"

    PASSED_PARTS "passed_parts" key 2 ["shape_id", "part", "why"]
    "shape_id INTEGER NOT NULL REFERENCES shapes ON DELETE CASCADE, part INTEGER NOT NULL,
     why TEXT NOT NULL, sum INTEGER, PRIMARY KEY (shape_id, part)"

    CANDIDATES "candidates" key 2 ["collection_id", "n_labels", "basis", "found"]
    "collection_id INTEGER NOT NULL REFERENCES collections ON DELETE CASCADE,
     n_labels INTEGER NOT NULL, basis TEXT NOT NULL, found BLOB NOT NULL, sum INTEGER,
     PRIMARY KEY (collection_id, n_labels)"

    PROPOSALS "proposals" key 2 ["collection_id", "n", "basis", "n_labels", "value", "labels"]
    "collection_id INTEGER NOT NULL REFERENCES collections ON DELETE CASCADE, n INTEGER NOT NULL,
     basis TEXT NOT NULL, n_labels INTEGER NOT NULL, value REAL NOT NULL, labels BLOB NOT NULL,
     sum INTEGER, PRIMARY KEY (collection_id, n)"

    LINKS "links" key 1 [
        "id", "collection_id", "kind", "shape_a", "part_a", "polygons_a", "shape_b", "part_b",
        "polygons_b", "person", "unix_ms",
    ]
    "id INTEGER PRIMARY KEY AUTOINCREMENT,
     collection_id INTEGER NOT NULL REFERENCES collections ON DELETE CASCADE, kind TEXT NOT NULL,
     shape_a INTEGER NOT NULL REFERENCES shapes ON DELETE CASCADE, part_a INTEGER NOT NULL,
     polygons_a BLOB NOT NULL,
     shape_b INTEGER NOT NULL REFERENCES shapes ON DELETE CASCADE, part_b INTEGER NOT NULL,
     polygons_b BLOB NOT NULL, person TEXT NOT NULL, unix_ms INTEGER NOT NULL, sum INTEGER"

    LABELS_BEFORE "labels_before" key 2 [
        "correction_id", "shape_id", "version", "label_epoch", "parts", "area_shares",
    ]
    "correction_id INTEGER NOT NULL REFERENCES corrections ON DELETE CASCADE,
     shape_id INTEGER NOT NULL REFERENCES shapes ON DELETE CASCADE, version INTEGER NOT NULL,
     label_epoch INTEGER NOT NULL, parts TEXT NOT NULL, area_shares TEXT NOT NULL, sum INTEGER,
     PRIMARY KEY (correction_id, shape_id)"

    MAPS "maps" key 2 ["from_shape", "to_shape", "k1", "k2", "c_12", "p2p_21", "quality"]
    "from_shape INTEGER NOT NULL REFERENCES shapes ON DELETE CASCADE,
     to_shape INTEGER NOT NULL REFERENCES shapes ON DELETE CASCADE, k1 INTEGER NOT NULL,
     k2 INTEGER NOT NULL, c_12 BLOB NOT NULL, p2p_21 BLOB NOT NULL, quality TEXT NOT NULL,
     sum INTEGER, PRIMARY KEY (from_shape, to_shape)"

    MAP_CONFIDENCE "map_confidence" key 2 ["from_shape", "to_shape", "of_vertex"]
    "from_shape INTEGER NOT NULL, to_shape INTEGER NOT NULL, of_vertex BLOB NOT NULL, sum INTEGER,
     PRIMARY KEY (from_shape, to_shape),
     FOREIGN KEY (from_shape, to_shape) REFERENCES maps ON DELETE CASCADE"

    POINT_MAPS "point_maps" key 4 [
        "from_shape", "to_shape", "request", "rank", "k", "c_12", "p2p_21", "matched", "detail",
    ]
    "from_shape INTEGER NOT NULL REFERENCES shapes ON DELETE CASCADE,
     to_shape INTEGER NOT NULL REFERENCES shapes ON DELETE CASCADE, request TEXT NOT NULL,
     rank INTEGER NOT NULL, k INTEGER NOT NULL, c_12 BLOB NOT NULL, p2p_21 BLOB NOT NULL,
     matched BLOB NOT NULL, detail TEXT NOT NULL, sum INTEGER,
     PRIMARY KEY (from_shape, to_shape, request, rank)"

    JOBS "jobs" key 1 ["id", "collection", "created"]
    "id INTEGER PRIMARY KEY AUTOINCREMENT, collection TEXT NOT NULL, created INTEGER NOT NULL,
     sum INTEGER"

    JOB_ITEMS "job_items" key 2 [
        "job_id", "idx", "name", "original_digest", "format", "replace_existing",
        "status", "detail",
    ]
    "job_id INTEGER NOT NULL REFERENCES jobs ON DELETE CASCADE, idx INTEGER NOT NULL,
     name TEXT NOT NULL, original_digest TEXT NOT NULL, format TEXT NOT NULL,
     replace_existing INTEGER NOT NULL, status TEXT NOT NULL, detail TEXT, sum INTEGER,
     PRIMARY KEY (job_id, idx)"

    REQUESTS "requests" key 2 ["client_id", "request_id", "request_digest", "reply", "created"]
    "client_id TEXT NOT NULL, request_id TEXT NOT NULL, request_digest TEXT NOT NULL,
     reply BLOB NOT NULL, created INTEGER NOT NULL, sum INTEGER,
     PRIMARY KEY (client_id, request_id)"
}

/// Tables that format 2 added.
const SINCE_FORMAT_2: [&Table; 3] = [&PINS, &CORRECTIONS, &LABELS_BEFORE];

/// Indexes of these tables.
const INDEXES_SINCE_FORMAT_2: &str = "
    CREATE INDEX corrections_by_collection ON corrections (collection_id, id);
    CREATE INDEX labels_before_by_shape ON labels_before (shape_id, version);
";

/// Tables that format 3 added.
const SINCE_FORMAT_3: [&Table; 2] = [&MAP_CONFIDENCE, &POINT_MAPS];

/// Indexes of these tables.
const INDEXES_SINCE_FORMAT_3: &str = "
    CREATE INDEX point_maps_by_to ON point_maps (to_shape);
";

/// Tables that format 4 added.
const SINCE_FORMAT_4: [&Table; 2] = [&REVIEWS, &PASSED_PARTS];

/// Tables that format 5 added.
const SINCE_FORMAT_5: [&Table; 2] = [&CANDIDATES, &PROPOSALS];

/// The table that format 6 added.
const SINCE_FORMAT_6: [&Table; 1] = [&LINKS];

/// Indexes of this table, by which the removal of a shape finds its links.
const INDEXES_SINCE_FORMAT_6: &str = "
    CREATE INDEX links_by_collection ON links (collection_id, id);
    CREATE INDEX links_by_a ON links (shape_a);
    CREATE INDEX links_by_b ON links (shape_b);
";

const INDEXES: &str = "
    CREATE INDEX stale_shapes ON shapes (collection_id, ordinal) WHERE stale;
    CREATE INDEX shapes_by_content ON shapes (content_digest);
    CREATE INDEX shapes_by_description ON shapes (description_digest);
    CREATE INDEX shapes_by_label ON shape_labels (label, shape_id);
    CREATE INDEX maps_by_to ON maps (to_shape);
    CREATE INDEX queued_items ON job_items (job_id, idx) WHERE status = 'queued';
    CREATE INDEX queued_originals ON job_items (original_digest) WHERE status = 'queued';
    CREATE INDEX requests_by_time ON requests (created);
";

/// Defines the function `row_sum` on a connection: the first eight bytes of a BLAKE3 over the type,
/// length and bytes of each argument.
pub(in crate::store) fn register_row_sum(connection: &Connection) -> rusqlite::Result<()> {
    let flags = FunctionFlags::SQLITE_UTF8
        | FunctionFlags::SQLITE_DETERMINISTIC
        | FunctionFlags::SQLITE_INNOCUOUS;
    connection.create_scalar_function("row_sum", -1, flags, |context| {
        let mut hasher = blake3::Hasher::new();
        for i in 0..context.len() {
            let mut add = |kind: u8, bytes: &[u8]| {
                hasher.update(&[kind]);
                hasher.update(&(bytes.len() as u64).to_le_bytes());
                hasher.update(bytes);
            };
            match context.get_raw(i) {
                ValueRef::Null => add(0, &[]),
                ValueRef::Integer(value) => add(1, &value.to_le_bytes()),
                ValueRef::Real(value) => add(2, &value.to_le_bytes()),
                ValueRef::Text(bytes) => add(3, bytes),
                ValueRef::Blob(bytes) => add(4, bytes),
            }
        }
        let mut first = [0; 8];
        hasher.finalize_xof().fill(&mut first);
        Ok(i64::from_le_bytes(first))
    })
}

/// Brings an empty file to the current format; rejects files that are not a catalog, or newer.
pub(super) fn prepare(connection: &mut Connection, path: &str) -> Result<(), StoreError> {
    let n_tables: i64 =
        connection.query_row("SELECT count(*) FROM sqlite_schema", [], |row| row.get(0))?;
    if n_tables > 0 {
        upgrade(connection)?;
        return check_format(connection, path);
    }
    let tx = connection.transaction()?;
    for table in TABLES {
        tx.execute_batch(&table.create())?;
    }
    tx.execute_batch(INDEXES)?;
    tx.execute_batch(INDEXES_SINCE_FORMAT_2)?;
    tx.execute_batch(INDEXES_SINCE_FORMAT_3)?;
    tx.execute_batch(INDEXES_SINCE_FORMAT_6)?;
    tx.execute(
        "INSERT INTO meta (key, value) VALUES ('library_id', lower(hex(randomblob(16)))), (?1, ?2)",
        params!["format", CATALOG_FORMAT.to_string()],
    )?;
    tx.pragma_update(None, "application_id", APPLICATION_ID)?;
    tx.pragma_update(None, "user_version", CATALOG_FORMAT)?;
    tx.commit()?;
    Ok(())
}

/// Upgrades a catalog of an older format to this one, in one transaction; leaves others unchanged.
fn upgrade(connection: &mut Connection) -> Result<(), StoreError> {
    let pragma = |name: &str| -> rusqlite::Result<u32> {
        connection.pragma_query_value(None, name, |row| row.get(0))
    };
    let found = pragma("user_version")?;
    let is_old = matches!(
        found,
        WITHOUT_CORRECTIONS
            | WITHOUT_CONFIDENCE
            | WITHOUT_REVIEWS
            | WITHOUT_PROPOSALS
            | WITHOUT_LINKS
    );
    if pragma("application_id")? != APPLICATION_ID || !is_old {
        return Ok(());
    }
    let tx = connection.transaction()?;
    if found == WITHOUT_CORRECTIONS {
        for table in SINCE_FORMAT_2 {
            tx.execute_batch(&table.create())?;
        }
        tx.execute_batch(INDEXES_SINCE_FORMAT_2)?;
    }
    if found < WITHOUT_REVIEWS {
        for table in SINCE_FORMAT_3 {
            tx.execute_batch(&table.create())?;
        }
        tx.execute_batch(INDEXES_SINCE_FORMAT_3)?;
    }
    if found < WITHOUT_PROPOSALS {
        for table in SINCE_FORMAT_4 {
            tx.execute_batch(&table.create())?;
        }
    }
    if found < WITHOUT_LINKS {
        for table in SINCE_FORMAT_5 {
            tx.execute_batch(&table.create())?;
        }
    }
    for table in SINCE_FORMAT_6 {
        tx.execute_batch(&table.create())?;
    }
    tx.execute_batch(INDEXES_SINCE_FORMAT_6)?;
    tx.execute(
        "UPDATE meta SET value = ?1 WHERE key = 'format'",
        [CATALOG_FORMAT.to_string()],
    )?;
    tx.pragma_update(None, "user_version", CATALOG_FORMAT)?;
    tx.commit()?;
    Ok(())
}

/// Rejects files that are not a catalog of a supported format.
pub(in crate::store) fn check_format(
    connection: &Connection,
    path: &str,
) -> Result<(), StoreError> {
    let pragma = |name: &str| -> rusqlite::Result<u32> {
        connection.pragma_query_value(None, name, |row| row.get(0))
    };
    let application = pragma("application_id")?;
    if application != APPLICATION_ID {
        return Err(StoreError::Damaged {
            path: CATALOG_FILE.into(),
            message: format!(
                "application id {application:#x}, but a catalog has {APPLICATION_ID:#x}"
            ),
        });
    }
    match pragma("user_version")? {
        CATALOG_FORMAT => Ok(()),
        found => Err(StoreError::Version {
            path: path.to_string(),
            found,
            supported: CATALOG_FORMAT,
        }),
    }
}
