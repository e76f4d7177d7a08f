//! `coseg-bench signatures` measures how fast signatures are computed from eigenvectors, in
//! comparison with copying them.

use crate::Global;
use crate::error::Outcome;
use crate::print::{print_line, table};
use clap::Args;
use coseg::descriptors::{PointKernels, gps_scales, hks_times};
use serde_json::{Value, json};
use std::time::Instant;

/// `coseg-bench signatures`
#[derive(Debug, Clone, Args)]
pub(crate) struct BenchSignatures {
    /// Number of vertices
    #[arg(
        long,
        value_name = "N",
        default_value_t = 40_000,
        value_parser = clap::value_parser!(u32).range(48..=10_000_000)
    )]
    vertices: u32,
    /// Number of eigenpairs
    #[arg(
        long,
        value_name = "K",
        default_value_t = 300,
        value_parser = clap::value_parser!(u32).range(2..=10_000)
    )]
    k: u32,
    /// Number of times of the heat kernel, and of energies of the wave kernel
    #[arg(
        long,
        value_name = "N",
        default_value_t = 100,
        value_parser = clap::value_parser!(u32).range(1..=1_000)
    )]
    columns: u32,
    /// Number of rounds, of which the best counts
    #[arg(
        long,
        value_name = "N",
        default_value_t = 5,
        value_parser = clap::value_parser!(u32).range(1..=1_000)
    )]
    rounds: u32,
}

/// Number of vertices whose signatures are computed together.
const BATCH: usize = 48;
/// Number of columns of the global point signature.
const N_GPS: usize = 60;

/// The cost of one signature.
struct Row {
    name: String,
    seconds: f64,
    gigabytes: f64,
    gigaflops: f64,
}

pub(crate) fn run(args: &BenchSignatures, global: &Global) -> Outcome {
    let (n, k) = (args.vertices as usize, args.k as usize);
    let columns = args.columns as usize;
    // Weyl's law, and numbers of about the right size; their values do not affect the time.
    let area = 4.0 * std::f64::consts::PI;
    let values: Vec<f64> = (0..k).map(|i| area * i as f64).collect();
    let vectors: Vec<f64> = (0..n * k)
        .map(|i| (i as f64 * 0.618).fract() - 0.5)
        .collect();
    let times = hks_times(&values, columns);
    let mut rows = Vec::new();
    let gigabytes = (n * k * size_of::<f64>()) as f64 / 1e9;
    let mut measure = |name: String, flops: usize, work: &mut dyn FnMut()| {
        work();
        let mut seconds = f64::INFINITY;
        for _ in 0..args.rounds {
            let begin = Instant::now();
            work();
            seconds = seconds.min(begin.elapsed().as_secs_f64());
        }
        let gigaflops = (n * flops) as f64 / 1e9;
        rows.push(Row {
            name,
            seconds,
            gigabytes,
            gigaflops,
        });
    };
    let mut copy = vec![0.0; n * k];
    measure("copy".into(), 0, &mut || copy.copy_from_slice(&vectors));
    drop(copy);
    let scales = gps_scales(&values, N_GPS.min(k - 1));
    let mut gps = vec![0.0; n * scales.len()];
    measure("gps".into(), 0, &mut || {
        let rows = vectors
            .chunks_exact(k)
            .zip(gps.chunks_exact_mut(scales.len()));
        for (row, out) in rows {
            for ((out, x), scale) in out.iter_mut().zip(&row[1..]).zip(&scales) {
                *out = x * scale;
            }
        }
    });
    let few = hks_times(&values, 8);
    for (name, times, energies) in [
        ("hks, 8 times".to_owned(), &few[..], 0),
        (format!("hks, {columns} times"), &times[..], 0),
        (format!("wks, {columns} energies"), &times[..0], columns),
        (format!("hks and wks, {columns} each"), &times[..], columns),
    ] {
        let kernels = PointKernels::new(&values, times, energies);
        let width = kernels.n_columns();
        let mut out = vec![0.0; n * width];
        measure(name, kernels.flops(), &mut || {
            let batches = vectors.chunks(BATCH * k).zip(out.chunks_mut(BATCH * width));
            for (rows, out) in batches {
                kernels.of_rows(rows, k, out);
            }
        });
    }
    print(&rows, global)
}

fn print(rows: &[Row], global: &Global) -> Outcome {
    if global.json {
        let all: Vec<Value> = rows
            .iter()
            .map(|r| {
                json!({
                    "name": r.name,
                    "ms": 1e3 * r.seconds,
                    "gigabytes_per_second": r.gigabytes / r.seconds,
                    "gigaflops": r.gigaflops / r.seconds,
                })
            })
            .collect();
        print_line(&Value::from(all).to_string())?;
        return Ok(true);
    }
    let header = ["", "ms", "GB/s of eigenvectors", "GFlop/s"].map(str::to_owned);
    let lines = rows.iter().map(|r| {
        [
            r.name.clone(),
            format!("{:.1}", 1e3 * r.seconds),
            format!("{:.1}", r.gigabytes / r.seconds),
            format!("{:.1}", r.gigaflops / r.seconds),
        ]
    });
    let lines: Vec<Vec<String>> = std::iter::once(header)
        .chain(lines)
        .map(Vec::from)
        .collect();
    print_line(&table(&lines))?;
    Ok(true)
}
