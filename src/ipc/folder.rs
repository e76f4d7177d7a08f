//! Checks the folder of a socket: users who can create a socket there decide who answers at its
//! path.

use super::endpoint::EndpointError;
use rustix::process::getuid;
use std::fs::{self, DirBuilder, Metadata};
use std::io::ErrorKind;
use std::os::unix::fs::{DirBuilderExt as _, MetadataExt as _};
use std::path::{Path, PathBuf};

/// The folder in which daemon and clients meet if no endpoint is named.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum DefaultFolder {
    /// The folder of the service manager, which may let a group in.
    Service(PathBuf),
    /// The folder of one user, below an existing folder.
    User(PathBuf),
}

impl DefaultFolder {
    /// `$RUNTIME_DIRECTORY`, else `$XDG_RUNTIME_DIR/coseg`, else `/tmp/coseg-UID`.
    pub(super) fn of_this_process() -> Self {
        let variable = |name| {
            std::env::var_os(name)
                .filter(|v| !v.is_empty())
                .map(PathBuf::from)
        };
        if let Some(folder) = variable("RUNTIME_DIRECTORY") {
            return Self::Service(folder);
        }
        let below = variable("XDG_RUNTIME_DIR").map(|d| d.join("coseg"));
        Self::User(below.unwrap_or_else(|| format!("/tmp/coseg-{}", getuid().as_raw()).into()))
    }

    pub(super) fn path(&self) -> &Path {
        match self {
            Self::Service(path) | Self::User(path) => path,
        }
    }

    /// Rejects the folder if anybody but this user and root could listen there. Creates a missing
    /// one below `/tmp`, so that nobody else creates it while a client waits for a daemon.
    pub(super) fn check(&self) -> Result<(), EndpointError> {
        let (path, forbidden) = match self {
            Self::Service(path) => (path, 0o022),
            Self::User(path) => (path, 0o077),
        };
        if path.parent() == Some(Path::new("/tmp")) {
            match DirBuilder::new().mode(0o700).create(path) {
                Err(e) if e.kind() != ErrorKind::AlreadyExists => return Err(io(path)(e)),
                _ => {}
            }
        }
        // Both a link and its target are checked: a user who can change the link can redirect it.
        for look in [fs::symlink_metadata, |p: &PathBuf| fs::metadata(p)] {
            match look(path) {
                Ok(found) => self.judge(&found, forbidden)?,
                Err(e) if e.kind() == ErrorKind::NotFound => return Ok(()),
                Err(e) => return Err(io(path)(e)),
            }
        }
        Ok(())
    }

    fn judge(&self, found: &Metadata, forbidden: u32) -> Result<(), EndpointError> {
        let (me, owner, mode) = (getuid().as_raw(), found.uid(), found.mode() & 0o7777);
        let path = self.path().display().to_string();
        let refuse = |found: String, cure: String| {
            let path = path.clone();
            let message = format!("{found}, so a listener there need not be your daemon; {cure}");
            Err(EndpointError::Directory { path, message })
        };
        if owner != me && owner != 0 {
            let cure = "remove it, set XDG_RUNTIME_DIR to a folder of your own, or name the \
                        daemon with --endpoint";
            return refuse(
                format!("belongs to user {owner}, not to {me}"),
                cure.to_owned(),
            );
        }
        if !found.is_symlink() && mode & forbidden != 0 {
            let may = if forbidden & 0o055 == 0 {
                "write"
            } else {
                "enter"
            };
            let cure = match forbidden & 0o055 {
                0 => format!("`chmod go-w {path}` mends that"),
                _ => format!("`chmod 700 {path}` mends that"),
            };
            return refuse(
                format!("has mode {mode:04o}, which lets others {may}"),
                cure,
            );
        }
        Ok(())
    }
}

fn io(path: &Path) -> impl Fn(std::io::Error) -> EndpointError {
    let path = path.display().to_string();
    move |source| EndpointError::Io {
        path: path.clone(),
        source,
    }
}

/// Creates `directory` for its owner alone, or checks that no other user can create files there.
pub(super) fn private_directory(directory: &Path) -> Result<(), EndpointError> {
    DirBuilder::new()
        .mode(0o700)
        .recursive(true)
        .create(directory)
        .map_err(io(directory))?;
    let default = DefaultFolder::of_this_process();
    if default.path() == directory {
        return default.check();
    }
    let metadata = fs::metadata(directory).map_err(io(directory))?;
    let refuse = |message: String| {
        Err(EndpointError::Directory {
            path: directory.display().to_string(),
            message,
        })
    };
    let (uid, mode) = (getuid().as_raw(), metadata.mode() & 0o7777);
    let sticky = mode & 0o1000 != 0;
    if metadata.uid() != uid && !(metadata.uid() == 0 && (sticky || mode & 0o022 == 0)) {
        return refuse(format!("belongs to user {}, not to {uid}", metadata.uid()));
    }
    // Anybody could have created the predictable name below /tmp.
    let well_known = directory.parent() == Some(Path::new("/tmp"))
        && directory
            .file_name()
            .is_some_and(|n| n.to_string_lossy().starts_with("coseg-"));
    if well_known && (mode & 0o077 != 0 || metadata.uid() != uid) {
        return refuse(format!(
            "has mode {mode:04o}, others may enter; expected 0700"
        ));
    }
    if mode & 0o022 != 0 && !sticky {
        return refuse(format!(
            "has mode {mode:04o}, others may write; expected 0700"
        ));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::DefaultFolder;
    use std::fs::{self, Permissions};
    use std::os::unix::fs::PermissionsExt as _;

    #[test]
    fn a_default_folder_in_which_others_could_listen_is_refused() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("coseg");
        let user = DefaultFolder::User(path.clone());
        let service = DefaultFolder::Service(path.clone());
        // No daemon listens there, and nobody else can create it.
        user.check().unwrap();
        fs::create_dir(&path).unwrap();
        for (mode, for_user, for_service) in [
            (0o700, true, true),
            (0o500, true, true),
            (0o750, false, true),
            (0o755, false, true),
            (0o770, false, false),
            (0o777, false, false),
            (0o1777, false, false),
        ] {
            fs::set_permissions(&path, Permissions::from_mode(mode)).unwrap();
            for (folder, fits) in [(&user, for_user), (&service, for_service)] {
                let message = folder.check().map_err(|e| e.to_string());
                assert_eq!(message.is_ok(), fits, "{mode:o}: {message:?}");
                if let Err(message) = message {
                    let what = [format!("has mode {mode:04o}"), "`chmod ".to_owned()];
                    assert!(what.iter().all(|w| message.contains(w)), "{message}");
                }
            }
        }
        // The target of a link is checked.
        let link = directory.path().join("link");
        std::os::unix::fs::symlink(&path, &link).unwrap();
        let linked = DefaultFolder::User(link);
        assert!(linked.check().is_err());
        fs::set_permissions(&path, Permissions::from_mode(0o700)).unwrap();
        linked.check().unwrap();
    }

    #[test]
    fn a_folder_of_another_user_is_refused() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("coseg");
        fs::create_dir(&path).unwrap();
        fs::set_permissions(&path, Permissions::from_mode(0o700)).unwrap();
        // Only root can change the owner of a folder.
        if std::os::unix::fs::chown(&path, Some(12_345), None).is_err() {
            return;
        }
        for folder in [
            DefaultFolder::User(path.clone()),
            DefaultFolder::Service(path),
        ] {
            let message = folder.check().unwrap_err().to_string();
            assert!(
                message.contains("belongs to user 12345, not to "),
                "{message}"
            );
            assert!(message.contains("--endpoint"), "{message}");
        }
    }
}
