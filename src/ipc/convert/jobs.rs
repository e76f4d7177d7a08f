//! Shapes to add, and the jobs they belong to.

use super::errors::{error, failure, field_error, frame_error};
use crate::ipc::frames::FrameReader;
use crate::ipc::size;
use crate::ipc::wire::{self, ErrorCode, ErrorReason, error::Subject, shape_input};
use crate::library::{ItemState, Job, JobItem, Outcome, Placed, PropagationProgress};
use crate::mesh::Format;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// What the daemon allows when shapes come in.
#[derive(Clone, Copy)]
pub struct Ingest {
    /// Shapes of one request.
    pub max_shapes: usize,
    /// Bytes of one shape's file.
    pub max_shape_bytes: u64,
}

/// A shape of a request.
#[derive(Debug)]
pub struct ShapeInput {
    /// Its name.
    pub name: String,
    /// Its format.
    pub format: Format,
    /// Whether it replaces the one of its name.
    pub replace: bool,
    /// Its mesh file.
    pub source: Source,
}

/// Where the bytes of a mesh file are.
#[derive(Debug)]
pub enum Source {
    /// Here.
    Bytes(Vec<u8>),
    /// In a file that the daemon is to read, if that is allowed.
    File(PathBuf),
}

impl Ingest {
    /// Refuses the file of a request's `i`th shape if it is too large.
    pub fn check_length(&self, i: usize, name: &str, found: u64) -> Result<(), wire::Error> {
        let limit = self.max_shape_bytes;
        if found <= limit {
            return Ok(());
        }
        let field = format!("shapes[{i}]");
        let what = format!("{field} ({name:?})");
        let key = "limits.max_shape, within limits.memory";
        let message = size::beyond(&what, found, limit, key);
        Err(field_error(ErrorReason::MeshTooLarge, &field, message))
    }
}

/// A job in which a correction is carried.
pub fn carrying_job(job: &Job, carrying: &PropagationProgress) -> wire::Job {
    let finished = carrying.n_left == 0;
    wire::Job {
        job_id: job.id,
        collection: job.collection.clone(),
        items: Vec::new(),
        // A finished job changes no more.
        revision: if finished {
            u64::MAX
        } else {
            1 + carrying.n_shapes - carrying.n_left
        },
        finished,
        progress: carrying.progress(),
        carrying: Some(wire::Carrying {
            n_shapes: carrying.n_shapes,
            n_left: carrying.n_left,
        }),
    }
}

/// A format on the wire.
pub fn mesh_format(format: Format) -> wire::MeshFormat {
    match format {
        Format::Obj => wire::MeshFormat::Obj,
        Format::Off => wire::MeshFormat::Off,
        Format::Ply => wire::MeshFormat::Ply,
        Format::Stl => wire::MeshFormat::Stl,
        Format::Gltf => wire::MeshFormat::Gltf,
    }
}

/// A format from the wire; `None` when it is not given, or one this version does not know.
pub fn format_from_wire(format: wire::MeshFormat) -> Option<Format> {
    Format::ALL.into_iter().find(|f| mesh_format(*f) == format)
}

/// The shapes of a request, in its order.
pub fn new_shapes(
    request: &wire::AddShapesRequest,
    frames: FrameReader<'_>,
    ingest: &Ingest,
) -> Result<Vec<ShapeInput>, wire::Error> {
    let n = request.shapes.len();
    if n == 0 {
        return Err(field_error(
            ErrorReason::FieldMissing,
            "shapes",
            "shapes is empty",
        ));
    }
    if n > ingest.max_shapes {
        let message = format!("shapes has {n} entries, the limit is {}", ingest.max_shapes);
        return Err(field_error(ErrorReason::MessageTooLarge, "shapes", message));
    }
    let shapes = request.shapes.iter().enumerate();
    shapes
        .map(|(i, shape)| new_shape(shape, i, frames, ingest))
        .collect()
}

fn new_shape(
    shape: &wire::ShapeInput,
    i: usize,
    frames: FrameReader<'_>,
    ingest: &Ingest,
) -> Result<ShapeInput, wire::Error> {
    let field = format!("shapes[{i}]");
    let (source, format) = match &shape.source {
        None => {
            let message = format!("{field} ({:?}) has no mesh", shape.name);
            return Err(field_error(
                ErrorReason::FieldMissing,
                &format!("{field}.source"),
                message,
            ));
        }
        Some(shape_input::Source::Encoded(mesh)) => {
            let format = format_from_wire(mesh.format()).ok_or_else(|| {
                let field = format!("{field}.encoded.format");
                let found = mesh.format;
                let message = format!("{field} is {found}, expected OBJ, OFF, PLY, STL or GLTF");
                field_error(ErrorReason::FieldRange, &field, message)
            })?;
            let bytes = frames
                .file(mesh.bytes.as_ref(), &format!("{field}.encoded.bytes"))
                .map_err(|e| frame_error(&e))?;
            // Before they are copied.
            ingest.check_length(i, &shape.name, bytes.len() as u64)?;
            (Source::Bytes(bytes.to_vec()), format)
        }
        Some(shape_input::Source::Arrays(mesh)) => {
            let bytes = off_from_arrays(mesh, &format!("{field}.arrays"), frames)?;
            (Source::Bytes(bytes), Format::Off)
        }
        Some(shape_input::Source::Path(path)) => {
            let path = Path::new(path);
            let format = Format::from_name(&path.to_string_lossy()).ok_or_else(|| {
                let (path, known) = (path.display(), Format::EXTENSIONS);
                let message = format!("{path} has no known mesh extension ({known})");
                field_error(ErrorReason::FieldRange, &format!("{field}.path"), message)
            })?;
            (Source::File(path.to_owned()), format)
        }
    };
    Ok(ShapeInput {
        name: shape.name.clone(),
        format,
        replace: shape.replace,
        source,
    })
}

/// The OFF file that holds exactly these values: the shortest decimals that read back as the same bits.
fn off_from_arrays(
    mesh: &wire::ArrayMesh,
    field: &str,
    frames: FrameReader<'_>,
) -> Result<Vec<u8>, wire::Error> {
    let range = |field: String, message: String| {
        field_error(
            ErrorReason::FieldRange,
            &field,
            format!("{field} {message}"),
        )
    };
    let field_of = |name: &str| format!("{field}.{name}");
    let read = |e| frame_error(&e);
    let (coordinates, shape) = frames
        .coordinate_array(mesh.vertices.as_ref(), &field_of("vertices"))
        .map_err(read)?;
    let [n, 3] = shape[..] else {
        return Err(range(
            field_of("vertices"),
            format!("has shape {shape:?}, expected (n, 3)"),
        ));
    };
    let (faces, shape) = frames
        .index_array(mesh.faces.as_ref(), &field_of("faces"))
        .map_err(read)?;
    let (m, d) = match shape[..] {
        [m, d] if d >= 3 => (m, d),
        _ => {
            let message = format!("has shape {shape:?}, expected (m, d) with d >= 3");
            return Err(range(field_of("faces"), message));
        }
    };
    let mut text = format!("OFF\n{n} {m} 0\n");
    // Writing to a string cannot fail.
    for v in coordinates.chunks_exact(3) {
        let _ = writeln!(text, "{} {} {}", v[0], v[1], v[2]);
    }
    for (i, face) in faces.chunks_exact(d).enumerate() {
        if let Some(v) = face.iter().find(|&&v| v as usize >= n) {
            let message = format!("face {i} names vertex {v}, but the mesh has {n}");
            let e = error(
                ErrorCode::InvalidArgument,
                ErrorReason::VertexIndex,
                message,
            );
            return Err(super::with_subject(e, Subject::Face(i as u64)));
        }
        let _ = write!(text, "{d}");
        for v in face {
            let _ = write!(text, " {v}");
        }
        text.push('\n');
    }
    Ok(text.into_bytes())
}

/// The answer to an accepted AddShapes.
pub fn add_shapes(job_id: u64, n_shapes: usize, job: Option<wire::Job>) -> wire::AddShapesReply {
    let n_shapes = u32::try_from(n_shapes).expect("invariant: shapes per request are limited");
    wire::AddShapesReply {
        job_id,
        n_shapes,
        job,
    }
}

/// Whether nothing of the item is left to do.
pub fn job_finished(state: &ItemState) -> bool {
    match state {
        ItemState::Queued | ItemState::Running(_) => false,
        ItemState::Done(_) | ItemState::Failed(_) | ItemState::Cancelled => true,
    }
}

fn placed(p: &Placed) -> wire::Placed {
    let outcome = match p.outcome {
        Outcome::Added => wire::Outcome::Added,
        Outcome::Unchanged => wire::Outcome::Unchanged,
        Outcome::Replaced => wire::Outcome::Replaced,
    };
    let stages = p.stages_ms.iter().map(|(stage, ms)| wire::StageTime {
        stage: stage.clone(),
        ms: *ms,
    });
    wire::Placed {
        outcome: outcome.into(),
        version: p.version,
        sequence: p.sequence,
        n_maps: p.n_maps,
        n_relabelled: p.n_relabelled,
        n_inconsistent: p.n_inconsistent,
        stages: stages.collect(),
    }
}

/// One shape of a job; `live_stage` is what it is at in this process, if it is at anything.
pub fn item(i: &JobItem, live_stage: Option<&str>) -> wire::JobItem {
    let mut wire = wire::JobItem {
        index: i.index,
        name: i.name.clone(),
        attempts: i.attempts,
        ..Default::default()
    };
    let state = match (&i.state, live_stage) {
        (ItemState::Queued | ItemState::Running(_), Some(stage)) => {
            wire.stage = stage.to_owned();
            wire::ItemState::Running
        }
        (ItemState::Running(stage), None) => {
            wire.stage.clone_from(stage);
            wire::ItemState::Running
        }
        (ItemState::Queued, None) => wire::ItemState::Queued,
        (ItemState::Done(p), _) => {
            wire.placed = Some(placed(p));
            wire::ItemState::Done
        }
        (ItemState::Failed(f), _) => {
            wire.error = Some(failure(f));
            wire::ItemState::Failed
        }
        (ItemState::Cancelled, _) => wire::ItemState::Cancelled,
    };
    wire.set_state(state);
    wire
}

#[cfg(test)]
mod tests {
    use super::{FrameReader, Ingest, new_shapes};
    use crate::ipc::frames::FrameWriter;
    use crate::ipc::wire::{self, ErrorReason, error::Subject, shape_input::Source};

    fn read(
        source: Option<Source>,
        frames: &[bytes::Bytes],
    ) -> Result<Vec<super::ShapeInput>, wire::Error> {
        let shape = wire::ShapeInput {
            name: "x".to_owned(),
            replace: false,
            source,
        };
        let request = wire::AddShapesRequest {
            shapes: vec![shape],
            ..Default::default()
        };
        let ingest = Ingest {
            max_shapes: 1,
            max_shape_bytes: 1_000,
        };
        new_shapes(&request, FrameReader::new(frames), &ingest)
    }

    #[test]
    fn arrays_become_an_off_file_of_the_same_bits() {
        let mut writer = FrameWriter::default();
        let vertices = writer.f64_array(&[0.1, 0.0, 1e-300, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0], &[3, 3]);
        let faces = writer.i32_array(&[0, 1, 2], &[1, 3]);
        let mesh = wire::ArrayMesh {
            vertices: Some(vertices),
            faces: Some(faces),
        };
        let shapes = read(Some(Source::Arrays(mesh)), &writer.finish()).unwrap();
        let super::Source::Bytes(bytes) = &shapes[0].source else {
            panic!("no bytes");
        };
        let text = String::from_utf8(bytes.clone()).unwrap();
        let first: Vec<f64> = text
            .lines()
            .nth(2)
            .unwrap()
            .split(' ')
            .map(|x| x.parse().unwrap())
            .collect();
        assert_eq!(first, [0.1, 0.0, 1e-300]);
        assert!(
            text.starts_with("OFF\n3 1 0\n") && text.ends_with("\n3 0 1 2\n"),
            "{text}"
        );
    }

    #[test]
    fn array_faces_are_checked() {
        let mut writer = FrameWriter::default();
        let vertices = writer.f32_array(&[0.0; 9], &[3, 3]);
        let faces = writer.i32_array(&[0, 1, 2, 0, -1, 2], &[2, 3]);
        let mesh = wire::ArrayMesh {
            vertices: Some(vertices),
            faces: Some(faces),
        };
        let error = read(Some(Source::Arrays(mesh)), &writer.finish()).unwrap_err();
        assert_eq!(error.reason(), ErrorReason::VertexIndex);
        assert_eq!(error.subject, Some(Subject::Face(1)));
    }

    #[test]
    fn missing_and_oversized_meshes_are_refused() {
        assert_eq!(
            read(None, &[]).unwrap_err().reason(),
            ErrorReason::FieldMissing
        );
        let encoded = |format: wire::MeshFormat| {
            let bytes = Some(wire::BytesRef { frame: 0 });
            Some(Source::Encoded(wire::EncodedMesh {
                format: format.into(),
                bytes,
            }))
        };
        let reason = |source, n: usize| {
            read(source, &[bytes::Bytes::from(vec![0; n])])
                .unwrap_err()
                .reason()
        };
        assert_eq!(
            reason(encoded(wire::MeshFormat::Obj), 1_001),
            ErrorReason::MeshTooLarge
        );
        assert_eq!(
            reason(encoded(wire::MeshFormat::Unspecified), 1),
            ErrorReason::FieldRange
        );
        assert_eq!(
            read(encoded(wire::MeshFormat::Off), &[])
                .unwrap_err()
                .reason(),
            ErrorReason::FrameMissing
        );
        let path = |p: &str| Some(Source::Path(p.to_owned()));
        let shapes = read(path("/a/b.off"), &[]).unwrap();
        let super::Source::File(file) = &shapes[0].source else {
            panic!("{shapes:?}");
        };
        assert_eq!(file, std::path::Path::new("/a/b.off"));
        let ingest = Ingest {
            max_shapes: 1,
            max_shape_bytes: 1_000,
        };
        assert!(ingest.check_length(0, "x", 1_000).is_ok());
        let error = ingest.check_length(0, "x", 1_001).unwrap_err();
        assert_eq!(error.reason(), ErrorReason::MeshTooLarge);
        assert_eq!(reason(path("/a/b.step"), 0), ErrorReason::FieldRange);
    }
}
