//! Converts a clean report to named counts and back, for storage and messages.

use super::CleanReport;

macro_rules! counts {
    (first: $($name:ident),+; later: $($later:ident),+ $(,)?) => {
        impl CleanReport {
            /// All counts with their names.
            ///
            /// ```
            /// use coseg_geometry::mesh::CleanReport;
            ///
            /// let report = CleanReport { n_polygons: 12, ..CleanReport::default() };
            /// assert_eq!(report.counts()[0], ("n_polygons", 12));
            /// ```
            pub fn counts(&self) -> Vec<(&'static str, usize)> {
                // No `..` here, so that a new count cannot be forgotten.
                let Self { $($name,)+ $($later),+ } = *self;
                vec![$((stringify!($name), $name),)+ $((stringify!($later), $later)),+]
            }

            /// The report whose counts `count` returns by name. It fails with the first error of
            /// `count`, or that of `missing` for a missing count. Reports of version 0.1.0 lack the
            /// later counts, which are then 0.
            pub fn from_counts<E>(
                count: impl Fn(&'static str) -> Result<Option<usize>, E>,
                missing: impl Fn(&'static str) -> E,
            ) -> Result<Self, E> {
                Ok(Self {
                    $($name: count(stringify!($name))?.ok_or_else(|| missing(stringify!($name)))?,)+
                    $($later: count(stringify!($later))?.unwrap_or(0)),+
                })
            }
        }
    };
}

counts!(
    first: n_polygons,
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
    n_bridges;
    later: n_concave_polygons,
    n_nonplanar_polygons,
    n_nonsimple_polygons,
    n_tolerated_statements,
    n_unread_statements,
    n_inner_walls,
    n_inner_triangles,
);

impl CleanReport {
    /// Whether version 0.1.0 described the same bytes differently: it used the fan of every
    /// polygon, dropped words that are read now, and analysed inner walls together with the outer
    /// ones.
    pub fn differs_from_first_release(&self) -> bool {
        self.n_concave_polygons + self.n_tolerated_statements + self.n_inner_walls > 0
    }
}

#[cfg(test)]
mod tests {
    use super::CleanReport;
    use std::collections::BTreeMap;

    #[test]
    fn counts_come_back_by_name_and_only_a_later_one_may_be_missing() {
        let report = CleanReport {
            n_triangles: 7,
            n_bridges: 3,
            n_concave_polygons: 2,
            ..CleanReport::default()
        };
        let mut counts: BTreeMap<&str, usize> = report.counts().into_iter().collect();
        let back = |counts: &BTreeMap<&str, usize>| {
            CleanReport::from_counts(|name| Ok(counts.get(name).copied()), |name| name)
        };
        assert_eq!(back(&counts), Ok(report.clone()));
        counts.remove("n_concave_polygons");
        let first = CleanReport {
            n_concave_polygons: 0,
            ..report
        };
        assert_eq!(back(&counts), Ok(first));
        counts.remove("n_bridges");
        assert_eq!(back(&counts), Err("n_bridges"));
    }
}
