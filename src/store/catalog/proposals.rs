//! Divisions of the shapes of a collection into labels, of which a person can choose one.

use super::reader::{Reader, Tx};
use super::schema::{CANDIDATES, PROPOSALS};
use crate::store::StoreError;
use crate::store::codec::{pack_bytes, unpack_bytes};
use crate::store::rows::{CandidatesRow, CollectionId, ProposalRow};
use rusqlite::params;

type Result<T> = std::result::Result<T, StoreError>;

impl Reader<'_> {
    /// The candidates for proposals of a collection, by number of labels.
    pub fn candidates(&self, collection: CollectionId) -> Result<Vec<CandidatesRow>> {
        let tail = "WHERE collection_id = ?1 ORDER BY n_labels";
        self.all(&CANDIDATES, tail, [collection], |fields| {
            Ok(CandidatesRow {
                n_labels: fields.get("n_labels")?,
                basis: fields.get("basis")?,
                found: fields.unpack("found", unpack_bytes)?,
            })
        })
    }

    /// The basis of the proposals of a collection, if it has any.
    pub fn proposals_basis(&self, collection: CollectionId) -> Result<Option<String>> {
        let tail = "WHERE collection_id = ?1 AND n = 0";
        self.first(&PROPOSALS, tail, [collection], |fields| fields.get("basis"))
    }

    /// The proposals of a collection, in their order.
    pub fn proposals(&self, collection: CollectionId) -> Result<Vec<ProposalRow>> {
        let tail = "WHERE collection_id = ?1 ORDER BY n";
        self.all(&PROPOSALS, tail, [collection], |fields| {
            Ok(ProposalRow {
                n: fields.get("n")?,
                basis: fields.get("basis")?,
                n_labels: fields.get("n_labels")?,
                value: fields.get("value")?,
                labels: fields.unpack("labels", unpack_bytes)?,
            })
        })
    }
}

impl Tx<'_> {
    /// Replaces the candidates with one number of labels, and deletes those of another basis.
    pub fn put_candidates(&self, collection: CollectionId, row: &CandidatesRow) -> Result<()> {
        self.execute(
            "DELETE FROM candidates WHERE collection_id = ?1 AND (n_labels = ?2 OR basis != ?3)",
            params![collection, row.n_labels, row.basis],
        )?;
        let packed = pack_bytes(&row.found);
        let values = params![collection, row.n_labels, row.basis, packed];
        self.insert(&CANDIDATES, collection, values)?;
        Ok(())
    }

    /// Replaces the proposals, and deletes the candidates from which they were picked.
    pub fn set_proposals(&self, collection: CollectionId, rows: &[ProposalRow]) -> Result<()> {
        let of = [collection];
        self.execute("DELETE FROM candidates WHERE collection_id = ?1", of)?;
        self.execute("DELETE FROM proposals WHERE collection_id = ?1", of)?;
        for row in rows {
            let packed = pack_bytes(&row.labels);
            let values = params![
                collection,
                row.n,
                row.basis,
                row.n_labels,
                row.value,
                packed
            ];
            self.insert(&PROPOSALS, collection, values)?;
        }
        Ok(())
    }
}
