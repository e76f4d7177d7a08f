//! `coseg export`: labels, or coloured meshes, of a collection become files.

use super::export_mesh::{colour, material, materials};
use super::session::{Session, bar};
use super::{CommandError, Outcome, labels};
use crate::cli::{Export, ExportFormat};
use coseg::call;
use coseg::ipc::client::ClientError;
use coseg::ipc::convert::{format_from_wire, up_from_wire};
use coseg::ipc::frames::FrameReader;
use coseg::ipc::wire;
use coseg::mesh::write::{glb, mtl, npy, obj, ply, seg, usda};
use coseg::mesh::{ParsedMesh, parse};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// The material file that exported OBJ files name.
const MATERIALS: &str = "labels.mtl";

pub(crate) fn run(args: &Export, mut session: Session) -> Outcome {
    let collection = session.collection(&args.within)?;
    if !args.no_wait {
        session.wait_until_idle(&collection)?;
    }
    let described = session.describe(&collection)?;
    let (infos, up) = (&described.labels, up_axis(&described));
    let shapes = match args.shapes.as_slice() {
        [] => session
            .shapes(&collection, None)?
            .into_iter()
            .map(|s| s.name)
            .collect(),
        some => some.to_vec(),
    };
    std::fs::create_dir_all(&args.out).map_err(|e| at(&args.out, e))?;
    let mut written: Vec<String> = Vec::new();
    let mut write = |name: String, text: &[u8]| {
        let path = args.out.join(name);
        std::fs::write(&path, text).map_err(|e| at(&path, e))?;
        written.push(path.display().to_string());
        Ok::<_, CommandError>(())
    };
    let progress = bar(shapes.len() as u64);
    for shape in &shapes {
        progress.set_message(shape.clone());
        let request = wire::GetLabelsRequest {
            collection: collection.clone(),
            shape: shape.clone(),
            version: 0,
            confidence: false,
        };
        let labels = labels::receive(&mut session, request)?.labels;
        let (name, bytes) = if let Some(found) = without_mesh(args.format, shape, &labels, infos) {
            found
        } else {
            let mesh = original(&mut session, &collection, shape, labels.len())?;
            with_mesh(args.format, shape, (&mesh, up), &labels, infos)
        };
        write(name, &bytes)?;
        progress.inc(1);
    }
    if args.format == ExportFormat::Obj {
        let named: Vec<(String, [u8; 3])> = materials(infos)
            .into_iter()
            .map(|(_, name, colour)| (name, colour))
            .collect();
        write(MATERIALS.to_owned(), mtl(&named).as_bytes())?;
    }
    progress.finish_and_clear();
    if session.json {
        let format = format!("{:?}", args.format).to_lowercase();
        session
            .print_json(&json!({ "collection": collection, "format": format, "files": written }))?;
    } else {
        eprintln!("{} shapes written to {}", shapes.len(), args.out.display());
    }
    Ok(true)
}

/// Name and bytes of a file that holds labels alone; `None` for formats that need the mesh.
fn without_mesh(
    format: ExportFormat,
    shape: &str,
    labels: &[i32],
    infos: &[wire::LabelInfo],
) -> Option<(String, Vec<u8>)> {
    Some(match format {
        ExportFormat::Labels => (format!("{shape}.labels.txt"), seg(labels).into_bytes()),
        ExportFormat::Seg => (format!("{shape}.seg"), seg(labels).into_bytes()),
        ExportFormat::Npy => (format!("{shape}.labels.npy"), npy(labels)),
        ExportFormat::Json => {
            let names: serde_json::Map<String, Value> = materials(infos)
                .into_iter()
                .map(|(label, name, _)| (label.to_string(), name.into()))
                .collect();
            let value = json!({ "shape": shape, "labels": labels, "names": names });
            (
                format!("{shape}.labels.json"),
                value.to_string().into_bytes(),
            )
        }
        ExportFormat::Ply | ExportFormat::Obj | ExportFormat::Glb | ExportFormat::Usda => {
            return None;
        }
    })
}

/// The axis that is up in the files of a collection: the one it was given, or that most shapes agree on.
fn up_axis(collection: &wire::Collection) -> Option<[f64; 3]> {
    let given = collection.spec.as_ref().map(wire::CollectionSpec::up)?;
    let estimate = collection.up_estimate.as_ref();
    let up = match given {
        wire::Up::Auto => estimate?.up(),
        given => given,
    };
    up_from_wire(up).axis()
}

/// Name and bytes of a file that holds the mesh, with its up axis, and its labels.
fn with_mesh(
    format: ExportFormat,
    shape: &str,
    (mesh, up): (&ParsedMesh, Option<[f64; 3]>),
    labels: &[i32],
    infos: &[wire::LabelInfo],
) -> (String, Vec<u8>) {
    let (vertices, polygons) = (&mesh.vertices, mesh.polygons());
    let name = |label| material(label, infos);
    let named = |label| (material(label, infos), colour(label, infos));
    match format {
        ExportFormat::Obj => {
            let text = obj(vertices, &polygons, labels, name, MATERIALS);
            (format!("{shape}.obj"), text.into_bytes())
        }
        ExportFormat::Glb => {
            let bytes = glb(shape, vertices, &polygons, labels, up, named);
            (format!("{shape}.glb"), bytes)
        }
        ExportFormat::Usda => {
            let text = usda(shape, vertices, &polygons, labels, up, named);
            (format!("{shape}.usda"), text.into_bytes())
        }
        _ => {
            let colours: Vec<[u8; 3]> = labels.iter().map(|&l| colour(l, infos)).collect();
            let bytes = ply(vertices, &polygons, &colours, labels);
            (format!("{shape}.ply"), bytes)
        }
    }
}

fn at(path: &Path, source: std::io::Error) -> CommandError {
    CommandError::File {
        path: PathBuf::from(path).display().to_string(),
        source,
    }
}

/// The mesh of a shape as it was sent.
pub(super) fn original(
    session: &mut Session,
    collection: &str,
    shape: &str,
    n_labels: usize,
) -> Result<ParsedMesh, CommandError> {
    let mesh = original_of(session, collection, shape)?;
    if mesh.n_polygons != n_labels {
        let n = mesh.n_polygons;
        return Err(CommandError::Client(ClientError::BadReply(format!(
            "{shape} has {n} faces, but {n_labels} labels, by an earlier release: add it again with \
             --replace"
        ))));
    }
    Ok(mesh)
}

/// The mesh of a shape, as it was sent.
pub(super) fn original_of(
    session: &mut Session,
    collection: &str,
    shape: &str,
) -> Result<ParsedMesh, CommandError> {
    let request = wire::GetOriginalRequest {
        collection: collection.to_owned(),
        shape: shape.to_owned(),
    };
    let (reply, frames) = call!(session.client, GetOriginal(request), frames)?;
    let bad = |message: String| CommandError::Client(ClientError::BadReply(message));
    let format = format_from_wire(reply.format())
        .ok_or_else(|| bad("a mesh of unknown format".to_owned()))?;
    let bytes = FrameReader::new(&frames)
        .file(reply.bytes.as_ref(), "bytes")
        .map_err(|e| bad(e.to_string()))?;
    parse(bytes, format).map_err(|e| bad(format!("{shape}: {e}")))
}
