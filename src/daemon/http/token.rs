//! The secret that a browser or a monitor shows where other machines can come.

use std::io::{Read as _, Write as _};
use std::os::unix::fs::{OpenOptionsExt as _, PermissionsExt as _};
use std::path::{Path, PathBuf};

/// In the folder of the library, unless the configuration names another.
const FILE: &str = "http.token";
/// Characters of a token: few enough for a header, too many to be guessed.
const MIN_CHARS: usize = 16;
const MAX_CHARS: usize = 512;
/// Random bytes of one that is made.
const N_RANDOM: usize = 32;

/// Why there is no token.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)]
pub enum TokenError {
    #[error("the token of the HTTP endpoint, {path}: {source}")]
    Io {
        path: String,
        source: std::io::Error,
    },
    #[error(
        "the token of the HTTP endpoint, {path}, can be read by others (mode {mode:o}); chmod 600 \
         it, or remove it and a new one is made"
    )]
    Readable { path: String, mode: u32 },
    #[error(
        "the token of the HTTP endpoint, {path}, has {found} characters, but must be one word of \
         {MIN_CHARS} to {MAX_CHARS} of A-Z a-z 0-9 . _ ~ -; remove the file and one is made"
    )]
    Form { path: String, found: usize },
}

/// A token, as what is compared with what is shown: a digest, whose comparison takes the same time
/// whatever differs.
pub(super) struct Token(blake3::Hash);

impl Token {
    /// The token of the file; where there is no file, a new one that only this user may read.
    pub(super) fn read_or_make(path: &Path) -> Result<Self, TokenError> {
        let io = |source| TokenError::Io {
            path: path.display().to_string(),
            source,
        };
        let mut file = match std::fs::File::open(path) {
            Ok(file) => file,
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => {
                let text = make(path).map_err(io)?;
                tracing::info!(file = %path.display(), "made a token for the HTTP endpoint");
                return Ok(Self::of(&text));
            }
            Err(e) => return Err(io(e)),
        };
        let mode = file.metadata().map_err(io)?.permissions().mode() & 0o7777;
        if mode & 0o007 != 0 {
            let path = path.display().to_string();
            return Err(TokenError::Readable { path, mode });
        }
        let mut text = String::new();
        // A few more than fit: a line end, and enough to see that it is too long.
        (&mut file)
            .take(MAX_CHARS as u64 + 16)
            .read_to_string(&mut text)
            .map_err(io)?;
        let text = text.trim();
        let fits = |c: char| c.is_ascii_alphanumeric() || "._~-".contains(c);
        if !(MIN_CHARS..=MAX_CHARS).contains(&text.len()) || !text.chars().all(fits) {
            let (path, found) = (path.display().to_string(), text.chars().count());
            return Err(TokenError::Form { path, found });
        }
        Ok(Self::of(text))
    }

    fn of(text: &str) -> Self {
        Self(blake3::hash(text.as_bytes()))
    }

    /// Whether this is it.
    pub(super) fn is(&self, shown: &str) -> bool {
        Self::of(shown).0 == self.0
    }
}

/// The path of the token for a library in this folder.
pub(super) fn path(configured: &Path, library: &Path) -> PathBuf {
    if configured.as_os_str().is_empty() {
        library.join(FILE)
    } else {
        configured.to_owned()
    }
}

/// Writes a new token, whole or not at all.
fn make(path: &Path) -> std::io::Result<String> {
    let mut random = [0; N_RANDOM];
    std::fs::File::open("/dev/urandom")?.read_exact(&mut random)?;
    let text: String = random.iter().map(|b| format!("{b:02x}")).collect();
    let mut new = path.as_os_str().to_owned();
    new.push(".new");
    let new = PathBuf::from(new);
    // A start that was killed may have left it.
    let _ = std::fs::remove_file(&new);
    let mut file = std::fs::OpenOptions::new()
        .write(true)
        .create_new(true)
        .mode(0o600)
        .open(&new)?;
    writeln!(file, "{text}")?;
    file.sync_all()?;
    std::fs::rename(&new, path)?;
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::{Token, TokenError};
    use std::os::unix::fs::PermissionsExt as _;

    #[test]
    fn a_token_is_made_once_and_for_its_owner_alone() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("token");
        let made = Token::read_or_make(&path).unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        let mode = std::fs::metadata(&path).unwrap().permissions().mode();
        assert_eq!((text.trim().len(), mode & 0o777), (64, 0o600));
        let read = Token::read_or_make(&path).unwrap();
        for token in [&made, &read] {
            assert!(token.is(text.trim()));
            assert!(!token.is("") && !token.is(&text.trim()[1..]));
        }
    }

    #[test]
    fn what_is_no_secret_is_no_token() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("token");
        let read = |text: &str, mode: u32| {
            std::fs::write(&path, text).unwrap();
            std::fs::set_permissions(&path, std::fs::Permissions::from_mode(mode)).unwrap();
            Token::read_or_make(&path).err()
        };
        assert!(read("0123456789abcdef\n", 0o640).is_none());
        let readable = read("0123456789abcdef\n", 0o644);
        assert!(matches!(
            readable,
            Some(TokenError::Readable { mode: 0o644, .. })
        ));
        for text in ["", "short", "two words of sixteen", &"x".repeat(600)] {
            let e = read(text, 0o600);
            assert!(matches!(e, Some(TokenError::Form { .. })), "{text}: {e:?}");
        }
    }
}
