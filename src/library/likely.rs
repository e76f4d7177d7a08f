//! Finds the known name that was probably meant by an unknown one.

use std::cmp::Reverse;
use strsim::osa_distance;

/// Longest names that are compared, in characters: what is compared costs the product of the
/// lengths.
const LONGEST: usize = 64;
/// Most letters that differ, however long a name is.
const MOST_SLIPS: usize = 3;

/// The known name that is most like `name`, if one is so like it that it was probably meant: the
/// same in other letter case, or a slip for each three letters away, at most three.
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
        // Of names as near, the one that begins the same: `chair-1` meant `chair-001`, not
        // `chairs`.
        let begins = wanted.chars().zip(folded.chars());
        let n_same = begins.take_while(|(a, b)| a == b).count();
        (distance <= slips).then_some(((distance, Reverse(n_same)), candidate))
    });
    near.min_by_key(|(rank, _)| *rank)
        .map(|(_, candidate)| candidate)
}

/// The question that follows an error about a name, or nothing.
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
