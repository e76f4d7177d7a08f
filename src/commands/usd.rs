//! `coseg usd`: labels of OpenUSD assets, by the Python package, which has OpenUSD itself.

use super::{CommandError, Outcome};
use crate::cli::{Global, Usd};
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// Names the interpreter.
const PYTHON: &str = "COSEG_PYTHON";

/// Becomes `python -m coseg.usd`; returns only if it cannot.
pub(crate) fn run(args: &Usd, global: &Global) -> Outcome {
    let python = interpreter();
    let imports = Command::new(&python)
        .args(["-c", "import coseg.usd"])
        .stdout(Stdio::null())
        .output();
    let why = match imports {
        Ok(output) if output.status.success() => {
            let mut command = Command::new(&python);
            command.args(["-m", "coseg.usd"]).args(&args.arguments);
            command.args(global.json.then_some("--json"));
            if let Some(endpoint) = &global.endpoint {
                command.env("COSEG_ENDPOINT", endpoint);
            }
            if let Some(key) = &global.server_key {
                command.env("COSEG_SERVER_KEY", key);
            }
            if let Some(key) = &global.client_key {
                command.env("COSEG_CLIENT_KEY", key);
            }
            command.exec().to_string()
        }
        Ok(output) => {
            let text = String::from_utf8_lossy(&output.stderr).into_owned();
            text.trim().lines().last().unwrap_or_default().to_owned()
        }
        Err(e) => e.to_string(),
    };
    Err(CommandError::Failed(format!(
        "coseg usd needs Python with the package coseg[usd], but {} has none ({why}): pip install \
         'coseg[usd]', or name another interpreter by {PYTHON}",
        python.display()
    )))
}

/// The interpreter that `COSEG_PYTHON` names, the one beside this program, which a wheel was
/// installed for, or the first `python3`.
fn interpreter() -> PathBuf {
    if let Some(named) = std::env::var_os(PYTHON) {
        return named.into();
    }
    let program = std::env::current_exe().ok();
    let beside = program.as_deref().and_then(Path::parent);
    let beside = beside.map(|folder| folder.join("python3"));
    beside
        .filter(|python| python.is_file())
        .unwrap_or_else(|| "python3".into())
}
