//! `corotate doctor`: is this machine fit for real time, and what to do about it.

use super::hosts::{self, KeyArguments};
use super::scenario::load;
use super::{Exit, fail, say};
use crate::bus::domain::{DomainError, domains, remove_dead_domains};
use crate::config::Scenario;
use crate::doctor::{Demand, Diagnosis, Lateness, Machine, leftovers, measure};
use crate::hosts::Address;
use crate::system::remedy;
use indicatif::{ProgressBar, ProgressStyle};
use std::path::{Path, PathBuf};

/// Options of `corotate doctor`.
#[derive(clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub struct Arguments {
    /// The scenario that the machine is to be fit for; without one, the first that ships with the program
    file: Option<PathBuf>,
    /// How long to measure the lateness of bare sleeps, s; 0 leaves it out
    #[arg(long, value_name = "S", default_value_t = 10, value_parser = clap::value_parser!(u32).range(0..=86_400))]
    seconds: u32,
    /// Remove what dead runs of this user left behind
    #[arg(long)]
    clean: bool,
    /// Examine the way to where a run waits for hosts to join, for so many seconds, and nothing else
    #[arg(long, value_name = "ADDR")]
    link: Option<Address>,
    #[command(flatten)]
    keys: KeyArguments,
    /// Print the report as one JSON object on stdout
    #[arg(long)]
    json: bool,
}

const EXAMPLES: &str = "\
Exit codes: 0 fit, 3 not fit: some line is bad

Examples:
  corotate doctor                  every line with what to do about it, after
                                   ten seconds of sleeping
  corotate doctor fast.toml --seconds 60
                                   for that scenario's tick, cores and memory,
                                   measured for a minute
  corotate doctor --link tcp/127.0.0.1:7447
                                   the clock of the host that launches, and how
                                   long messages take to it and back
  corotate doctor --clean --json   remove what dead runs left; for programs";

/// Examines the machine.
pub fn doctor(arguments: &Arguments) -> Exit {
    if let Some(address) = &arguments.link {
        return hosts::probe(address, &arguments.keys, f64::from(arguments.seconds), arguments.json);
    }
    let scenario = match load(arguments.file.as_deref(), []) {
        Ok(scenario) => scenario,
        Err(error) => return fail(Exit::Usage, &error),
    };
    // If it cannot be done, the line on what is left says why.
    let cleared = if arguments.clean { remove_dead_domains().map_err(DomainError::from) } else { Ok(Vec::new()) };
    let mut checks = Machine::at(Path::new("/")).examine(&Demand::of(&scenario));
    checks.push(leftovers(cleared.and_then(|_| domains())));
    let lateness = match (arguments.seconds > 0).then(|| sleep(&scenario, arguments.seconds)).transpose() {
        Ok(lateness) => lateness,
        Err(exit) => return exit,
    };
    let diagnosis = Diagnosis::new(&scenario.name, checks, lateness);
    let text = if arguments.json { diagnosis.to_json() } else { diagnosis.to_string() };
    match say(&text) {
        Err(gone) => gone,
        Ok(()) if diagnosis.fit => Exit::Ok,
        Ok(()) => Exit::NotAccepted,
    }
}

/// Measures, with its progress on a terminal.
fn sleep(scenario: &Scenario, seconds: u32) -> Result<Lateness, Exit> {
    let style = ProgressStyle::with_template("{bar:40} measuring lateness, {eta} left");
    let bar = ProgressBar::new(1000).with_style(style.expect("the template is a constant that parses"));
    let lateness = measure(scenario, f64::from(seconds), &mut |done| bar.set_position((1e3 * done) as u64));
    bar.finish_and_clear();
    lateness.map_err(|error| fail(Exit::Failure, &format!("cannot start a thread: {error}; {}", remedy(&error))))
}
