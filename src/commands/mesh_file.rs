//! Reads the bytes of a mesh file; a `.gltf` with its buffers in separate files is packed into one
//! binary file.
//!
//! A buffer is read only from the folder of the file, by a relative path, and only if it contains
//! positions or indices. Textures and other files are not read.

use coseg::mesh::{Format, write};
use percent_encoding::percent_decode_str;
use serde_json::{Value, json};
use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io::{self, Read};
use std::path::{Component, Path};

/// Extensions whose views name buffers themselves.
const COMPRESSIONS: [&str; 2] = ["EXT_meshopt_compression", "KHR_meshopt_compression"];

/// The bytes to send for the file at a path.
///
/// # Errors
/// If the file, or a buffer that it needs, cannot be read.
pub(crate) fn read(path: &Path, format: Format) -> io::Result<Vec<u8>> {
    let bytes = fs::read(path)?;
    if format != Format::Gltf || bytes.starts_with(b"glTF") {
        return Ok(bytes);
    }
    let folder = match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    let packed = pack(&bytes, folder).map_err(io::Error::other)?;
    Ok(packed.unwrap_or(bytes))
}

/// The file with the buffers of its triangles, as a GLB; `None` if it is already complete, or is
/// not JSON, which its parser will report.
fn pack(bytes: &[u8], folder: &Path) -> Result<Option<Vec<u8>>, String> {
    let text = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
    let Ok(mut root) = serde_json::from_slice::<Value>(text) else {
        return Ok(None);
    };
    let buffers: Vec<Value> = root["buffers"].as_array().cloned().unwrap_or_default();
    let external = |index: &usize| {
        let uri = buffers
            .get(*index)
            .and_then(|buffer| buffer["uri"].as_str());
        uri.filter(|uri| !is_data(uri)).map(|uri| (*index, uri))
    };
    let needed = needed_buffers(&root);
    let external: Vec<(usize, &str)> = needed.iter().filter_map(external).collect();
    if external.is_empty() {
        return Ok(None);
    }
    let mut binary = Vec::new();
    // For each buffer its new index, and its offset in the new buffer.
    let mut moved = vec![(0, 0); buffers.len()];
    let mut rest = vec![Value::Null];
    for (index, buffer) in buffers.iter().enumerate() {
        if let Some((_, uri)) = external.iter().find(|(i, _)| *i == index) {
            moved[index] = (0, binary.len() as u64);
            binary.extend(file(index, buffer, uri, folder)?);
            binary.resize(binary.len().next_multiple_of(4), 0);
        } else {
            moved[index] = (rest.len(), 0);
            rest.push(buffer.clone());
        }
    }
    rest[0] = json!({ "byteLength": binary.len() });
    root["buffers"] = rest.into();
    let views = root["bufferViews"].as_array_mut();
    for view in views.into_iter().flatten() {
        relocate(view, &moved);
        for name in COMPRESSIONS {
            if let Some(compressed) = view.pointer_mut(&format!("/extensions/{name}")) {
                relocate(compressed, &moved);
            }
        }
    }
    let text = root.to_string();
    if text.len() + binary.len() > u32::MAX as usize - 64 {
        return Err("with its buffers it is larger than the 4 GiB that a GLB can have".to_owned());
    }
    Ok(Some(write::glb_of(text, binary)))
}

fn is_data(uri: &str) -> bool {
    let start = uri.get(..5);
    start.is_some_and(|start| start.eq_ignore_ascii_case("data:"))
}

/// The buffers that contain positions and indices.
fn needed_buffers(root: &Value) -> BTreeSet<usize> {
    let list = |value: &Value| value.as_array().cloned().unwrap_or_default();
    let index = |value: &Value| value.as_u64().and_then(|i| usize::try_from(i).ok());
    let meshes = list(&root["meshes"]);
    let primitives = meshes.iter().flat_map(|mesh| list(&mesh["primitives"]));
    let accessors = primitives
        .flat_map(|p| [index(&p["attributes"]["POSITION"]), index(&p["indices"])])
        .flatten()
        .filter_map(|a| root["accessors"].get(a));
    let views = accessors.flat_map(|accessor| {
        let sparse = &accessor["sparse"];
        let parts = [accessor, &sparse["indices"], &sparse["values"]];
        parts.map(|part| index(&part["bufferView"]))
    });
    let views = views.flatten().filter_map(|v| root["bufferViews"].get(v));
    let buffers = views.filter_map(|view| {
        let compressed = COMPRESSIONS
            .iter()
            .find_map(|name| view["extensions"].get(name));
        index(&compressed.unwrap_or(view)["buffer"])
    });
    buffers.collect()
}

/// Moves a view, or an object that replaces one, to the new position of its buffer.
fn relocate(view: &mut Value, moved: &[(usize, u64)]) {
    let buffer = view["buffer"]
        .as_u64()
        .and_then(|i| moved.get(usize::try_from(i).ok()?));
    if let Some(&(index, begin)) = buffer {
        view["buffer"] = index.into();
        let offset = view.get("byteOffset").and_then(Value::as_u64).unwrap_or(0);
        if offset + begin > 0 {
            view["byteOffset"] = (offset + begin).into();
        }
    }
}

/// The bytes of a buffer in a separate file.
fn file(index: usize, buffer: &Value, uri: &str, folder: &Path) -> Result<Vec<u8>, String> {
    let fault = |why: &str| format!("buffer {index} is in {uri:?}, {why}");
    let scheme = uri.split_once(':').map_or("", |(scheme, _)| scheme);
    let is_scheme = |c: char| c.is_ascii_alphanumeric() || "+-.".contains(c);
    if scheme.starts_with(|c: char| c.is_ascii_alphabetic()) && scheme.chars().all(is_scheme) {
        return Err(fault(
            "and only files beside the mesh are read: download it",
        ));
    }
    let decoded = percent_decode_str(uri).decode_utf8();
    let decoded = decoded.map_err(|_| fault("which is not valid UTF-8"))?;
    let path = Path::new(decoded.as_ref());
    let inside = |c: Component<'_>| matches!(c, Component::Normal(_) | Component::CurDir);
    if decoded.is_empty() || decoded.contains(['\\', '\0']) || !path.components().all(inside) {
        return Err(fault(
            "but must be in the folder of the file, by a relative path",
        ));
    }
    let whole = folder.join(path);
    let at = |e: io::Error| match e.kind() {
        io::ErrorKind::NotFound => fault("but the folder of the file has no file of that name"),
        _ => fault(&format!("which cannot be read: {e}")),
    };
    let (real, root) = (
        whole.canonicalize().map_err(at)?,
        folder.canonicalize().map_err(at)?,
    );
    if !real.starts_with(&root) {
        return Err(fault(
            "which is a link that leads out of the folder of the file",
        ));
    }
    if !fs::metadata(&real).map_err(at)?.is_file() {
        return Err(fault("which is not a regular file"));
    }
    let length = buffer["byteLength"].as_u64();
    let length = length.ok_or_else(|| format!("buffer {index} has no byteLength"))?;
    let mut bytes = Vec::new();
    let opened = File::open(&real).map_err(at)?;
    opened.take(length).read_to_end(&mut bytes).map_err(at)?;
    if (bytes.len() as u64) < length {
        let found = bytes.len();
        return Err(fault(&format!(
            "which has {found} bytes, but the buffer declares {length}"
        )));
    }
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::read;
    use coseg::mesh::{Format, parse};
    use std::fs;
    use std::path::Path;

    /// A square: positions in one buffer, indices in a second, animation in a third, and a texture.
    fn scene(positions: &str, indices: &str) -> String {
        format!(
            r#"{{"asset":{{"version":"2.0"}},"scenes":[{{"nodes":[0]}}],"nodes":[{{"mesh":0}}],
            "meshes":[{{"primitives":[{{"attributes":{{"POSITION":0}},"indices":1}}]}}],
            "images":[{{"uri":"nowhere.png"}}],
            "accessors":[{{"bufferView":0,"componentType":5126,"count":4,"type":"VEC3"}},
            {{"bufferView":1,"componentType":5121,"count":6,"type":"SCALAR"}},
            {{"bufferView":2,"componentType":5126,"count":1,"type":"SCALAR"}}],
            "bufferViews":[{{"buffer":0,"byteLength":48}},
                {{"buffer":2,"byteOffset":1,"byteLength":6}},
            {{"buffer":1,"byteLength":4}}],
            "buffers":[{{"byteLength":48,"uri":"{positions}"}},
                {{"byteLength":4,"uri":"missing.bin"}},
            {{"byteLength":7,"uri":"{indices}"}}]}}"#
        )
    }

    fn floats() -> Vec<u8> {
        let corners = [
            0.0f32, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 1.0, 0.0,
        ];
        corners.iter().flat_map(|x| x.to_le_bytes()).collect()
    }

    fn folder() -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        fs::create_dir(folder.path().join("mesh")).unwrap();
        fs::create_dir(folder.path().join("mesh/data")).unwrap();
        fs::write(folder.path().join("mesh/data/a b.bin"), floats()).unwrap();
        fs::write(folder.path().join("mesh/i.bin"), [9, 0, 1, 2, 2, 1, 3, 77]).unwrap();
        fs::write(folder.path().join("secret.bin"), floats()).unwrap();
        folder
    }

    fn packed(folder: &Path, text: &str) -> Result<Vec<u8>, String> {
        let path = folder.join("mesh/square.gltf");
        fs::write(&path, text).unwrap();
        read(&path, Format::Gltf).map_err(|e| e.to_string())
    }

    #[test]
    fn buffers_beside_the_file_go_into_one_with_it() {
        let folder = folder();
        let bytes = packed(folder.path(), &scene("./data/a%20b.bin", "i.bin")).unwrap();
        assert!(bytes.starts_with(b"glTF"));
        let mesh = parse(&bytes, Format::Gltf).unwrap();
        assert_eq!(mesh.triangles, [[0, 1, 2], [2, 1, 3]]);
        assert_eq!(mesh.vertices[3], [1.0, 1.0, 0.0]);
        // Unneeded parts stay unchanged, and may be missing.
        let text = String::from_utf8_lossy(&bytes).into_owned();
        assert!(
            text.contains("nowhere.png") && text.contains("missing.bin"),
            "{text}"
        );
    }

    #[test]
    fn a_file_that_has_its_buffers_is_sent_as_it_is() {
        let folder = folder();
        let data = "data:application/octet-stream;base64,AAAA";
        let whole = scene(data, "DATA:;base64,AAAAAAAAAA==");
        assert_eq!(packed(folder.path(), &whole).unwrap(), whole.as_bytes());
        assert_eq!(packed(folder.path(), "{no json").unwrap(), b"{no json");
    }

    #[test]
    fn a_buffer_elsewhere_is_refused_by_its_name() {
        let folder = folder();
        let outside = folder.path().join("secret.bin");
        std::os::unix::fs::symlink(&outside, folder.path().join("mesh/link.bin")).unwrap();
        for (uri, part) in [
            (
                "gone.bin",
                "the folder of the file has no file of that name",
            ),
            ("../secret.bin", "must be in the folder of the file"),
            ("%2e%2e/secret.bin", "must be in the folder of the file"),
            (
                "data/..%2f..%2fsecret.bin",
                "must be in the folder of the file",
            ),
            ("..%5csecret.bin", "must be in the folder of the file"),
            (
                outside.to_str().unwrap(),
                "must be in the folder of the file",
            ),
            ("", "must be in the folder of the file"),
            (
                "https://example.com/a.bin",
                "only files beside the mesh are read",
            ),
            ("file:///etc/passwd", "only files beside the mesh are read"),
            ("link.bin", "a link that leads out of the folder"),
            ("data", "not a regular file"),
            ("i.bin", "which has 8 bytes, but the buffer declares 48"),
        ] {
            let message = packed(folder.path(), &scene(uri, "i.bin")).unwrap_err();
            assert!(
                message.starts_with("buffer 0 is in ") && message.contains(part),
                "{uri}: {message}"
            );
        }
    }
}
