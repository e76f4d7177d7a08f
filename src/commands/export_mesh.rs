//! Provides the colours and the names of the materials of labels in exported meshes.

use coseg::ipc::wire::LabelInfo;

/// Colour of faces without a label.
const UNLABELLED: [u8; 3] = [128, 128, 128];

/// The colour of a label; grey without one.
pub(crate) fn colour(label: i32, labels: &[LabelInfo]) -> [u8; 3] {
    let found = u32::try_from(label)
        .ok()
        .and_then(|id| labels.iter().find(|l| l.id == id));
    found.map_or(UNLABELLED, |l| {
        let [_, r, g, b] = l.colour_rgb.to_be_bytes();
        [r, g, b]
    })
}

/// The name of a group and material: the label's id, followed by its name if it has one.
pub(crate) fn material(label: i32, labels: &[LabelInfo]) -> String {
    let found = u32::try_from(label)
        .ok()
        .and_then(|id| labels.iter().find(|l| l.id == id));
    match found.map(|l| l.name.as_str()) {
        None if label < 0 => "unlabelled".to_owned(),
        None | Some("") => format!("label_{label}"),
        // Names end at white space in both formats.
        Some(name) => format!("label_{label}_{}", name.replace(char::is_whitespace, "_")),
    }
}

/// All labels, and -1 for unlabelled faces, with the names and colours of their materials.
pub(crate) fn materials(infos: &[LabelInfo]) -> Vec<(i32, String, [u8; 3])> {
    let ids = infos
        .iter()
        .filter_map(|l| i32::try_from(l.id).ok())
        .chain([-1]);
    ids.map(|id| (id, material(id, infos), colour(id, infos)))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::{LabelInfo, material, materials};

    fn infos() -> Vec<LabelInfo> {
        let name = "long leg".to_owned();
        vec![LabelInfo {
            id: 7,
            name,
            colour_rgb: 0x01_02_ff,
            merged_into: None,
            n_shapes: 1,
        }]
    }

    #[test]
    fn labels_have_their_names_and_colours() {
        let found = materials(&infos());
        let expected = [
            (7, "label_7_long_leg".to_owned(), [1, 2, 255]),
            (-1, "unlabelled".to_owned(), [128, 128, 128]),
        ];
        assert_eq!(found, expected);
        assert_eq!(material(8, &infos()), "label_8");
    }
}
