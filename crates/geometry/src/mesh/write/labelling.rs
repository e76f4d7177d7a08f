//! Labels of the polygons of a mesh, with what files show of them: names, colours, confidence.

use std::collections::{BTreeMap, BTreeSet};

/// How files show a label.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LabelStyle {
    /// Its name; part instances are numbered after it, such as `leg.001`.
    pub name: String,
    /// Its sRGB colour.
    pub colour: [u8; 3],
}

impl LabelStyle {
    /// A label that nobody named, in grey: `label_2`, or `unlabelled` for -1.
    ///
    /// ```
    /// use coseg_geometry::mesh::write::LabelStyle;
    ///
    /// assert_eq!(LabelStyle::unnamed(2).name, "label_2");
    /// assert_eq!(LabelStyle::unnamed(-1).name, "unlabelled");
    /// ```
    pub fn unnamed(label: i32) -> Self {
        let name = match label {
            ..0 => "unlabelled".to_owned(),
            _ => format!("label_{label}"),
        };
        let colour = [128; 3];
        Self { name, colour }
    }
}

/// Which materials parts have in a file whose mesh has materials of its own.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Materials {
    /// Its own; faces without one have the label's.
    #[default]
    Own,
    /// The labels'.
    Labels,
}

/// A label for each polygon of a mesh.
#[derive(Debug, Clone, Copy)]
pub struct Labelling<'a> {
    /// Label of each polygon; -1 for none.
    pub labels: &'a [i32],
    /// Probability of each polygon's label, if known.
    pub confidence: Option<&'a [f32]>,
    /// How labels are shown; labels that are missing here are unnamed and grey.
    pub styles: &'a BTreeMap<i32, LabelStyle>,
}

impl Labelling<'_> {
    /// How a label is shown.
    pub(super) fn style(&self, label: i32) -> LabelStyle {
        let style = self.styles.get(&label).cloned();
        style.unwrap_or_else(|| LabelStyle::unnamed(label))
    }

    /// A name for each label that is used, in the alphabet of a format. Where names become equal
    /// the later one has its label as a suffix.
    pub(super) fn names(&self, spelled: impl Fn(&str) -> String) -> BTreeMap<i32, String> {
        let used: BTreeSet<i32> = self.labels.iter().copied().collect();
        let styles = used.into_iter().map(|label| (label, self.style(label)));
        unique_names(styles, spelled)
    }
}

/// Names of labels in the alphabet of a format, all different.
pub(super) fn unique_names(
    styles: impl IntoIterator<Item = (i32, LabelStyle)>,
    spelled: impl Fn(&str) -> String,
) -> BTreeMap<i32, String> {
    let mut taken = BTreeSet::new();
    let named = styles.into_iter().map(|(label, style)| {
        let mut name = spelled(&style.name);
        while !taken.insert(name.clone()) {
            name = spelled(&format!("{name}_{label}"));
        }
        (label, name)
    });
    named.collect()
}

/// Polygons of each label, both ascending.
pub(super) fn by_label(labels: &[i32]) -> BTreeMap<i32, Vec<u32>> {
    let mut groups: BTreeMap<i32, Vec<u32>> = BTreeMap::new();
    for (polygon, &label) in (0..).zip(labels) {
        groups.entry(label).or_default().push(polygon);
    }
    groups
}

/// First and count of each run of consecutive numbers.
pub(super) fn runs(ascending: &[u32]) -> impl Iterator<Item = (u32, usize)> {
    ascending
        .chunk_by(|a, b| *b == a + 1)
        .map(|run| (run[0], run.len()))
}

#[cfg(test)]
mod tests {
    use super::{LabelStyle, Labelling, runs};
    use std::collections::BTreeMap;

    #[test]
    fn names_are_unique_in_the_alphabet_of_a_format() {
        let named = |name: &str| LabelStyle {
            name: name.to_owned(),
            colour: [0; 3],
        };
        let styles = BTreeMap::from([
            (1, named("long leg")),
            (2, named("long_leg")),
            (4, named("long_leg_2")),
        ]);
        let labelling = Labelling {
            labels: &[1, 2, -1, 3, 4],
            confidence: None,
            styles: &styles,
        };
        let names = labelling.names(|name| name.replace(' ', "_"));
        let expected = [
            (-1, "unlabelled"),
            (1, "long_leg"),
            (2, "long_leg_2"),
            (3, "label_3"),
            (4, "long_leg_2_4"),
        ];
        assert_eq!(names, expected.map(|(l, n)| (l, n.to_owned())).into());
    }

    #[test]
    fn runs_have_a_first_and_a_count() {
        let found: Vec<(u32, usize)> = runs(&[0, 1, 2, 5, 7, 8]).collect();
        assert_eq!(found, [(0, 3), (5, 1), (7, 2)]);
    }
}
