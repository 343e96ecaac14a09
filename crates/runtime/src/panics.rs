//! Panics: what they say, where they are, and whose code that is.
//!
//! A user's law may panic: its message and place come first, and nothing calls it a defect of this crate. Must not end the
//! process; the caller that catches a panic decides.

use crate::files;
use serde::{Deserialize, Serialize};
use std::backtrace::{Backtrace, BacktraceStatus};
use std::cell::RefCell;
use std::fmt::{self, Display};
use std::panic::{AssertUnwindSafe, PanicHookInfo, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};

/// Letters of a message that are kept, and those of it that are put into a line.
const MESSAGE_MAX: usize = 4096;
const LINE_MAX: usize = 400;

/// One panic.
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
        Self { place, message: "its message could not be written".to_owned() }
    }

    fn of(info: &PanicHookInfo<'_>) -> Self {
        let payload = info.payload();
        let words = payload.downcast_ref::<String>().map(String::as_str).or(payload.downcast_ref().copied());
        let words = words.unwrap_or("a value that is no text").trim();
        let mut message: String = words.chars().take(MESSAGE_MAX).collect();
        if message.len() < words.len() {
            message += "...";
        }
        Self { message, ..Self::at(info) }
    }

    fn tell(&self, tell: fn(&dyn Display)) {
        let Self { place, message } = self;
        match self.is_ours() {
            true => tell(&format!(
                "a defect of corotate or of iceoryx2 at {place}: {message}; run it again, and report this line"
            )),
            false => tell(&format!("panicked at {place}: {message}")),
        }
    }

    /// Returns true if the panic is in code of this project or of iceoryx2: then it is a defect of theirs.
    pub fn is_ours(&self) -> bool {
        [Some(file!()), Some(corotate_core::FILE), FACADE.get().copied()]
            .into_iter()
            .flatten()
            .any(|file| is_within(&self.place, file))
    }

    /// Returns true if both are the same but for numbers in their messages.
    pub fn is_like(&self, other: &Self) -> bool {
        let words = |panic: &Self| panic.message.chars().filter(|letter| letter.is_alphabetic()).collect::<String>();
        self.place == other.place && words(self) == words(other)
    }

    /// The panic that a process has left in this file, which is removed: a successor leaves its own.
    pub fn take(path: &Path) -> Option<Self> {
        let text = std::fs::read(path).ok()?;
        let _ = std::fs::remove_file(path);
        serde_json::from_slice(&text).ok()
    }
}

/// Returns true if a place is in the crate that has this file at its root, or in one of iceoryx2's.
fn is_within(place: &str, file: &str) -> bool {
    let sources = file.rfind('/').map_or("", |end| &file[..=end]);
    place.starts_with(sources) || place.split('/').any(|part| part.starts_with("iceoryx2"))
}

/// A file at the root of the facade's sources.
static FACADE: OnceLock<&str> = OnceLock::new();

/// Where the first panic of this process is kept.
static KEPT: OnceLock<PathBuf> = OnceLock::new();
static KEPT_ONE: AtomicBool = AtomicBool::new(false);

thread_local! {
    /// While this thread catches panics: whether they are silent, and the one that was caught.
    static CAUGHT: RefCell<Option<(bool, Option<Panic>)>> = const { RefCell::new(None) };
}

/// Keeps the first panic of this process in a file, from which the launcher reads why the process ended.
pub fn keep_in(path: PathBuf) {
    let _ = KEPT.set(path);
}

/// Tells every panic by `tell`, first its message and place, and with RUST_BACKTRACE where it came from. `facade` is a file at the root
/// of the facade's sources: a panic below it is a defect of the facade.
pub fn set_hook(facade: &'static str, tell: fn(&dyn Display)) {
    let _ = FACADE.set(facade);
    std::panic::set_hook(Box::new(move |info| {
        let first = KEPT.get().filter(|_| !KEPT_ONE.swap(true, Ordering::Relaxed));
        let keep = |panic: &Panic| {
            let written = first.map(|path| files::write(path, &serde_json::to_vec(panic).unwrap_or_default()));
            // Without the file the launcher has the exit code.
            let _ = written;
        };
        // Before its message, which may panic in its turn and end the process.
        keep(&Panic::at(info));
        let panic = Panic::of(info);
        keep(&panic);
        let quiet = CAUGHT.try_with(|caught| match &mut *caught.borrow_mut() {
            Some((quiet, caught @ None)) => {
                *caught = Some(panic.clone());
                *quiet
            }
            // A panic while the caught one unwinds ends the process.
            Some((true, Some(before))) => {
                before.tell(tell);
                false
            }
            _ => false,
        });
        if quiet.unwrap_or(false) {
            return;
        }
        panic.tell(tell);
        let trace = Backtrace::capture();
        if trace.status() == BacktraceStatus::Captured {
            tell(&trace);
        }
    }));
}

/// Calls a function, and gives its panic, which is told.
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
    // A program that has a hook of its own has told it.
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
    fn a_line_has_place_and_message_whatever_the_message_is() {
        let told = panic("src/main.rs:3:5", "first\n\n  second\u{1b}[31m").to_string();
        assert_eq!(told, "it panicked at src/main.rs:3:5: first | second\\u{1b}[31m");
        let long = panic("src/main.rs:3:5", &"é".repeat(10_000)).to_string();
        assert!(long.chars().count() < LINE_MAX + 50 && long.ends_with("é..."), "{long}");
    }

    #[test]
    fn panics_are_alike_but_for_numbers() {
        let one = panic("a.rs:1:1", "rate 3.17e-2 at tick 500");
        assert!(one.is_like(&panic("a.rs:1:1", "rate 9.1e+3 at tick 7")));
        assert!(!one.is_like(&panic("a.rs:2:1", "rate 3.17e-2 at tick 500")));
        assert!(!one.is_like(&panic("a.rs:1:1", "no rate at tick 500")));
    }

    #[test]
    fn what_is_no_text_is_a_panic_too() {
        assert_eq!(catch(|| 3), Ok(3));
        assert!(catch(|| std::panic::panic_any(7_u32)).is_err());
    }
}
