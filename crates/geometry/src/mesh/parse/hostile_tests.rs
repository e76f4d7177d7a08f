//! Damaged files: every parser refuses them or reads a consistent mesh.

use super::gltf_tests::{SQUARE, binary, glb, json};
use super::{parse, ply_stl_tests};
use crate::mesh::Format;
use proptest::prelude::{Strategy as _, any, prop, proptest};

/// A small complete file of each kind.
fn samples() -> Vec<(Format, Vec<u8>)> {
    let obj = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\nf -1 -2 \\\n-3\n";
    let off = "OFF\n4 2 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3\n3 0 1 2\n";
    let mut samples = vec![
        (Format::Obj, obj.as_bytes().to_vec()),
        (Format::Off, off.as_bytes().to_vec()),
        (
            Format::Gltf,
            glb(&json(r#"{"mesh":0}"#, SQUARE, "", ""), &binary()),
        ),
    ];
    samples.extend(
        ply_stl_tests::samples()
            .into_iter()
            .map(|s| (Format::Ply, s)),
    );
    samples.extend(ply_stl_tests::stl_samples().map(|s| (Format::Stl, s)));
    samples
}

/// Reads bytes and checks the mesh, if they are one.
fn check(bytes: &[u8], format: Format) {
    let Ok(mesh) = parse(bytes, format) else {
        return;
    };
    let n = mesh.vertices.len() as u32;
    assert!(mesh.triangles.iter().flatten().all(|&v| v < n));
    assert_eq!(mesh.triangles.len(), mesh.polygon_of_triangle.len());
    let mut seen = vec![false; mesh.n_polygons];
    for &p in &mesh.polygon_of_triangle {
        seen[p as usize] = true;
    }
    assert!(seen.iter().all(|&s| s));
    // The size of the result is bounded: a vertex takes two bytes, unless a scene repeats it within
    // its allowance.
    let most = if format == Format::Gltf { 1 << 17 } else { 0 } + bytes.len();
    assert!(mesh.vertices.len() <= most && mesh.triangles.len() <= most);
}

#[test]
fn files_that_are_cut_off_anywhere_are_refused_or_shorter() {
    for (format, whole) in samples() {
        assert!(parse(&whole, format).is_ok(), "{format:?}");
        for end in 0..whole.len() {
            check(&whole[..end], format);
        }
        // A binary file is incomplete as soon as one byte is missing.
        if whole.contains(&0) {
            for end in 0..whole.len() {
                assert!(
                    parse(&whole[..end], format).is_err(),
                    "{format:?} up to {end}"
                );
            }
        }
    }
}

#[test]
fn every_byte_may_be_wrong() {
    for (format, whole) in samples() {
        for at in 0..whole.len() {
            for byte in [0, 1, b'9', b'-', b' ', b'\n', 0x7f, 0x80, 0xff] {
                let mut bytes = whole.clone();
                bytes[at] = byte;
                check(&bytes, format);
            }
        }
    }
}

#[test]
fn every_parser_refuses_every_other_format() {
    for (is, bytes) in samples() {
        for format in Format::ALL.into_iter().filter(|f| *f != is) {
            assert!(parse(&bytes, format).is_err(), "{is:?} as {format:?}");
        }
    }
}

proptest! {
    #[test]
    fn any_bytes_are_refused_or_read(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
        for format in Format::ALL {
            check(&bytes, format);
        }
    }

    #[test]
    fn anything_that_looks_like_a_text_mesh_is_refused_or_in_range(
        text in "(OFF\n)?([0-9]{1,2} [0-9] 0\n)?((v|f|3|2)( -?[0-9]{1,2}(/1)?){1,4}(\\\\)?\n){0,12}"
    ) {
        for format in Format::ALL {
            check(text.as_bytes(), format);
        }
    }

    #[test]
    fn any_counts_and_types_of_a_ply_are_refused_or_read(
        counts in (0..9u64, 0..9u64),
        types in prop::collection::vec(
            prop::sample::select(
                &["char", "uchar", "short", "ushort", "int", "uint", "float", "double"][..],
            ),
            6,
        ),
        encoding in prop::sample::select(
            &["ascii", "binary_little_endian", "binary_big_endian"][..],
        ),
        body in prop::collection::vec(any::<u8>(), 0..200),
    ) {
        let [x, y, z, n, i, label] = &types[..] else { unreachable!() };
        let (vertices, faces) = counts;
        let mut bytes = format!(
            "ply\nformat {encoding} 1.0\nelement vertex {vertices}\nproperty {x} x\n\
             property {y} y\nproperty {z} z\nelement face {faces}\nproperty list {n} {i} \
             vertex_indices\n\
             property {label} label\nend_header\n"
        )
        .into_bytes();
        bytes.extend(body.iter().map(|b| match encoding {
            "ascii" => b"0123456789 \n"[*b as usize % 12],
            _ => b % 8,
        }));
        check(&bytes, Format::Ply);
    }

    #[test]
    fn any_numbers_in_a_gltf_are_refused_or_read(
        numbers in prop::collection::vec(
            prop::sample::select(
                &[
                    "0", "1", "2", "4", "6", "48", "4294967295", "18446744073709551615", "-1",
                    "1e3",
                ][..],
            ),
            12,
        ),
        places in prop::collection::vec((0..24usize).prop_map(|i| i), 12),
    ) {
        let whole = json(r#"{"mesh":0,"children":[]}"#, SQUARE, "", "");
        // Replaces the numbers after some of the colons.
        let parts: Vec<&str> = whole.split(':').collect();
        let mut text = String::from(parts[0]);
        for (i, part) in parts.iter().enumerate().skip(1) {
            text.push(':');
            let digits = part.len() - part.trim_start_matches(|c: char| c.is_ascii_digit()).len();
            match places.iter().position(|p| *p == i).filter(|_| digits > 0) {
                Some(at) => {
                    text.push_str(numbers[at]);
                    text.push_str(&part[digits..]);
                }
                None => text.push_str(part),
            }
        }
        check(&glb(&text, &binary()), Format::Gltf);
    }
}
