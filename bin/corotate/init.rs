//! `corotate init`: print a shipped scenario.

use crate::{Exit, fail, say};
use corotate::config::SHIPPED;

/// Options of `corotate init`.
#[derive(clap::Args)]
pub struct Arguments {
    /// Name of a shipped scenario, for example gyro-loss; a name that is none lists them all
    name: String,
}

/// Prints a scenario.
pub fn init(arguments: &Arguments) -> Exit {
    match SHIPPED.iter().find(|(name, _)| *name == arguments.name) {
        Some((_, text)) => say(text).map_or_else(|exit| exit, |()| Exit::Ok),
        None => {
            let known = SHIPPED.map(|(name, _)| name).join(", ");
            fail(Exit::Usage, &format!("there is no scenario `{}`; there are: {known}", arguments.name))
        }
    }
}
