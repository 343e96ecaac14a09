//! Finds the campaign that the command line names, as `scenario` finds scenarios.
//!
//! Must not validate: [`crate::campaign`] does.

use super::output::Failure;
use super::scenario::{quoting, text, unknown};
use super::shipped::{campaigns, scenarios};
use crate::campaign::{Campaign, is_campaign};
use crate::config::{ConfigError, Document, is_name, nearest};
use std::borrow::Cow;
use std::path::Path;

/// Loads a campaign, with overrides of its scenario.
pub fn load(given: &Path, overrides: &[String]) -> Result<Campaign, Failure> {
    let (text, origin) = text(given, &|name| {
        let found = campaigns().iter().find(|(known, _)| *known == name);
        found.map(|(_, text)| Cow::Borrowed(*text)).ok_or_else(|| no_campaign(name))
    })?;
    let base = |name: &str| {
        let found = scenarios().iter().find(|(known, _)| *known == name);
        found.map(|(_, text)| Cow::Borrowed(*text)).ok_or_else(|| unknown(name))
    };
    let campaign = Campaign::parse(&text, &origin, overrides, &base);
    campaign.map_err(|error| quoting(error, &origin, &text))
}

/// Returns the scenario of a case.
pub fn case(campaign: &Campaign, number: u64) -> Result<Document, Failure> {
    let cases = campaign.cases();
    let case = campaign.case(number);
    let case = case.ok_or_else(|| {
        Failure::new("no-such-case", format!("--case {number}: `{}` has cases 0 to {}", campaign.name(), cases - 1))
    })?;
    Ok(campaign.document(&case)?)
}

/// Returns true if the name or file is that of a campaign.
pub fn is_campaign_name(given: &Path) -> bool {
    match given.to_str().filter(|text| is_name(text)) {
        Some(name) => campaigns().iter().any(|(known, _)| *known == name),
        None => Document::read(given).is_ok_and(|document| is_campaign(&document)),
    }
}

fn no_campaign(name: &str) -> ConfigError {
    if scenarios().iter().any(|(known, _)| *known == name) {
        let text = format!("`{name}` is a scenario, not a campaign; run it with `corotate run {name}`");
        return ConfigError::Unknown { code: "is-scenario", text };
    }
    let known: Vec<&str> = campaigns().iter().map(|(name, _)| *name).collect();
    let remedy = nearest(name, &known);
    let end = if remedy.ends_with('?') { "" } else { "." };
    let text = format!(
        "there is no campaign `{name}`; {remedy}{end} Give a file by its path, such as ./{name} or {name}.toml"
    );
    ConfigError::Unknown { code: "unknown-campaign", text }
}
