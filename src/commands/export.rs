//! `coseg export` writes labels, or coloured meshes, of a collection to files.

use super::export_mesh::{OwnMaterials, colour, styles};
use super::session::{Session, bar};
use super::{CommandError, Outcome, labels};
use crate::cli::{Export, ExportFormat, ExportMaterials};
use coseg::call;
use coseg::ipc::client::ClientError;
use coseg::ipc::convert::{format_from_wire, up_from_wire};
use coseg::ipc::frames::FrameReader;
use coseg::ipc::wire;
use coseg::library::shown;
use coseg::mesh::write::{
    Attributes, Labelling, Materials, glb, glb_of_obj, labelled_gltf, labelled_obj, mtl, npy,
    obj_with, ply_with, seg, usda,
};
use coseg::mesh::{Format, ParseError, ParsedMesh, parse};
use coseg::store::Digest;
use coseg::text::counted;
use serde_json::json;
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The name of the material file in exported OBJ files.
const MATERIALS: &str = "labels.mtl";
/// Longest file name that common file systems accept.
const MAX_FILE_NAME_BYTES: usize = 255;
/// Hexadecimal digits of the digest in a shortened file name.
const N_DIGITS: usize = 16;

pub(crate) fn run(args: &Export, mut session: Session) -> Outcome {
    let collection = session.collection(&args.within)?;
    if !args.no_wait {
        session.wait_until_idle(&collection)?;
    }
    let described = session.describe(&collection)?;
    let (styles, up) = (styles(&described.labels), up_axis(&described));
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
    let mut own = OwnMaterials::beside(&styles);
    let form = Form {
        format: args.format,
        materials: args.materials,
        instances: args.instances,
    };
    let progress = bar(shapes.len() as u64);
    for shape in &shapes {
        progress.set_message(shape.clone());
        let request = wire::GetLabelsRequest {
            collection: collection.clone(),
            shape: shape.clone(),
            version: 0,
            confidence: args.format == ExportFormat::Usda,
        };
        let received = labels::receive(&mut session, request)?;
        let labelling = Labelling {
            labels: &received.labels,
            confidence: received.confidence.as_deref(),
            styles: &styles,
        };
        let (suffix, bytes) = if let Some(found) = without_mesh(args.format, shape, &labelling) {
            found
        } else {
            let original = Original::receive(&mut session, &collection, shape)?;
            let mesh = original.mesh(shape, labelling.labels.len())?;
            with_mesh(&form, shape, (&original, &mesh, up), &labelling, &mut own)
                .map_err(|e| bad_reply(format!("{shape}: {e}")))?
        };
        let stem = file_stem(shape, suffix);
        if stem != *shape {
            let name = shown(shape);
            let note = format!("coseg: {name} is too long for a file name; its file is");
            progress.suspend(|| eprintln!("{note} {}{suffix}", shown(&stem)));
        }
        write(format!("{stem}{suffix}"), &bytes)?;
        progress.inc(1);
    }
    if args.format == ExportFormat::Obj {
        let text = mtl(&styles) + &own.text();
        write(MATERIALS.to_owned(), text.as_bytes())?;
    }
    progress.finish_and_clear();
    if session.json {
        let format = format!("{:?}", args.format).to_lowercase();
        session
            .print_json(&json!({ "collection": collection, "format": format, "files": written }))?;
    } else {
        let shapes = counted(shapes.len() as u64, "shape");
        eprintln!("{shapes} written to {}", args.out.display());
    }
    Ok(true)
}

/// The form of the files to write.
pub(super) struct Form {
    pub(super) format: ExportFormat,
    pub(super) materials: ExportMaterials,
    pub(super) instances: bool,
}

/// Suffix and bytes of the file of a shape in any format but OBJ, whose materials are in a file of
/// their own.
pub(super) fn encoded(
    form: &Form,
    shape: &str,
    original: &Original,
    up: Option<[f64; 3]>,
    labelling: &Labelling<'_>,
) -> Result<(&'static str, Vec<u8>), CommandError> {
    if let Some(found) = without_mesh(form.format, shape, labelling) {
        return Ok(found);
    }
    let mesh = original.mesh(shape, labelling.labels.len())?;
    let mut own = OwnMaterials::beside(labelling.styles);
    with_mesh(form, shape, (original, &mesh, up), labelling, &mut own)
        .map_err(|e| CommandError::Failed(format!("{shape}: {e}")))
}

/// The part of a shape's file name before `suffix`: the shape's name or, if the file name would be
/// too long for a file system, its beginning with digits that distinguish names with the same
/// beginning.
pub(super) fn file_stem<'a>(shape: &'a str, suffix: &str) -> Cow<'a, str> {
    if shape.len() + suffix.len() <= MAX_FILE_NAME_BYTES {
        return Cow::Borrowed(shape);
    }
    let digits = &Digest::of(shape.as_bytes()).to_string()[..N_DIGITS];
    let room = MAX_FILE_NAME_BYTES - suffix.len() - 1 - N_DIGITS;
    let ends = shape.char_indices().map(|(end, _)| end);
    let end = ends.take_while(|end| *end <= room).last().unwrap_or(0);
    Cow::Owned(format!("{}~{digits}", &shape[..end]))
}

/// Suffix and bytes of a file that contains only labels; `None` for formats that need the mesh.
fn without_mesh(
    format: ExportFormat,
    shape: &str,
    labelling: &Labelling<'_>,
) -> Option<(&'static str, Vec<u8>)> {
    let labels = labelling.labels;
    Some(match format {
        ExportFormat::Labels => (".labels.txt", seg(labels).into_bytes()),
        ExportFormat::Seg => (".seg", seg(labels).into_bytes()),
        ExportFormat::Npy => (".labels.npy", npy(labels)),
        ExportFormat::Json => {
            let names = labelling.styles.iter();
            let names: BTreeMap<String, &str> = names
                .map(|(label, style)| (label.to_string(), style.name.as_str()))
                .collect();
            let value = json!({ "shape": shape, "labels": labels, "names": names });
            (".labels.json", value.to_string().into_bytes())
        }
        ExportFormat::Ply | ExportFormat::Obj | ExportFormat::Glb | ExportFormat::Usda => {
            return None;
        }
    })
}

/// The up axis in the files of a collection: the given one, or the one on which most shapes agree.
fn up_axis(collection: &wire::Collection) -> Option<[f64; 3]> {
    let given = collection.spec.as_ref().map(wire::CollectionSpec::up)?;
    let estimate = collection.up_estimate.as_ref();
    let up = match given {
        wire::Up::Auto => estimate?.up(),
        given => given,
    };
    up_from_wire(up).axis()
}

/// Suffix and bytes of a file that contains the mesh, with its up axis, and its labels. A file in
/// the format of the original keeps what that holds; `own` collects materials for [`MATERIALS`].
fn with_mesh(
    form: &Form,
    shape: &str,
    (original, mesh, up): (&Original, &ParsedMesh, Option<[f64; 3]>),
    labelling: &Labelling<'_>,
    own: &mut OwnMaterials,
) -> Result<(&'static str, Vec<u8>), ParseError> {
    let (vertices, polygons) = (&mesh.vertices, mesh.polygons());
    let bytes = &original.bytes;
    let materials = match form.materials {
        ExportMaterials::Own => Materials::Own,
        ExportMaterials::Labels => Materials::Labels,
    };
    Ok(match (form.format, original.format) {
        (ExportFormat::Obj, Format::Obj) => {
            let bytes = labelled_obj(bytes, labelling, materials, MATERIALS)?;
            (".obj", bytes)
        }
        (ExportFormat::Obj, format) => {
            let attributes = Attributes::of(bytes, format)?;
            let names = own.names(&attributes.materials);
            let own = (materials == Materials::Own).then_some(names.as_slice());
            let of = (&attributes, own);
            let text = obj_with(vertices, &polygons, labelling, MATERIALS, of);
            (".obj", text.into_bytes())
        }
        (ExportFormat::Glb, Format::Gltf) => {
            let bytes = labelled_gltf(shape, bytes, labelling, materials, up)?;
            (".glb", bytes)
        }
        (ExportFormat::Glb, Format::Obj) => {
            let bytes = glb_of_obj(shape, bytes, labelling, materials, up)?;
            (".glb", bytes)
        }
        (ExportFormat::Glb, _) => {
            let bytes = glb(shape, vertices, &polygons, labelling, up);
            (".glb", bytes)
        }
        (ExportFormat::Usda, _) => {
            let text = usda(shape, vertices, &polygons, labelling, up, form.instances);
            (".usda", text.into_bytes())
        }
        _ => {
            let colour = |label: &i32| colour(*label, labelling.styles);
            let colours: Vec<[u8; 3]> = labelling.labels.iter().map(colour).collect();
            let attributes = Attributes::of(bytes, original.format)?;
            let of = (&attributes, materials);
            let bytes = ply_with(vertices, &polygons, &colours, labelling.labels, of);
            (".ply", bytes)
        }
    })
}

fn at(path: &Path, source: std::io::Error) -> CommandError {
    CommandError::File {
        path: PathBuf::from(path).display().to_string(),
        source,
    }
}

pub(super) fn bad_reply(message: String) -> CommandError {
    CommandError::Client(ClientError::BadReply(message))
}

/// The file of a shape as it was sent.
pub(super) struct Original {
    bytes: Vec<u8>,
    format: Format,
}

impl Original {
    pub(super) fn new(bytes: Vec<u8>, format: Format) -> Self {
        Self { bytes, format }
    }

    pub(super) fn receive(
        session: &mut Session,
        collection: &str,
        shape: &str,
    ) -> Result<Self, CommandError> {
        let request = wire::GetOriginalRequest {
            collection: collection.to_owned(),
            shape: shape.to_owned(),
        };
        let (reply, frames) = call!(session.client, GetOriginal(request), frames)?;
        let format = format_from_wire(reply.format());
        let format = format.ok_or_else(|| bad_reply("a mesh of unknown format".to_owned()))?;
        let reader = FrameReader::new(&frames);
        let bytes = reader.file(reply.bytes.as_ref(), "bytes");
        let bytes = bytes.map_err(|e| bad_reply(e.to_string()))?.to_vec();
        Ok(Self { bytes, format })
    }

    /// Its mesh, which may have another number of polygons than labels.
    pub(super) fn any_mesh(&self, shape: &str) -> Result<ParsedMesh, CommandError> {
        let mesh = parse(&self.bytes, self.format);
        mesh.map_err(|e| bad_reply(format!("{shape}: {e}")))
    }

    /// Its mesh, which has one polygon for each label.
    pub(super) fn mesh(&self, shape: &str, n_labels: usize) -> Result<ParsedMesh, CommandError> {
        let mesh = self.any_mesh(shape)?;
        if mesh.n_polygons != n_labels {
            let n = mesh.n_polygons;
            return Err(bad_reply(format!(
                "{shape} has {n} faces, but {n_labels} labels by an earlier release: add it again \
                 with --replace"
            )));
        }
        Ok(mesh)
    }
}

#[cfg(test)]
mod tests {
    use super::{MAX_FILE_NAME_BYTES, file_stem};

    #[test]
    fn long_names_become_distinct_file_names() {
        let fits = "x".repeat(MAX_FILE_NAME_BYTES - 4);
        assert_eq!(file_stem(&fits, ".ply"), fits);
        assert_eq!(file_stem("chair", ".labels.txt"), "chair");
        for letter in ["x", "\u{e9}", "\u{6905}", "\u{1fa91}"] {
            let [one, other] = ["1", "2"].map(|end| format!("{}{end}", letter.repeat(254)));
            let [one, other] = [&one, &other].map(|name| file_stem(name, ".labels.json"));
            assert_ne!(one, other);
            assert!(one.starts_with(letter));
            let room = one.len() + ".labels.json".len();
            assert!(
                room <= MAX_FILE_NAME_BYTES && room > MAX_FILE_NAME_BYTES - 4,
                "{room}"
            );
        }
    }
}
