//! Converts collections and labels.

use super::errors::field_error;
use crate::ipc::wire;
use crate::library::{
    CollectionInfo, CollectionSpec, LabelInfo, ReviewState, Up, UpEstimate, UpSet,
};
use crate::operators::Operator;

fn up_to_wire(up: Up) -> wire::Up {
    match up {
        Up::PlusX => wire::Up::PlusX,
        Up::MinusX => wire::Up::MinusX,
        Up::PlusY => wire::Up::PlusY,
        Up::MinusY => wire::Up::MinusY,
        Up::PlusZ => wire::Up::PlusZ,
        Up::MinusZ => wire::Up::MinusZ,
        Up::Unknown => wire::Up::Unknown,
        Up::Auto => wire::Up::Auto,
    }
}

/// The up axis.
pub fn up_from_wire(up: wire::Up) -> Up {
    match up {
        wire::Up::PlusX => Up::PlusX,
        wire::Up::MinusX => Up::MinusX,
        wire::Up::PlusY => Up::PlusY,
        wire::Up::MinusY => Up::MinusY,
        wire::Up::PlusZ => Up::PlusZ,
        wire::Up::MinusZ => Up::MinusZ,
        wire::Up::Unspecified | wire::Up::Unknown => Up::Unknown,
        wire::Up::Auto => Up::Auto,
    }
}

fn operator_to_wire(operator: Operator) -> wire::Operator {
    match operator {
        Operator::Tufted => wire::Operator::Tufted,
        Operator::Cotan => wire::Operator::Cotan,
        Operator::MeshLaplace => wire::Operator::MeshLaplace,
    }
}

fn unknown_value(field: &str, value: i32) -> wire::Error {
    let text = format!("{field} is {value}, which this version does not know");
    field_error(wire::ErrorReason::FieldRange, field, text)
}

/// An up axis, if it is set.
fn up_of(value: i32, field: &str) -> Result<Option<Up>, wire::Error> {
    let up = wire::Up::try_from(value).map_err(|_| unknown_value(field, value))?;
    Ok((up != wire::Up::Unspecified).then(|| up_from_wire(up)))
}

/// The new up axis of a collection.
pub fn new_up(request: &wire::UpdateCollectionRequest) -> Result<Up, wire::Error> {
    let missing = || {
        let text = "up is missing; no other setting can be changed";
        field_error(wire::ErrorReason::FieldMissing, "up", text)
    };
    up_of(request.up, "up")?.ok_or_else(missing)
}

/// The result of a change of the up axis.
pub fn updated(done: &UpSet) -> wire::UpdateCollectionReply {
    wire::UpdateCollectionReply {
        changed: done.changed,
        n_stale: done.n_stale,
        sequence: done.sequence,
    }
}

/// The specification of a new collection; omitted fields take their defaults.
pub fn collection_spec(
    spec: &wire::CollectionSpec,
    field: &str,
) -> Result<CollectionSpec, wire::Error> {
    let up = up_of(spec.up, &format!("{field}.up"))?.unwrap_or_default();
    let operator = wire::Operator::try_from(spec.operator)
        .map_err(|_| unknown_value(&format!("{field}.operator"), spec.operator))?;
    let operator = match operator {
        wire::Operator::Unspecified | wire::Operator::Tufted => Operator::Tufted,
        wire::Operator::Cotan => Operator::Cotan,
        wire::Operator::MeshLaplace => Operator::MeshLaplace,
    };
    Ok(CollectionSpec {
        name: spec.name.clone(),
        n_parts: spec.n_parts.filter(|&n| n > 0),
        up,
        operator,
        working_faces: spec.working_faces,
    })
}

/// The first setting of a specification that is set and differs from the collection: its name, the
/// requested value and the present one, as text.
pub fn collection_differs(
    wish: &wire::CollectionSpec,
    is: &CollectionSpec,
) -> Option<(&'static str, String, String)> {
    let is = spec_to_wire(is);
    let parts = |n: u32| {
        if n == 0 {
            "estimated".to_owned()
        } else {
            n.to_string()
        }
    };
    if let Some(n) = wish.n_parts.filter(|&n| n != is.n_parts()) {
        return Some(("n_parts", parts(n), parts(is.n_parts())));
    }
    if wish.up() != wire::Up::Unspecified && wish.up() != is.up() {
        return Some((
            "up",
            up_name(wish.up()).to_owned(),
            up_name(is.up()).to_owned(),
        ));
    }
    if wish.operator() != wire::Operator::Unspecified && wish.operator() != is.operator() {
        let name = |o: wire::Operator| operator_name(o).to_owned();
        return Some(("operator", name(wish.operator()), name(is.operator())));
    }
    if wish.working_faces != 0 && wish.working_faces != is.working_faces {
        let (wish, is) = (wish.working_faces.to_string(), is.working_faces.to_string());
        return Some(("working_faces", wish, is));
    }
    None
}

/// The name of an axis on the command line and in messages: `+y`, `unknown`, `auto`.
pub fn up_name(up: wire::Up) -> &'static str {
    match up {
        wire::Up::PlusX => "+x",
        wire::Up::MinusX => "-x",
        wire::Up::PlusY => "+y",
        wire::Up::MinusY => "-y",
        wire::Up::PlusZ => "+z",
        wire::Up::MinusZ => "-z",
        wire::Up::Unspecified | wire::Up::Unknown => "unknown",
        wire::Up::Auto => "auto",
    }
}

/// Parses the name of an axis, in upper or lower case; `y` means `+y`.
///
/// ```
/// use coseg::ipc::{convert::parse_up, wire::Up};
///
/// assert_eq!(parse_up("Y"), Ok(Up::PlusY));
/// assert!(parse_up("up").is_err_and(|e| e.contains("\"up\"")));
/// ```
///
/// # Errors
/// A message with the text and the names of all axes, if the text is not one of them.
pub fn parse_up(text: &str) -> Result<wire::Up, String> {
    const AXES: [wire::Up; 8] = [
        wire::Up::PlusX,
        wire::Up::MinusX,
        wire::Up::PlusY,
        wire::Up::MinusY,
        wire::Up::PlusZ,
        wire::Up::MinusZ,
        wire::Up::Unknown,
        wire::Up::Auto,
    ];
    let lower = text.to_ascii_lowercase();
    let is_meant = |axis: &wire::Up| {
        let name = up_name(*axis);
        lower == name || name.strip_prefix('+') == Some(lower.as_str())
    };
    let found = AXES.into_iter().find(is_meant);
    found.ok_or_else(|| {
        format!(
            "{text:?} is not an axis; expected one of {}",
            AXES.map(up_name).join(" ")
        )
    })
}

fn operator_name(operator: wire::Operator) -> &'static str {
    match operator {
        wire::Operator::Unspecified | wire::Operator::Tufted => "tufted",
        wire::Operator::Cotan => "cotan",
        wire::Operator::MeshLaplace => "mesh-laplace",
    }
}

fn spec_to_wire(spec: &CollectionSpec) -> wire::CollectionSpec {
    wire::CollectionSpec {
        name: spec.name.clone(),
        n_parts: Some(spec.n_parts.unwrap_or(0)),
        up: up_to_wire(spec.up).into(),
        operator: operator_to_wire(spec.operator).into(),
        working_faces: spec.working_faces,
    }
}

/// A label.
pub fn label_info(label: &LabelInfo) -> wire::LabelInfo {
    let [r, g, b] = label.colour.map(u32::from);
    wire::LabelInfo {
        id: label.id,
        name: label.name.clone().unwrap_or_default(),
        colour_rgb: r << 16 | g << 8 | b,
        merged_into: label.merged_into,
        n_shapes: label.n_shapes,
        area_share: label.area_share,
        unclaimed: label.unclaimed,
    }
}

fn estimate_to_wire(estimate: UpEstimate) -> wire::UpEstimate {
    wire::UpEstimate {
        up: up_to_wire(estimate.up).into(),
        agreement: estimate.agreement,
    }
}

fn review_counts(info: &CollectionInfo) -> wire::ReviewCounts {
    let count = |state: ReviewState| {
        let found = info.reviews.iter().find(|r| r.0 == state);
        found.map_or(0, |r| r.1)
    };
    wire::ReviewCounts {
        unseen: count(ReviewState::Unseen),
        corrected: count(ReviewState::Corrected),
        approved: count(ReviewState::Approved),
        doubtful: count(ReviewState::Doubtful),
    }
}

/// A collection.
pub fn collection(info: &CollectionInfo) -> wire::Collection {
    wire::Collection {
        spec: Some(spec_to_wire(&info.spec)),
        sequence: info.sequence,
        n_shapes: info.n_shapes,
        n_stale: info.n_stale,
        labels: info.labels.iter().map(label_info).collect(),
        up_estimate: info.up_estimate.map(estimate_to_wire),
        up_disagrees: info.up_disagrees.map(estimate_to_wire),
        n_undoable: info.n_undoable,
        reviews: Some(review_counts(info)),
    }
}

#[cfg(test)]
mod tests {
    use super::{collection_differs, collection_spec, new_up, spec_to_wire};
    use crate::ipc::wire;
    use crate::library::{CollectionSpec, Up};

    #[test]
    fn settings_survive_the_way() {
        let spec = CollectionSpec {
            name: "chairs".to_owned(),
            n_parts: Some(3),
            up: Up::MinusZ,
            operator: crate::operators::Operator::Cotan,
            working_faces: 4_000,
        };
        assert_eq!(collection_spec(&spec_to_wire(&spec), "spec"), Ok(spec));
    }

    #[test]
    fn only_stated_settings_are_compared() {
        let is = CollectionSpec {
            n_parts: Some(3),
            up: Up::PlusY,
            ..CollectionSpec::default()
        };
        let mut wish = wire::CollectionSpec::default();
        assert_eq!(collection_differs(&wish, &is), None);
        wish.n_parts = Some(3);
        wish.set_up(wire::Up::PlusY);
        assert_eq!(collection_differs(&wish, &is), None);
        wish.n_parts = Some(0);
        let expected = ("n_parts", "estimated".to_owned(), "3".to_owned());
        assert_eq!(collection_differs(&wish, &is), Some(expected));
        wish.n_parts = None;
        wish.set_up(wire::Up::Unknown);
        let expected = ("up", "unknown".to_owned(), "+y".to_owned());
        assert_eq!(collection_differs(&wish, &is), Some(expected));
    }

    #[test]
    fn unknown_enum_values_are_refused() {
        let spec = wire::CollectionSpec {
            up: 99,
            ..wire::CollectionSpec::default()
        };
        let error = collection_spec(&spec, "spec").unwrap_err();
        assert_eq!(
            error.message,
            "spec.up is 99, which this version does not know"
        );
        assert_eq!(error.reason(), wire::ErrorReason::FieldRange);
        let request = |up| wire::UpdateCollectionRequest {
            collection: String::new(),
            up,
        };
        let reason = |up| new_up(&request(up)).unwrap_err().reason();
        assert_eq!(reason(99), wire::ErrorReason::FieldRange);
        assert_eq!(reason(0), wire::ErrorReason::FieldMissing);
        assert_eq!(new_up(&request(wire::Up::Unknown.into())), Ok(Up::Unknown));
    }
}
