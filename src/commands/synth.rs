//! `coseg synth` generates a folder of labelled meshes from a family and a seed.

use clap::Args;
use coseg::mesh::write::off;
use coseg::synth::{Family, LEAST_FACES, Options, UnknownFamily, generate};
use coseg::text::counted;
use rayon::iter::{IntoParallelIterator, ParallelIterator};
use serde_json::{Value, json};
use std::fmt::Write as _;
use std::io::Write as _;
use std::path::{Path, PathBuf};

/// Maximum number of faces of a shape.
const MOST_FACES: i64 = 1_000_000;

/// `coseg synth`: generates a family of labelled shapes.
#[derive(Debug, Clone, Args)]
pub(crate) struct SynthArgs {
    /// The family; `--list` lists all.
    #[arg(required_unless_present = "list", value_parser = parse_family)]
    pub(crate) family: Option<Family>,
    /// Number of shapes.
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..))]
    pub(crate) count: u32,
    /// The same seed gives the same files on every machine.
    #[arg(long, default_value_t = 1)]
    pub(crate) seed: u64,
    /// Number of faces of each shape.
    #[arg(
        long,
        default_value_t = 6_000,
        value_parser = clap::value_parser!(u32).range(i64::from(LEAST_FACES)..=MOST_FACES)
    )]
    pub(crate) faces: u32,
    /// Turn each shape at random; otherwise +y is up and all face the same way.
    #[arg(long)]
    pub(crate) rotate: bool,
    /// Folder for NAME.off, NAME.labels.txt and LABEL_NAMES.txt; created if missing.
    #[arg(long, required_unless_present = "list")]
    pub(crate) out: Option<PathBuf>,
    /// List the families and their parts.
    #[arg(long)]
    pub(crate) list: bool,
}

/// The reasons why the shapes could not be written.
#[derive(Debug, thiserror::Error)]
pub(crate) enum SynthError {
    /// Both a family and a folder are needed.
    #[error("{0} is missing (without --list, a family and --out are needed)")]
    Missing(&'static str),
    /// A file or the folder could not be written.
    #[error("cannot write {path}: {source}")]
    Write {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// The report could not be printed.
    #[error("cannot print: {0}")]
    Print(std::io::Error),
}

fn parse_family(name: &str) -> Result<Family, UnknownFamily> {
    name.parse()
}

/// Writes the shapes or lists the families, and prints a report.
pub(crate) fn run(args: &SynthArgs, json: bool) -> Result<(), SynthError> {
    let text = if args.list {
        list(json)
    } else {
        write_family(args, json)?
    };
    std::io::stdout()
        .lock()
        .write_all(text.as_bytes())
        .map_err(SynthError::Print)
}

/// The families with their parts.
fn list(as_json: bool) -> String {
    if as_json {
        let families = Family::ALL.map(|f| {
            let names = f.label_names();
            json!({"family": f.name(), "n_parts": names.len(), "parts": names})
        });
        return format!("{}\n", json!({ "families": families }));
    }
    let mut text = String::new();
    for family in Family::ALL {
        let names = family.label_names();
        writeln!(
            text,
            "{family:<12}{} parts: {}",
            names.len(),
            names.join(", ")
        )
        .expect("invariant: writing to a string cannot fail");
    }
    text
}

fn write_family(args: &SynthArgs, as_json: bool) -> Result<String, SynthError> {
    let family = args.family.ok_or(SynthError::Missing("the family"))?;
    let out = args.out.as_deref().ok_or(SynthError::Missing("--out"))?;
    std::fs::create_dir_all(out).map_err(|source| SynthError::Write {
        path: out.to_path_buf(),
        source,
    })?;
    let options = Options {
        n_faces: args.faces,
        rotate: args.rotate,
    };
    let written: Result<Vec<Value>, SynthError> = (0..args.count)
        .into_par_iter()
        .map(|index| {
            let shape = generate(family, args.seed, index, &options);
            write(&out.join(format!("{}.off", shape.name)), &off(&shape.mesh))?;
            let labels: String = shape.labels.iter().map(|l| format!("{l}\n")).collect();
            write(&out.join(format!("{}.labels.txt", shape.name)), &labels)?;
            let mut parts = shape.labels.clone();
            parts.sort_unstable();
            parts.dedup();
            let n_faces = shape.mesh.faces.len();
            Ok(json!({"name": shape.name, "n_faces": n_faces, "labels": parts}))
        })
        .collect();
    let written = written?;
    let names: String = family
        .label_names()
        .iter()
        .map(|n| format!("{n}\n"))
        .collect();
    write(&out.join("LABEL_NAMES.txt"), &names)?;
    if as_json {
        let report = json!({
            "family": family.name(),
            "seed": args.seed,
            "parts": family.label_names(),
            "out": out.display().to_string(),
            "shapes": written,
        });
        return Ok(format!("{report}\n"));
    }
    let n_parts = family.label_names().len();
    let (n, path) = (written.len(), out.display());
    Ok(format!(
        "{} of family {family} ({n_parts} parts) in {path}\n",
        counted(n as u64, "shape")
    ))
}

fn write(path: &Path, text: &str) -> Result<(), SynthError> {
    std::fs::write(path, text).map_err(|source| SynthError::Write {
        path: path.to_path_buf(),
        source,
    })
}

#[cfg(test)]
mod tests {
    use super::{SynthArgs, list, write_family};
    use clap::Parser;

    #[derive(Debug, Parser)]
    struct Cli {
        #[command(flatten)]
        synth: SynthArgs,
    }

    #[test]
    fn writes_a_mesh_and_its_labels() {
        let dir = tempfile::tempdir().unwrap();
        let out = dir.path().join("new/pliers");
        let typed = [
            "synth",
            "pliers",
            "--count",
            "2",
            "--faces",
            "1000",
            "--out",
            out.to_str().unwrap(),
        ];
        let report = write_family(&Cli::try_parse_from(typed).unwrap().synth, false).unwrap();
        assert!(report.starts_with("2 shapes of family pliers (3 parts) in "));
        let mut files: Vec<String> = std::fs::read_dir(&out)
            .unwrap()
            .map(|f| f.unwrap().file_name().into_string().unwrap())
            .collect();
        files.sort();
        let expected = [
            "LABEL_NAMES.txt",
            "pliers-001.labels.txt",
            "pliers-001.off",
            "pliers-002.labels.txt",
            "pliers-002.off",
        ];
        assert_eq!(files, expected);
        let off = std::fs::read_to_string(out.join("pliers-001.off")).unwrap();
        let counts = off.lines().nth(1).unwrap();
        let n_faces: usize = counts.split(' ').nth(1).unwrap().parse().unwrap();
        let labels = std::fs::read_to_string(out.join("pliers-001.labels.txt")).unwrap();
        assert_eq!(labels.lines().count(), n_faces);
        assert!(labels.lines().all(|l| l.parse::<u32>().unwrap() < 3));
    }

    #[test]
    fn refuses_what_it_cannot_do() {
        let parse = |typed: &[&str]| Cli::try_parse_from([&["synth"], typed].concat());
        assert!(parse(&[]).is_err());
        assert!(parse(&["pliers"]).is_err());
        assert!(parse(&["pliers", "--out", "x", "--faces", "10"]).is_err());
        let message = parse(&["dragon", "--out", "x"]).unwrap_err().to_string();
        assert!(message.contains("no family is called 'dragon'; there are animal, bird"));
        assert!(parse(&["--list"]).is_ok());
    }

    #[test]
    fn lists_families_with_their_parts() {
        assert!(list(false).contains("chair       4 parts: seat, back, leg, arm\n"));
        let value: serde_json::Value = serde_json::from_str(&list(true)).unwrap();
        assert_eq!(value["families"].as_array().unwrap().len(), 7);
    }
}
