//! `coseg config` shows the settings of the daemon without starting it.

use super::session::print_line;
use super::{CommandError, Outcome};
use crate::cli::{ConfigCommand, Global};
use coseg::config::{Config, Overrides};
use coseg::ipc::endpoint::Endpoint;
use serde_json::{Value, json};

pub(crate) fn run(command: &ConfigCommand, global: &Global) -> Outcome {
    let (ConfigCommand::Check(file) | ConfigCommand::Show(file)) = command;
    let overrides = Overrides {
        file: file.config.clone(),
        endpoint: global.endpoint.clone(),
        ..Overrides::default()
    };
    let config = Config::load(&overrides)?;
    let endpoint = match config.server.endpoint.as_str() {
        "" => Endpoint::default_for_user(),
        uri => Endpoint::parse(uri)?,
    };
    let events = endpoint.events()?.to_string();
    let library = config.library()?.display().to_string();
    let settings = serde_json::to_value(&config)
        .map_err(|e| CommandError::Failed(format!("the configuration cannot be shown: {e}")))?;
    match command {
        ConfigCommand::Check(_) if global.json => print_line(&json!({ "ok": true }).to_string())?,
        ConfigCommand::Check(_) => print_line("the configuration is valid")?,
        ConfigCommand::Show(_) if global.json => {
            let in_use = json!({
                "endpoint": endpoint.to_string(),
                "events": events,
                "library": library,
                "workers": config.n_workers(),
            });
            print_line(&json!({ "settings": settings, "in_use": in_use }).to_string())?;
        }
        ConfigCommand::Show(_) => {
            print_line(&format!(
                "# endpoint in use: {endpoint}\n# events: {events}\n# library in use: {library}"
            ))?;
            print_line(to_toml(&settings).trim_end())?;
        }
    }
    Ok(true)
}

/// Writes sections of scalars and lists of scalars as TOML; JSON's strings, numbers and lists are
/// valid TOML.
fn to_toml(settings: &Value) -> String {
    let mut text = String::new();
    for (section, keys) in settings.as_object().into_iter().flatten() {
        text.push_str(&format!("\n[{section}]\n"));
        for (key, value) in keys.as_object().into_iter().flatten() {
            text.push_str(&format!("{key} = {value}\n"));
        }
    }
    text
}
