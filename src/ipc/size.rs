//! Formats numbers of bytes for messages.

const UNITS: [(&str, u64); 4] = [
    ("TiB", 1 << 40),
    ("GiB", 1 << 30),
    ("MiB", 1 << 20),
    ("KiB", 1 << 10),
];

/// Formats a size: `64 MiB` if that is exact, `76.3 MiB (80000000 bytes)` if it is rounded, `999
/// bytes` below a KiB.
pub fn in_words(n: u64) -> String {
    match UNITS.iter().find(|(_, unit)| n >= *unit) {
        None if n == 1 => "1 byte".to_owned(),
        None => format!("{n} bytes"),
        Some((name, unit)) if n.is_multiple_of(*unit) => format!("{} {name}", n / unit),
        Some((name, unit)) => format!("{:.1} {name} ({n} bytes)", n as f64 / *unit as f64),
    }
}

/// The message that something exceeds a limit, with the setting of the daemon that raises it.
pub fn beyond(what: &str, found: u64, limit: u64, key: &str) -> String {
    let (found, limit) = (in_words(found), in_words(limit));
    format!("{what} has {found}, the limit is {limit} ({key} of the daemon's configuration)")
}

#[cfg(test)]
mod tests {
    use super::{beyond, in_words};

    #[test]
    fn sizes_have_units_and_stay_exact() {
        for (n, words) in [
            (0, "0 bytes"),
            (1, "1 byte"),
            (1_023, "1023 bytes"),
            (1_024, "1 KiB"),
            (1_025, "1.0 KiB (1025 bytes)"),
            (80_000_000, "76.3 MiB (80000000 bytes)"),
            (64 << 20, "64 MiB"),
            (2 << 30, "2 GiB"),
        ] {
            assert_eq!(in_words(n), words);
        }
        assert_eq!(
            beyond("the file", 80_000_000, 64 << 20, "limits.max_shape"),
            "the file has 76.3 MiB (80000000 bytes), the limit is 64 MiB (limits.max_shape of the \
             daemon's configuration)"
        );
    }
}
