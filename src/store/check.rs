//! Verifies everything on disk against the catalog.
//!
//! It only reads, and may run beside the daemon: it sees the catalog at one moment, and a missing
//! file counts only if its row still exists afterwards.

use super::agreement::KeptMaps;
use super::catalog::KEPT_LABEL_VERSIONS;
use super::catalog::schema::TABLES;
use super::catalog::witness::{self, Found, WITNESS_FILE, Witness};
use super::catalog::{self, Reader};
use super::disk::{Disk, RealDisk};
use super::error::CATALOG_FILE;
use super::objects::{FOLDERS, map_description, read_original, relative};
use super::rows::{CollectionId, ObjectKind, ObjectRow, ShapeId, ShapeRow};
use super::{Digest, StoreError};
use rusqlite::Connection;
use rusqlite::types::FromSql;
use std::collections::{HashMap, HashSet};
use std::path::Path;

/// A fault or a note about one file or row.
#[derive(Debug, Clone, PartialEq)]
pub struct Finding {
    /// The file, relative to the library, or the table and key.
    pub location: String,
    /// The fault.
    pub message: String,
    /// Whether data are lost or wrong. It is false for orphans that the next sweep removes, and for
    /// maps that disagree with others.
    pub damage: bool,
}

/// The data of a description that rows refer to.
struct Arrays {
    n_polygons: u64,
    n_vertices: usize,
    n_faces: usize,
}

/// Verifies the library in `dir`: the catalog's pages and references, the sum of every row, every
/// object file's length, BLAKE3 and content, and that shapes, labels, maps and events fit together.
///
/// Damage is a finding, not an error: errors mean that the search for damage failed. The check
/// takes about as long as reading all files once.
pub fn check(dir: &Path) -> Result<Vec<Finding>, StoreError> {
    let mut findings = Findings::default();
    let path = catalog::path_in(dir);
    std::fs::metadata(dir).map_err(|e| StoreError::io(dir, e))?;
    let witness = Witness::read(&path)?;
    if let Found::Damaged(what) = &witness {
        findings.damage(WITNESS_FILE, what);
    }
    let shortfall = witness::shortfall(&path)?;
    let is_short = shortfall.is_some();
    if let Some(shortfall) = shortfall {
        findings.damage(CATALOG_FILE, shortfall.what);
    }
    if !path.is_file() {
        findings.damage(CATALOG_FILE, "the catalog is missing");
        return Ok(findings.list);
    }
    let log = catalog::log_of(&path);
    if let Some(message) = catalog::log::damage(&log).map_err(|e| StoreError::io(&log, e))? {
        findings.damage(relative(dir, &log), message);
    }
    let connection = match catalog::open_reader(&path) {
        Ok(connection) => connection,
        Err(error) if error.is_damage() => {
            findings.error(&error);
            return Ok(findings.list);
        }
        Err(error) => return Err(error),
    };
    // One snapshot serves all queries of the catalog, while writers continue.
    connection.execute_batch("BEGIN")?;
    let reader = Reader::new(&connection);
    findings.take(CATALOG_FILE, |f| check_pages(&connection, f));
    findings.take(CATALOG_FILE, |f| check_sums(&connection, f));
    let mut rows = Vec::new();
    findings.take("objects", |f| {
        for (kind, digest) in keys::<ObjectKind, Digest>(&connection, "objects", "kind, digest")? {
            rows.extend(f.keep(reader.object(kind, &digest)).flatten());
        }
        Ok(())
    });
    let mut arrays = HashMap::new();
    for row in &rows {
        if let Err(error) = check_object(dir, row, &mut arrays) {
            if file_is_missing(dir, row) && !still_catalogued(&path, row)? {
                continue;
            }
            findings.error(&error);
        }
    }
    findings.take("shapes", |f| check_shapes(&connection, &reader, &arrays, f));
    findings.take("maps", |f| check_maps(&connection, &reader, &arrays, f));
    findings.take("collections", |f| {
        check_collections(&connection, &reader, f)
    });
    findings.take("events", |f| check_events(&connection, f));
    findings.take("jobs", |f| check_jobs(&connection, &reader, f));
    drop(connection);
    let n_orphans = check_orphans(dir, &rows, &path, &mut findings)?;
    let text = format!("{n_orphans} shapes are in the store and not in the catalog");
    match witness {
        _ if n_orphans == 0 => {}
        _ if is_short => findings.damage("originals", text),
        // With an intact witness these are interrupted additions, and nothing else.
        Found::Whole(_) => {}
        Found::Missing | Found::Damaged(_) => findings.note(
            "originals".into(),
            format!(
                "{text}, and without {WITNESS_FILE} it is unknown whether the catalog held them: \
                 if these are more than were being added at one time, restore a snapshot"
            ),
        ),
    }
    Ok(findings.list)
}

/// The findings so far, without duplicates: one cause may be found in several ways.
#[derive(Default)]
struct Findings {
    list: Vec<Finding>,
    seen: HashSet<(String, String)>,
}

impl Findings {
    fn damage(&mut self, location: impl Into<String>, message: impl Into<String>) {
        let (location, message) = (location.into(), message.into());
        if self.seen.insert((location.clone(), message.clone())) {
            self.list.push(Finding {
                location,
                message,
                damage: true,
            });
        }
    }

    fn note(&mut self, location: String, message: String) {
        self.list.push(Finding {
            location,
            message,
            damage: false,
        });
    }

    fn error(&mut self, error: &StoreError) {
        match error {
            StoreError::Damaged { path, message } => self.damage(path, message),
            StoreError::DamagedRow {
                table,
                key,
                message,
            } => {
                self.damage(format!("{table} {key}"), message);
            }
            StoreError::Io { path, source } => self.damage(path, source.to_string()),
            error => self.damage(CATALOG_FILE, error.to_string()),
        }
    }

    /// Runs one part; an error that stops it becomes a finding, and the next part runs.
    fn take(&mut self, location: &str, part: impl FnOnce(&mut Self) -> Result<(), StoreError>) {
        match part(self) {
            Ok(()) => {}
            Err(StoreError::Catalog(error)) => {
                self.damage(location, format!("cannot be read: {error}"));
            }
            Err(error) => self.error(&error),
        }
    }

    /// The value, or a finding in its place.
    fn keep<T>(&mut self, value: Result<T, StoreError>) -> Option<T> {
        value.map_err(|error| self.error(&error)).ok()
    }
}

/// All keys of a table, without their rows.
fn keys<A: FromSql, B: FromSql>(
    connection: &Connection,
    table: &str,
    columns: &str,
) -> Result<Vec<(A, B)>, StoreError> {
    let sql = format!("SELECT {columns} FROM {table} ORDER BY {columns}");
    let mut statement = connection.prepare(&sql)?;
    let rows = statement.query_map([], |row| Ok((row.get(0)?, row.get(1)?)))?;
    // A key of the wrong type was already found by its sum.
    Ok(rows.flatten().collect())
}

fn check_pages(connection: &Connection, findings: &mut Findings) -> Result<(), StoreError> {
    let mut statement = connection.prepare("PRAGMA integrity_check")?;
    let mut rows = statement.query([])?;
    while let Some(row) = rows.next()? {
        let message: String = row.get(0)?;
        if message != "ok" {
            findings.damage(CATALOG_FILE, message);
        }
    }
    let mut statement = connection.prepare("PRAGMA foreign_key_check")?;
    let mut rows = statement.query([])?;
    while let Some(row) = rows.next()? {
        let (table, id, parent): (String, Option<i64>, String) =
            (row.get(0)?, row.get(1)?, row.get(2)?);
        let id = id.map_or("?".to_string(), |id| id.to_string());
        let message = format!("refers to a row of {parent} that does not exist");
        findings.damage(format!("{table} rowid {id}"), message);
    }
    Ok(())
}

fn check_sums(connection: &Connection, findings: &mut Findings) -> Result<(), StoreError> {
    for table in TABLES {
        let columns = table.columns.join(", ");
        let key = table.columns[..table.n_key].join(" || ', ' || ");
        let sql = format!(
            "SELECT CAST({key} AS TEXT) FROM {} WHERE row_sum({columns}) IS NOT sum",
            table.name
        );
        let read = || -> rusqlite::Result<Vec<Option<String>>> {
            connection
                .prepare(&sql)?
                .query_map([], |row| row.get(0))?
                .collect()
        };
        match read() {
            Ok(keys) => {
                for key in keys {
                    let key = key.unwrap_or("?".into());
                    findings.damage(
                        format!("{} {key}", table.name),
                        "its sum does not match its columns",
                    );
                }
            }
            Err(error) => findings.damage(table.name, format!("cannot be read: {error}")),
        }
    }
    Ok(())
}

fn check_object(
    dir: &Path,
    row: &ObjectRow,
    arrays: &mut HashMap<Digest, Arrays>,
) -> Result<(), StoreError> {
    match row.kind {
        ObjectKind::Original => read_original(&RealDisk, dir, row).map(drop),
        ObjectKind::Description => {
            let mapped = map_description(dir, row)?;
            let view = mapped.view();
            let found = Arrays {
                n_polygons: view.face_map.len() as u64,
                n_vertices: view.vertices.len(),
                n_faces: view.faces.len(),
            };
            arrays.insert(row.digest, found);
            Ok(())
        }
    }
}

fn file_is_missing(dir: &Path, row: &ObjectRow) -> bool {
    !dir.join(&row.file).exists()
}

/// Looks in the present catalog, rather than the one at the beginning of the check.
fn still_catalogued(path: &Path, row: &ObjectRow) -> Result<bool, StoreError> {
    let connection = catalog::open_reader(path)?;
    Reader::new(&connection).is_catalogued(&row.file)
}

fn check_shapes(
    connection: &Connection,
    reader: &Reader<'_>,
    arrays: &HashMap<Digest, Arrays>,
    findings: &mut Findings,
) -> Result<(), StoreError> {
    for (id, _) in keys::<ShapeId, i64>(connection, "shapes", "id, collection_id")? {
        let Some(Some(shape)) = findings.keep(reader.shape(id)) else {
            continue;
        };
        let location = format!("shapes {id}");
        for (kind, digest) in [
            (ObjectKind::Original, shape.content_digest),
            (ObjectKind::Description, shape.description_digest),
        ] {
            if let Some(None) = findings.keep(reader.object(kind, &digest)) {
                findings.damage(&location, format!("no object {digest} of kind {kind:?}"));
            }
        }
        // A description that cannot be opened was already found with its file.
        let described = arrays.get(&shape.description_digest);
        if let Some(described) = described.filter(|d| d.n_polygons != shape.n_polygons) {
            let (row, file) = (shape.n_polygons, described.n_polygons);
            findings.damage(
                &location,
                format!("{row} polygons, but its description has {file}"),
            );
        }
        if let Some(None) = findings.keep(reader.signature(id)) {
            findings.damage(&location, "no signature");
        }
        findings.keep(reader.stats(id));
        findings.keep(reader.area_shares(id));
        check_labels(reader, &shape, described, findings);
    }
    Ok(())
}

fn check_labels(
    reader: &Reader<'_>,
    shape: &ShapeRow,
    described: Option<&Arrays>,
    findings: &mut Findings,
) {
    let location = format!("shapes {}", shape.id);
    let Some(versions) = findings.keep(reader.kept_versions(shape.id)) else {
        return;
    };
    let newest = versions.last().copied();
    if newest.is_none_or(|newest| newest != shape.version) {
        let message = format!(
            "version {}, but the newest labels are {newest:?}",
            shape.version
        );
        findings.damage(&location, message);
    }
    // Versions before the newest ones are kept if undoing a correction needs them.
    let first = shape.version.saturating_sub(KEPT_LABEL_VERSIONS - 1);
    let is_gap = |pair: &[u64]| pair[1] != pair[0] + 1 && pair[1] > first;
    if versions.windows(2).any(is_gap) {
        findings.damage(
            &location,
            format!("versions of its labels are missing among {versions:?}"),
        );
    }
    for version in versions {
        let Some(Some(labels)) = findings.keep(reader.labels_at(shape.id, version)) else {
            continue;
        };
        let mut lengths = vec![
            (
                "polygon labels",
                labels.polygon_labels.len() as u64,
                shape.n_polygons,
            ),
            (
                "polygon confidences",
                labels.polygon_confidence.len() as u64,
                shape.n_polygons,
            ),
        ];
        if let Some(described) = described {
            let n_faces = described.n_faces as u64;
            lengths.push(("proxy labels", labels.proxy_labels.len() as u64, n_faces));
            let found = labels.proxy_probabilities.len() as u64;
            let expected = found.div_ceil(n_faces.max(1)).max(1) * n_faces;
            lengths.push(("proxy probabilities", found, expected));
        }
        for (what, found, expected) in lengths {
            if found != expected {
                findings.damage(
                    format!("label_versions {}, {version}", shape.id),
                    format!("{found} {what}, but the shape has {expected}"),
                );
            }
        }
    }
}

fn check_maps(
    connection: &Connection,
    reader: &Reader<'_>,
    arrays: &HashMap<Digest, Arrays>,
    findings: &mut Findings,
) -> Result<(), StoreError> {
    for (from, to) in keys::<ShapeId, ShapeId>(connection, "maps", "from_shape, to_shape")? {
        let Some(Some(map)) = findings.keep(reader.map(from, to)) else {
            continue;
        };
        let mut n_vertices = |id| {
            let shape = findings.keep(reader.shape(id)).flatten()?;
            arrays
                .get(&shape.description_digest)
                .map(|described| described.n_vertices)
        };
        let (Some(n1), Some(n2)) = (n_vertices(from), n_vertices(to)) else {
            continue;
        };
        check_p2p(
            findings,
            &format!("maps {from}, {to}"),
            &map.p2p_21,
            (n1, n2),
        );
    }
    for (id, _) in keys::<CollectionId, i64>(connection, "collections", "id, stream_id")? {
        let Some(kept) = findings.keep(KeptMaps::read(reader, id)) else {
            continue;
        };
        for ((from, to, _), standing) in kept.maps.iter().zip(kept.standings()) {
            if standing.inconsistent {
                let (from, to) = (kept.shapes[*from], kept.shapes[*to]);
                let mut name = |id| {
                    let shape = findings.keep(reader.shape(id)).flatten();
                    shape.map_or_else(|| id.to_string(), |s| format!("{:?}", s.name))
                };
                let (one, two) = (name(from), name(to));
                let text = format!(
                    "the map from {one} to {two} disagrees with the maps by way of other shapes: \
                     departure {:.2} (0: equal, 1.4: unrelated), the median over {} third shapes. \
                     Nothing is damaged, and no action is needed: labels transferred by it count \
                     as little as its confidence says. `coseg check --repair` looks for a better \
                     map",
                    standing.departure, standing.n_triangles
                );
                findings.note(format!("maps {from}, {to}"), text);
            }
        }
    }
    for (from, to, request) in reader.point_map_keys()? {
        let kept = findings.keep(reader.point_maps(from, to, &request));
        let mut n_vertices = |id| {
            let shape = findings.keep(reader.shape(id)).flatten()?;
            let described = arrays.get(&shape.description_digest);
            described.map(|described| described.n_vertices)
        };
        let (Some(n1), Some(n2)) = (n_vertices(from), n_vertices(to)) else {
            continue;
        };
        for map in kept.into_iter().flatten() {
            check_p2p(
                findings,
                &format!("point_maps {from}, {to}"),
                &map.p2p_21,
                (n1, n2),
            );
        }
    }
    Ok(())
}

/// Checks that a pointwise map leads from the `n2` vertices of one shape to the `n1` of another.
fn check_p2p(findings: &mut Findings, location: &str, p2p_21: &[u32], (n1, n2): (usize, usize)) {
    if p2p_21.len() != n2 {
        let found = p2p_21.len();
        let text = format!("p2p_21 has {found} vertices, but the shape has {n2}");
        findings.damage(location, text);
    }
    if let Some(vertex) = p2p_21.iter().find(|&&vertex| vertex as usize >= n1) {
        let text = format!("p2p_21 names vertex {vertex}, but there are {n1}");
        findings.damage(location, text);
    }
}

fn check_collections(
    connection: &Connection,
    reader: &Reader<'_>,
    findings: &mut Findings,
) -> Result<(), StoreError> {
    for (id, _) in keys::<_, i64>(connection, "collections", "id, stream_id")? {
        let Some(Some(collection)) = findings.keep(reader.collection_by_id(id)) else {
            continue;
        };
        findings.keep(reader.model(id));
        let largest_label = findings
            .keep(reader.labels(id))
            .and_then(|labels| labels.last().map(|label| u64::from(label.id)));
        let largest_ordinal: Option<u64> = connection.query_row(
            "SELECT max(ordinal) FROM shapes WHERE collection_id = ?1",
            [id],
            |row| row.get(0),
        )?;
        let location = format!("collections {id}");
        for (what, largest, next) in [
            ("label", largest_label, u64::from(collection.next_label)),
            ("ordinal", largest_ordinal, collection.next_ordinal),
        ] {
            if let Some(largest) = largest.filter(|&largest| largest >= next) {
                findings.damage(
                    &location,
                    format!("its next {what} is {next}, but {largest} is in use"),
                );
            }
        }
    }
    Ok(())
}

/// Checks that the log of a name contains every number from 1 to its sequence once.
fn check_events(connection: &Connection, findings: &mut Findings) -> Result<(), StoreError> {
    let mut statement = connection.prepare(
        "SELECT name, streams.sequence, count(events.sequence), coalesce(min(events.sequence), 1),
                coalesce(max(events.sequence), 0)
         FROM streams LEFT JOIN events ON events.stream_id = streams.id GROUP BY streams.id",
    )?;
    let mut rows = statement.query([])?;
    while let Some(row) = rows.next()? {
        let (name, sequence): (String, i64) = (row.get(0)?, row.get(1)?);
        let (count, first, last): (i64, i64, i64) = (row.get(2)?, row.get(3)?, row.get(4)?);
        if (count, first, last) != (sequence, 1, sequence) {
            findings.damage(
                format!("events of {name:?}"),
                format!("{count} events from {first} to {last}, but the sequence is {sequence}"),
            );
        }
    }
    Ok(())
}

fn check_jobs(
    connection: &Connection,
    reader: &Reader<'_>,
    findings: &mut Findings,
) -> Result<(), StoreError> {
    for (job, _) in keys::<u64, i64>(connection, "jobs", "id, created")? {
        let Some(items) = findings.keep(reader.job_items(job)) else {
            continue;
        };
        if let Some(at) = (0..items.len()).find(|&at| items[at].index as usize != at) {
            findings.damage(format!("jobs {job}"), format!("item {at} is missing"));
        }
    }
    for item in findings.keep(reader.queued_items()).unwrap_or_default() {
        if let Some(None) =
            findings.keep(reader.object(ObjectKind::Original, &item.item.original_digest))
        {
            findings.damage(
                format!("job_items {}, {}", item.job, item.index),
                format!("no object {}", item.item.original_digest),
            );
        }
    }
    for (client, request) in
        keys::<String, String>(connection, "requests", "client_id, request_id")?
    {
        findings.keep(reader.request(&client, &request));
    }
    Ok(())
}

/// Reports files without a row; returns how many of them are mesh files.
fn check_orphans(
    dir: &Path,
    rows: &[ObjectRow],
    catalog: &Path,
    findings: &mut Findings,
) -> Result<usize, StoreError> {
    let named: HashSet<&str> = rows.iter().map(|row| row.file.as_str()).collect();
    let connection = match catalog::open_reader(catalog) {
        Ok(connection) => connection,
        Err(error) => {
            findings.error(&error);
            return Ok(0);
        }
    };
    let reader = Reader::new(&connection);
    let mut n_originals = 0;
    for folder in FOLDERS {
        let path = dir.join(folder);
        for entry in RealDisk
            .files(&path)
            .map_err(|e| StoreError::io(&path, e))?
        {
            let file = relative(dir, &entry.path);
            // The file may have been committed since the check began.
            if named.contains(file.as_str()) || reader.is_catalogued(&file).unwrap_or(false) {
                continue;
            }
            n_originals += usize::from(folder == ObjectKind::Original.folder());
            let message = format!("{} bytes without a row", entry.length);
            findings.note(file, message);
        }
    }
    Ok(n_originals)
}
