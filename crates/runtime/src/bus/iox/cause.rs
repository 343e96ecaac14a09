//! The system error behind a failure of iceoryx2, which reports it only in its log.
//!
//! The log message follows the failed call directly, so the error code is still set. Must not print.

use crate::system::remedy;
use iceoryx2::prelude::{LogLevel, set_log_level, set_logger};
use iceoryx2_log_types::Log;
use std::cell::Cell;
use std::fmt::Arguments;
use std::io;

/// Errors that iceoryx2 never meets in normal operation. It uses others to test whether a file exists or is locked.
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
    /// The last error of any kind, which explains an uninformative message.
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

/// Captures the transport's errors from now on instead of printing them.
pub fn capture_errors() {
    set_logger(&ErrorCapture);
    set_log_level(LogLevel::Debug);
}

/// Resets the captured errors before a call.
pub fn reset() {
    // Replaces the current error code by that of a missing file, which is never reported as a cause.
    let _ = std::fs::metadata("");
    LAST_SERIOUS.set(None);
    LAST_ANY.set(None);
}

/// Returns the captured system error with a remedy, else `otherwise`.
pub fn reason(otherwise: impl FnOnce() -> String) -> String {
    let describe = |code| {
        let error = io::Error::from_raw_os_error(code);
        format!("{error}; {}", remedy(&error))
    };
    let (serious, any) = (LAST_SERIOUS.take(), LAST_ANY.take());
    serious.map(describe).unwrap_or_else(|| {
        let words = otherwise();
        let vague = ["Internal", "UnableTo", "Insufficient"].iter().any(|word| words.contains(word));
        any.filter(|_| vague).map_or(words, describe)
    })
}
