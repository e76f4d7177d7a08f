//! What an interrupt (Ctrl-C) leaves behind in the daemon is said before the command ends.

use signal_hook::consts::SIGINT;
use std::sync::{Mutex, Once, PoisonError};

static NOTE: Mutex<Option<String>> = Mutex::new(None);
static LISTENING: Once = Once::new();

/// From now on an interrupt prints `note` to stderr, then ends the process as it would have
/// without.
pub(super) fn say(note: String) {
    *NOTE.lock().unwrap_or_else(PoisonError::into_inner) = Some(note);
    LISTENING.call_once(|| {
        // Where signals cannot be handled, an interrupt ends the command without a word, as it
        // always did.
        if let Ok(mut signals) = signal_hook::iterator::Signals::new([SIGINT]) {
            std::thread::spawn(move || {
                for _ in signals.forever() {
                    if let Some(note) = &*NOTE.lock().unwrap_or_else(PoisonError::into_inner) {
                        // Past a progress bar and the terminal's ^C.
                        eprintln!("\n{note}");
                    }
                    let _ = signal_hook::low_level::emulate_default_handler(SIGINT);
                }
            });
        }
    });
}

/// Nothing is left behind any more.
pub(super) fn forget() {
    *NOTE.lock().unwrap_or_else(PoisonError::into_inner) = None;
}
