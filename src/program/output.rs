//! What a command prints, and the exit code that it gives its parent.

pub use crate::failure::Failure;
use crate::launch::LaunchError;
use crate::system::remedy;
use std::io::{self, Write};

/// What the process says to its parent.
#[derive(Clone, Copy)]
pub enum Exit {
    Ok,
    Failure,
    Usage,
    NotAccepted,
    ProcessLost,
    PrivilegeMissing,
    Signal(usize),
}

impl Exit {
    pub fn code(self) -> u8 {
        match self {
            Self::Ok => 0,
            Self::Failure => 1,
            Self::Usage => 2,
            Self::NotAccepted => 3,
            Self::ProcessLost => 4,
            Self::PrivilegeMissing => 5,
            Self::Signal(number) => 128_u8.saturating_add(number.min(127) as u8),
        }
    }
}

/// Prints an error, one paragraph per line of it, and gives the exit code.
pub fn fail(exit: Exit, error: impl Into<Failure>) -> Exit {
    remark(&error.into());
    exit
}

/// Prints what there is to be said beside the results.
pub fn remark(text: &dyn std::fmt::Display) {
    for line in harmless(&text.to_string()).lines() {
        // Without a stderr the exit code is all there is to say.
        let _ = writeln!(io::stderr(), "corotate: {line}");
    }
}

/// A text that may come from a file, as it may stand on a terminal: what would command it, or turn the order of letters, is
/// shown by its number.
pub fn harmless(text: &str) -> String {
    let shown = |letter: char| match letter {
        '\n' => letter.to_string(),
        '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}' => {
            letter.escape_unicode().to_string()
        }
        _ if letter.is_control() => letter.escape_unicode().to_string(),
        _ => letter.to_string(),
    };
    text.chars().map(shown).collect()
}

/// Prints to stdout, or says why not. A reader that has had enough and is gone, as `head`, is no error.
pub fn print(text: &str) -> Result<(), Failure> {
    let mut stdout = io::stdout().lock();
    match stdout.write_all(text.as_bytes()).and_then(|()| stdout.flush()) {
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => {
            Err(Failure::new("cannot-print", format!("cannot write to stdout: {error}; {}", remedy(&error))))
        }
        _ => Ok(()),
    }
}

/// How a command ended: with an error if it stopped early. Its reason is printed then.
pub type Ended = Result<Exit, Exit>;

/// Prints to stdout.
pub fn say(text: &str) -> Ended {
    print(text).map(|()| Exit::Ok).map_err(|reason| fail(Exit::Failure, reason))
}

/// The exit code of a run, or a replay, that failed.
pub fn exit_of(error: &LaunchError) -> Exit {
    match error {
        LaunchError::Died { .. } | LaunchError::StartUp { .. } | LaunchError::Hung { .. } => Exit::ProcessLost,
        LaunchError::Privileges { .. } => Exit::PrivilegeMissing,
        LaunchError::NotStepped { .. } | LaunchError::Cores { .. } => Exit::Usage,
        LaunchError::Domain(_)
        | LaunchError::Descriptors { .. }
        | LaunchError::Bus(_)
        | LaunchError::Node(_)
        | LaunchError::Panicked { .. }
        | LaunchError::Ledger(_)
        | LaunchError::Write { .. }
        | LaunchError::Record(_)
        | LaunchError::Spawn { .. } => Exit::Failure,
    }
}
