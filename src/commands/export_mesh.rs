//! What exported meshes show of labels: names and colours.

use coseg::ipc::wire::LabelInfo;
use coseg::mesh::write::{LabelStyle, OwnMaterial, mtl, mtl_entry};
use std::collections::{BTreeMap, BTreeSet};

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

/// Materials of the shapes' own, for the file of materials that all exported OBJ files share.
#[derive(Debug)]
pub(crate) struct OwnMaterials {
    /// Names that materials of labels have.
    taken: BTreeSet<String>,
    colours: BTreeMap<String, [u8; 3]>,
}

impl OwnMaterials {
    /// Beside the materials of labels.
    pub(crate) fn beside(styles: &BTreeMap<i32, LabelStyle>) -> Self {
        let text = mtl(styles);
        let names = text.lines().filter_map(|line| line.strip_prefix("newmtl "));
        Self {
            taken: names.map(str::to_owned).collect(),
            colours: BTreeMap::new(),
        }
    }

    /// Names in the file for the materials of a shape. Materials of two shapes with one name share
    /// it if they have the same colour, else the second one gets a number.
    pub(crate) fn names(&mut self, materials: &[OwnMaterial]) -> Vec<String> {
        let mut own = BTreeSet::new();
        let named = materials.iter().map(|material| {
            let name = material.name.replace(char::is_whitespace, "_");
            let colour = material.colour.unwrap_or([255; 3]);
            let mut candidates = std::iter::once(name.clone())
                .chain((2_u32..).map(|number| format!("{name}_{number}")));
            let is_free = |name: &String| {
                let known = self.colours.get(name);
                let differs = known.is_some_and(|known| *known != colour);
                !self.taken.contains(name) && !differs && !own.contains(name)
            };
            let name = candidates
                .find(is_free)
                .unwrap_or_else(|| unreachable!("invariant: numbers do not end"));
            own.insert(name.clone());
            self.colours.insert(name.clone(), colour);
            name
        });
        named.collect()
    }

    /// Their text in the file.
    pub(crate) fn text(&self) -> String {
        let entries = self.colours.iter();
        entries
            .map(|(name, colour)| mtl_entry(name, *colour))
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::{LabelInfo, OwnMaterials, colour, styles};
    use coseg::mesh::write::OwnMaterial;

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

    #[test]
    fn materials_of_shapes_share_a_name_only_with_their_like() {
        let info = LabelInfo {
            id: 7,
            name: "leg".to_owned(),
            colour_rgb: 0,
            merged_into: None,
            n_shapes: 1,
            area_share: 1.0,
            unclaimed: false,
        };
        let mut own = OwnMaterials::beside(&styles(&[info]));
        let shape = |materials: &[(&str, u8)]| -> Vec<OwnMaterial> {
            let materials = materials.iter().map(|(name, red)| OwnMaterial {
                name: (*name).to_owned(),
                colour: Some([*red, 0, 0]),
            });
            materials.collect()
        };
        assert_eq!(
            own.names(&shape(&[("dark oak", 1), ("leg", 2)])),
            ["dark_oak", "leg_2"]
        );
        assert_eq!(own.names(&shape(&[("dark oak", 1)])), ["dark_oak"]);
        assert_eq!(own.names(&shape(&[("dark oak", 9)])), ["dark_oak_2"]);
        // Two of one shape stay two.
        assert_eq!(
            own.names(&shape(&[("pine", 1), ("pine", 1)])),
            ["pine", "pine_2"]
        );
        assert_eq!(own.text().matches("newmtl ").count(), 5);
        assert!(
            own.text()
                .starts_with("newmtl dark_oak\nKd 0.0039 0.0000 0.0000\n")
        );
    }
}
