//! Output and exit codes of commands.

pub use crate::failure::Failure;
use crate::launch::LaunchError;
use crate::system::remedy;
use std::io::{self, Write};

/// The exit code of the process.
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

/// Prints an error to stderr, each of its lines with the program's name, and returns the exit code.
pub fn fail(exit: Exit, error: impl Into<Failure>) -> Exit {
    remark(&error.into());
    exit
}

/// Prints a remark to stderr, each of its lines with the program's name.
pub fn remark(text: &dyn std::fmt::Display) {
    for line in harmless(&text.to_string()).lines() {
        // Without a stderr only the exit code remains.
        let _ = writeln!(io::stderr(), "corotate: {line}");
    }
}

/// Returns the text with control characters and bidirectional overrides escaped, because text from files may reach a
/// terminal.
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

/// Prints to stdout. A reader that closed the pipe early, such as `head`, is not an error.
pub fn print(text: &str) -> Result<(), Failure> {
    let mut stdout = io::stdout().lock();
    match stdout.write_all(text.as_bytes()).and_then(|()| stdout.flush()) {
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => {
            Err(Failure::new("cannot-print", format!("cannot write to stdout: {error}; {}", remedy(&error))))
        }
        _ => Ok(()),
    }
}

/// The exit code of a command; `Err` if it stopped early, after its reason was printed.
pub type CommandResult = Result<Exit, Exit>;

/// Prints to stdout as the last step of a command.
pub fn say(text: &str) -> CommandResult {
    print(text).map(|()| Exit::Ok).map_err(|reason| fail(Exit::Failure, reason))
}

/// Returns the exit code of a failed run or replay.
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

/// Prints an event as a line of JSON.
pub fn event(name: &str, mut fields: serde_json::Value) -> Result<(), Failure> {
    fields["schema"] = "corotate/event/v1".into();
    fields["event"] = name.into();
    print(&format!("{fields}\n"))
}
