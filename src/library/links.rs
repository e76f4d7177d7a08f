//! Links two parts: a person demands that they have the same label, or different ones. Discovery,
//! propagation and the placing of shapes obey.

use super::advance::relabel_all;
use super::change::{Change, LinkEdit, Undoable, commit_once};
use super::collection::discovered;
use super::collection::{Collection, Regime, Staleness, supervised};
use super::correct::part_polygons;
use super::error::{LibraryError, Named, Result};
use super::facade::Library;
use super::linked::{LinkKind, Linked, PartName, kind_of, label_of_most, linked_shapes};
use super::once::{Request, answered, from_reply, unix_ms};
use super::pins::used_labels;
use super::reason::Reason;
use super::review_rows::check_reviewer;
use super::rows::{damaged, to_json};
use super::sources::Sources;
use super::types::{LabelId, RequestKey};
use crate::store::{CollectionId, LinkEnd, LinkRow, Reader, ShapeId};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};

/// Maximum number of links of a collection.
pub const MAX_LINKS: usize = 100;
/// Maximum number of shapes whose parts are linked. All of them take part in every re-clustering
/// and in every fit, which are of [`MAX_REPRESENTATIVES`](super::MAX_REPRESENTATIVES) shapes.
pub const MAX_LINKED_SHAPES: usize = 32;
/// Maximum number of labels that links may need.
const MAX_NEEDED: usize = 64;

/// A link between two parts.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Link {
    /// Its id.
    pub id: u64,
    /// What it demands.
    pub kind: LinkKind,
    /// The parts, as they were numbered when they were linked.
    pub parts: [PartName; 2],
    /// Who made it; may be empty.
    pub by: String,
    /// When, in milliseconds since 1970.
    pub unix_ms: u64,
    /// Whether the present labels of the parts are as demanded.
    pub holds: bool,
    /// Whether labels that persons gave contradict it. Then it demands nothing.
    pub overruled: bool,
}

/// The result of making or removing a link.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct LinkChanged {
    /// The link. If it was removed, as it was before.
    pub link: Link,
    /// Whether anything changed: not if the same link was there.
    pub changed: bool,
    /// Number of shapes whose labels wait to be recomputed.
    pub n_stale: u64,
    /// Sequence number of the collection after it.
    pub sequence: u64,
    /// The job that propagates it; 0 if none does.
    pub job: u64,
}

/// A stored link with the labels that most of its parts have.
struct ReadLink {
    row: LinkRow,
    link: Link,
    labels: [i32; 2],
}

/// A part that is about to be linked.
struct NewEnd {
    end: LinkEnd,
    /// The label that most of it has.
    label: i32,
    stale: bool,
}

impl Library {
    /// Demands that two parts have the same label, or different ones. The parts remain linked when
    /// labels change. While labels are discovered, parts are clustered again at once if the present
    /// labels are not as demanded; after corrections, the model is fitted again in the background.
    /// Labels that persons give overrule links. Can be undone.
    ///
    /// # Errors
    /// There is no such collection, shape or part; the link contradicts other links or labels that
    /// persons gave; it needs more labels than there are; or there are too many links.
    pub fn link_parts(
        &self,
        collection: &str,
        kind: LinkKind,
        parts: &[PartName; 2],
        by: &str,
        key: Option<&RequestKey>,
    ) -> Result<LinkChanged> {
        check_reviewer(by)?;
        let [a, b] = parts;
        let text = format!(
            "{} {:?} {} {:?} {}",
            kind.name(),
            a.shape,
            a.part,
            b.shape,
            b.part
        );
        let request = Request::of(key, &format!("link {collection:?} {text}"));
        let row = self.collection_row(collection)?;
        self.with_collection(row, |in_memory| {
            if let Some(reply) = answered(&self.store, &request)? {
                return from_reply(&reply);
            }
            let ends = [self.end(collection, a)?, self.end(collection, b)?];
            let is_held =
                ends.iter().all(|e| !e.stale) && kind.allows(ends[0].label, ends[1].label);
            let new = LinkRow {
                id: 0,
                kind: kind.name().to_owned(),
                ends: ends.map(|e| e.end),
                person: by.to_owned(),
                unix_ms: unix_ms(),
            };
            let links = self.read_links(in_memory.id())?;
            if let Some(there) = links.into_iter().find(|l| is_same(&l.row, &new)) {
                let nothing = Change::default();
                let same = Some((there.link, false));
                return self.commit_links(in_memory, nothing, &request, same);
            }
            let mut all = self.store.links(in_memory.id())?;
            self.check_link(in_memory, kind, &new, &all)?;
            all.push(new.clone());
            let change = Change {
                undoable: Some(Undoable::Link {
                    kind,
                    parts: parts_text(parts),
                }),
                links: vec![LinkEdit::Made {
                    row: new,
                    kind,
                    parts: parts.clone(),
                }],
                ..self.obeyed(in_memory, &all, is_held)?
            };
            self.commit_links(in_memory, change, &request, None)
        })
    }

    /// Removes a link. While labels are discovered, parts are clustered again without it; after
    /// corrections, the model is fitted again in the background. Can be undone.
    ///
    /// # Errors
    /// There is no such collection or link.
    pub fn unlink_parts(
        &self,
        collection: &str,
        id: u64,
        key: Option<&RequestKey>,
    ) -> Result<LinkChanged> {
        let request = Request::of(key, &format!("unlink {collection:?} {id}"));
        let row = self.collection_row(collection)?;
        self.with_collection(row, |in_memory| {
            if let Some(reply) = answered(&self.store, &request)? {
                return from_reply(&reply);
            }
            let mut links = self.read_links(in_memory.id())?;
            let Some(at) = links.iter().position(|l| l.link.id == id) else {
                return Err(LibraryError::not_found(Named::Link, id.to_string()));
            };
            let ReadLink { row, link, .. } = links.remove(at);
            let left: Vec<LinkRow> = links.into_iter().map(|l| l.row).collect();
            let change = Change {
                undoable: Some(Undoable::Unlink {
                    parts: parts_text(&link.parts),
                }),
                links: vec![LinkEdit::Removed { row }],
                ..self.obeyed(in_memory, &left, link.overruled)?
            };
            self.commit_links(in_memory, change, &request, Some((link, true)))
        })
    }

    /// Returns the links of a collection, the oldest first; with `shape`, only those of its parts.
    ///
    /// # Errors
    /// There is no such collection or shape.
    pub fn links(&self, collection: &str, shape: Option<&str>) -> Result<Vec<Link>> {
        let row = self.collection_row(collection)?;
        if let Some(name) = shape {
            self.shape_row(collection, name)?;
        }
        let links = self.read_links(row.id)?.into_iter().map(|l| l.link);
        let is_wanted = |l: &Link| shape.is_none_or(|name| l.parts.iter().any(|p| p.shape == name));
        Ok(links.filter(is_wanted).collect())
    }

    /// Refuses to merge two labels that parts must have because they must differ.
    pub(super) fn check_merge(
        &self,
        collection: &Collection,
        (label, into): (LabelId, LabelId),
    ) -> Result<()> {
        let both = BTreeSet::from([label as i32, into as i32]);
        let forbids = |l: &ReadLink| {
            let demands = l.link.kind == LinkKind::Differ && !l.link.overruled;
            demands && BTreeSet::from(l.labels) == both
        };
        let links = self.read_links(collection.id())?;
        let Some(ReadLink { link, .. }) = links.into_iter().find(forbids) else {
            return Ok(());
        };
        let [a, b] = link.parts.each_ref().map(part_text);
        Err(LibraryError::FailedPrecondition {
            reason: Reason::LinkContradicts,
            message: format!(
                "label {label} cannot be merged into {into}: {a} and {b} must have different \
                 labels (link {}); remove that link first",
                link.id
            ),
        })
    }

    fn read_links(&self, collection: CollectionId) -> Result<Vec<ReadLink>> {
        self.store.catalog().read(|r| read_links(r, collection))
    }

    /// Returns a part as an end of a link.
    fn end(&self, collection: &str, part: &PartName) -> Result<NewEnd> {
        let id = self.shape_row(collection, &part.shape)?.1.id;
        let known = self.store.known(id)?;
        let polygons = part_polygons(&known, &known.view(), part.part)?;
        let Some(label) = label_of_most(&polygons, &known.labels.polygon_labels) else {
            let message = format!(
                "part {} of shape {:?} stands for no face of the shape's file",
                part.part, part.shape
            );
            return Err(LibraryError::invalid(Reason::PartIndex, message));
        };
        let end = LinkEnd {
            shape: id,
            part: part.part,
            polygons,
        };
        Ok(NewEnd {
            end,
            label,
            stale: known.row.stale,
        })
    }

    /// Refuses a link that contradicts others, or exceeds a limit.
    fn check_link(
        &self,
        collection: &Collection,
        kind: LinkKind,
        new: &LinkRow,
        links: &[LinkRow],
    ) -> Result<()> {
        let name = &collection.row().name;
        let refused = |reason, message| Err(LibraryError::FailedPrecondition { reason, message });
        if links.len() >= MAX_LINKS {
            let message = format!(
                "collection {name:?} has {MAX_LINKS} links, the limit; remove one, or label parts"
            );
            return refused(Reason::LinkLimit, message);
        }
        let mut all = links.to_vec();
        all.push(new.clone());
        let shapes = linked_shapes(&all);
        if shapes.len() > MAX_LINKED_SHAPES {
            let message = format!(
                "parts of {} shapes of collection {name:?} would be linked, the limit is \
                 {MAX_LINKED_SHAPES}; label parts instead",
                shapes.len()
            );
            return refused(Reason::LinkLimit, message);
        }
        let (pins, names) = self.pins_and_names(&shapes)?;
        let before = Linked::under(&pins, links, &new.ends)?;
        if let [Some(a), Some(b)] = new.ends.each_ref().map(|end| before.find(end)) {
            if a == b {
                let message = "both ends of the link are one part, which has one label".to_owned();
                return Err(LibraryError::invalid(Reason::FieldRange, message));
            }
            let name_of = |id: ShapeId| names.get(&id).cloned().unwrap_or_default();
            if let Some(chain) = before.contradiction(kind, [a, b], &name_of) {
                let what = match kind {
                    LinkKind::Same => "the same label",
                    LinkKind::Differ => "different labels",
                };
                let message = format!("the parts cannot have {what}: {chain}");
                return refused(Reason::LinkContradicts, message);
            }
        }
        let limit = self.label_limit(collection)?;
        if Linked::under(&pins, &all, &[])?
            .fewest_labels(limit)
            .is_none()
        {
            let message = format!(
                "with this link more than {limit} parts would have to differ from each other, but \
                 shapes of collection {name:?} have at most {limit} labels"
            );
            return refused(Reason::LinkContradicts, message);
        }
        Ok(())
    }

    /// Returns the labels that persons gave to polygons of some shapes, and the shapes' names.
    #[allow(clippy::type_complexity)] // used once
    fn pins_and_names(
        &self,
        shapes: &BTreeSet<ShapeId>,
    ) -> Result<(BTreeMap<ShapeId, Vec<i32>>, BTreeMap<ShapeId, String>)> {
        let (mut pins, mut names) = (BTreeMap::new(), BTreeMap::new());
        self.store.catalog().read(|r| {
            for id in shapes {
                pins.extend(r.pins(*id)?.map(|pins| (*id, pins)));
                names.extend(r.shape(*id)?.map(|row| (*id, row.name)));
            }
            Ok::<_, LibraryError>(())
        })?;
        Ok((pins, names))
    }

    /// Returns the number of labels that shapes of a collection can have.
    fn label_limit(&self, collection: &Collection) -> Result<usize> {
        let supervision = collection.state().regime.supervision();
        Ok(match (supervision, collection.row().n_parts) {
            (Some(s), _) if !s.is_open() => {
                let used = used_labels(collection, &self.store, None)?;
                used.labels.len() + s.discovered().kept.len()
            }
            (None, Some(n)) => n as usize,
            _ => MAX_NEEDED,
        })
    }

    /// Returns the change by which labels come to obey some links; if `is_held`, they already do.
    fn obeyed(
        &self,
        collection: &mut Collection,
        links: &[LinkRow],
        is_held: bool,
    ) -> Result<Change> {
        let is_discovering = matches!(collection.state().regime, Regime::Discovering);
        if is_held || collection.model().is_none() {
            return Ok(Change::default());
        }
        if is_discovering {
            let chosen = discovered::representatives(collection, links);
            relabel_all(&self.store, collection, &chosen)?;
            return discovered::relinked(collection, &self.store, links);
        }
        let Some(supervision) = supervised::refit(collection, &self.store, None)? else {
            return Ok(Change::default());
        };
        Ok(Change {
            staleness: Staleness::All,
            state: Some(supervised::with(collection, supervision)),
            propagates: true,
            ..Change::default()
        })
    }

    /// Writes a change of links. Its reply has the new link; or the link `given`, and whether it
    /// changed.
    fn commit_links(
        &self,
        collection: &mut Collection,
        change: Change,
        request: &Request<'_>,
        given: Option<(Link, bool)>,
    ) -> Result<LinkChanged> {
        let id = collection.id();
        let reply = commit_once(&self.store, collection, change, request, |tx, now| {
            let gone = || damaged("links", "the new link is gone");
            let (link, changed) = match given {
                Some(given) => given,
                None => (read_links(tx, id)?.pop().ok_or_else(gone)?.link, true),
            };
            let done = LinkChanged {
                link,
                changed,
                n_stale: tx.n_stale(id)?,
                sequence: now.row.sequence,
                job: now.job,
            };
            Ok(to_json(&done).into_bytes())
        })?;
        from_reply(&reply)
    }
}

/// Reads the links of a collection, the oldest first, under the labels of the same moment.
fn read_links(reader: &Reader<'_>, collection: CollectionId) -> Result<Vec<ReadLink>> {
    let rows = reader.links(collection)?;
    let (mut names, mut labels, mut pins) = (BTreeMap::new(), BTreeMap::new(), BTreeMap::new());
    for id in linked_shapes(&rows) {
        let gone = || damaged("links", &format!("shape {id} is gone"));
        names.insert(id, reader.shape(id)?.ok_or_else(gone)?.name);
        let newest = reader.newest_labels(id)?.ok_or_else(gone)?;
        labels.insert(id, newest.polygon_labels);
        pins.extend(reader.pins(id)?.map(|pins| (id, pins)));
    }
    let overruled = Linked::under(&pins, &rows, &[])?.overruled();
    let read = |row: LinkRow| {
        let kind = kind_of(&row)?;
        let label = |e: &LinkEnd| label_of_most(&e.polygons, &labels[&e.shape]).unwrap_or(-1);
        let part = |e: &LinkEnd| PartName {
            shape: names[&e.shape].clone(),
            part: e.part,
        };
        let labels = row.ends.each_ref().map(label);
        let link = Link {
            id: row.id.unsigned_abs(),
            kind,
            parts: row.ends.each_ref().map(part),
            by: row.person.clone(),
            unix_ms: row.unix_ms,
            holds: kind.allows(labels[0], labels[1]),
            overruled: overruled.contains(&row.id),
        };
        Ok(ReadLink { row, link, labels })
    };
    rows.into_iter().map(read).collect()
}

/// Returns whether two links demand the same of the same parts, in either order.
fn is_same(link: &LinkRow, other: &LinkRow) -> bool {
    let is_part = |x: &LinkEnd, y: &LinkEnd| x.shape == y.shape && x.polygons == y.polygons;
    let ([a, b], [c, d]) = (&link.ends, &other.ends);
    let is_between = is_part(a, c) && is_part(b, d) || is_part(a, d) && is_part(b, c);
    link.kind == other.kind && is_between
}

fn part_text(part: &PartName) -> String {
    format!("{}:{}", part.shape, part.part)
}

fn parts_text([a, b]: &[PartName; 2]) -> String {
    format!("{} {}", part_text(a), part_text(b))
}
