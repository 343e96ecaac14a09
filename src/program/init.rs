//! `corotate init`: print a shipped scenario.

use super::{Exit, fail, say, scenarios};

/// Options of `corotate init`.
#[derive(clap::Args)]
pub struct Arguments {
    /// Name of a scenario that ships with the program; a name that is none lists them all
    name: String,
}

/// Prints a scenario.
pub fn init(arguments: &Arguments) -> Exit {
    match scenarios().iter().find(|(name, _)| *name == arguments.name) {
        Some((_, text)) => say(text).map_or_else(|exit| exit, |()| Exit::Ok),
        None => {
            let known: Vec<&str> = scenarios().iter().map(|(name, _)| *name).collect();
            fail(Exit::Usage, &format!("there is no scenario `{}`; there are: {}", arguments.name, known.join(", ")))
        }
    }
}
