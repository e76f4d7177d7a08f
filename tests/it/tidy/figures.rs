//! Checks figures that the README takes from the pages with the measurements.

/// Cells of the rows of all tables of a text, without their marks: `**0.860** (0.018)` is `0.860`.
fn rows(text: &str) -> Vec<Vec<String>> {
    let cells = |line: &str| -> Vec<String> {
        let line = line.trim().trim_matches('|');
        line.split('|')
            .map(|c| c.replace("**", "").trim().to_owned())
            .collect()
    };
    let lines = text.lines().filter(|l| l.trim_start().starts_with('|'));
    lines
        .map(cells)
        .filter(|r| !r[0].starts_with("---"))
        .collect()
}

/// The number at the beginning of a cell.
fn number(cell: &str) -> Option<&str> {
    let first = cell.split_whitespace().next()?;
    (first.parse::<f64>().is_ok() && first.contains('.')).then_some(first)
}

fn numbers(row: &[String]) -> Vec<&str> {
    row.iter().filter_map(|cell| number(cell)).collect()
}

/// Rows of the README's table of accuracy that differ from those of the page, and faults of the
/// page itself.
pub(super) fn accuracy_faults(readme: &str, page: &str) -> Vec<String> {
    let heading = "0 labelled";
    let section = |text: &str, title: &str| {
        let from = text
            .find(title)
            .map_or("", |at| &text[at + title.len()..])
            .to_owned();
        let end = from.find("\n## ").unwrap_or(from.len());
        from[..end].to_owned()
    };
    let reached = rows(&section(page, "\n## Reached\n"));
    let measured = |name: &str| reached.iter().find(|r| r[0] == name).map(|r| numbers(r));
    let mut faults = Vec::new();
    let mut n = 0;
    let shown = rows(&section(readme, "\n## Measured\n"));
    let of_accuracy = shown.iter().filter(|r| r[0].contains(": "));
    for row in of_accuracy {
        let name = row[0].rsplit_once(": ").map_or("", |(_, name)| name);
        match measured(name) {
            None => faults.push(format!("README has a row {name:?}, docs/accuracy.md none")),
            Some(figures) if figures == numbers(row) => n += 1,
            Some(figures) => faults.push(format!(
                "README says {:?} of {name:?}, docs/accuracy.md {figures:?}",
                numbers(row)
            )),
        }
    }
    if !shown.iter().any(|r| r.iter().any(|c| c == heading)) || n + faults.len() == 0 {
        faults.push(format!(
            "README has no table with {heading:?} under Measured"
        ));
    }
    // The page's other table repeats the first column.
    for row in rows(&section(
        page,
        "\n## Against others, on the same descriptors\n",
    )) {
        if let (Some(first), Some(figures)) = (numbers(&row).first(), measured(&row[0]))
            && figures.first() != Some(first)
        {
            let name = &row[0];
            faults.push(format!(
                "docs/accuracy.md says {first} of {name:?}, and {figures:?}"
            ));
        }
    }
    faults
}

/// The family of `coseg demo`, at the places where the README names it.
pub(super) fn demo_faults(readme: &str, help: &str) -> Vec<String> {
    let family = help
        .split_once("[default: ")
        .and_then(|(_, rest)| rest.split_once(']'))
        .map_or("", |(family, _)| family);
    let says = format!("`coseg demo` makes up a family of {family}");
    let words = readme.split_whitespace().collect::<Vec<_>>().join(" ");
    match family.is_empty() || !words.contains(&says) {
        true => vec![format!("README does not say: {says}")],
        false => Vec::new(),
    }
}

#[test]
fn planted_faults_of_figures_are_found() {
    let page = "# A\n\n## Reached\n\n| category | parts | 0 labelled | 1 |\n\
                | --- | --- | --- | --- |\n\
                | Chair | 4 | 0.873 (0.000) | 0.960 (0.001) |\n\
                | mean of 10 | | **0.860** (0.018) | **0.909** (0.004) |\n\n\
                ## Against others, on the same descriptors\n\n\
                | category | streamed | batch |\n| --- | --- | --- |\n\
                | Chair | **0.873** | 0.966 |\n\n## Else\n\n| Chair | 0.1 | 0.2 |\n";
    let readme = "# R\n\n## Measured\n\n| set | shapes | 0 labelled | 1 |\n\
                  | --- | --- | --- | --- |\n\
                  | P: mean of 10 | 20 each | 0.860 | 0.909 |\n\
                  | of these: Chair | 20 | 0.873 | 0.960 |\n";
    assert_eq!(accuracy_faults(readme, page), Vec::<String>::new());
    for (readme, page) in [
        (readme.replace("0.873 |", "0.97 |"), page.to_owned()),
        (readme.replace(" 0.909", " 0.900"), page.to_owned()),
        (readme.replace(": Chair", ": Chiar"), page.to_owned()),
        (readme.to_owned(), page.replace("0.873 (", "0.874 (")),
        (readme.to_owned(), page.replace("**0.873**", "**0.973**")),
        ("# R\n\n## Measured\n\nWell.\n".to_owned(), page.to_owned()),
        (readme.to_owned(), "# A\n".to_owned()),
    ] {
        assert!(
            !accuracy_faults(&readme, &page).is_empty(),
            "{readme}\n{page}"
        );
    }
    let help = "  [FAMILY]  Which family [default: pliers]\n";
    assert!(demo_faults("x `coseg demo` makes up a\nfamily of pliers, and", help).is_empty());
    assert!(!demo_faults("`coseg demo` makes up a family of animals", help).is_empty());
    assert!(!demo_faults("`coseg demo` makes up a family of pliers", "").is_empty());
}
