//! Formats text for people: lines of data, tables and counts.

use crate::library::shown;
use std::io::Write as _;

/// Prints a line of data to stdout, and flushes it.
///
/// # Errors
/// If stdout is closed or full.
pub fn print_line(text: &str) -> std::io::Result<()> {
    let mut out = std::io::stdout().lock();
    writeln!(out, "{text}").and_then(|()| out.flush())
}

/// Pads columns to the widest entry; the first row is the heading. Invisible characters are made
/// visible.
///
/// ```
/// let row = |a: &str, b: &str| vec![a.to_owned(), b.to_owned()];
/// assert_eq!(coseg::text::table(&[row("name", "n"), row("a", "12")]), "name  n\na     12");
/// ```
pub fn table(rows: &[Vec<String>]) -> String {
    let shown_row = |row: &Vec<String>| row.iter().map(|c| shown(c).into_owned()).collect();
    let rows: Vec<Vec<String>> = rows.iter().map(shown_row).collect();
    let n = rows.iter().map(Vec::len).max().unwrap_or(0);
    let width = |i: usize| {
        let cells = rows.iter().filter_map(|r| r.get(i));
        cells.map(|c| c.chars().count()).max().unwrap_or(0)
    };
    let widths: Vec<usize> = (0..n).map(width).collect();
    let lines = rows.iter().map(|row| {
        let cells = row.iter().zip(&widths);
        let cells = cells.map(|(cell, &width)| format!("{cell:width$}"));
        cells.collect::<Vec<_>>().join("  ").trim_end().to_owned()
    });
    lines.collect::<Vec<_>>().join("\n")
}

/// A number with its noun, which takes an `s` unless the number is 1.
///
/// ```
/// use coseg::text::counted;
///
/// assert_eq!([counted(1, "shape"), counted(2, "shape")], ["1 shape", "2 shapes"]);
/// ```
pub fn counted(n: u64, noun: &str) -> String {
    let s = if n == 1 { "" } else { "s" };
    format!("{n} {noun}{s}")
}

/// Estimates when something is done whose rest was counted again and again.
///
/// ```
/// use coseg::text::Pace;
/// use std::time::Duration;
///
/// let mut pace = Pace::default();
/// assert_eq!(pace.left(100, Duration::from_secs(10)), None);
/// // 40 in 2 s, so that 60 take 3 s.
/// assert_eq!(pace.left(60, Duration::from_secs(12)), Some(Duration::from_secs(3)));
/// // More has come: the estimate begins again.
/// assert_eq!(pace.left(90, Duration::from_secs(13)), None);
/// ```
#[derive(Debug, Default, Clone)]
pub struct Pace {
    begin: Option<(u64, std::time::Duration)>,
    last: u64,
}

impl Pace {
    /// Returns the time that `n` things are expected to take; `None` if none was done since they
    /// were counted first, or more have come. `now` is a time from any beginning.
    pub fn left(&mut self, n: u64, now: std::time::Duration) -> Option<std::time::Duration> {
        let began = self.begin.filter(|_| n <= self.last);
        self.last = n;
        let (of, begin) = *self.begin.insert(began.unwrap_or((n, now)));
        (n > 0 && of > n).then(|| {
            now.saturating_sub(begin)
                .mul_f64(n as f64 / (of - n) as f64)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::{counted, table};

    #[test]
    fn columns_line_up_and_show_invisible_characters() {
        let row = |a: &str, b: &str| vec![a.to_owned(), b.to_owned()];
        let rows = [row("name", "n"), row("a\u{200b}", "12")];
        assert_eq!(table(&rows), "name       n\na\\u{200b}  12");
    }

    #[test]
    fn only_one_is_singular() {
        assert_eq!(counted(0, "label"), "0 labels");
        assert_eq!(counted(1, "label"), "1 label");
        assert_eq!(counted(11, "label"), "11 labels");
    }
}
