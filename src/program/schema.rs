//! `corotate schema`: what a scenario may say, for editors.

use super::output::{Ended, say};
use super::shipped::{name, scenarios};

/// Options of `corotate schema`.
#[derive(clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub struct Arguments {}

const EXAMPLES: &str = "\
With it an editor completes keys, explains them and marks what is misspelt. What
two keys say together, and which quantities [accept] and [watchdog] can name,
only `corotate check` judges.

Example, for editors with Taplo (Even Better TOML, Helix, Neovim):
  corotate schema > scenario.schema.json
  echo '#:schema ./scenario.schema.json' | cat - pair.toml > with-schema.toml";

/// Prints the schema.
pub fn schema(_: &Arguments) -> Ended {
    let schema = crate::scenario::schema(name(), scenarios());
    let text = serde_json::to_string_pretty(&schema).expect("plain values are JSON");
    say(&(text + "\n"))
}
