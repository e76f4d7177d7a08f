//! Expands runs of painted polygons into a label for each polygon.

/// Labels as runs of polygons: first, count, label.
pub(super) type Run = (usize, usize, i32);

/// A label for each of a shape's polygons: that of the last run that has it, or -1. Nothing is
/// expanded before the runs are known to fit, so that the work is bounded by the size of the shape.
pub(super) fn labels_of(n_polygons: usize, runs: &[Run]) -> Result<Vec<i32>, String> {
    let mut total = 0_usize;
    for &(first, count, _) in runs {
        if first.checked_add(count).is_none_or(|end| end > n_polygons) {
            return Err(format!(
                "a run of {count} polygons begins at polygon {first}, but the shape has \
                 {n_polygons}"
            ));
        }
        total = total.saturating_add(count);
    }
    if total > n_polygons {
        return Err(format!(
            "the runs have {total} polygons together, but the shape has {n_polygons}"
        ));
    }
    let mut labels = vec![-1; n_polygons];
    for &(first, count, label) in runs {
        labels[first..first + count].fill(label);
    }
    Ok(labels)
}

#[cfg(test)]
mod tests {
    use super::labels_of;

    #[test]
    fn runs_become_a_label_for_each_polygon() {
        let labels = labels_of(6, &[(1, 2, 4), (5, 1, 0), (6, 0, 9)]).unwrap();
        assert_eq!(labels, [-1, 4, 4, -1, -1, 0]);
        let labels = labels_of(3, &[(0, 2, 4), (1, 1, 5)]).unwrap();
        assert_eq!(labels, [4, 5, -1]);
    }

    #[test]
    fn runs_beyond_the_shape_are_refused_with_what_they_say() {
        for (runs, expected) in [
            (vec![(5, 2, 0)], "a run of 2 polygons begins at polygon 5"),
            (
                vec![(0, 1 << 60, 0)],
                "a run of 1152921504606846976 polygons",
            ),
            (
                vec![(usize::MAX, 2, 0)],
                "begins at polygon 18446744073709551615",
            ),
            (vec![(7, 0, 0)], "begins at polygon 7"),
            (vec![(0, 6, 0); 200_000], "have 1200000 polygons together"),
        ] {
            let text = labels_of(6, &runs).unwrap_err();
            assert!(
                text.contains(expected) && text.ends_with("the shape has 6"),
                "{text}"
            );
        }
    }
}
