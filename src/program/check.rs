//! `corotate check`: validate scenarios and tell what may be claimed of their loops.

use super::campaign;
use super::output::{Ended, Exit, Failure, fail, say};
use super::scenario::{Change, load};
use crate::analysis::{Claim, Reach, apart, digits};
use crate::campaign::Campaign;
use crate::launch::check_cores;
use crate::scenario::Scenario;
use crate::scenario::claims;
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// Options of `corotate check`.
#[derive(clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub struct Arguments {
    /// Names of shipped scenarios or campaigns, files (x.toml, ./x), or - for stdin
    #[arg(required = true, value_name = "SCENARIO")]
    files: Vec<PathBuf>,
    /// Override any key of the scenarios
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Print each scenario with every default, its claims as comments: a scenario file again
    #[arg(long, conflicts_with = "json")]
    resolved: bool,
    /// Print what is claimed of each scenario as one line of JSON (corotate/check/v1)
    #[arg(long)]
    json: bool,
}

const EXAMPLES: &str = "\
Examples:
  corotate check pair.toml         what may be claimed of its loop
  corotate check --resolved pair.toml > full.toml
                                   the scenario with every default
  corotate check --json pair.toml  those claims for programs
  corotate check config/*.toml > /dev/null
                                   are they all valid? exit code 2 if not";

/// Checks scenarios; all of them, even if one fails.
pub fn check(arguments: &Arguments) -> Ended {
    let mut exit = Exit::Ok;
    for path in &arguments.files {
        match checked(arguments, path) {
            Ok(text) => drop(say(&text)?),
            Err(error) => exit = fail(Exit::Usage, error),
        }
    }
    Ok(exit)
}

/// What there is to say of a scenario, or of a campaign.
fn checked(arguments: &Arguments, path: &Path) -> Result<String, Failure> {
    if campaign::is_meant(path) {
        let campaign = campaign::load(path, &arguments.set)?;
        if arguments.json {
            return Ok(campaign_json(path, &campaign));
        }
        let told = tell_campaign(path, &campaign);
        return Ok(if arguments.resolved { resolved(&told, campaign.to_toml()) } else { told });
    }
    let scenario = load(Some(path), arguments.set.iter().map(|argument| Change::Set(argument)))?;
    check_cores(&scenario).map_err(|error| Failure::prefixed(path.display(), error))?;
    if arguments.json {
        return Ok(json(path, &scenario));
    }
    let mut told = format!("{}: valid\n", path.display());
    tell_claims(&scenario, &mut told).expect("a string takes every text");
    Ok(if arguments.resolved { resolved(&told, &scenario.to_toml()) } else { told })
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

/// Returns the text as comments, then the resolved file: together a file of the same kind.
fn resolved(told: &str, file: &str) -> String {
    let comments: String = told.lines().map(|line| format!("# {line}\n")).collect();
    format!("{comments}{file}\n")
}

fn tell_campaign(path: &Path, campaign: &Campaign) -> String {
    let cases = campaign.cases();
    let words = if cases == 1 { "1 case".to_owned() } else { format!("{cases} cases") };
    format!("{}: valid, {words}, identity {}\n", path.display(), campaign.identity())
}

/// What is claimed of a scenario, for programs.
fn json(path: &Path, scenario: &Scenario) -> String {
    let value = serde_json::json!({
        "schema": "corotate/check/v1",
        "file": path.display().to_string(),
        "scenario": scenario.name,
        "clock": scenario.clock.name(),
        "tick_hz": 1.0 / scenario.tick_s(),
        "notes": scenario.notes(),
        "warnings": scenario.warnings,
        "limits": scenario.rig.limits(),
        "followers": claims(scenario),
    });
    format!("{value}\n")
}

/// Writes the loop's convergence first, then what weakens it, then the theorem behind it and the limits of the guards.
fn tell_claims(scenario: &Scenario, text: &mut String) -> std::fmt::Result {
    let claims = claims(scenario);
    if claims.is_empty() {
        writeln!(text, "no body is driven, so no convergence rate is claimed")?;
    }
    let late = match scenario.actuation_delay_ticks {
        1 => "one tick".to_owned(),
        ticks => format!("{ticks} ticks"),
    };
    claims.iter().try_for_each(|claim| tell_loop(claim, &late, text))?;
    scenario.warnings.iter().try_for_each(|warning| writeln!(text, "warning: {warning}"))?;
    scenario.notes().iter().try_for_each(|note| writeln!(text, "note: {note}"))?;
    claims.iter().try_for_each(|claim| tell_theorem(claim, text))?;
    let limits = scenario.rig.limits();
    if !limits.is_empty() {
        writeln!(text, "limits of the guards")?;
    }
    limits.iter().try_for_each(|limit| writeln!(text, "  {}: {}", limit.name, digits(limit.value)))
}

/// Writes the convergence of the loop that runs.
fn tell_loop(claim: &Claim, late: &str, text: &mut String) -> std::fmt::Result {
    match (claim.loop_rate_text(), claim.over_s, &claim.reason) {
        (Some(rate), Some(over_s), _) => {
            writeln!(text, "{}: a small error falls as exp(-{rate} t)", claim.body)?;
            writeln!(text, "  in the sampled loop, {late} late; computed over the first {} s", digits(over_s))?;
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
    // The reason why no rate is claimed is a warning too, and is written above.
    let mut others = claim.warnings.iter().filter(|warning| claim.reason.as_ref() != Some(*warning));
    others.try_for_each(|warning| writeln!(text, "  warning: {warning}"))
}

/// Writes what is proven of the law in continuous time.
fn tell_theorem(claim: &Claim, text: &mut String) -> std::fmt::Result {
    writeln!(text, "{}, the law in continuous time", claim.body)?;
    match claim.continuous_rate_per_s {
        Some(rate) => writeln!(text, "  the error falls at least as exp(-{} t)", digits(rate))?,
        None if claim.conditions.is_empty() => writeln!(text, "  the rig has no theorem for it")?,
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
