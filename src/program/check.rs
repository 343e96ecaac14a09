//! `corotate check`: validates scenarios and prints the claims about their loops.

use super::campaign;
use super::output::{CommandResult, Exit, Failure, fail, say};
use super::scenario::{Change, load};
use super::set::tunable;
use crate::analysis::{Claim, Reach, apart, digits};
use crate::campaign::Campaign;
use crate::launch::check_cores;
use crate::runtime::{RoleId, ignored_changes};
use crate::scenario::Scenario;
use crate::scenario::claims;
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// Options of `corotate check`.
#[derive(clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub struct Arguments {
    /// Shipped scenarios or campaigns, files (x.toml, ./x), or - for stdin
    #[arg(required = true, value_name = "SCENARIO")]
    files: Vec<PathBuf>,
    /// Override a key of the scenarios
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Print each scenario with all defaults, and the claims as comments
    #[arg(long, conflicts_with = "json")]
    resolved: bool,
    /// Print the claims about each scenario as a line of JSON (corotate/check/v1)
    #[arg(long)]
    json: bool,
    /// Print the keys that may change while the loop runs
    #[arg(long, conflicts_with_all = ["resolved", "json"])]
    tunable: bool,
}

const EXAMPLES: &str = "\
Examples:
  corotate check pair.toml         the claims about its loop
  corotate check --resolved pair.toml > full.toml
                                   a scenario file with all defaults
  corotate check --json pair.toml  the claims as JSON
  corotate check config/*.toml > /dev/null
                                   exit code 2 unless all are valid";

/// Checks all scenarios, even if one is invalid.
pub fn check(arguments: &Arguments) -> CommandResult {
    let mut exit = Exit::Ok;
    for path in &arguments.files {
        match check_file(arguments, path) {
            Ok(text) => drop(say(&text)?),
            Err(error) => exit = fail(Exit::Usage, error),
        }
    }
    Ok(exit)
}

/// Validates a scenario or campaign and returns the text to print.
fn check_file(arguments: &Arguments, path: &Path) -> Result<String, Failure> {
    if campaign::is_campaign_name(path) {
        let campaign = campaign::load(path, &arguments.set)?;
        if arguments.json {
            return Ok(campaign_json(path, &campaign));
        }
        let text = campaign_text(path, &campaign);
        return Ok(if arguments.resolved { resolved(&text, campaign.to_toml()) } else { text });
    }
    let scenario = load(Some(path), arguments.set.iter().map(|argument| Change::Set(argument)))?;
    check_cores(&scenario).map_err(|error| Failure::prefixed(path.display(), error))?;
    if arguments.json {
        return Ok(json(path, &scenario));
    }
    if arguments.tunable {
        return Ok(tunable(&scenario));
    }
    let mut text = format!("{}: valid\n", path.display());
    write_claims(&scenario, &mut text).expect("writing to a string does not fail");
    Ok(if arguments.resolved { resolved(&text, &scenario.to_toml()) } else { text })
}

fn campaign_json(path: &Path, campaign: &Campaign) -> String {
    let value = serde_json::json!({
        "schema": "corotate/check/v1",
        "file": path.display().to_string(),
        "campaign": campaign.name(),
        "identity": campaign.identity(),
        "cases": campaign.cases(),
        "axes": campaign.table().axes,
    });
    format!("{value}\n")
}

/// Returns the resolved file with the text as comments before it.
fn resolved(text: &str, file: &str) -> String {
    let comments: String = text.lines().map(|line| format!("# {line}\n")).collect();
    format!("{comments}{file}\n")
}

fn campaign_text(path: &Path, campaign: &Campaign) -> String {
    let cases = campaign.cases();
    let words = if cases == 1 { "1 case".to_owned() } else { format!("{cases} cases") };
    format!("{}: valid, {words}, identity {}\n", path.display(), campaign.identity())
}

/// Returns the claims about a scenario as JSON.
fn json(path: &Path, scenario: &Scenario) -> String {
    let value = serde_json::json!({
        "schema": "corotate/check/v1",
        "file": path.display().to_string(),
        "scenario": scenario.name,
        "clock": scenario.clock.name(),
        "tick_hz": 1.0 / scenario.tick_s(),
        "notes": scenario.notes(),
        "warnings": warnings(scenario),
        "limits": scenario.rig.limits(),
        "inputs": scenario.inputs.infos.iter().map(|info| serde_json::json!({
            "key": info.key,
            "description": info.description,
            "variability": info.variability,
            "value": info.to_toml(&info.initial),
            "range": [info.range.0, info.range.1],
        })).collect::<Vec<_>>(),
        "followers": claims(scenario),
    });
    format!("{value}\n")
}

/// Returns the warnings about a scenario, and of its changes of inputs that an external role may ignore.
fn warnings(scenario: &Scenario) -> Vec<String> {
    let is_external = |role: RoleId| scenario.external.iter().any(|name| name == role.name(scenario));
    scenario.warnings.iter().cloned().chain(ignored_changes(scenario, &is_external)).collect()
}

/// Writes the convergence of the sampled loops, warnings and notes, then the theorems and the limits of the guards.
fn write_claims(scenario: &Scenario, text: &mut String) -> std::fmt::Result {
    let claims = claims(scenario);
    if claims.is_empty() {
        writeln!(text, "no body is driven: no convergence rate is claimed")?;
    }
    let late = match scenario.actuation_delay_ticks {
        1 => "one tick".to_owned(),
        ticks => format!("{ticks} ticks"),
    };
    claims.iter().try_for_each(|claim| write_loop(claim, &late, text))?;
    warnings(scenario).iter().try_for_each(|warning| writeln!(text, "warning: {warning}"))?;
    scenario.notes().iter().try_for_each(|note| writeln!(text, "note: {note}"))?;
    claims.iter().try_for_each(|claim| write_theorem(claim, text))?;
    let limits = scenario.rig.limits();
    if !limits.is_empty() {
        writeln!(text, "limits of the guards")?;
    }
    limits.iter().try_for_each(|limit| writeln!(text, "  {}: {}", limit.name, digits(limit.value)))
}

/// Writes the convergence of the sampled loop.
fn write_loop(claim: &Claim, late: &str, text: &mut String) -> std::fmt::Result {
    match (claim.loop_rate_text(), claim.over_s, &claim.reason) {
        (Some(rate), Some(over_s), _) => {
            writeln!(text, "{}: a small error falls as exp(-{rate} t)", claim.body)?;
            writeln!(text, "  sampled loop, commands {late} late; computed over the first {} s", digits(over_s))?;
        }
        (_, _, reason) => {
            writeln!(text, "{}: no rate is claimed: {}", claim.body, reason.as_deref().unwrap_or_default())?;
        }
    }
    for floor in &claim.floors {
        let reach = claim.reaches.iter().find(|reach| reach.metric == floor.name);
        let fall = reach.map_or(String::new(), |Reach { from, limit, after_s, .. }| {
            let time = after_s.map_or("never".to_owned(), |after_s| format!("in {} s", digits(after_s)));
            format!("from {} to {} {time}; ", digits(*from), digits(*limit))
        });
        writeln!(text, "  {}: {fall}floor {}", floor.name, digits(floor.value))?;
    }
    // The reason for claiming no rate is also a warning; it is written above.
    let mut rest = claim.warnings.iter().filter(|warning| claim.reason.as_ref() != Some(*warning));
    rest.try_for_each(|warning| writeln!(text, "  warning: {warning}"))
}

/// Writes the theorem about the law in continuous time.
fn write_theorem(claim: &Claim, text: &mut String) -> std::fmt::Result {
    writeln!(text, "{}, the law in continuous time", claim.body)?;
    match claim.continuous_rate_per_s {
        Some(rate) => writeln!(text, "  the error falls at least as exp(-{} t)", digits(rate))?,
        None if claim.conditions.is_empty() => writeln!(text, "  no theorem: the rig has none for this law")?,
        None => writeln!(text, "  no constant rate: the observer's gain varies")?,
    }
    for condition in &claim.conditions {
        let verdict = if condition.holds { "holds" } else { "does not hold" };
        let [value, required] = apart(condition.value, condition.required);
        let margin = digits(condition.value - condition.required);
        writeln!(text, "  {}: {value} > {required} {verdict}, margin {margin}", condition.name)?;
    }
    claim.bounds.iter().try_for_each(|bound| writeln!(text, "  {}: {}", bound.name, digits(bound.value)))
}
