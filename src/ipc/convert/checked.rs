//! Validates a request before any work for it starts: it rejects unknown enum values, frames that
//! no field names, and lists beyond their limits.

use super::errors::{error, field_error};
use crate::ipc::wire::{
    self, ErrorCode, ErrorReason, correct_labels_request::Correction, request::Body, shape_input,
};

/// Maximum number of landmarks of one map between points.
pub const MAX_LANDMARKS: usize = 1_000;
/// Maximum number of shapes of one GetPortraits.
pub const MAX_PORTRAITS: usize = 256;

/// Rejects a request with this number of raw frames if it is wrong regardless of the library.
pub fn check_request(body: &Body, n_frames: usize) -> Result<(), wire::Error> {
    let mut frames = Named::default();
    match body {
        Body::CreateCollection(r) => check_spec(r.spec.as_ref(), "spec")?,
        Body::UpdateCollection(r) => known::<wire::Up>(r.up, "up")?,
        Body::AddShapes(r) => {
            check_spec(r.create.as_ref(), "create")?;
            known::<wire::AddMode>(r.mode, "mode")?;
            for (i, shape) in r.shapes.iter().enumerate() {
                match &shape.source {
                    Some(shape_input::Source::Encoded(mesh)) => {
                        // The name is built only for an error, since there may be very many shapes.
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
        }
        Body::CorrectLabels(r) => match &r.correction {
            Some(Correction::Labels(labels)) => frames.array(Some(labels)),
            Some(Correction::Faces(faces)) => frames.array(faces.faces.as_ref()),
            Some(Correction::Part(_)) | None => {}
        },
        Body::GetFunctionalMap(r) => check_points(r.points.as_ref())?,
        Body::TransferFunction(r) => {
            check_points(r.points.as_ref())?;
            frames.array(r.values.as_ref());
        }
        Body::GetPortraits(r) => {
            known::<wire::PortraitDetail>(r.detail, "detail")?;
            at_most("shapes", r.shapes.len(), MAX_PORTRAITS)?;
        }
        Body::Hello(_)
        | Body::Stats(_)
        | Body::Drain(_)
        | Body::ListCollections(_)
        | Body::DescribeCollection(_)
        | Body::DeleteCollection(_)
        | Body::NameLabel(_)
        | Body::GetJob(_)
        | Body::WatchJob(_)
        | Body::CancelJob(_)
        | Body::WaitIdle(_)
        | Body::ListJobs(_)
        | Body::RetryJob(_)
        | Body::ListShapes(_)
        | Body::GetShape(_)
        | Body::GetLabels(_)
        | Body::GetOriginal(_)
        | Body::RemoveShape(_)
        | Body::LabelsSnapshot(_)
        | Body::GetSpectrum(_)
        | Body::GetHks(_)
        | Body::GetDescriptors(_)
        | Body::GetPartCorrespondence(_)
        | Body::Nearest(_)
        | Body::EventsSince(_)
        | Body::MergeLabels(_)
        | Body::SplitLabel(_)
        | Body::Undo(_)
        | Body::SuggestNext(_) => {}
    }
    frames.check(n_frames)
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
    at_most("points.landmarks", points.landmarks.len(), MAX_LANDMARKS)
}

/// Frames that fields name. A named frame that was not sent is rejected when it is read, with the
/// field.
#[derive(Default)]
struct Named(Vec<u32>);

impl Named {
    fn array(&mut self, array: Option<&wire::ArrayRef>) {
        self.0.extend(array.map(|a| a.frame));
    }

    fn file(&mut self, file: Option<&wire::BytesRef>) {
        self.0.extend(file.map(|f| f.frame));
    }

    fn check(&self, n_frames: usize) -> Result<(), wire::Error> {
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
    use super::check_request;
    use crate::ipc::wire::{self, ErrorReason, error::Subject, request::Body, shape_input::Source};

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
        let body = Body::AddShapes(adding(vec![file(0), mesh, file(0)]));
        assert_eq!(check_request(&body, 3), Ok(()));
        let e = check_request(&body, 4).unwrap_err();
        assert_eq!(e.reason(), ErrorReason::FrameMissing);
        assert_eq!(
            e.message,
            "the message has 4 raw frames, but no field names frame 3"
        );
        let hello = Body::Hello(wire::HelloRequest {});
        assert_eq!(check_request(&hello, 0), Ok(()));
        assert!(check_request(&hello, 1).is_err());
        let values = Body::TransferFunction(wire::TransferFunctionRequest {
            values: array(0),
            ..Default::default()
        });
        assert_eq!(check_request(&values, 1), Ok(()));
        assert!(check_request(&values, 2).is_err());
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
        let create = |spec| Body::CreateCollection(wire::CreateCollectionRequest { spec });
        let add = |create, mode, format| {
            let mesh = wire::EncodedMesh {
                format,
                bytes: None,
            };
            Body::AddShapes(wire::AddShapesRequest {
                create,
                mode,
                ..adding(vec![Source::Encoded(mesh)])
            })
        };
        let points = |orientation, n| wire::PointMapOptions {
            orientation,
            landmarks: vec![wire::Landmark::default(); n],
            ..Default::default()
        };
        let map = |points| {
            Body::GetFunctionalMap(wire::GetFunctionalMapRequest {
                points: Some(points),
                ..Default::default()
            })
        };
        let transfer = |points| {
            Body::TransferFunction(wire::TransferFunctionRequest {
                points: Some(points),
                ..Default::default()
            })
        };
        let portraits = |detail, n| {
            Body::GetPortraits(wire::GetPortraitsRequest {
                detail,
                shapes: vec![String::new(); n],
                ..Default::default()
            })
        };
        for body in [
            create(spec(8, 3)),
            add(spec(1, 1), 2, 5),
            map(points(2, 1_000)),
            transfer(points(0, 0)),
            portraits(3, 256),
        ] {
            assert_eq!(check_request(&body, 0), Ok(()), "{body:?}");
        }
        for (body, field) in [
            (create(spec(99, 0)), "spec.up"),
            (create(spec(0, -1)), "spec.operator"),
            (add(spec(99, 0), 0, 1), "create.up"),
            (add(None, 3, 1), "mode"),
            (add(None, 0, 6), "shapes[0].encoded.format"),
            (map(points(3, 0)), "points.orientation"),
            (map(points(0, 1_001)), "points.landmarks"),
            (transfer(points(i32::MIN, 0)), "points.orientation"),
            (transfer(points(0, 1_001)), "points.landmarks"),
            (portraits(4, 0), "detail"),
            (portraits(0, 257), "shapes"),
        ] {
            let e = check_request(&body, 0).unwrap_err();
            assert_eq!(e.reason(), ErrorReason::FieldRange, "{body:?}");
            assert_eq!(e.subject, Some(Subject::Field(field.to_owned())));
        }
    }
}
