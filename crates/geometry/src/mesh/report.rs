//! A clean report becomes named counts and back, for whoever writes it down.

use super::CleanReport;

macro_rules! counts {
    ($($name:ident),+ $(,)?) => {
        impl CleanReport {
            /// Every count with its name. Taken apart without `..`, so that a new one cannot be forgotten.
            pub fn counts(&self) -> Vec<(&'static str, usize)> {
                let Self { $($name),+ } = *self;
                vec![$((stringify!($name), $name)),+]
            }

            /// The report whose counts `count` gives by name; its first error is returned.
            pub fn from_counts<E>(count: impl Fn(&'static str) -> Result<usize, E>) -> Result<Self, E> {
                Ok(Self { $($name: count(stringify!($name))?),+ })
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
        let back = CleanReport::from_counts(|name| counts.get(name).copied().ok_or(name));
        assert_eq!(back, Ok(report));
        counts.remove("n_bridges");
        let back = CleanReport::from_counts(|name| counts.get(name).copied().ok_or(name));
        assert_eq!(back, Err("n_bridges"));
    }
}
