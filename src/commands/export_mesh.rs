//! What exported meshes show of labels: names and colours.

use coseg::ipc::wire::LabelInfo;
use coseg::mesh::write::LabelStyle;
use std::collections::BTreeMap;

/// The colour of a label; grey without one.
pub(crate) fn colour(label: i32, styles: &BTreeMap<i32, LabelStyle>) -> [u8; 3] {
    let style = styles.get(&label).cloned();
    style.unwrap_or_else(|| LabelStyle::unnamed(label)).colour
}

/// How each label is shown, and -1 for faces without one: under the name that a person gave, in its
/// colour.
pub(crate) fn styles(infos: &[LabelInfo]) -> BTreeMap<i32, LabelStyle> {
    let mut styles = BTreeMap::from([(-1, LabelStyle::unnamed(-1))]);
    for info in infos {
        let Ok(label) = i32::try_from(info.id) else {
            continue;
        };
        let [_, r, g, b] = info.colour_rgb.to_be_bytes();
        let name = match info.name.as_str() {
            "" => LabelStyle::unnamed(label).name,
            name => name.to_owned(),
        };
        let colour = [r, g, b];
        styles.insert(label, LabelStyle { name, colour });
    }
    styles
}

#[cfg(test)]
mod tests {
    use super::{LabelInfo, colour, styles};

    #[test]
    fn labels_have_their_names_and_colours() {
        let info = |id, name: &str| LabelInfo {
            id,
            name: name.to_owned(),
            colour_rgb: 0x01_02_ff,
            merged_into: None,
            n_shapes: 1,
            area_share: 1.0,
            unclaimed: false,
        };
        let styles = styles(&[info(7, "long leg"), info(8, "")]);
        let names: Vec<(i32, &str)> = styles.iter().map(|(l, s)| (*l, s.name.as_str())).collect();
        assert_eq!(names, [(-1, "unlabelled"), (7, "long leg"), (8, "label_8")]);
        assert_eq!(colour(7, &styles), [1, 2, 255]);
        assert_eq!(colour(-1, &styles), colour(9, &styles));
    }
}
