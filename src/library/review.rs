//! Stores a person's verdict on a shape, and reads it back.

use super::change::{Change, Undoable, commit_once};
use super::correct::{Corrected, Correction, Said, corrects};
use super::error::Result;
use super::facade::Library;
use super::once::{Request, answered, from_reply};
use super::review_rows::{check_reviewer, review_of_row, review_row};
use super::rows::to_json;
use super::sources::Sources;
use super::types::RequestKey;
use super::verdict::{Review, ReviewState};

impl Library {
    /// Approves a shape: all its present labels count as given by a person, who found them right.
    /// It becomes a training shape, from which the labels of other shapes follow in the background.
    ///
    /// # Errors
    /// There is no such collection or shape, or it has more labels than persons can use.
    pub fn approve(
        &self,
        collection: &str,
        shape: &str,
        by: &str,
        key: Option<&RequestKey>,
    ) -> Result<Corrected> {
        check_reviewer(by)?;
        let request = Request::of(key, &format!("approve {collection:?} {shape:?}"));
        let row = self.collection_row(collection)?;
        self.with_collection(row, |in_memory| {
            if let Some(reply) = answered(&self.store, &request)? {
                return from_reply(&reply);
            }
            let id = self.shape_row(collection, shape)?.1.id;
            let labels = self.store.known(id)?.labels.polygon_labels;
            let labels = Correction::Whole(labels);
            let mut corrects = corrects(in_memory, &self.store, id, &labels, Said::Nothing)?;
            corrects.change.undoable = Some(Undoable::Approve {
                shape: shape.to_owned(),
            });
            let review = review_row(ReviewState::Approved, by);
            corrects.change.reviews.push((id, Some(review)));
            let reply = corrects.commit(&self.store, in_memory, &request, |done| to_json(&done))?;
            from_reply(&reply)
        })
    }

    /// Records that a person found a fault in the labels of a shape without correcting it. No label
    /// changes.
    ///
    /// # Errors
    /// There is no such collection or shape.
    pub fn doubt(
        &self,
        collection: &str,
        shape: &str,
        by: &str,
        key: Option<&RequestKey>,
    ) -> Result<Review> {
        check_reviewer(by)?;
        let request = Request::of(key, &format!("doubt {collection:?} {shape:?}"));
        let row = self.collection_row(collection)?;
        self.with_collection(row, |in_memory| {
            let id = self.shape_row(collection, shape)?.1.id;
            if answered(&self.store, &request)?.is_none() {
                let change = Change {
                    undoable: Some(Undoable::Doubt {
                        shape: shape.to_owned(),
                    }),
                    reviews: vec![(id, Some(review_row(ReviewState::Doubtful, by)))],
                    ..Change::default()
                };
                commit_once(&self.store, in_memory, change, &request, |_, _| {
                    Ok(Vec::from(b"doubtful"))
                })?;
            }
            let found = self.store.catalog().read(|r| r.review(id))?;
            review_of_row(found, false)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::ReviewRow;

    #[test]
    fn states_have_names_that_come_back() {
        for state in ReviewState::ALL {
            assert_eq!(ReviewState::of_name(state.name()), Some(state));
        }
        assert_eq!(ReviewState::of_name("sure"), None);
    }

    #[test]
    fn shapes_that_an_earlier_version_corrected_count_as_corrected() {
        let state = |row, pinned| review_of_row(row, pinned).map(|r| r.state);
        assert_eq!(state(None, false).unwrap(), ReviewState::Unseen);
        assert_eq!(state(None, true).unwrap(), ReviewState::Corrected);
        let row = review_row(ReviewState::Approved, "ada");
        assert_eq!(
            state(Some(row.clone()), true).unwrap(),
            ReviewState::Approved
        );
        let row = ReviewRow {
            state: "sure".into(),
            ..row
        };
        assert!(state(Some(row), true).is_err());
    }
}
