//! `coseg-bench labels` measures accuracy on meshes with known parts, and time.

use crate::error::{BenchError, Outcome};
use crate::print::{print_line, table};
use crate::proposals::ProposalScores;
use crate::session::{Session, log_warnings};
use crate::stream::{Category, Run, WithExemplars};
use crate::{Global, proposals, stream};
use clap::Args;
use coseg::ipc::convert::parse_up;
use coseg::ipc::wire;
use coseg::labels::N_PROPOSALS;
use serde_json::{Value, json};
use std::collections::BTreeSet;
use std::path::PathBuf;

/// `coseg-bench labels`
#[derive(Debug, Clone, Args)]
pub(crate) struct BenchLabels {
    /// Folder with a folder of meshes for each category: NAME.off or .obj, and NAME.labels.txt with
    /// one integer for each face
    #[arg(long, value_name = "DIR")]
    data: PathBuf,
    /// Only these categories [default: all]
    #[arg(long, value_name = "NAME")]
    category: Vec<String>,
    /// Number of orders of arrival: the first is that of the names, others are shuffled
    #[arg(
        long,
        value_name = "N",
        default_value_t = 3,
        value_parser = clap::value_parser!(u32).range(1..=100)
    )]
    orders: u32,
    /// Maximum number of shapes of each category, the first by name
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    limit: Option<u32>,
    /// The axis that points up in every file [default: unknown]
    #[arg(long, value_name = "AXIS", value_parser = parse_up, allow_hyphen_values = true)]
    up: Option<wire::Up>,
    /// Let the daemon estimate the number of part kinds
    #[arg(long)]
    estimate: bool,
    /// After the stream, give the shapes that the daemon suggests their true labels, and score the
    /// others by label id after each of these numbers of labelled shapes, such as 0,1,3,5 (0: the
    /// stream itself, which is always scored). In parentheses: where labels that no person gave
    /// stand, one to one, for true labels that no person gave
    #[arg(
        long,
        value_name = "N,...",
        value_delimiter = ',',
        value_parser = clap::value_parser!(u32).range(..=100)
    )]
    exemplars: Vec<u32>,
    /// After the stream, choose each of so many proposals in turn, and score the labels that follow
    /// from it; the best counts. Proposals do not depend on the number of part kinds
    #[arg(
        long,
        value_name = "N",
        value_parser = clap::value_parser!(u32).range(1..=N_PROPOSALS as i64)
    )]
    proposals: Option<u32>,
    /// Only stream: no batch run, no baselines (which use at most 60 evenly spread shapes)
    #[arg(long)]
    no_baselines: bool,
    /// Write the labels of the last order to DIR/CATEGORY/NAME.labels.txt
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
}

/// Number of shapes at the beginning and at the end of a stream whose times are compared.
const N_TIMED: usize = 50;

/// The two ways to compare labels with a person's.
const STRICT: fn(&WithExemplars) -> f64 = |w| w.strict;
const OPEN: fn(&WithExemplars) -> f64 = |w| w.open;

/// Accuracies of one category.
struct Row {
    name: String,
    n_shapes: usize,
    n_parts: usize,
    runs: Vec<Run>,
    others: Vec<(&'static str, f64)>,
}

impl Row {
    fn accuracies(&self) -> Vec<f64> {
        self.runs.iter().map(|r| r.accuracy).collect()
    }

    /// Accuracy with labelled shapes, for each number of them, over the orders.
    fn with_exemplars(&self, which: fn(&WithExemplars) -> f64) -> Vec<f64> {
        let n = self.runs.first().map_or(0, |r| r.with_exemplars.len());
        (0..n)
            .map(|i| mean(self.runs.iter().map(|r| which(&r.with_exemplars[i]))))
            .collect()
    }

    /// Accuracy after the best of the proposals was chosen, over the orders.
    fn best_of_proposals(&self) -> Option<f64> {
        let best = self
            .runs
            .iter()
            .map(|r| r.proposals.as_ref().map(ProposalScores::best));
        let best: Option<Vec<f64>> = best.collect();
        best.map(|b| mean(b.into_iter()))
    }

    fn spread(&self) -> f64 {
        spread(self.accuracies().into_iter())
    }

    /// Spread between the orders, for each number of labelled shapes.
    fn spread_with_exemplars(&self) -> Vec<f64> {
        let n = self.runs.first().map_or(0, |r| r.with_exemplars.len());
        (0..n)
            .map(|i| spread(self.runs.iter().map(|r| r.with_exemplars[i].strict)))
            .collect()
    }

    /// Number of orders in which as many labels are in use as there are parts.
    fn n_right(&self) -> usize {
        let right = |r: &&Run| r.n_labels == self.n_parts;
        self.runs.iter().filter(right).count()
    }

    /// Mean time of placing a shape in milliseconds.
    fn place_ms(&self) -> f64 {
        mean(self.runs.iter().flat_map(|r| &r.place_ms).copied())
    }

    /// The ratio of the times of placing the last and the first fifty shapes; `None` with fewer
    /// than a hundred.
    fn place_growth(&self) -> Option<f64> {
        let of = |r: &Run| {
            let n = r.place_ms.len();
            (n >= 2 * N_TIMED).then(|| {
                let last = mean(r.place_ms[n - N_TIMED..].iter().copied());
                last / mean(r.place_ms[..N_TIMED].iter().copied())
            })
        };
        let growth: Option<Vec<f64>> = self.runs.iter().map(of).collect();
        growth.map(|g| mean(g.into_iter()))
    }
}

pub(crate) fn run(args: &BenchLabels, global: &Global) -> Outcome {
    let categories = stream::categories(&args.data, &args.category, args.limit)?;
    let up = args.up.unwrap_or(wire::Up::Unknown);
    log_warnings();
    let mut rows = Vec::new();
    for category in &categories {
        rows.push(row(args, category, up, global)?);
        if let (Some(row), false) = (rows.last(), global.json) {
            let runs: Vec<String> = row.accuracies().iter().map(|a| format!("{a:.3}")).collect();
            eprintln!("{}: {}", row.name, runs.join(" "));
        }
    }
    if global.json {
        print_line(&report(&rows).to_string())?;
    } else {
        print_line(&table(&lines(&rows, &counts(args))))?;
    }
    Ok(rows.iter().flat_map(|r| &r.runs).all(|r| r.n_missing == 0))
}

/// Streams a category in every order, each through a daemon of its own on an empty library.
fn row(
    args: &BenchLabels,
    category: &Category,
    up: wire::Up,
    global: &Global,
) -> Result<Row, BenchError> {
    let counts = exemplars(args, category)?;
    let mut runs = Vec::new();
    let mut others = Vec::new();
    for order in 0..args.orders {
        let mut session = Session::start(global.patience())?;
        let n_parts = if args.estimate {
            0
        } else {
            category.n_parts as u32
        };
        let mut run = stream::stream(category, order, n_parts, up, &mut session)?;
        if let Some(most) = args.proposals {
            run.proposals = Some(proposals::proposals(category, most, &mut session)?);
        }
        run.with_exemplars = stream::with_exemplars(category, &counts, &mut session)?;
        let library = session.drain();
        if order + 1 == args.orders {
            if !args.no_baselines {
                others = stream::others(category, &library)?;
            }
            if let Some(out) = &args.out {
                stream::write(category, &run, &out.join(&category.name))?;
            }
        }
        runs.push(run);
    }
    Ok(Row {
        name: category.name.clone(),
        n_shapes: category.shapes.len(),
        n_parts: category.n_parts,
        runs,
        others,
    })
}

/// Numbers of shapes that are labelled by hand, ascending.
fn counts(args: &BenchLabels) -> BTreeSet<usize> {
    let counts = args.exemplars.iter().map(|n| *n as usize);
    counts.filter(|n| *n > 0).collect()
}

/// Numbers of shapes that are labelled by hand, ascending; at least one shape must remain to be
/// scored.
fn exemplars(args: &BenchLabels, category: &Category) -> Result<Vec<usize>, BenchError> {
    let counts = counts(args);
    let n_shapes = category.shapes.len();
    match counts.last().filter(|n| **n >= n_shapes) {
        Some(n) => Err(BenchError::Usage(format!(
            "--exemplars {n} leaves no shape of {} to score: it has {n_shapes}",
            category.name
        ))),
        None => Ok(counts.into_iter().collect()),
    }
}

pub(crate) fn mean(values: impl Iterator<Item = f64> + Clone) -> f64 {
    values.clone().sum::<f64>() / values.count().max(1) as f64
}

/// The largest value minus the smallest.
fn spread(values: impl Iterator<Item = f64> + Clone) -> f64 {
    let most = values.clone().fold(f64::NEG_INFINITY, f64::max);
    most - values.fold(f64::INFINITY, f64::min)
}

/// The table: a line for each category, the mean last.
fn lines(rows: &[Row], exemplars: &BTreeSet<usize>) -> Vec<Vec<String>> {
    let mut head = [
        "category",
        "shapes",
        "parts",
        "found",
        "right",
        "place ms",
        "last/first",
        "streamed",
        "spread",
    ]
    .map(str::to_owned)
    .to_vec();
    let others = rows.first().map_or(&[][..], |r| &r.others);
    let has_proposals = rows.iter().all(|r| r.best_of_proposals().is_some());
    head.extend(has_proposals.then(|| "best proposal".to_owned()));
    head.extend(exemplars.iter().map(|n| format!("{n} labelled (open)")));
    head.extend(others.iter().map(|o| o.0.to_owned()));
    let mut lines = vec![head];
    for r in rows {
        let found = mean(r.runs.iter().map(|r| r.n_labels as f64));
        let mut line = vec![
            r.name.clone(),
            r.n_shapes.to_string(),
            r.n_parts.to_string(),
            format!("{found:.1}"),
            format!("{}/{}", r.n_right(), r.runs.len()),
            format!("{:.0}", r.place_ms()),
            r.place_growth()
                .map_or_else(String::new, |g| format!("{g:.2}")),
            format!("{:.3}", mean(r.accuracies().into_iter())),
            format!("{:.3}", r.spread()),
        ];
        line.extend(r.best_of_proposals().map(|a| format!("{a:.3}")));
        let open = r.with_exemplars(OPEN).into_iter();
        let both = r.with_exemplars(STRICT).into_iter().zip(open);
        line.extend(both.map(|(strict, open)| format!("{strict:.3} ({open:.3})")));
        line.extend(r.others.iter().map(|o| format!("{:.3}", o.1)));
        lines.push(line);
    }
    let streamed = mean(rows.iter().map(|r| mean(r.accuracies().into_iter())));
    let spread = mean(rows.iter().map(Row::spread));
    let mut last = vec!["mean".to_owned()];
    last.resize(7, String::new());
    let n_runs: usize = rows.iter().map(|r| r.runs.len()).sum();
    let n_right: usize = rows.iter().map(Row::n_right).sum();
    last[4] = format!("{n_right}/{n_runs}");
    last.extend([format!("{streamed:.3}"), format!("{spread:.3}")]);
    let best: Option<Vec<f64>> = rows.iter().map(Row::best_of_proposals).collect();
    last.extend(best.map(|b| format!("{:.3}", mean(b.into_iter()))));
    let labelled = |which, i| mean(rows.iter().map(|r| r.with_exemplars(which)[i]));
    let both = (0..exemplars.len()).map(|i| (labelled(STRICT, i), labelled(OPEN, i)));
    last.extend(both.map(|(strict, open)| format!("{strict:.3} ({open:.3})")));
    last.extend(
        (0..others.len()).map(|i| format!("{:.3}", mean(rows.iter().map(|r| r.others[i].1)))),
    );
    lines.push(last);
    lines
}

fn report(rows: &[Row]) -> Value {
    let category = |r: &Row| {
        let runs: Vec<Value> = r
            .runs
            .iter()
            .map(|run| {
                json!({
                    "accuracy": run.accuracy,
                    "purity": run.purity,
                    "rand_error": run.rand_error,
                    "n_labels": run.n_labels,
                    "n_missing": run.n_missing,
                    "seconds": run.seconds,
                    "place_ms": run.place_ms,
                    "with_exemplars": run.with_exemplars.iter().map(STRICT).collect::<Vec<_>>(),
                    "with_exemplars_open": run.with_exemplars.iter().map(OPEN).collect::<Vec<_>>(),
                    "proposals": run.proposals.as_ref().map(ProposalScores::report),
                })
            })
            .collect();
        let others: serde_json::Map<String, Value> = r
            .others
            .iter()
            .map(|(name, accuracy)| ((*name).to_owned(), (*accuracy).into()))
            .collect();
        json!({
            "category": r.name,
            "n_shapes": r.n_shapes,
            "n_parts": r.n_parts,
            "accuracy": mean(r.accuracies().into_iter()),
            "spread": r.spread(),
            "n_right": r.n_right(),
            "place_ms": r.place_ms(),
            "place_growth": r.place_growth(),
            "best_of_proposals": r.best_of_proposals(),
            "with_exemplars": r.with_exemplars(STRICT),
            "with_exemplars_open": r.with_exemplars(OPEN),
            "spread_with_exemplars": r.spread_with_exemplars(),
            "orders": runs,
            "others": others,
        })
    };
    let accuracy = mean(rows.iter().map(|r| mean(r.accuracies().into_iter())));
    json!({
        "accuracy": accuracy,
        "categories": rows.iter().map(category).collect::<Vec<_>>(),
    })
}
