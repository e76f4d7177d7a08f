//! A clean report becomes named counts and back, for whoever writes it down.

use super::CleanReport;

/// Counts that reports of version 0.1.0 do not have.
const LATER: [&str; 2] = ["n_inner_walls", "n_inner_triangles"];

macro_rules! counts {
    ($($name:ident),+ $(,)?) => {
        impl CleanReport {
            /// Every count with its name. Taken apart without `..`, so that a new one cannot be forgotten.
            pub fn counts(&self) -> Vec<(&'static str, usize)> {
                let Self { $($name),+ } = *self;
                vec![$((stringify!($name), $name)),+]
            }

            /// The report whose counts `count` gives by name; its first error is returned. A count that did
            /// not exist when the report was written is absent, and 0.
            pub fn from_counts<E>(
                count: impl Fn(&'static str) -> Result<usize, E>,
                is_absent: impl Fn(&'static str) -> bool,
            ) -> Result<Self, E> {
                let read = |name| match LATER.contains(&name) && is_absent(name) {
                    true => Ok(0),
                    false => count(name),
                };
                Ok(Self { $($name: read(stringify!($name))?),+ })
            }
        }
    };
}

counts!(
    n_polygons,
    n_triangles,
    n_vertices,
    n_welded_vertices,
    n_isolated_vertices,
    n_degenerate_triangles,
    n_duplicate_triangles,
    n_flipped_triangles,
    n_nonmanifold_edges,
    n_boundary_edges,
    n_components,
    n_proxy_faces,
    n_proxy_vertices,
    n_bridges,
    n_inner_walls,
    n_inner_triangles,
);

#[cfg(test)]
mod tests {
    use super::CleanReport;
    use std::collections::BTreeMap;

    #[test]
    fn counts_come_back_by_name_and_a_missing_one_is_an_error() {
        let report = CleanReport {
            n_triangles: 7,
            n_bridges: 3,
            ..CleanReport::default()
        };
        let mut counts: BTreeMap<&str, usize> = report.counts().into_iter().collect();
        let read = |counts: &BTreeMap<&str, usize>| {
            let count = |name| counts.get(name).copied().ok_or(name);
            CleanReport::from_counts(count, |name| !counts.contains_key(name))
        };
        assert_eq!(read(&counts), Ok(report.clone()));
        counts.remove("n_inner_walls");
        assert_eq!(read(&counts), Ok(report), "an old report");
        counts.remove("n_bridges");
        assert_eq!(read(&counts), Err("n_bridges"));
    }
}
