//! `corotate init`: print a shipped scenario or campaign, or the list of them.

use super::output::{Ended, Exit, fail, say};
use super::scenario::{title, unknown};
use super::shipped::{campaigns, scenarios};

/// Layout version of the list.
const SCHEMA: &str = "corotate/scenarios/v1";

/// Options of `corotate init`.
#[derive(clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub struct Arguments {
    /// Name of a scenario or campaign that ships with the program
    #[arg(required_unless_present = "list")]
    name: Option<String>,
    /// List the scenarios and campaigns that ship with the program, a line each
    #[arg(long, conflicts_with = "name")]
    list: bool,
    /// Print the list as one JSON object (corotate/scenarios/v1)
    #[arg(long, requires = "list")]
    json: bool,
}

const EXAMPLES: &str = "\
Examples:
  corotate init --list                     what there is
  corotate init rigid-pair > pair.toml     a scenario with every key explained";

/// Prints a scenario, or the list.
pub fn init(arguments: &Arguments) -> Ended {
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
