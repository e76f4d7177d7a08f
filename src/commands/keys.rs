//! `coseg keys` generates keys and manages the list of clients that may connect.

use super::session::print_line;
use super::{CommandError, Outcome};
use crate::cli::{Global, Keys, KeysCommand};
use coseg::config::{Config, Overrides};
use coseg::ipc::keys::{
    ALLOW_FILE, AllowList, Allowed, KeyPair, PublicKey, SERVER_KEY_FILE, SERVER_PUBLIC_FILE,
    check_name, read_public, write_public,
};
use coseg::text::table;
use serde_json::json;
use std::os::unix::fs::DirBuilderExt as _;
use std::path::{Path, PathBuf};

pub(crate) fn run(args: &Keys, global: &Global) -> Outcome {
    let dir = folder(args)?;
    let allow = dir.join(ALLOW_FILE);
    if matches!(args.command, KeysCommand::Generate { .. }) {
        let made = std::fs::DirBuilder::new()
            .recursive(true)
            .mode(0o700)
            .create(&dir);
        made.map_err(|source| CommandError::File {
            path: dir.display().to_string(),
            source,
        })?;
    }
    match &args.command {
        KeysCommand::Generate { server: true, .. } => server(&dir, global.json)?,
        KeysCommand::Generate {
            name, role, out, ..
        } => {
            let name = name.as_deref().unwrap_or_default();
            check_name(name)?;
            let pair = KeyPair::generate()?;
            let path = match out {
                Some(path) => path.clone(),
                None => dir.join(format!("{name}.key")),
            };
            let client = Allowed {
                role: *role,
                key: pair.public().clone(),
                name: name.to_owned(),
            };
            let mut list = AllowList::read(&allow)?;
            list.add(client.clone())?;
            pair.write(&path)?;
            list.write(&allow)?;
            report(&client, Some(&path), global.json)?;
        }
        KeysCommand::Allow { key, name, role } => {
            let key = match key.parse::<PublicKey>() {
                Ok(key) => key,
                Err(_) if Path::new(key).exists() => read_public(Path::new(key))?,
                Err(e) => return Err(e.into()),
            };
            let client = Allowed {
                role: *role,
                key,
                name: name.clone(),
            };
            let mut list = AllowList::read(&allow)?;
            list.add(client.clone())?;
            list.write(&allow)?;
            report(&client, None, global.json)?;
        }
        KeysCommand::List => list(&allow, global.json)?,
        KeysCommand::Revoke { who } => {
            let mut list = AllowList::read(&allow)?;
            let gone = list.remove(who)?;
            list.write(&allow)?;
            if global.json {
                print_line(&json!({ "revoked": gone.name, "key": gone.key.as_str() }).to_string())?;
            } else {
                eprintln!("{} may no longer connect", gone.name);
            }
        }
    }
    Ok(true)
}

/// The folder of keys: `--dir`, or that of the daemon's configuration, or the user's own.
fn folder(args: &Keys) -> Result<PathBuf, CommandError> {
    if let Some(dir) = &args.dir {
        return Ok(dir.clone());
    }
    let configured = Config::load(&Overrides::default())?.security.keys;
    if !configured.as_os_str().is_empty() {
        return Ok(configured);
    }
    let variable = |name: &str| std::env::var_os(name).filter(|v| !v.is_empty());
    let base = variable("XDG_CONFIG_HOME")
        .map(PathBuf::from)
        .or_else(|| variable("HOME").map(|h| PathBuf::from(h).join(".config")));
    base.map(|b| b.join("coseg/keys")).ok_or_else(|| {
        CommandError::Usage(
            "neither XDG_CONFIG_HOME nor HOME is set; name a folder with --dir".into(),
        )
    })
}

fn server(dir: &Path, as_json: bool) -> Result<(), CommandError> {
    let pair = KeyPair::generate()?;
    pair.write(&dir.join(SERVER_KEY_FILE))?;
    let public = dir.join(SERVER_PUBLIC_FILE);
    write_public(&public, pair.public())?;
    if !dir.join(ALLOW_FILE).exists() {
        AllowList::default().write(&dir.join(ALLOW_FILE))?;
    }
    if as_json {
        let (keys, public) = (dir.display().to_string(), public.display().to_string());
        let value = json!({ "keys": keys, "public": pair.public().as_str(), "file": public });
        return print_line(&value.to_string());
    }
    print_line(pair.public().as_str())?;
    eprintln!(
        "the daemon's keys are in {0}: coseg serve --keys {0}",
        dir.display()
    );
    eprintln!("give {} to clients: COSEG_SERVER_KEY", public.display());
    Ok(())
}

fn report(client: &Allowed, file: Option<&Path>, as_json: bool) -> Result<(), CommandError> {
    let file = file.map(|f| f.display().to_string());
    if as_json {
        let value = json!({
            "name": client.name,
            "role": client.role.to_string(),
            "key": client.key.as_str(),
            "file": file,
        });
        return print_line(&value.to_string());
    }
    print_line(client.key.as_str())?;
    eprintln!("{} may connect, with the role {}", client.name, client.role);
    if let Some(file) = file {
        eprintln!("give {file} to the client, and to nobody else: COSEG_CLIENT_KEY");
    }
    Ok(())
}

fn list(allow: &Path, as_json: bool) -> Result<(), CommandError> {
    let list = AllowList::read(allow)?;
    if as_json {
        let clients = list
            .clients()
            .iter()
            .map(|c| json!({ "name": c.name, "role": c.role.to_string(), "key": c.key.as_str() }));
        let value = json!({ "clients": clients.collect::<Vec<_>>() });
        return print_line(&value.to_string());
    }
    let mut rows = vec![vec!["name".to_owned(), "role".to_owned(), "key".to_owned()]];
    rows.extend(
        list.clients()
            .iter()
            .map(|c| vec![c.name.clone(), c.role.to_string(), c.key.to_string()]),
    );
    print_line(&table(&rows))
}
