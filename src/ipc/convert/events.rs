//! Converts the events of a collection's log.

use super::links::{link_kind, part_of_shape};
use crate::ipc::wire::{self, event::Kind};
use crate::library::{Event, EventKind};

/// An event of `collection`.
pub fn event(collection: &str, e: &Event) -> wire::Event {
    let kind = match &e.kind {
        EventKind::CollectionCreated => Kind::CollectionCreated(wire::CollectionCreated {}),
        EventKind::CollectionDeleted => Kind::CollectionDeleted(wire::CollectionDeleted {}),
        EventKind::ShapeAdded {
            shape,
            version,
            area_shares,
        } => {
            let area_shares = area_shares
                .iter()
                .map(|&(label, area_share)| wire::LabelShare { label, area_share })
                .collect();
            Kind::ShapeAdded(wire::ShapeAdded {
                shape: shape.clone(),
                version: *version,
                area_shares,
            })
        }
        EventKind::ShapeRemoved { shape } => Kind::ShapeRemoved(wire::ShapeRemoved {
            shape: shape.clone(),
        }),
        EventKind::LabelsChanged {
            shape,
            version,
            cause,
            moves,
        } => {
            let moves = moves
                .iter()
                .map(|m| wire::LabelMove {
                    from: m.from,
                    to: m.to,
                    area_share: m.area_share,
                })
                .collect();
            Kind::LabelsChanged(wire::LabelsChanged {
                shape: shape.clone(),
                version: *version,
                cause: cause.clone(),
                moves,
            })
        }
        EventKind::LabelCreated { label } => {
            Kind::LabelCreated(wire::LabelCreated { label: *label })
        }
        EventKind::LabelMerged { from, into } => Kind::LabelMerged(wire::LabelMerged {
            from: *from,
            into: *into,
        }),
        EventKind::LabelSplit { from, into } => Kind::LabelSplit(wire::LabelSplit {
            from: *from,
            into: into.clone(),
        }),
        EventKind::LabelNamed { label, name } => Kind::LabelNamed(wire::LabelNamed {
            label: *label,
            name: name.clone(),
        }),
        EventKind::LabelRetired { label } => {
            Kind::LabelRetired(wire::LabelRetired { label: *label })
        }
        EventKind::Corrected {
            shape,
            version,
            n_faces,
            area_share,
        } => Kind::Corrected(wire::Corrected {
            shape: shape.clone(),
            version: *version,
            n_faces: *n_faces,
            area_share: *area_share,
        }),
        EventKind::Undone { change } => Kind::Undone(wire::Undone {
            change: change.clone(),
        }),
        EventKind::UpChanged { from, to } => Kind::UpChanged(wire::UpChanged {
            from: from.clone(),
            to: to.clone(),
        }),
        EventKind::Chosen {
            proposal,
            n_labels,
            value,
        } => Kind::Chosen(wire::Chosen {
            proposal: *proposal,
            n_labels: *n_labels,
            value: *value,
        }),
        EventKind::PartsLinked { link, kind, parts } => Kind::PartsLinked(wire::PartsLinked {
            link: *link,
            kind: link_kind(*kind).into(),
            a: Some(part_of_shape(&parts[0])),
            b: Some(part_of_shape(&parts[1])),
        }),
        EventKind::PartsUnlinked { link } => {
            Kind::PartsUnlinked(wire::PartsUnlinked { link: *link })
        }
        EventKind::Reclustered {
            score_before,
            score_after,
            accepted,
        } => Kind::Reclustered(wire::Reclustered {
            score_before: *score_before,
            score_after: *score_after,
            accepted: *accepted,
        }),
    };
    wire::Event {
        sequence: e.sequence,
        collection: collection.to_owned(),
        kind: Some(kind),
    }
}
