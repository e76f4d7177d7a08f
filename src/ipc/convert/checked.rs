//! Validates a request before any work for it starts: it rejects unknown enum values, frames that
//! no field names, and lists beyond their limits.

use super::errors::{error, field_error};
use super::links::new_link;
use crate::ipc::wire::{
    self, ErrorCode, ErrorReason, correct_labels_request::Correction, shape_input,
};

/// Maximum number of landmarks of one map between points.
pub const MAX_LANDMARKS: usize = 1_000;
/// Maximum number of shapes of one GetPortraits.
pub const MAX_PORTRAITS: usize = 256;

/// Checks an addition of shapes.
pub fn check_addition(
    r: &wire::AddShapesRequest,
    frames: &mut NamedFrames,
) -> Result<(), wire::Error> {
    check_spec(r.create.as_ref(), "create")?;
    known::<wire::AddMode>(r.mode, "mode")?;
    for (i, shape) in r.shapes.iter().enumerate() {
        match &shape.source {
            Some(shape_input::Source::Encoded(mesh)) => {
                // Spelt out only where it is needed: there may be very many shapes.
                if wire::MeshFormat::try_from(mesh.format).is_err() {
                    let field = format!("shapes[{i}].encoded.format");
                    known::<wire::MeshFormat>(mesh.format, &field)?;
                }
                frames.file(mesh.bytes.as_ref());
            }
            Some(shape_input::Source::Arrays(mesh)) => {
                frames.array(mesh.vertices.as_ref());
                frames.array(mesh.faces.as_ref());
            }
            Some(shape_input::Source::Path(_)) | None => {}
        }
    }
    Ok(())
}

/// Checks the creation of a collection.
pub fn check_creation(
    r: &wire::CreateCollectionRequest,
    _frames: &mut NamedFrames,
) -> Result<(), wire::Error> {
    check_spec(r.spec.as_ref(), "spec")
}

/// Checks a change of a collection's settings.
pub fn check_update(
    r: &wire::UpdateCollectionRequest,
    _frames: &mut NamedFrames,
) -> Result<(), wire::Error> {
    known::<wire::Up>(r.up, "up")
}

/// Checks a correction of labels.
pub fn check_correction(
    r: &wire::CorrectLabelsRequest,
    frames: &mut NamedFrames,
) -> Result<(), wire::Error> {
    match &r.correction {
        Some(Correction::Labels(labels)) => frames.array(Some(labels)),
        Some(Correction::Faces(faces)) => frames.array(faces.faces.as_ref()),
        Some(Correction::Part(_)) | None => {}
    }
    Ok(())
}

/// Checks a request for a map.
pub fn check_map(
    r: &wire::GetFunctionalMapRequest,
    _frames: &mut NamedFrames,
) -> Result<(), wire::Error> {
    known::<wire::Resolution>(r.resolution, "resolution")?;
    check_points(r.points.as_ref())
}

/// Checks a request for a spectrum.
pub fn check_spectrum(
    r: &wire::GetSpectrumRequest,
    _frames: &mut NamedFrames,
) -> Result<(), wire::Error> {
    known::<wire::Resolution>(r.resolution, "resolution")
}

/// Checks a request for a heat kernel signature.
pub fn check_hks(r: &wire::GetHksRequest, _frames: &mut NamedFrames) -> Result<(), wire::Error> {
    known::<wire::Resolution>(r.resolution, "resolution")
}

/// Checks a transfer of values.
pub fn check_transfer(
    r: &wire::TransferFunctionRequest,
    frames: &mut NamedFrames,
) -> Result<(), wire::Error> {
    known::<wire::Resolution>(r.resolution, "resolution")?;
    check_points(r.points.as_ref())?;
    frames.array(r.values.as_ref());
    Ok(())
}

/// Checks a request for portraits.
pub fn check_portraits(
    r: &wire::GetPortraitsRequest,
    _frames: &mut NamedFrames,
) -> Result<(), wire::Error> {
    known::<wire::PortraitDetail>(r.detail, "detail")?;
    let is_proxy = matches!(
        r.detail(),
        wire::PortraitDetail::Unspecified | wire::PortraitDetail::Proxy
    );
    if r.proposal > 0 && !is_proxy {
        let text = format!(
            "proposal {} is wanted of {}, but only a portrait of the proxy can have its classes",
            r.proposal,
            r.detail().as_str_name()
        );
        return Err(field_error(ErrorReason::FieldRange, "proposal", text));
    }
    at_most("shapes", r.shapes.len(), MAX_PORTRAITS)
}

/// Checks a verdict on a shape: only some can be given.
pub fn check_review(
    r: &wire::ReviewShapeRequest,
    _frames: &mut NamedFrames,
) -> Result<(), wire::Error> {
    known::<wire::ReviewState>(r.state, "state")?;
    match r.state() {
        wire::ReviewState::Approved | wire::ReviewState::Doubtful => Ok(()),
        other => {
            let text = format!(
                "state is {}, but only approved and doubtful can be given",
                other.as_str_name()
            );
            Err(field_error(ErrorReason::FieldRange, "state", text))
        }
    }
}

/// Checks a link between parts.
pub fn check_link(
    r: &wire::LinkPartsRequest,
    _frames: &mut NamedFrames,
) -> Result<(), wire::Error> {
    known::<wire::LinkKind>(r.kind, "kind")?;
    new_link(r).map(|_| ())
}

/// Checks a request for shapes.
pub fn check_reviews(
    r: &wire::ListShapesRequest,
    _frames: &mut NamedFrames,
) -> Result<(), wire::Error> {
    known::<wire::ReviewState>(r.review, "review")
}

/// Rejects an enum value that this version does not know.
fn known<T: TryFrom<i32>>(value: i32, field: &str) -> Result<(), wire::Error> {
    T::try_from(value).map(|_| ()).map_err(|_| {
        let text = format!("{field} is {value}, which this version does not know");
        field_error(ErrorReason::FieldRange, field, text)
    })
}

fn at_most(field: &str, found: usize, limit: usize) -> Result<(), wire::Error> {
    if found <= limit {
        return Ok(());
    }
    let text = format!("{field} has {found} entries, the limit is {limit}");
    Err(field_error(ErrorReason::FieldRange, field, text))
}

fn check_spec(spec: Option<&wire::CollectionSpec>, field: &str) -> Result<(), wire::Error> {
    let Some(spec) = spec else { return Ok(()) };
    known::<wire::Up>(spec.up, &format!("{field}.up"))?;
    known::<wire::Operator>(spec.operator, &format!("{field}.operator"))
}

fn check_points(points: Option<&wire::PointMapOptions>) -> Result<(), wire::Error> {
    let Some(points) = points else { return Ok(()) };
    known::<wire::MapOrientation>(points.orientation, "points.orientation")?;
    let field = "points.landmark_resolution";
    known::<wire::Resolution>(points.landmark_resolution, field)?;
    if points.landmark_resolution() == wire::Resolution::InputFaces {
        let text = format!(
            "{field} is RESOLUTION_INPUT_FACES, but landmarks are vertices: RESOLUTION_INPUT or \
             RESOLUTION_PROXY"
        );
        return Err(field_error(ErrorReason::FieldRange, field, text));
    }
    at_most("points.landmarks", points.landmarks.len(), MAX_LANDMARKS)
}

/// The raw frames that fields of a request name. A frame that is named and missing is refused where
/// it is read, with the field.
#[derive(Default)]
pub struct NamedFrames(Vec<u32>);

impl NamedFrames {
    fn array(&mut self, array: Option<&wire::ArrayRef>) {
        self.0.extend(array.map(|a| a.frame));
    }

    fn file(&mut self, file: Option<&wire::BytesRef>) {
        self.0.extend(file.map(|f| f.frame));
    }

    /// Refuses a message with a raw frame that no field names.
    ///
    /// # Errors
    /// The first such frame.
    pub fn check(&self, n_frames: usize) -> Result<(), wire::Error> {
        let mut is_named = vec![false; n_frames];
        for &frame in &self.0 {
            if let Some(named) = is_named.get_mut(frame as usize) {
                *named = true;
            }
        }
        let Some(stray) = is_named.iter().position(|named| !named) else {
            return Ok(());
        };
        let text =
            format!("the message has {n_frames} raw frames, but no field names frame {stray}");
        Err(error(
            ErrorCode::InvalidArgument,
            ErrorReason::FrameMissing,
            text,
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::{
        NamedFrames, check_addition, check_creation, check_hks, check_map, check_portraits,
        check_spectrum, check_transfer,
    };
    use crate::ipc::wire::{self, ErrorReason, error::Subject, shape_input::Source};

    type Check<R> = fn(&R, &mut NamedFrames) -> Result<(), wire::Error>;

    fn checked<R>(check: Check<R>, request: &R, n_frames: usize) -> Result<(), wire::Error> {
        let mut frames = NamedFrames::default();
        check(request, &mut frames)?;
        frames.check(n_frames)
    }

    fn adding(sources: Vec<Source>) -> wire::AddShapesRequest {
        let shape = |source| wire::ShapeInput {
            source: Some(source),
            ..Default::default()
        };
        wire::AddShapesRequest {
            shapes: sources.into_iter().map(shape).collect(),
            ..Default::default()
        }
    }

    fn file(frame: u32) -> Source {
        Source::Encoded(wire::EncodedMesh {
            format: wire::MeshFormat::Off.into(),
            bytes: Some(wire::BytesRef { frame }),
        })
    }

    #[test]
    fn every_frame_is_named() {
        let array = |frame| {
            Some(wire::ArrayRef {
                frame,
                ..Default::default()
            })
        };
        let mesh = Source::Arrays(wire::ArrayMesh {
            vertices: array(1),
            faces: array(2),
        });
        let add = adding(vec![file(0), mesh, file(0)]);
        assert_eq!(checked(check_addition, &add, 3), Ok(()));
        let e = checked(check_addition, &add, 4).unwrap_err();
        assert_eq!(e.reason(), ErrorReason::FrameMissing);
        assert_eq!(
            e.message,
            "the message has 4 raw frames, but no field names frame 3"
        );
        assert_eq!(NamedFrames::default().check(0), Ok(()));
        assert!(NamedFrames::default().check(1).is_err());
        let values = wire::TransferFunctionRequest {
            values: array(0),
            ..Default::default()
        };
        assert_eq!(checked(check_transfer, &values, 1), Ok(()));
        assert!(checked(check_transfer, &values, 2).is_err());
    }

    #[test]
    fn values_that_this_version_does_not_know_are_refused() {
        let spec = |up, operator| {
            Some(wire::CollectionSpec {
                up,
                operator,
                ..Default::default()
            })
        };
        let create = |spec| {
            let request = wire::CreateCollectionRequest { spec };
            checked(check_creation, &request, 0)
        };
        let add = |create, mode, format| {
            let mesh = wire::EncodedMesh {
                format,
                bytes: None,
            };
            let request = wire::AddShapesRequest {
                create,
                mode,
                ..adding(vec![Source::Encoded(mesh)])
            };
            checked(check_addition, &request, 0)
        };
        let points = |orientation, n| wire::PointMapOptions {
            orientation,
            landmarks: vec![wire::Landmark::default(); n],
            ..Default::default()
        };
        let map = |points| {
            let request = wire::GetFunctionalMapRequest {
                points: Some(points),
                ..Default::default()
            };
            checked(check_map, &request, 0)
        };
        let transfer = |points| {
            let request = wire::TransferFunctionRequest {
                points: Some(points),
                ..Default::default()
            };
            checked(check_transfer, &request, 0)
        };
        let rows = |resolution| {
            let points = |landmark_resolution| wire::PointMapOptions {
                landmark_resolution,
                ..Default::default()
            };
            let hks = wire::GetHksRequest {
                resolution,
                ..Default::default()
            };
            let spectrum = wire::GetSpectrumRequest {
                resolution,
                ..Default::default()
            };
            let transfer = wire::TransferFunctionRequest {
                resolution,
                ..Default::default()
            };
            let map = wire::GetFunctionalMapRequest {
                resolution,
                ..Default::default()
            };
            let landmarks = wire::GetFunctionalMapRequest {
                points: Some(points(resolution)),
                ..Default::default()
            };
            [
                checked(check_hks, &hks, 0),
                checked(check_spectrum, &spectrum, 0),
                checked(check_transfer, &transfer, 0),
                checked(check_map, &map, 0),
                checked(check_map, &landmarks, 0),
            ]
        };
        let (known, faces) = (rows(2), rows(3));
        assert!(known.iter().all(Result::is_ok), "{known:?}");
        assert!(rows(4).iter().all(Result::is_err));
        // Landmarks are no faces.
        assert!(faces[..4].iter().all(Result::is_ok) && faces[4].is_err());
        let portraits = |detail, n, proposal| {
            let request = wire::GetPortraitsRequest {
                detail,
                proposal,
                shapes: vec![String::new(); n],
                ..Default::default()
            };
            checked(check_portraits, &request, 0)
        };
        for done in [
            create(spec(8, 3)),
            add(spec(1, 1), 2, 5),
            map(points(2, 1_000)),
            transfer(points(0, 0)),
            portraits(3, 256, 0),
            portraits(1, 256, 8),
        ] {
            assert_eq!(done, Ok(()));
        }
        for (done, field) in [
            (create(spec(99, 0)), "spec.up"),
            (create(spec(0, -1)), "spec.operator"),
            (add(spec(99, 0), 0, 1), "create.up"),
            (add(None, 3, 1), "mode"),
            (add(None, 0, 6), "shapes[0].encoded.format"),
            (map(points(3, 0)), "points.orientation"),
            (map(points(0, 1_001)), "points.landmarks"),
            (transfer(points(i32::MIN, 0)), "points.orientation"),
            (transfer(points(0, 1_001)), "points.landmarks"),
            (portraits(4, 0, 0), "detail"),
            (portraits(0, 257, 0), "shapes"),
            (portraits(2, 1, 1), "proposal"),
        ] {
            let e = done.unwrap_err();
            assert_eq!(e.reason(), ErrorReason::FieldRange, "{field}");
            assert_eq!(e.subject, Some(Subject::Field(field.to_owned())));
        }
    }
}
