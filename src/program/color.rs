//! Colours on terminals.

use std::io::IsTerminal;
use std::sync::OnceLock;

/// Condition for colours; `Auto`: on terminals, unless NO_COLOR is set or TERM is dumb.
#[derive(Clone, Copy, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum When {
    #[default]
    Auto,
    Always,
    Never,
}

/// A colour, with its ANSI code.
#[derive(Clone, Copy)]
pub enum Color {
    Red = 31,
    Green = 32,
    Yellow = 33,
}

static WHEN: OnceLock<When> = OnceLock::new();

/// Sets the condition for colours. Later calls have no effect.
pub fn choose(when: When) {
    let _ = WHEN.set(when);
}

/// Returns the word, bold and coloured if the condition holds for the stream.
pub fn paint(word: &str, color: Color, stream: &impl IsTerminal) -> String {
    let set = |name: &str| std::env::var_os(name).filter(|value| !value.is_empty());
    let wanted = match WHEN.get().copied().unwrap_or_default() {
        When::Auto => {
            stream.is_terminal() && set("NO_COLOR").is_none() && set("TERM").is_none_or(|term| term != "dumb")
        }
        When::Always => true,
        When::Never => false,
    };
    if wanted { format!("\x1b[1;{}m{word}\x1b[0m", color as u8) } else { word.to_owned() }
}
