//! Finds the known name that was probably meant by an unknown one.

use std::cmp::Reverse;
use strsim::osa_distance;

/// Maximum number of characters of names that are compared: the cost of a comparison is the product
/// of the lengths.
const LONGEST: usize = 64;
/// Maximum number of letters that may differ, however long a name is.
const MOST_SLIPS: usize = 3;

/// Returns the known name that is most similar to `name`, if it was probably meant: it differs only
/// in case, or in at most one letter for every three, and in at most three.
pub fn likeliest<'a>(name: &str, known: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    let wanted = name.to_lowercase();
    let n = wanted.chars().count();
    if n > LONGEST {
        return None;
    }
    let slips = (n / 3).min(MOST_SLIPS);
    let near = known.into_iter().filter_map(|candidate| {
        let folded = candidate.to_lowercase();
        if folded.chars().count().abs_diff(n) > slips {
            return None;
        }
        let distance = osa_distance(&wanted, &folded);
        // Among equally near names, prefer the one with the longest common beginning: `chair-1`
        // probably meant `chair-001`, not `chairs`.
        let begins = wanted.chars().zip(folded.chars());
        let n_same = begins.take_while(|(a, b)| a == b).count();
        (distance <= slips).then_some(((distance, Reverse(n_same)), candidate))
    });
    near.min_by_key(|(rank, _)| *rank)
        .map(|(_, candidate)| candidate)
}

/// Returns the question that follows an error about a name, or nothing.
pub fn did_you_mean(nearest: Option<&str>) -> String {
    nearest.map_or_else(String::new, |name| format!("; did you mean {name:?}?"))
}

#[cfg(test)]
mod tests {
    use super::{did_you_mean, likeliest};

    #[test]
    fn what_is_near_is_found_and_what_is_far_is_not() {
        let known = ["chairs", "tables", "chair-001", "chair-010", "Big One", "9"];
        for (name, meant) in [
            ("chair", Some("chairs")),
            ("CHAIRS", Some("chairs")),
            ("chiar-001", Some("chair-001")),
            ("chair-1", Some("chair-001")),
            ("big one", Some("Big One")),
            ("8", None),
            ("lamps", None),
            ("", None),
        ] {
            assert_eq!(likeliest(name, known), meant, "{name}");
        }
        assert_eq!(likeliest(&"x".repeat(300), known), None);
        assert_eq!(did_you_mean(Some("a\nb")), "; did you mean \"a\\nb\"?");
        assert_eq!(did_you_mean(None), "");
    }
}
