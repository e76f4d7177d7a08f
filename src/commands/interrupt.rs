//! Prints a note about work that continues in the daemon when an interrupt (Ctrl-C) ends the
//! command.

use signal_hook::consts::SIGINT;
use std::sync::{Mutex, Once, PoisonError};

static NOTE: Mutex<Option<String>> = Mutex::new(None);
static LISTENING: Once = Once::new();

/// Sets the note: from now on an interrupt prints it to stderr, then ends the process as usual.
pub(super) fn set_note(note: String) {
    *NOTE.lock().unwrap_or_else(PoisonError::into_inner) = Some(note);
    LISTENING.call_once(|| {
        // Where signals cannot be handled, an interrupt ends the command without the note.
        if let Ok(mut signals) = signal_hook::iterator::Signals::new([SIGINT]) {
            std::thread::spawn(move || {
                for _ in signals.forever() {
                    if let Some(note) = &*NOTE.lock().unwrap_or_else(PoisonError::into_inner) {
                        // The empty line moves past a progress bar and the terminal's ^C.
                        eprintln!("\n{note}");
                    }
                    let _ = signal_hook::low_level::emulate_default_handler(SIGINT);
                }
            });
        }
    });
}

/// Clears the note, since no work continues in the daemon.
pub(super) fn clear_note() {
    *NOTE.lock().unwrap_or_else(PoisonError::into_inner) = None;
}
