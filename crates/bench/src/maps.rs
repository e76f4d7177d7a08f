//! `coseg-bench maps` measures the accuracy of maps between points on meshes with known
//! correspondence.

use crate::error::{BenchError, Outcome};
use crate::made::{self, Change};
use crate::print::{print_line, table};
use crate::{Global, transfer};
use clap::Args;
use coseg::SpectralMesh;
use coseg::fmap::{EstimateOptions, PointMap, PointShape, Side, point_maps};
use coseg::mesh::{self, EdgeGraph, Format, TriMesh};
use coseg::operators::Operator;
use coseg::spectrum::Options;
use serde_json::json;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Number of eigenpairs of each mesh.
const K: usize = 100;
/// Number of points of each mesh at which errors are measured, evenly spread over the known ones.
const MAX_POINTS: usize = 500;

/// `coseg-bench maps`
#[derive(Debug, Clone, Args)]
pub(crate) struct BenchMaps {
    /// Folder with folders of meshes: NAME.off, and NAME.vts, whose line i is the number, from 1,
    /// of the vertex at point i; optionally NAME.sym.vts with the mirrored positions of the points.
    /// Meshes whose names begin with the same letters form a set
    #[arg(long, value_name = "DIR", required_unless_present_any = ["labels", "pair"])]
    data: Option<PathBuf>,
    /// Folder with a folder of meshes for each category: NAME.off or .obj, and NAME.labels.txt with
    /// one integer for each face. Measures how well maps transfer labels, instead of points
    #[arg(long, value_name = "DIR", conflicts_with_all = ["data", "pair"])]
    labels: Option<PathBuf>,
    /// With --labels: only these categories [default: all]
    #[arg(long, value_name = "NAME", requires = "labels")]
    category: Vec<String>,
    /// Two meshes and a file with, for each vertex of the second, the number of a vertex of the
    /// first, from 0
    #[arg(long, num_args = 3, value_names = ["FROM.off", "TO.off", "TRUTH"])]
    pair: Option<Vec<PathBuf>>,
    /// Only every Nth pair
    #[arg(
        long,
        value_name = "N",
        default_value_t = 1,
        value_parser = clap::value_parser!(u32).range(1..)
    )]
    stride: u32,
    /// Of the pairs of --data, change one shape: cut off a part, add a component, add a handle
    #[arg(long, requires = "data")]
    made: bool,
}

/// A mesh with its spectrum, and the graph for measuring distances on it.
pub(crate) struct Meshed {
    spectral: SpectralMesh,
    graph: EdgeGraph,
}

/// Vertices at the known points of a mesh, and at their mirrored positions.
pub(crate) struct Known {
    at: Vec<u32>,
    mirrored: Vec<u32>,
    /// Distances from the points at which errors are measured, with the indices of these points.
    distances: Vec<(usize, Vec<f64>)>,
}

/// Errors of one map, in units of the square root of the area.
pub(crate) struct Score {
    counted: f64,
    forgiven: f64,
    expected: f64,
    estimate_ms: f64,
    /// Time of the samples and probe functions of a shape.
    frame_ms: f64,
}

pub(crate) fn run(args: &BenchMaps, global: &Global) -> Outcome {
    if let Some(labels) = &args.labels {
        return transfer::run(labels, &args.category, global);
    }
    let mut rows = Vec::new();
    let mut scores = Vec::new();
    let sets = args.data.as_deref().map(sets).transpose()?;
    if args.made {
        return made(&sets.unwrap_or_default(), args.stride as usize, global);
    }
    for (set, files) in sets.unwrap_or_default() {
        let found = bench_set(&files, args.stride as usize)?;
        if !global.json {
            eprintln!("{set}: {} pairs", found.len());
        }
        rows.push((set, mean(&found)));
        scores.extend(found);
    }
    if let Some([from, to, truth]) = args.pair.as_deref() {
        let found = bench_pair(from, to, truth)?;
        let name = |p: &Path| {
            p.file_stem()
                .unwrap_or_default()
                .to_string_lossy()
                .into_owned()
        };
        rows.push((format!("{} to {}", name(from), name(to)), mean(&[found])));
    }
    let calibration = calibration(&mut scores);
    if global.json {
        let sets: Vec<_> = rows
            .iter()
            .map(|(set, m)| {
                json!({
                    "set": set, "pairs": m.0, "counted": m.1, "forgiven": m.2,
                    "estimate_ms": m.3, "frame_ms": m.4,
                })
            })
            .collect();
        let bins: Vec<_> = calibration
            .iter()
            .map(|b| json!({"maps": b.0, "expected": b.1, "actual": b.2}))
            .collect();
        print_line(&json!({"sets": sets, "calibration": bins}).to_string())?;
        return Ok(true);
    }
    let head = ["set", "pairs", "error", "mirror forgiven", "ms"];
    let mut lines = vec![head.map(str::to_owned).to_vec()];
    lines.extend(rows.iter().map(|(set, m)| {
        vec![
            set.clone(),
            m.0.to_string(),
            format!("{:.4}", m.1),
            format!("{:.4}", m.2),
            format!("{:.0}", m.3),
        ]
    }));
    print_line(&table(&lines))?;
    let mut lines = vec![
        ["maps", "error to expect", "error"]
            .map(str::to_owned)
            .to_vec(),
    ];
    lines.extend(calibration.iter().map(|b| {
        vec![
            b.0.to_string(),
            format!("{:.3}", b.1),
            format!("{:.3}", b.2),
        ]
    }));
    print_line(&table(&lines))?;
    Ok(true)
}

/// Pairs of which one shape is changed.
fn made(sets: &BTreeMap<String, Vec<PathBuf>>, stride: usize, global: &Global) -> Outcome {
    let mut lines = Vec::new();
    for (set, files) in sets {
        for (change, name) in Change::ALL {
            let (scores, masked) = made::bench(files, change, stride, &options())?;
            lines.push((set, name, mean(&scores), masked.figures()));
        }
    }
    if global.json {
        let rows = lines.iter().map(|(set, change, m, f)| {
            json!({"set": set, "change": change, "pairs": m.0, "counted": m.1, "forgiven": m.2,
                   "precision": f[0], "recall": f[1], "said": f[2]})
        });
        print_line(&json!(rows.collect::<Vec<_>>()).to_string())?;
        return Ok(true);
    }
    let head = [
        "set",
        "change",
        "pairs",
        "error",
        "mirror forgiven",
        "precision",
        "recall",
        "said",
    ];
    let mut rows = vec![head.map(str::to_owned).to_vec()];
    rows.extend(lines.iter().map(|(set, change, m, f)| {
        let mut row = vec![(*set).clone(), (*change).to_owned(), m.0.to_string()];
        row.extend([m.1, m.2].map(|x| format!("{x:.4}")));
        row.extend(f.map(|x| format!("{x:.3}")));
        row
    }));
    print_line(&table(&rows))?;
    Ok(true)
}

/// Number of pairs, mean error, mean error up to reflection, mean times.
fn mean(scores: &[Score]) -> (usize, f64, f64, f64, f64) {
    let over =
        |f: &dyn Fn(&Score) -> f64| scores.iter().map(f).sum::<f64>() / scores.len().max(1) as f64;
    (
        scores.len(),
        over(&|s| s.counted),
        over(&|s| s.forgiven),
        over(&|s| s.estimate_ms),
        over(&|s| s.frame_ms),
    )
}

/// Quintiles of the expected error: number of maps, mean expected and mean actual error.
fn calibration(scores: &mut [Score]) -> Vec<(usize, f64, f64)> {
    scores.sort_by(|a, b| a.expected.total_cmp(&b.expected));
    let size = scores.len().div_ceil(5).max(1);
    let of = |bin: &[Score], f: &dyn Fn(&Score) -> f64| {
        bin.iter().map(f).sum::<f64>() / bin.len() as f64
    };
    scores
        .chunks(size)
        .map(|bin| {
            (
                bin.len(),
                of(bin, &|s| s.expected),
                of(bin, &|s| s.forgiven),
            )
        })
        .collect()
}

/// Meshes by set, both in order.
fn sets(data: &Path) -> Result<BTreeMap<String, Vec<PathBuf>>, BenchError> {
    let file = |path: &Path| {
        let path = path.display().to_string();
        move |source| BenchError::File { path, source }
    };
    let mut folders = vec![data.to_path_buf()];
    let mut sets: BTreeMap<String, Vec<PathBuf>> = BTreeMap::new();
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).map_err(file(&folder))? {
            let path = entry.map_err(file(&folder))?.path();
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|e| e == "off")
                && path.with_extension("vts").exists()
            {
                let stem = path
                    .file_stem()
                    .unwrap_or_default()
                    .to_string_lossy()
                    .into_owned();
                let set = stem.trim_end_matches(|c: char| c.is_ascii_digit());
                sets.entry(set.trim_end_matches(['_', '-']).to_owned())
                    .or_default()
                    .push(path);
            }
        }
    }
    sets.values_mut().for_each(|files| files.sort());
    if sets.is_empty() {
        return Err(BenchError::Failed(format!(
            "{}: no NAME.off with NAME.vts",
            data.display()
        )));
    }
    Ok(sets)
}

pub(crate) fn numbers(path: &Path, first: u32) -> Result<Vec<u32>, BenchError> {
    let text = std::fs::read_to_string(path).map_err(|source| BenchError::File {
        path: path.display().to_string(),
        source,
    })?;
    let number = |word: &str| {
        let n = word.parse::<u32>().ok().and_then(|n| n.checked_sub(first));
        n.ok_or_else(|| BenchError::Failed(format!("{}: {word:?} is no vertex", path.display())))
    };
    text.split_whitespace().map(number).collect()
}

fn load(path: &Path) -> Result<Meshed, BenchError> {
    let failed = |e: BenchError| BenchError::Failed(format!("{}: {e}", path.display()));
    meshed(load_mesh(path)?).map_err(failed)
}

pub(crate) fn load_mesh(path: &Path) -> Result<TriMesh, BenchError> {
    let failed = |e: &dyn std::fmt::Display| BenchError::Failed(format!("{}: {e}", path.display()));
    let bytes = std::fs::read(path).map_err(|source| BenchError::File {
        path: path.display().to_string(),
        source,
    })?;
    let parsed = mesh::parse(&bytes, Format::Off).map_err(|e| failed(&e))?;
    Ok(TriMesh {
        vertices: parsed.vertices,
        faces: parsed.triangles,
    })
}

/// The mesh scaled to area 1, with its spectrum.
pub(crate) fn meshed(whole: TriMesh) -> Result<Meshed, BenchError> {
    let spectral = SpectralMesh::new(whole, Operator::Tufted, K, &Options::default())
        .map_err(|e| BenchError::Failed(e.to_string()))?;
    Ok(Meshed {
        graph: EdgeGraph::new(&spectral.mesh, &spectral.bridges),
        spectral,
    })
}

impl Meshed {
    pub(crate) fn shape(&self, options: &EstimateOptions) -> PointShape<'_> {
        self.spectral.point_shape(options)
    }

    /// Distances from points that are evenly spread over `at`.
    pub(crate) fn known(&self, at: Vec<u32>, mirrored: Vec<u32>) -> Known {
        let count = at.len().min(MAX_POINTS);
        let points = (0..count).map(|i| i * at.len() / count);
        let distances = points.map(|p| (p, self.graph.dijkstra(at[p]))).collect();
        Known {
            at,
            mirrored,
            distances,
        }
    }
}

/// Mean error of a map to a shape with these points, and the same against the mirrored ones.
fn errors(from: &Known, to: &Known, map: &PointMap) -> (f64, f64) {
    let error = |at: &[u32]| {
        let each = from.distances.iter().filter_map(|(p, distance)| {
            let there = map.p2p_21.get(*at.get(*p)? as usize)?;
            distance.get(*there as usize)
        });
        let (sum, count) = each.fold((0.0, 0usize), |(s, n), d| (s + d, n + 1));
        if count > 0 {
            sum / count as f64
        } else {
            f64::INFINITY
        }
    };
    let direct = error(&to.at);
    (direct, direct.min(error(&to.mirrored)))
}

pub(crate) fn scored(
    one: (&PointShape<'_>, &Known),
    two: (&PointShape<'_>, &Known),
    options: &EstimateOptions,
) -> (Score, PointMap) {
    let begin = Instant::now();
    let maps = point_maps(one.0, two.0, &[], options);
    let estimate_ms = begin.elapsed().as_secs_f64() * 1e3;
    let map = maps.into_iter().next();
    let map = map.expect("invariant: there is a map between any two shapes");
    let (counted, forgiven) = errors(one.1, two.1, &map);
    let score = Score {
        counted,
        forgiven,
        expected: map.expected_error,
        estimate_ms,
        frame_ms: 0.0,
    };
    (score, map)
}

fn options() -> EstimateOptions {
    EstimateOptions {
        side: Side::Preferred,
        alternative: false,
        ..EstimateOptions::default()
    }
}

/// All ordered pairs of a set, or every `stride`th of them.
fn bench_set(files: &[PathBuf], stride: usize) -> Result<Vec<Score>, BenchError> {
    let options = options();
    let mut meshes = Vec::new();
    for file in files {
        let mirrored = file.with_extension("sym.vts");
        let mirrored = if mirrored.exists() {
            numbers(&mirrored, 1)?
        } else {
            Vec::new()
        };
        let meshed = load(file)?;
        let known = meshed.known(numbers(&file.with_extension("vts"), 1)?, mirrored);
        meshes.push((meshed, known));
    }
    let shapes: Vec<_> = meshes
        .iter()
        .map(|(m, known)| (m.shape(&options), known))
        .collect();
    let n = shapes.len();
    let pairs = (0..n).flat_map(|i| (0..n).filter(move |j| *j != i).map(move |j| (i, j)));
    let scores = pairs.step_by(stride).map(|(i, j)| {
        let ((a, known_a), (b, known_b)) = (&shapes[i], &shapes[j]);
        scored((a, known_a), (b, known_b), &options).0
    });
    Ok(scores.collect())
}

/// A pair of meshes with known correspondence for each vertex of the second.
fn bench_pair(from: &Path, to: &Path, truth: &Path) -> Result<Score, BenchError> {
    let options = options();
    let (one, two) = (load(from)?, load(to)?);
    let truth = numbers(truth, 0)?;
    let all = (0..truth.len() as u32).collect();
    let begin = Instant::now();
    let (a, b) = (one.shape(&options), two.shape(&options));
    let frame_ms = begin.elapsed().as_secs_f64() * 1e3 / 2.0;
    let known = one.known(truth, Vec::new());
    let target = Known {
        at: all,
        mirrored: Vec::new(),
        distances: Vec::new(),
    };
    let (score, _) = scored((&a, &known), (&b, &target), &options);
    Ok(Score { frame_ms, ..score })
}
