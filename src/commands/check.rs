//! `coseg check`: a library's files against its catalog.

use super::Outcome;
use super::session::print_line;
use crate::cli::{Check, Global};
use coseg::Library;
use coseg::config::{Config, Overrides};
use serde_json::json;

pub(crate) fn run(args: &Check, global: &Global) -> Outcome {
    let directory = match &args.library {
        Some(directory) => directory.clone(),
        None => Config::load(&Overrides::default())?.library()?,
    };
    let findings = Library::check(&directory)?;
    let n_damaged = findings.iter().filter(|f| f.damage).count();
    if global.json {
        let list = findings
            .iter()
            .map(|f| json!({ "place": f.place, "message": f.message, "damage": f.damage }));
        let value = json!({
            "library": directory.display().to_string(),
            "ok": n_damaged == 0,
            "findings": list.collect::<Vec<_>>(),
        });
        print_line(&value.to_string())?;
        return Ok(n_damaged == 0);
    }
    for f in &findings {
        let kind = if f.damage { "damage" } else { "note" };
        print_line(&format!("{kind}: {}: {}", f.place, f.message))?;
    }
    if n_damaged == 0 {
        eprintln!("{}: no damage", directory.display());
    } else {
        eprintln!("{}: {n_damaged} damaged", directory.display());
    }
    Ok(n_damaged == 0)
}
