//! `coseg serve` starts a daemon with the configuration.

use super::Outcome;
use crate::cli::{Global, Serve};
use crate::telemetry;
use coseg::config::{Config, Overrides};
use coseg::daemon;

pub(crate) fn run(args: &Serve, global: &Global) -> Outcome {
    let overrides = Overrides {
        file: args.file.config.clone(),
        endpoint: global.endpoint.clone(),
        library: args.library.clone(),
        keys: args.keys.clone(),
        http: args.http.clone(),
        workers: args.workers,
        log_level: args.log_level.clone(),
    };
    let config = Config::load(&overrides)?;
    let telemetry = telemetry::start(&config.log)?;
    let reload = move || {
        let config = Config::load(&overrides)?;
        if let Err(e) = telemetry.set_level(&config.log.level) {
            tracing::error!(error = %e, "the log level stays as it was");
        }
        Ok(config)
    };
    daemon::serve(config, reload)?;
    Ok(true)
}
