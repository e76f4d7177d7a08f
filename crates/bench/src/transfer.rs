//! `coseg-bench maps --labels` measures how well maps transfer labels from a few shapes to another,
//! and how well their confidence predicts that.

use crate::error::{BenchError, Outcome};
use crate::print::{print_line, table};
use crate::stream::{Category, Known, categories};
use crate::{Global, partial};
use coseg::fmap::confidence::{figures, fitted, logistic, of_map};
use coseg::fmap::{Confidence, FunctionalMap, MapOptions};
use coseg::ipc::convert::format_from_wire;
use coseg::labels::{Features, LabelModel, Normalisation, Statistics};
use coseg::mesh::Format;
use coseg::neighbors::SignatureMetric;
use coseg::pipeline::{
    Description, DescriptionView, FitOptions, Params, Prepared, Vote, describe,
    descriptor_distance, label_fitted, map, map_by_descriptors, proxy_pins, vote_probabilities,
};
use coseg::segmentation::Surface;
use rand::SeedableRng as _;
use rand::seq::SliceRandom as _;
use rayon::prelude::*;
use serde_json::json;
use std::path::Path;
use std::time::Instant;

/// Number of shapes that vote.
const N_BEST: usize = 5;
/// Number of random draws of a few labelled shapes.
const N_DRAWS: u64 = 3;
/// The ways of transferring labels.
const ARMS: [&str; 5] = [
    "maps",
    "descriptors",
    "model",
    "maps and model",
    "descriptors and model",
];
/// The criteria by which shapes are ranked.
const RANKINGS: [&str; 3] = ["signature", "as placed", "confidence"];

/// A described shape with its true labels.
pub(crate) struct Labelled {
    pub(crate) description: Description,
    /// Class of each polygon.
    pub(crate) truth: Vec<u32>,
    /// Class of most of each proxy face.
    pub(crate) of_face: Vec<Option<u32>>,
}

/// The shapes of a category, prepared for maps.
pub(crate) struct Ready {
    pub(crate) shapes: Vec<Labelled>,
    pub(crate) prepared: Vec<Prepared>,
    pub(crate) model: LabelModel,
    /// Number of classes.
    pub(crate) k: usize,
    /// The labels of the classes.
    pub(crate) kinds: Vec<i32>,
}

/// One ordered pair of shapes.
struct Pair {
    map: FunctionalMap,
    by_descriptors: (Vec<u32>, Confidence),
    /// Area share on which the transferred labels are right.
    accuracy: f64,
    distance: f64,
}

/// Figures of a category.
struct Row {
    name: String,
    /// For 19 and for 5 labelled shapes, the accuracy of each of [`ARMS`].
    accuracy: [[f64; 5]; 2],
    /// For each of [`RANKINGS`]: the share of the five best shapes that are among the first five,
    /// and the accuracy of maps from these.
    ranking: [(f64, f64); 3],
    /// Accuracy of maps from the five best.
    oracle: f64,
    /// The figures of each map that are known beforehand, and its accuracy.
    maps: Vec<([f64; 5], f64)>,
    matched: partial::Mask,
    map_ms: f64,
}

pub(crate) fn run(data: &Path, wanted: &[String], global: &Global) -> Outcome {
    let mut rows = Vec::new();
    for category in categories(data, wanted, None)? {
        let row = bench(&category)?;
        if !global.json {
            eprintln!("{}: {:.4} by maps", row.name, row.accuracy[0][0]);
        }
        rows.push(row);
    }
    print(&rows, global)?;
    Ok(true)
}

pub(crate) fn described(shape: &Known) -> Result<Description, BenchError> {
    let format = format_from_wire(shape.format);
    describe(
        &shape.bytes,
        format.unwrap_or(Format::Off),
        &Params::default(),
        &|_| true,
    )
    .map_err(|e| BenchError::Failed(e.to_string()))
}

pub(crate) fn prepared(category: &Category) -> Result<Ready, BenchError> {
    let mut kinds: Vec<i32> = category
        .shapes
        .iter()
        .flat_map(|s| s.truth.clone())
        .collect();
    kinds.sort_unstable();
    kinds.dedup();
    let k = kinds.len();
    let shapes: Vec<Labelled> = category
        .shapes
        .par_iter()
        .map(|shape| Ok(labelled(described(shape)?, &shape.truth, &kinds)))
        .collect::<Result<_, BenchError>>()?;
    let raw: Vec<(Features, Surface)> = shapes
        .par_iter()
        .map(|s| {
            let view = s.description.view();
            (Features::raw(&view, None), Surface::new(&view.mesh()))
        })
        .collect();
    let weighted = raw.iter().map(|(f, s)| (f, s.area.as_slice()));
    let normalisation = Normalisation::fit(weighted, false);
    let model = LabelModel {
        epoch: 0,
        labels: (0..k as u32).collect(),
        statistics: Statistics::empty(k, normalisation.mean.len()),
        normalisation,
        up: None,
    };
    let prepared = shapes
        .par_iter()
        .map(|s| Prepared::new(&s.description.view(), &model))
        .collect();
    Ok(Ready {
        shapes,
        prepared,
        model,
        k,
        kinds,
    })
}

pub(crate) fn labelled(description: Description, truth: &[i32], kinds: &[i32]) -> Labelled {
    let class = |l: &i32| kinds.partition_point(|k| k < l) as u32;
    let truth: Vec<u32> = truth.iter().map(class).collect();
    let pins: Vec<Option<u32>> = truth.iter().map(|c| Some(*c)).collect();
    Labelled {
        of_face: proxy_pins(&description.view(), &pins, kinds.len()),
        description,
        truth,
    }
}

impl Labelled {
    /// Area share of the polygons whose proxy face has their class.
    fn accuracy(&self, classes: &[u32]) -> f64 {
        let (mut right, mut total) = (0.0, 0.0);
        let d = &self.description;
        for ((truth, face), area) in self.truth.iter().zip(&d.face_map).zip(&d.polygon_area) {
            total += f64::from(*area);
            right += f64::from(*area) * f64::from(u8::from(classes[*face as usize] == *truth));
        }
        right / total.max(1e-300)
    }

    /// The votes for its faces `(m, k)`, 0 to 255.
    fn vote(&self, k: usize) -> Vec<u8> {
        let mut out = vec![0; self.of_face.len() * k];
        for (row, class) in out.chunks_exact_mut(k).zip(&self.of_face) {
            if let Some(class) = class {
                row[*class as usize] = u8::MAX;
            }
        }
        out
    }
}

fn bench(category: &Category) -> Result<Row, BenchError> {
    let prep = prepared(category)?;
    let n = prep.shapes.len();
    let votes: Vec<Vec<u8>> = prep.shapes.iter().map(|s| s.vote(prep.k)).collect();
    let begin = Instant::now();
    let sides = |s: usize| (prep.shapes[s].description.view(), &prep.prepared[s]);
    // Measured alone, before other maps run concurrently.
    let alone = n.min(9);
    let mut times: Vec<f64> = (1..alone)
        .map(|i| {
            let begin = Instant::now();
            let ((a, pa), (b, pb)) = (sides(i), sides(0));
            let found = map((&a, pa), (&b, pb), &MapOptions::default());
            let ms = begin.elapsed().as_secs_f64() * 1e3;
            if found.p2p_21.is_empty() { 0.0 } else { ms }
        })
        .collect();
    times.sort_by(f64::total_cmp);
    let map_ms = times.get(times.len() / 2).copied().unwrap_or(0.0);
    let pairs: Vec<Option<Pair>> = (0..n * n)
        .into_par_iter()
        .map(|at| {
            let (i, j) = (at / n, at % n);
            if i == j {
                return None;
            }
            let ((a, pa), (b, pb)) = (sides(i), sides(j));
            let found = map((&a, pa), (&b, pb), &MapOptions::default());
            let mut pair = Pair {
                by_descriptors: map_by_descriptors((&a, pa), (&b, pb)),
                map: found,
                accuracy: 0.0,
                distance: descriptor_distance(pa, pb),
            };
            let vote = as_vote(&a, &votes[i], &pair, true);
            let (faces, _) = vote_probabilities(&b, &[vote], prep.k);
            pair.accuracy = prep.shapes[j].accuracy(&most_likely(&faces, prep.k));
            Some(pair)
        })
        .collect();
    log_time("maps", begin);
    let at = |i: usize, j: usize| pairs[i * n + j].as_ref();
    let n_descriptors = prep
        .shapes
        .first()
        .map_or(0, |s| s.description.n_descriptors);
    let metric = SignatureMetric::new(&prep.model.normalisation, n_descriptors);
    let figures_of = |t: usize| target(&prep, &votes, t, &|i| at(i, t), &metric);
    let targets: Vec<Target> = (0..n).into_par_iter().map(figures_of).collect();
    let mean = |f: &dyn Fn(&Target) -> f64| targets.iter().map(f).sum::<f64>() / n as f64;
    let accuracy = std::array::from_fn(|p| std::array::from_fn(|a| mean(&|t| t.accuracy[p][a])));
    Ok(Row {
        name: category.name.clone(),
        accuracy,
        ranking: std::array::from_fn(|r| (mean(&|t| t.ranking[r].0), mean(&|t| t.ranking[r].1))),
        oracle: mean(&|t| t.oracle),
        maps: pairs
            .iter()
            .flatten()
            .map(|p| (figures(&p.map.quality), p.accuracy))
            .collect(),
        matched: partial::cut_away(category, &prep)?,
        map_ms,
    })
}

fn log_time(what: &str, begin: Instant) {
    tracing::debug!(what, seconds = begin.elapsed().as_secs_f64());
}

fn as_vote<'a>(
    from: &DescriptionView<'a>,
    probabilities: &'a [u8],
    pair: &'a Pair,
    by_map: bool,
) -> Vote<'a> {
    let (p2p, confidence) = match by_map {
        true => (&pair.map.p2p_21, &pair.map.confidence),
        false => (&pair.by_descriptors.0, &pair.by_descriptors.1),
    };
    Vote {
        faces: from.faces,
        probabilities,
        p2p,
        confidence,
        trust: 1.0,
    }
}

fn most_likely(faces: &[f64], k: usize) -> Vec<u32> {
    let best = |row: &[f64]| (0..k).max_by(|&a, &b| row[a].total_cmp(&row[b]).then(b.cmp(&a)));
    let rows = faces.chunks_exact(k);
    rows.map(|row| best(row).unwrap_or(0) as u32).collect()
}

/// Figures of one shape that is labelled from others.
struct Target {
    accuracy: [[f64; 5]; 2],
    ranking: [(f64, f64); 3],
    oracle: f64,
}

fn target<'a>(
    prep: &Ready,
    votes: &[Vec<u8>],
    t: usize,
    pair: &dyn Fn(usize) -> Option<&'a Pair>,
    metric: &SignatureMetric,
) -> Target {
    let all: Vec<usize> = (0..prep.shapes.len()).filter(|i| *i != t).collect();
    let by = |value: &dyn Fn(usize) -> f64, among: &[usize]| {
        let mut order = among.to_vec();
        order.sort_by(|a, b| value(*a).total_cmp(&value(*b)));
        order
    };
    let signature = |s: usize| prep.shapes[s].description.signature.as_slice();
    let distance = |i: usize| metric.distance(signature(t), signature(i));
    let compared = |i: usize| pair(i).map_or(f64::INFINITY, |p| p.distance);
    let as_placed = |among: &[usize]| {
        let mut near = by(&distance, among);
        near.truncate(2 * N_BEST);
        by(&compared, &near)
    };
    let label = |sources: &[usize], labelled: &[usize], arm: usize| -> f64 {
        let views: Vec<DescriptionView<'_>> = sources
            .iter()
            .map(|i| prep.shapes[*i].description.view())
            .collect();
        let by_map = arm == 0 || arm == 3;
        let given: Vec<Vote<'_>> = sources
            .iter()
            .zip(&views)
            .filter_map(|(i, view)| Some(as_vote(view, &votes[*i], pair(*i)?, by_map)))
            .collect();
        let mut statistics = Statistics::empty(prep.k, prep.model.normalisation.mean.len());
        if arm >= 2 {
            for i in labelled {
                let class = |f: usize| prep.shapes[*i].of_face[f];
                let (features, area) =
                    (&prep.prepared[*i].features, &prep.prepared[*i].surface.area);
                statistics.accumulate(&Statistics::of_shape(features, area, class, prep.k), 1.0);
            }
        }
        let options = FitOptions {
            vote_share: if arm < 2 {
                1.0
            } else {
                FitOptions::default().vote_share
            },
            ..FitOptions::default()
        };
        let view = prep.shapes[t].description.view();
        let given = if arm == 2 { &[][..] } else { &given[..] };
        let found = label_fitted(
            &view,
            &prep.prepared[t],
            (&statistics, None),
            given,
            &[],
            &options,
        );
        prep.shapes[t].accuracy(&found.classes)
    };
    let five = |order: &[usize]| order[..N_BEST.min(order.len())].to_vec();
    let draws: Vec<Vec<usize>> = (0..N_DRAWS)
        .map(|draw| {
            let mut few = all.clone();
            let seed = 1_000 * draw + t as u64;
            few.shuffle(&mut rand_pcg::Pcg64::seed_from_u64(seed));
            few.truncate(N_BEST);
            few
        })
        .collect();
    let placed = five(&as_placed(&all));
    let accuracy = [
        std::array::from_fn(|arm| label(&placed, &all, arm)),
        std::array::from_fn(|arm| {
            let each = draws.iter().map(|few| label(few, few, arm));
            each.sum::<f64>() / draws.len() as f64
        }),
    ];
    let best = five(&by(&|i| -pair(i).map_or(0.0, |p| p.accuracy), &all));
    let confidence = |i: usize| -pair(i).map_or(0.0, |p| of_map(&p.map.quality));
    let orders = [by(&distance, &all), as_placed(&all), by(&confidence, &all)];
    let ranking = orders.map(|order| {
        let first = five(&order);
        let hits = first.iter().filter(|i| best.contains(i)).count();
        (
            hits as f64 / best.len().max(1) as f64,
            label(&first, &all, 0),
        )
    });
    Target {
        accuracy,
        ranking,
        oracle: label(&best, &all, 0),
    }
}

/// Predicted and actual accuracy of maps, in five equal bins of the predicted one, and their rank
/// correlation. Each category is predicted from the others if there are any.
fn calibration(rows: &[Row]) -> (Vec<(usize, f64, f64)>, f64) {
    let mut points: Vec<(f64, f64)> = Vec::new();
    for (r, row) in rows.iter().enumerate() {
        let others = rows.iter().enumerate().filter(|(o, _)| *o != r);
        let known: Vec<([f64; 5], f64)> = others.flat_map(|(_, o)| o.maps.clone()).collect();
        let weights = match known.is_empty() {
            true => coseg::fmap::confidence::OF_MAP,
            false => fitted(&known),
        };
        points.extend(row.maps.iter().map(|(x, y)| (logistic(&weights, x), *y)));
    }
    let rank = |value: &dyn Fn(usize) -> f64| {
        let mut order: Vec<usize> = (0..points.len()).collect();
        order.sort_by(|a, b| value(*a).total_cmp(&value(*b)));
        let mut rank = vec![0.0; order.len()];
        order
            .iter()
            .enumerate()
            .for_each(|(r, i)| rank[*i] = r as f64);
        rank
    };
    let (x, y) = (rank(&|i| points[i].0), rank(&|i| points[i].1));
    let centre = (points.len() as f64 - 1.0) / 2.0;
    let sum = |a: &[f64], b: &[f64]| -> f64 {
        a.iter()
            .zip(b)
            .map(|(a, b)| (a - centre) * (b - centre))
            .sum()
    };
    let correlation = sum(&x, &y) / sum(&x, &x).max(1e-300);
    points.sort_by(|a, b| a.0.total_cmp(&b.0));
    let bins = points.chunks(points.len().div_ceil(5).max(1)).map(|bin| {
        let mean =
            |f: &dyn Fn(&(f64, f64)) -> f64| bin.iter().map(f).sum::<f64>() / bin.len() as f64;
        (bin.len(), mean(&|p| p.0), mean(&|p| p.1))
    });
    (bins.collect(), correlation)
}

fn print(rows: &[Row], global: &Global) -> Result<(), BenchError> {
    let n = rows.len().max(1) as f64;
    let mean = |f: &dyn Fn(&Row) -> f64| rows.iter().map(f).sum::<f64>() / n;
    let (bins, correlation) = calibration(rows);
    let all: Vec<([f64; 5], f64)> = rows.iter().flat_map(|r| r.maps.clone()).collect();
    let weights = fitted(&all);
    let masks: Vec<&partial::Mask> = rows.iter().map(|r| &r.matched).collect();
    let mask = partial::Mask::sum(&masks);
    if global.json {
        let of = |r: &Row| {
            json!({"category": r.name, "labelled_19": r.accuracy[0], "labelled_5": r.accuracy[1],
                   "ranking": r.ranking, "oracle": r.oracle, "map_ms": r.map_ms})
        };
        let categories: Vec<_> = rows.iter().map(of).collect();
        let text = json!({"arms": ARMS, "rankings": RANKINGS, "categories": categories,
                          "calibration": bins, "correlation": correlation, "weights": weights,
                          "mask": mask.json()});
        return print_line(&text.to_string());
    }
    let figure = |x: f64| format!("{x:.4}");
    let head = |first: &str, names: &[&str]| -> Vec<String> {
        let names = names.iter().map(|n| (*n).to_owned());
        std::iter::once(first.to_owned()).chain(names).collect()
    };
    for (p, count) in ["all others", "5 shapes"].iter().enumerate() {
        let mut lines = vec![head(&format!("{count} labelled"), &ARMS)];
        let line = |name: &str, f: &dyn Fn(usize) -> f64| {
            let cells = (0..ARMS.len()).map(|a| figure(f(a)));
            std::iter::once(name.to_owned())
                .chain(cells)
                .collect::<Vec<_>>()
        };
        lines.extend(rows.iter().map(|r| line(&r.name, &|a| r.accuracy[p][a])));
        lines.push(line("mean", &|a| mean(&|r| r.accuracy[p][a])));
        print_line(&table(&lines))?;
    }
    let mut lines = vec![head(
        "ranking",
        &["recall of the five best", "accuracy by maps"],
    )];
    for (r, name) in RANKINGS.iter().enumerate() {
        let cells = [mean(&|x| x.ranking[r].0), mean(&|x| x.ranking[r].1)];
        lines.push(vec![(*name).to_owned(), figure(cells[0]), figure(cells[1])]);
    }
    lines.push(vec![
        "five best".to_owned(),
        figure(1.0),
        figure(mean(&|r| r.oracle)),
    ]);
    print_line(&table(&lines))?;
    let mut lines = vec![head("maps", &["expected", "accuracy"])];
    lines.extend(
        bins.iter()
            .map(|b| vec![b.0.to_string(), figure(b.1), figure(b.2)]),
    );
    print_line(&table(&lines))?;
    print_line(&format!(
        "rank correlation {correlation:.2}; fitted to all: {weights:.3?}; {:.1} ms a map",
        mean(&|r| r.map_ms)
    ))?;
    print_line(&mask.text())
}
