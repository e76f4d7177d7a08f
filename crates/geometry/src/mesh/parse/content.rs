//! Recognises a file that cannot be read by its first bytes: an archive, a picture, a mesh of
//! another format, or a pointer to a file that was not fetched.

use super::{Format, ParseError, as_utf8};

const UNPACK: &str = "unpack it and take the mesh that is in it";
const EXPORT: &str = "export it from the program that made it";
const NO_MESH: &str = "it holds no mesh";
const POINTER: &str = "get the file itself with `git lfs pull`";

/// Beginnings of files that are not meshes, or meshes of formats that are not supported.
const BEGINNINGS: [(&[u8], &str, &str); 34] = [
    (
        b"PK\x03\x04",
        "a ZIP archive (or a 3MF, USDZ or office file)",
        UNPACK,
    ),
    (b"PK\x05\x06", "an empty ZIP archive", UNPACK),
    (b"\x1f\x8b", "a gzip file", UNPACK),
    (b"BZh", "a bzip2 file", UNPACK),
    (b"\xfd7zXZ\0", "an XZ file", UNPACK),
    (b"7z\xbc\xaf\x27\x1c", "a 7-Zip archive", UNPACK),
    (b"Rar!\x1a\x07", "a RAR archive", UNPACK),
    (b"\x28\xb5\x2f\xfd", "a Zstandard file", UNPACK),
    (b"\x04\x22\x4d\x18", "an LZ4 file", UNPACK),
    (b"\x89PNG\r\n\x1a\n", "a PNG picture", NO_MESH),
    (b"\xff\xd8\xff", "a JPEG picture", NO_MESH),
    (b"GIF8", "a GIF picture", NO_MESH),
    (b"II*\0", "a TIFF picture", NO_MESH),
    (b"MM\0*", "a TIFF picture", NO_MESH),
    (b"\x76\x2f\x31\x01", "an OpenEXR picture", NO_MESH),
    (b"#?RADIANCE", "a Radiance picture", NO_MESH),
    (b"8BPS", "a Photoshop picture", NO_MESH),
    (b"DDS ", "a DDS picture", NO_MESH),
    (
        b"RIFF",
        "a RIFF file (a WebP picture, a sound or a film)",
        NO_MESH,
    ),
    (b"%PDF-", "a PDF document", NO_MESH),
    (b"%!PS", "a PostScript document", NO_MESH),
    (b"\x93NUMPY", "a NumPy array", NO_MESH),
    (b"\x89HDF\r\n\x1a\n", "an HDF5 file", NO_MESH),
    (b"SQLite format 3\0", "an SQLite database", NO_MESH),
    (b"\x7fELF", "a program", NO_MESH),
    (b"version https://git-lfs", "a Git LFS pointer", POINTER),
    (b"Kaydara FBX Binary", "an FBX scene", EXPORT),
    (b"; FBX", "an FBX scene", EXPORT),
    (b"BLENDER", "a Blender file", EXPORT),
    (b"PXR-USDC", "a USD stage", EXPORT),
    (b"#usda", "a USD stage", EXPORT),
    (b"ISO-10303-21", "a STEP file", EXPORT),
    (b"#VRML", "a VRML world", EXPORT),
    (b"DRACO", "a Draco mesh", EXPORT),
];

/// The error for a file whose first bytes show another kind than its name says.
pub(super) fn of(bytes: &[u8], wanted: Format) -> Option<ParseError> {
    let found = BEGINNINGS
        .iter()
        .find(|(begin, ..)| bytes.starts_with(begin));
    let (found, instead) = match found {
        Some(&(_, found, instead)) => (found, instead_of(instead)),
        None => {
            let text = as_utf8(bytes);
            let text = text.trim_ascii_start();
            match supported(text).filter(|found| *found != wanted) {
                Some(format) => (title(format), format!("name it .{}", format.name())),
                None => (foreign(text, wanted)?, instead_of(EXPORT)),
            }
        }
    };
    Some(ParseError::OtherContent {
        found,
        wanted: title(wanted),
        instead,
    })
}

/// The advice of the message, with the supported formats where that helps.
fn instead_of(what: &str) -> String {
    match what {
        POINTER => what.to_owned(),
        NO_MESH => format!("{what}, which is needed as one of {}", Format::EXTENSIONS),
        _ => format!("{what}, as one of {}", Format::EXTENSIONS),
    }
}

fn title(format: Format) -> &'static str {
    match format {
        Format::Obj => "an OBJ mesh",
        Format::Off => "an OFF mesh",
        Format::Ply => "a PLY mesh",
        Format::Stl => "an STL mesh",
        Format::Gltf => "a glTF scene",
    }
}

/// The supported format whose beginning a text or a binary file has. OBJ has no header.
fn supported(text: &[u8]) -> Option<Format> {
    let first = text.split(u8::is_ascii_whitespace).next()?;
    match first {
        b"ply" => Some(Format::Ply),
        b"solid" => Some(Format::Stl),
        _ if text.starts_with(b"glTF") => Some(Format::Gltf),
        _ if text.starts_with(b"{") && window(text, b"\"asset\"") => Some(Format::Gltf),
        _ if first.len() <= 12 && window(first, b"OFF") => Some(Format::Off),
        _ => None,
    }
}

/// Other kinds, which are recognised a little after their first bytes.
fn foreign(text: &[u8], wanted: Format) -> Option<&'static str> {
    let head: Vec<u8> = text[..text.len().min(1024)].to_ascii_lowercase();
    let has = |what: &[u8]| window(&head, what);
    if head.starts_with(b"<!doctype html") || head.starts_with(b"<html") {
        return Some("a web page");
    }
    if head.starts_with(b"<") {
        return Some(if has(b"<collada") {
            "a COLLADA scene"
        } else if has(b"<svg") {
            "an SVG drawing"
        } else {
            "an XML document"
        });
    }
    if head.starts_with(b"{") && wanted != Format::Gltf {
        return Some("a JSON document");
    }
    // A binary STL may begin with any bytes, and a glTF that is not text begins with its own name.
    let control = |b: &u8| b.is_ascii_control() && !b.is_ascii_whitespace();
    let text_only = matches!(wanted, Format::Obj | Format::Off);
    (text_only && text.iter().take(4).any(control)).then_some("binary data of an unknown kind")
}

fn window(text: &[u8], what: &[u8]) -> bool {
    text.windows(what.len()).any(|w| w == what)
}

#[cfg(test)]
mod tests {
    use super::{BEGINNINGS, of};
    use crate::mesh::{Format, parse};

    fn message(bytes: &[u8], format: Format) -> String {
        parse(bytes, format).unwrap_err().to_string()
    }

    #[test]
    fn what_is_no_mesh_is_named_whatever_its_name_says() {
        for (begin, found, _) in BEGINNINGS {
            let bytes = [begin, b"\x00\x01 and more\n\x02"].concat();
            for format in Format::ALL {
                let message = message(&bytes, format);
                assert!(
                    message.starts_with(&format!("the file is {found}, not ")),
                    "{message}"
                );
            }
        }
        assert_eq!(
            message(b"PK\x03\x04\x14\0\0\0", Format::Obj),
            "the file is a ZIP archive (or a 3MF, USDZ or office file), not an OBJ mesh: unpack \
             it and take the mesh that is in it, as one of .obj, .off, .ply, .stl, .glb, .gltf"
        );
        assert_eq!(
            message(
                b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n",
                Format::Obj
            ),
            "the file is a Git LFS pointer, not an OBJ mesh: get the file itself with `git lfs \
             pull`"
        );
        assert_eq!(
            message(b"ply\nformat ascii 1.0\n", Format::Obj),
            "the file is a PLY mesh, not an OBJ mesh: name it .ply"
        );
        for (bytes, found) in [
            (&b"<?xml version=\"1.0\"?><COLLADA>"[..], "a COLLADA scene"),
            (b"<!DOCTYPE html>", "a web page"),
            (b"{\"labels\": []}", "a JSON document"),
            (b"\x01\x02\x03\x04", "binary data of an unknown kind"),
        ] {
            let message = message(bytes, Format::Off);
            assert!(
                message.contains(&format!(" is {found}, not an OFF mesh")),
                "{message}"
            );
        }
    }

    #[test]
    fn a_damaged_file_of_the_format_it_is_named_after_is_not_taken_for_another() {
        for (bytes, format) in [
            (&b"ply\n"[..], Format::Ply),
            (b"OFF\n3 1 0\n0 0 0\n", Format::Off),
            (b"solid x\nfacet\n", Format::Stl),
            (b"{\"asset\": 3}", Format::Gltf),
            (b"{", Format::Gltf),
            (b"glTF", Format::Gltf),
            (b"v 0 0 0\nf 1 1 2\n", Format::Obj),
            (b"some words\n", Format::Off),
        ] {
            assert_eq!(of(bytes, format), None, "{bytes:?}");
        }
    }
}
