//! `corotate init`: prints a shipped scenario or campaign, or a list.

use super::output::{CommandResult, Exit, fail, say};
use super::scenario::{title, unknown};
use super::shipped::{campaigns, scenarios};

/// Layout version of the list.
const SCHEMA: &str = "corotate/scenarios/v1";

/// Options of `corotate init`.
#[derive(clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub struct Arguments {
    /// Name of a shipped scenario or campaign
    #[arg(required_unless_present = "list")]
    name: Option<String>,
    /// List the shipped scenarios and campaigns
    #[arg(long, conflicts_with = "name")]
    list: bool,
    /// Print the list as one JSON object (corotate/scenarios/v1)
    #[arg(long, requires = "list")]
    json: bool,
}

const EXAMPLES: &str = "\
Examples:
  corotate init --list                     list all names
  corotate init rigid-pair > pair.toml     a scenario with every key explained";

/// Prints a scenario, or the list.
pub fn init(arguments: &Arguments) -> CommandResult {
    let Some(name) = &arguments.name else {
        return say(&list(arguments.json));
    };
    match scenarios().iter().chain(campaigns()).find(|(known, _)| known == name) {
        Some((_, text)) => say(text),
        None => Err(fail(Exit::Usage, unknown(name))),
    }
}

fn list(json: bool) -> String {
    if json {
        let entry = |(name, text): &(&str, &str)| serde_json::json!({ "name": name, "title": title(text) });
        let [scenarios, campaigns] = [scenarios(), campaigns()].map(|all| all.iter().map(entry).collect::<Vec<_>>());
        let list = serde_json::json!({ "schema": SCHEMA, "scenarios": scenarios, "campaigns": campaigns });
        return format!("{list}\n");
    }
    let all = || scenarios().iter().chain(campaigns());
    let width = all().map(|(name, _)| name.len()).max().unwrap_or(0);
    all().map(|(name, text)| format!("{name:<width$}  {}\n", title(text))).collect()
}
