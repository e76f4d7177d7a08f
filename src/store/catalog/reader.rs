//! Reads and writes rows; the methods of all tables build on this module.

use super::schema::{META, Table};
use super::witness::{COMMITS, LIBRARY_ID};
use crate::store::StoreError;
use crate::store::codec::BadBlob;
use crate::store::rows::Totals;
use rusqlite::types::{FromSql, ValueRef};
use rusqlite::{Connection, ErrorCode, OptionalExtension, Params, Row};
use std::ops::Deref;

type Result<T> = std::result::Result<T, StoreError>;

/// The catalog at one moment.
#[derive(Debug)]
pub struct Reader<'c> {
    connection: &'c Connection,
}

/// A transaction: reads see its own writes.
#[derive(Debug)]
pub struct Tx<'c> {
    reader: Reader<'c>,
}

impl<'c> Deref for Tx<'c> {
    type Target = Reader<'c>;

    fn deref(&self) -> &Reader<'c> {
        &self.reader
    }
}

/// The columns of one row, in the order of [`Table::columns`].
pub(super) struct Fields<'a> {
    table: &'static Table,
    row: &'a Row<'a>,
}

impl Fields<'_> {
    /// The value of a column.
    pub(super) fn get<T: FromSql>(&self, column: &str) -> Result<T> {
        let index = self.index(column);
        self.row.get(index).map_err(|e| self.damaged(column, e))
    }

    /// The value of a packed blob.
    pub(super) fn unpack<T>(
        &self,
        column: &str,
        unpack: fn(&[u8]) -> std::result::Result<T, BadBlob>,
    ) -> Result<T> {
        let index = self.index(column);
        let blob = self
            .row
            .get_ref(index)
            .map_err(|e| self.damaged(column, e))?;
        let blob = blob.as_blob().map_err(|e| self.damaged(column, e))?;
        unpack(blob).map_err(|e| self.damaged(column, e))
    }

    pub(super) fn damaged(&self, column: &str, message: impl std::fmt::Display) -> StoreError {
        StoreError::DamagedRow {
            table: self.table.name,
            key: row_key(self.table, self.row),
            message: format!("{column}: {message}"),
        }
    }

    fn index(&self, column: &str) -> usize {
        self.table
            .columns
            .iter()
            .position(|&name| name == column)
            .expect("invariant: columns are named as in the schema")
    }
}

/// The key of a row whose first columns are the table's key.
pub(super) fn row_key(table: &Table, row: &Row<'_>) -> String {
    let part = |index| match row.get_ref(index) {
        Ok(ValueRef::Integer(value)) => value.to_string(),
        Ok(ValueRef::Text(text)) => String::from_utf8_lossy(text).into_owned(),
        _ => "?".to_string(),
    };
    (0..table.n_key).map(part).collect::<Vec<_>>().join(", ")
}

impl<'c> Reader<'c> {
    pub(in crate::store) fn new(connection: &'c Connection) -> Self {
        Self { connection }
    }

    pub(in crate::store) fn connection(&self) -> &'c Connection {
        self.connection
    }

    /// Calls `visit` with each row of `table` that `tail` selects, its sum verified.
    pub(super) fn each(
        &self,
        table: &'static Table,
        tail: &str,
        params: impl Params,
        mut visit: impl FnMut(&Fields<'_>) -> Result<()>,
    ) -> Result<()> {
        let mut statement = self.connection.prepare_cached(&table.select(tail))?;
        let mut rows = statement.query(params)?;
        while let Some(row) = rows.next()? {
            let fields = Fields { table, row };
            let whole: bool = row.get(table.columns.len())?;
            if !whole {
                return Err(StoreError::DamagedRow {
                    table: table.name,
                    key: row_key(table, row),
                    message: "its sum does not match its columns".into(),
                });
            }
            visit(&fields)?;
        }
        Ok(())
    }

    pub(super) fn all<T>(
        &self,
        table: &'static Table,
        tail: &str,
        params: impl Params,
        mut row: impl FnMut(&Fields<'_>) -> Result<T>,
    ) -> Result<Vec<T>> {
        let mut found = Vec::new();
        self.each(table, tail, params, |fields| {
            found.push(row(fields)?);
            Ok(())
        })?;
        Ok(found)
    }

    pub(super) fn first<T>(
        &self,
        table: &'static Table,
        tail: &str,
        params: impl Params,
        row: impl FnMut(&Fields<'_>) -> Result<T>,
    ) -> Result<Option<T>> {
        Ok(self
            .all(table, &format!("{tail} LIMIT 1"), params, row)?
            .pop())
    }

    /// One number, such as a count.
    pub(super) fn number(&self, sql: &str, params: impl Params) -> Result<u64> {
        Ok(self
            .connection
            .prepare_cached(sql)?
            .query_row(params, |row| row.get(0))?)
    }

    /// Texts for people, whose sums are not checked.
    pub(super) fn names(&self, sql: &str, params: impl Params) -> Result<Vec<String>> {
        let mut statement = self.connection.prepare_cached(sql)?;
        let rows = statement.query_map(params, |row| row.get(0))?;
        Ok(rows.collect::<rusqlite::Result<_>>()?)
    }

    pub(super) fn optional<T: FromSql>(&self, sql: &str, params: impl Params) -> Result<Option<T>> {
        Ok(self
            .connection
            .prepare_cached(sql)?
            .query_row(params, |row| row.get(0))
            .optional()?)
    }

    /// The random name that the library got when it was created.
    pub fn library_id(&self) -> Result<String> {
        self.meta(LIBRARY_ID)?
            .ok_or_else(|| missing(&META, LIBRARY_ID))
    }

    /// Number of commits since commits are numbered.
    pub fn n_commits(&self) -> Result<u64> {
        let Some(text) = self.meta(COMMITS)? else {
            return Ok(0);
        };
        text.parse().map_err(|e| StoreError::DamagedRow {
            table: META.name,
            key: COMMITS.into(),
            message: format!("{text:?}: {e}"),
        })
    }

    pub(super) fn meta(&self, key: &str) -> Result<Option<String>> {
        self.first(&META, "WHERE key = ?1", [key], |fields| fields.get("value"))
    }

    /// Counters over the whole catalog.
    pub fn totals(&self) -> Result<Totals> {
        let count = |sql: &str| self.number(sql, []);
        Ok(Totals {
            n_collections: count("SELECT count(*) FROM collections")?,
            n_shapes: count("SELECT count(*) FROM shapes")?,
            n_stale: count("SELECT count(*) FROM shapes WHERE stale")?,
            n_queued: count("SELECT count(*) FROM job_items WHERE status = 'queued'")?,
            object_bytes: count("SELECT coalesce(sum(length), 0) FROM objects")?,
            catalog_bytes: count(
                "SELECT page_count * page_size FROM pragma_page_count, pragma_page_size",
            )?,
        })
    }
}

impl<'c> Tx<'c> {
    pub(super) fn new(connection: &'c Connection) -> Self {
        Self {
            reader: Reader::new(connection),
        }
    }

    /// Numbers this commit; if the catalog's own number cannot be read, calls `known`, which
    /// returns at least the number of the previous commit.
    pub(super) fn number_commit(&self, known: impl FnOnce() -> u64) -> Result<u64> {
        let before = match self.n_commits() {
            Err(e) if e.is_damage() => known(),
            before => before?,
        };
        let number = before + 1;
        self.execute(
            "INSERT INTO meta (key, value) VALUES (?1, ?2)
             ON CONFLICT (key) DO UPDATE SET value = excluded.value",
            [COMMITS, &number.to_string()],
        )?;
        Ok(number)
    }

    /// Commits this transaction even if it contains no other change.
    pub fn touch(&self) -> Result<()> {
        self.execute("UPDATE meta SET value = value WHERE key = 'format'", [])?;
        Ok(())
    }

    /// Inserts a row of all columns; an existing key gets an error of its own.
    pub(super) fn insert(
        &self,
        table: &'static Table,
        key: impl std::fmt::Display,
        params: impl Params,
    ) -> Result<i64> {
        let connection = self.connection();
        match connection.prepare_cached(&table.insert())?.execute(params) {
            Ok(_) => Ok(connection.last_insert_rowid()),
            Err(e) if is_taken(&e) => Err(StoreError::Exists {
                table: table.name,
                key: key.to_string(),
            }),
            Err(e) if e.sqlite_error_code() == Some(ErrorCode::ConstraintViolation) => {
                Err(StoreError::Dangling {
                    table: table.name,
                    key: key.to_string(),
                })
            }
            Err(e) => Err(e.into()),
        }
    }

    /// Runs a statement; returns the number of changed rows.
    pub(super) fn execute(&self, sql: &str, params: impl Params) -> Result<usize> {
        Ok(self.connection().prepare_cached(sql)?.execute(params)?)
    }

    /// Runs a statement that must change the one row with this key.
    pub(super) fn change(
        &self,
        table: &'static Table,
        key: impl std::fmt::Display,
        sql: &str,
        params: impl Params,
    ) -> Result<()> {
        match self.execute(sql, params)? {
            0 => Err(missing(table, key)),
            _ => Ok(()),
        }
    }

    pub(super) fn set_meta(&self, key: &str, value: &str) -> Result<()> {
        self.execute(
            "INSERT INTO meta (key, value) VALUES (?1, ?2)
             ON CONFLICT (key) DO UPDATE SET value = excluded.value",
            [key, value],
        )?;
        Ok(())
    }
}

pub(super) fn missing(table: &'static Table, key: impl std::fmt::Display) -> StoreError {
    StoreError::Missing {
        table: table.name,
        key: key.to_string(),
    }
}

fn is_taken(error: &rusqlite::Error) -> bool {
    use rusqlite::ffi::{
        SQLITE_CONSTRAINT_PRIMARYKEY, SQLITE_CONSTRAINT_ROWID, SQLITE_CONSTRAINT_UNIQUE,
    };
    error.sqlite_error().is_some_and(|e| {
        [
            SQLITE_CONSTRAINT_PRIMARYKEY,
            SQLITE_CONSTRAINT_ROWID,
            SQLITE_CONSTRAINT_UNIQUE,
        ]
        .contains(&e.extended_code)
    })
}
