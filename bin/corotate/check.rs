//! `corotate check`: validate scenarios and tell what is proven of them.

use crate::{Exit, fail, say};
use corotate::config::Scenario;
use corotate::rig::CertificateReport;
use std::fmt::Write;
use std::path::{Path, PathBuf};

/// Options of `corotate check`.
#[derive(clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Arguments {
    /// Scenario files
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// Override any key of the scenarios
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
}

const EXAMPLES: &str = "\
Examples:
  corotate check pair.toml                  the scenario with every default, and its certificate
  corotate check config/*.toml > /dev/null  are they all valid? exit code 2 if one is not";

/// Checks scenarios; all of them, even if one fails.
pub fn check(arguments: &Arguments) -> Exit {
    let mut exit = Exit::Ok;
    for path in &arguments.files {
        match Scenario::load(path, &arguments.set) {
            Ok(scenario) => {
                if let Err(gone) = say(&tell(path, &scenario)) {
                    return gone;
                }
            }
            Err(error) => exit = fail(Exit::Usage, &error),
        }
    }
    exit
}

/// The scenario as resolved, and what is proven of it as comments, so that the whole is a scenario file.
fn tell(path: &Path, scenario: &Scenario) -> String {
    let mut text = format!("# {}: valid\n{}\n", path.display(), scenario.to_toml());
    tell_proof(scenario, &mut text).expect("a string takes every text");
    text
}

fn tell_proof(scenario: &Scenario, text: &mut String) -> std::fmt::Result {
    scenario.rig.notes().iter().try_for_each(|note| writeln!(text, "# note: {note}"))?;
    for limit in scenario.rig.limits() {
        writeln!(text, "# limit: {}: {:.4}", limit.name, limit.value)?;
    }
    scenario.rig.certificates().iter().try_for_each(|certificate| tell_certificate(certificate, text))
}

fn tell_certificate(certificate: &CertificateReport, text: &mut String) -> std::fmt::Result {
    writeln!(text, "# certificate of {}", certificate.body)?;
    for bound in &certificate.bounds {
        writeln!(text, "#   {}: {:.4}", bound.name, bound.value)?;
    }
    for condition in &certificate.conditions {
        let verdict = if condition.holds { "holds" } else { "does not hold" };
        let margin = condition.value - condition.required;
        writeln!(
            text,
            "#   {}: {:.4} > {:.4} {verdict}, margin {margin:.4}",
            condition.name, condition.value, condition.required
        )?;
    }
    writeln!(text, "#   the error falls at least as exp(-{} t)", certificate.rate_per_s)?;
    certificate.warnings.iter().try_for_each(|warning| writeln!(text, "#   warning: {warning}"))
}
