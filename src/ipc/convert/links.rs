//! Links between parts.

use super::errors::field_error;
use crate::ipc::wire::{self, ErrorReason};
use crate::library::{Link, LinkChanged, LinkKind, PartName};

/// The kind and the parts of a link in a request.
pub fn new_link(r: &wire::LinkPartsRequest) -> Result<(LinkKind, [PartName; 2]), wire::Error> {
    let kind = match r.kind() {
        wire::LinkKind::Same => LinkKind::Same,
        wire::LinkKind::Differ => LinkKind::Differ,
        wire::LinkKind::Unspecified => {
            let text = "kind is missing: LINK_KIND_SAME or LINK_KIND_DIFFER";
            return Err(field_error(ErrorReason::FieldMissing, "kind", text));
        }
    };
    let part = |given: &Option<wire::PartOfShape>, field: &str| match given {
        Some(part) => Ok(PartName {
            shape: part.shape.clone(),
            part: part.part,
        }),
        None => {
            let text = format!("{field} is missing");
            Err(field_error(ErrorReason::FieldMissing, field, text))
        }
    };
    Ok((kind, [part(&r.a, "a")?, part(&r.b, "b")?]))
}

/// What a link demands.
pub fn link_kind(kind: LinkKind) -> wire::LinkKind {
    match kind {
        LinkKind::Same => wire::LinkKind::Same,
        LinkKind::Differ => wire::LinkKind::Differ,
    }
}

/// A part of a shape.
pub fn part_of_shape(part: &PartName) -> wire::PartOfShape {
    wire::PartOfShape {
        shape: part.shape.clone(),
        part: part.part,
    }
}

/// A link.
pub fn link(l: &Link) -> wire::Link {
    let [a, b] = &l.parts;
    wire::Link {
        id: l.id,
        kind: link_kind(l.kind).into(),
        a: Some(part_of_shape(a)),
        b: Some(part_of_shape(b)),
        by: l.by.clone(),
        unix_ms: l.unix_ms,
        holds: l.holds,
        overruled: l.overruled,
    }
}

/// A new link.
pub fn linked(done: &LinkChanged) -> wire::LinkPartsReply {
    wire::LinkPartsReply {
        link: Some(link(&done.link)),
        changed: done.changed,
        n_stale: done.n_stale,
        sequence: done.sequence,
        job_id: done.job,
    }
}

/// A removed link.
pub fn unlinked(done: &LinkChanged) -> wire::UnlinkPartsReply {
    wire::UnlinkPartsReply {
        link: Some(link(&done.link)),
        n_stale: done.n_stale,
        sequence: done.sequence,
        job_id: done.job,
    }
}
