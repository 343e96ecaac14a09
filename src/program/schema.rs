//! `corotate schema`: prints the JSON Schema of scenarios.

use super::output::{CommandResult, say};
use super::shipped::{name, scenarios};

/// Options of `corotate schema`.
#[derive(clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub struct Arguments {}

const EXAMPLES: &str = "\
Editors complete and explain keys with it, and mark misspelt ones. Only
`corotate check` validates combinations of keys, and the quantities in [accept]
and [watchdog].

Example, for editors with Taplo (Even Better TOML, Helix, Neovim):
  corotate schema > scenario.schema.json
  echo '#:schema ./scenario.schema.json' | cat - pair.toml > with-schema.toml";

/// Prints the schema.
pub fn schema(_: &Arguments) -> CommandResult {
    let schema = crate::scenario::schema(name(), scenarios());
    let text = serde_json::to_string_pretty(&schema).expect("plain values are JSON");
    say(&(text + "\n"))
}
