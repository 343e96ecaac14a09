//! The error of the system behind a failure of the transport, which iceoryx2 tells in its log alone.
//!
//! Every message of that log is written right after the failed call, so the error is still at hand. Must not print.

use crate::system::remedy;
use iceoryx2::prelude::{LogLevel, set_log_level, set_logger};
use iceoryx2_log_types::Log;
use std::cell::Cell;
use std::fmt::Arguments;
use std::io;

/// Errors that iceoryx2 never meets in order: others are its way to look whether something is there, or locked.
const SERIOUS: [i32; 11] = [
    libc::ENOSPC,
    libc::EDQUOT,
    libc::EMFILE,
    libc::ENFILE,
    libc::EIO,
    libc::ENOMEM,
    libc::EROFS,
    libc::ENOLCK,
    libc::EPERM,
    libc::EACCES,
    libc::EFBIG,
];

thread_local! {
    static LAST_SERIOUS: Cell<Option<i32>> = const { Cell::new(None) };
    /// The last error of any kind, by which a word that tells nothing is made clearer.
    static LAST_ANY: Cell<Option<i32>> = const { Cell::new(None) };
}

struct ErrorCapture;

impl Log for ErrorCapture {
    fn log(&self, _: LogLevel, _: Arguments<'_>, _: Arguments<'_>) {
        let code = io::Error::last_os_error().raw_os_error();
        LAST_ANY.set(code);
        if code.is_some_and(|code| SERIOUS.contains(&code)) {
            LAST_SERIOUS.set(code);
        }
    }
}

/// From now on the transport's failures are heard, and not printed: what matters comes back as an error.
pub fn capture_errors() {
    set_logger(&ErrorCapture);
    set_log_level(LogLevel::Debug);
}

/// Forgets what was heard. What is called next has causes of its own.
pub fn reset() {
    // The error at hand is forgotten too, by one that is no cause: a name that cannot be there.
    let _ = std::fs::metadata("");
    LAST_SERIOUS.set(None);
    LAST_ANY.set(None);
}

/// Why the transport failed: the error of the system behind it and what to do about it, else `otherwise`.
pub fn reason(otherwise: impl FnOnce() -> String) -> String {
    let told = |code| {
        let error = io::Error::from_raw_os_error(code);
        format!("{error}; {}", remedy(&error))
    };
    let (serious, any) = (LAST_SERIOUS.take(), LAST_ANY.take());
    serious.map(told).unwrap_or_else(|| {
        let words = otherwise();
        let vague = ["Internal", "UnableTo", "Insufficient"].iter().any(|word| words.contains(word));
        any.filter(|_| vague).map_or(words, told)
    })
}
