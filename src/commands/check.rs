//! `coseg check` compares a library's files with its catalog; `coseg snapshot` and `coseg restore`
//! copy libraries.

use super::session::print_line;
use super::{CommandError, Outcome};
use crate::cli::{Check, Global, Restore, Snapshot};
use coseg::Library;
use coseg::config::{Config, Overrides};
use coseg::store::check::Finding;
use coseg::text::counted;
use serde_json::json;
use std::path::{Path, PathBuf};

pub(crate) fn run(args: &Check, global: &Global) -> Outcome {
    let directory = library(args.library.as_ref())?;
    let (findings, repaired) = if args.repair {
        let repaired = Library::repair(&directory)?;
        (repaired.left, Some(repaired.done))
    } else {
        (Library::check(&directory)?, None)
    };
    report(&directory, &findings, repaired.as_deref(), global.json)
}

/// The named folder, or the one in the configuration.
fn library(named: Option<&PathBuf>) -> Result<PathBuf, CommandError> {
    Ok(match named {
        Some(directory) => directory.clone(),
        None => Config::load(&Overrides::default())?.library()?,
    })
}

pub(crate) fn snapshot(args: &Snapshot, global: &Global) -> Outcome {
    let from = library(args.library.as_ref())?;
    copy(&from, &args.to, args.link, global.json)
}

pub(crate) fn restore(args: &Restore, global: &Global) -> Outcome {
    let to = library(args.library.as_ref())?;
    copy(&args.from, &to, false, global.json)
}

fn copy(from: &Path, to: &Path, link: bool, as_json: bool) -> Outcome {
    let copied = Library::copy(from, to, link)?;
    eprintln!(
        "{}: {}, {}",
        to.display(),
        counted(copied.n_files, "file"),
        coseg::ipc::size::in_words(copied.n_bytes)
    );
    report(to, &copied.findings, None, as_json)
}

fn report(
    directory: &Path,
    findings: &[Finding],
    repaired: Option<&[String]>,
    as_json: bool,
) -> Outcome {
    let n_damaged = findings.iter().filter(|f| f.damage).count();
    if as_json {
        let list = findings
            .iter()
            .map(|f| json!({ "place": f.location, "message": f.message, "damage": f.damage }));
        let value = json!({
            "library": directory.display().to_string(),
            "ok": n_damaged == 0,
            "findings": list.collect::<Vec<_>>(),
            "repaired": repaired,
        });
        print_line(&value.to_string())?;
        return Ok(n_damaged == 0);
    }
    for what in repaired.unwrap_or_default() {
        print_line(&format!("repair: {what}"))?;
    }
    for f in findings {
        let kind = if f.damage { "damage" } else { "note" };
        print_line(&format!("{kind}: {}: {}", f.location, f.message))?;
    }
    if n_damaged == 0 {
        eprintln!("{}: no damage", directory.display());
    } else {
        eprintln!("{}: {n_damaged} damaged", directory.display());
    }
    Ok(n_damaged == 0)
}
