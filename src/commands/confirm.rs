//! Asks for confirmation before actions that cannot be undone, if stdin is a terminal.

use super::CommandError;
use std::io::{IsTerminal as _, Write as _, stderr, stdin};

/// Whether to continue: asks on a terminal, unless `yes` is set. A script is not asked, since its
/// command line is the confirmation.
pub(super) fn confirmed(question: &str, yes: bool) -> Result<bool, CommandError> {
    if yes || !stdin().is_terminal() || !stderr().is_terminal() {
        return Ok(true);
    }
    let mut answer = String::new();
    eprint!("{question} [y/N] ");
    stderr()
        .flush()
        .and_then(|()| stdin().read_line(&mut answer))
        .map_err(|e| CommandError::Failed(format!("the answer cannot be read: {e}")))?;
    Ok(is_yes(&answer))
}

fn is_yes(answer: &str) -> bool {
    matches!(answer.trim().to_lowercase().as_str(), "y" | "yes")
}

#[cfg(test)]
mod tests {
    use super::is_yes;

    #[test]
    fn only_yes_is_yes() {
        assert!(is_yes("y\n") && is_yes(" YES \n"));
        assert!(!is_yes("") && !is_yes("\n") && !is_yes("n\n") && !is_yes("yesterday\n"));
    }
}
