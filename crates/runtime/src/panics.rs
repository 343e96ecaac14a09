//! Panics: message, place, and the crate that they occur in.
//!
//! A panic of a user's law is not reported as a defect of this crate. This file does not end the process; the caller that
//! catches a panic decides.

use crate::files;
use serde::{Deserialize, Serialize};
use std::backtrace::{Backtrace, BacktraceStatus};
use std::cell::RefCell;
use std::fmt::{self, Display};
use std::panic::{AssertUnwindSafe, PanicHookInfo, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};

/// The largest number of characters of a message that are kept, and the largest number printed on a line.
const MESSAGE_MAX: usize = 4096;
const LINE_MAX: usize = 400;

/// A panic.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Panic {
    /// File, line and column.
    pub place: String,
    /// Its message.
    pub message: String,
}

impl Display for Panic {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let line = self.message.lines().map(str::trim).filter(|line| !line.is_empty()).collect::<Vec<_>>().join(" | ");
        let shown = line.chars().take(LINE_MAX).flat_map(|letter| match letter.is_control() {
            true => letter.escape_unicode().collect::<Vec<_>>(),
            false => vec![letter],
        });
        let more = if line.chars().count() > LINE_MAX { "..." } else { "" };
        write!(f, "it panicked at {}: {}{more}", self.place, shown.collect::<String>())
    }
}

impl Panic {
    fn at(info: &PanicHookInfo<'_>) -> Self {
        let place = info.location().map_or("an unknown place".to_owned(), ToString::to_string);
        Self { place, message: "its message could not be formatted".to_owned() }
    }

    fn from_hook(info: &PanicHookInfo<'_>) -> Self {
        let payload = info.payload();
        let words = payload.downcast_ref::<String>().map(String::as_str).or(payload.downcast_ref().copied());
        let words = words.unwrap_or("a value that is not text").trim();
        let mut message: String = words.chars().take(MESSAGE_MAX).collect();
        if message.len() < words.len() {
            message += "...";
        }
        Self { message, ..Self::at(info) }
    }

    fn report(&self, print: fn(&dyn Display)) {
        let Self { place, message } = self;
        match self.is_ours() {
            true => print(&format!(
                "a defect of corotate or of iceoryx2 at {place}: {message}; run it again, and report this line"
            )),
            false => print(&format!("panicked at {place}: {message}")),
        }
    }

    /// Returns true if the panic is a defect of this project or of iceoryx2, judged by its place.
    pub fn is_ours(&self) -> bool {
        [Some(file!()), Some(corotate_core::FILE), FACADE.get().copied()]
            .into_iter()
            .flatten()
            .any(|file| is_within(&self.place, file))
    }

    /// Returns true if both panics have the same place and the same message apart from numbers.
    pub fn is_like(&self, panic: &Self) -> bool {
        let words = |panic: &Self| panic.message.chars().filter(|letter| letter.is_alphabetic()).collect::<String>();
        self.place == panic.place && words(self) == words(panic)
    }

    /// Reads and removes the file in which a process left its panic, so that a successor can leave its own.
    pub fn take(path: &Path) -> Option<Self> {
        let text = std::fs::read(path).ok()?;
        let _ = std::fs::remove_file(path);
        serde_json::from_slice(&text).ok()
    }
}

/// Returns true if the place is in the crate with this root file, or in a crate of iceoryx2.
fn is_within(place: &str, file: &str) -> bool {
    let sources = file.rfind('/').map_or("", |end| &file[..=end]);
    place.starts_with(sources) || place.split('/').any(|part| part.starts_with("iceoryx2"))
}

/// The root file of the facade's sources.
static FACADE: OnceLock<&str> = OnceLock::new();

/// The file that receives the first panic of this process.
static KEPT: OnceLock<PathBuf> = OnceLock::new();
static IS_KEPT: AtomicBool = AtomicBool::new(false);

thread_local! {
    /// While this thread catches panics: true if they are silent, and the first caught one.
    static CAUGHT: RefCell<Option<(bool, Option<Panic>)>> = const { RefCell::new(None) };
}

/// Makes this process write its first panic to a file, from which the launcher reads why the process ended.
pub fn keep_in(path: PathBuf) {
    let _ = KEPT.set(path);
}

/// Installs a hook that passes every panic to `print`: message and place first, then the backtrace if RUST_BACKTRACE asks for it.
/// `facade` is a file at the root of the facade's sources: a panic below it is a defect of the facade.
pub fn set_hook(facade: &'static str, print: fn(&dyn Display)) {
    let _ = FACADE.set(facade);
    std::panic::set_hook(Box::new(move |info| {
        let first = KEPT.get().filter(|_| !IS_KEPT.swap(true, Ordering::Relaxed));
        let keep = |panic: &Panic| {
            let written = first.map(|path| files::write(path, &serde_json::to_vec(panic).unwrap_or_default()));
            // Without the file, the launcher still has the exit code.
            let _ = written;
        };
        // Written before the message is formatted: formatting may panic and end the process.
        keep(&Panic::at(info));
        let panic = Panic::from_hook(info);
        keep(&panic);
        let quiet = CAUGHT.try_with(|caught| match &mut *caught.borrow_mut() {
            Some((quiet, caught @ None)) => {
                *caught = Some(panic.clone());
                *quiet
            }
            // A second panic while the first one unwinds ends the process.
            Some((true, Some(before))) => {
                before.report(print);
                false
            }
            _ => false,
        });
        if quiet.unwrap_or(false) {
            return;
        }
        panic.report(print);
        let trace = Backtrace::capture();
        if trace.status() == BacktraceStatus::Captured {
            print(&trace);
        }
    }));
}

/// Calls a function and catches its panic, which is printed.
///
/// # Errors
/// The panic.
pub fn catch<T>(call: impl FnOnce() -> T) -> Result<T, Panic> {
    catch_as(false, call)
}

/// Catches a panic without printing it.
///
/// # Errors
/// The panic.
pub fn catch_quietly<T>(call: impl FnOnce() -> T) -> Result<T, Panic> {
    catch_as(true, call)
}

fn catch_as<T>(quiet: bool, call: impl FnOnce() -> T) -> Result<T, Panic> {
    CAUGHT.set(Some((quiet, None)));
    let returned = catch_unwind(AssertUnwindSafe(call));
    let caught = CAUGHT.take().and_then(|(_, caught)| caught);
    // A program with its own hook has printed it.
    let unknown = || Panic { place: "an unknown place".to_owned(), message: "see above".to_owned() };
    returned.map_err(|_| caught.unwrap_or_else(unknown))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn panic(place: &str, message: &str) -> Panic {
        Panic { place: place.to_owned(), message: message.to_owned() }
    }

    #[test]
    fn a_panic_is_ours_where_its_place_is() {
        for (place, file, ours) in [
            ("src/role/plant.rs:3:5", "src/lib.rs", true),
            ("/home/a/corotate/src/role/plant.rs:3:5", "/home/a/corotate/src/lib.rs", true),
            ("src/main.rs:3:5", "/home/a/corotate/src/lib.rs", false),
            ("examples/motor-pair/src/main.rs:3:5", "src/lib.rs", false),
            ("/r/iceoryx2-0.10.0/src/node.rs:1:1", "/r/corotate-0.1.0/src/lib.rs", true),
            ("/r/iceoryx2-bb-posix-0.10.0/src/file.rs:1:1", "src/lib.rs", true),
            ("/r/nalgebra-0.34.0/src/base.rs:1:1", "/r/corotate-0.1.0/src/lib.rs", false),
        ] {
            assert_eq!(is_within(place, file), ours, "{place}");
        }
        for file in [file!(), corotate_core::FILE] {
            assert!(panic(&format!("{file}:1:1"), "").is_ours(), "{file}");
        }
    }

    #[test]
    fn a_line_has_place_and_message_for_any_message() {
        let line = panic("src/main.rs:3:5", "first\n\n  second\u{1b}[31m").to_string();
        assert_eq!(line, "it panicked at src/main.rs:3:5: first | second\\u{1b}[31m");
        let long = panic("src/main.rs:3:5", &"é".repeat(10_000)).to_string();
        assert!(long.chars().count() < LINE_MAX + 50 && long.ends_with("é..."), "{long}");
    }

    #[test]
    fn panics_are_alike_but_for_numbers() {
        let first = panic("a.rs:1:1", "rate 3.17e-2 at tick 500");
        assert!(first.is_like(&panic("a.rs:1:1", "rate 9.1e+3 at tick 7")));
        assert!(!first.is_like(&panic("a.rs:2:1", "rate 3.17e-2 at tick 500")));
        assert!(!first.is_like(&panic("a.rs:1:1", "no rate at tick 500")));
    }

    #[test]
    fn a_panic_without_text_is_caught() {
        assert_eq!(catch(|| 3), Ok(3));
        assert!(catch(|| std::panic::panic_any(7_u32)).is_err());
    }
}
