//! `corotate check`: validate scenarios and tell what is proven of them.

use crate::{Exit, fail};
use corotate::config::Scenario;
use corotate::rig::CertificateReport;
use std::path::PathBuf;

/// Options of `corotate check`.
#[derive(clap::Args)]
pub struct Arguments {
    /// Scenario files
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// Override any key of the scenarios
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
}

/// Checks scenarios; all of them, even if one fails.
pub fn check(arguments: &Arguments) -> Exit {
    let mut exit = Exit::Ok;
    for path in &arguments.files {
        match Scenario::load(path, &arguments.set) {
            Ok(scenario) => {
                println!("# {}: valid\n{}", path.display(), scenario.to_toml());
                scenario.rig.notes().iter().for_each(|note| println!("# note: {note}"));
                scenario.rig.certificates().iter().for_each(print);
            }
            Err(error) => exit = fail(Exit::Usage, &error),
        }
    }
    exit
}

/// As TOML comments, so that the whole output is a scenario file.
fn print(certificate: &CertificateReport) {
    println!("# certificate of {}", certificate.body);
    for bound in &certificate.bounds {
        println!("#   {}: {:.4}", bound.name, bound.value);
    }
    for condition in &certificate.conditions {
        let verdict = if condition.holds { "holds" } else { "does not hold" };
        let margin = condition.value - condition.required;
        println!(
            "#   {}: {:.4} > {:.4} {verdict}, margin {margin:.4}",
            condition.name, condition.value, condition.required
        );
    }
    println!("#   the error falls at least as exp(-{} t)", certificate.rate_per_s);
    for warning in &certificate.warnings {
        println!("#   warning: {warning}");
    }
}
