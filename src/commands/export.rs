//! `coseg export`: labels, or coloured meshes, of a collection become files.

use super::export_mesh::{colour, material, materials, polygons};
use super::session::{Session, bar};
use super::{CommandError, Outcome, labels};
use crate::cli::{Export, ExportFormat};
use coseg::call;
use coseg::ipc::client::ClientError;
use coseg::ipc::frames::FrameReader;
use coseg::ipc::wire;
use coseg::mesh::write::{mtl, obj, ply};
use coseg::mesh::{Format, ParsedMesh, parse};
use serde_json::json;
use std::path::{Path, PathBuf};

/// The material file that exported OBJ files name.
const MATERIALS: &str = "labels.mtl";

pub(crate) fn run(args: &Export, mut session: Session) -> Outcome {
    let collection = session.collection(&args.within)?;
    if !args.no_wait {
        session.wait_until_idle(&collection)?;
    }
    let infos = session.describe(&collection)?.labels;
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
        match args.format {
            ExportFormat::Labels => {
                let lines: String = labels.iter().map(|l| format!("{l}\n")).collect();
                write(format!("{shape}.labels.txt"), lines.as_bytes())?;
            }
            ExportFormat::Ply => {
                let mesh = original(&mut session, &collection, shape, labels.len())?;
                let colours: Vec<[u8; 3]> = labels.iter().map(|&l| colour(l, &infos)).collect();
                let bytes = ply(&mesh.vertices, &polygons(&mesh), &colours, &labels);
                write(format!("{shape}.ply"), &bytes)?;
            }
            ExportFormat::Obj => {
                let mesh = original(&mut session, &collection, shape, labels.len())?;
                let name = |label| material(label, &infos);
                let text = obj(&mesh.vertices, &polygons(&mesh), &labels, name, MATERIALS);
                write(format!("{shape}.obj"), text.as_bytes())?;
            }
        }
        progress.inc(1);
    }
    if args.format == ExportFormat::Obj {
        write(MATERIALS.to_owned(), mtl(&materials(&infos)).as_bytes())?;
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
    let request = wire::GetOriginalRequest {
        collection: collection.to_owned(),
        shape: shape.to_owned(),
    };
    let (reply, frames) = call!(session.client, GetOriginal(request), frames)?;
    let bad = |message: String| CommandError::Client(ClientError::BadReply(message));
    let format = match reply.format() {
        wire::MeshFormat::Obj => Format::Obj,
        wire::MeshFormat::Off => Format::Off,
        wire::MeshFormat::Unspecified => return Err(bad("a mesh of unknown format".to_owned())),
    };
    let bytes = FrameReader::new(&frames)
        .file(reply.bytes.as_ref(), "bytes")
        .map_err(|e| bad(e.to_string()))?;
    let mesh = parse(bytes, format).map_err(|e| bad(format!("{shape}: {e}")))?;
    if mesh.n_polygons != n_labels {
        let n = mesh.n_polygons;
        return Err(bad(format!("{shape} has {n} faces, but {n_labels} labels")));
    }
    Ok(mesh)
}
