//! `corotate doctor`: is this machine fit for real time, and what to do about it.

use super::hosts::{self, KeyArguments};
use super::output::{Ended, Exit, Failure, fail, say};
use super::scenario::{Change, load};
use super::signals::catch_signals;
use crate::bus::domain::{DomainError, domains, remove_dead_domains, scan_abandoned};
use crate::doctor::{Check, Demand, Diagnosis, Machine, Trial, Verdict, left_in_shared_memory, leftovers, refused};
use crate::hosts::Address;
use crate::launch::{Launch, Progress, run};
use indicatif::{ProgressBar, ProgressStyle};
use std::path::{Path, PathBuf};

/// Options of `corotate doctor`.
#[derive(clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub struct Arguments {
    /// The scenario that the machine is to be fit for; without one, the first that ships with the program
    file: Option<PathBuf>,
    /// How long to run the scenario in real time, s; 0 leaves it out
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
Exit codes: 0 no line is bad, 3 not fit: some line is bad

The scenario runs in a domain of its own: every role at its core, priority and
rate, without faults, criteria and results; external roles are ours.

Examples:
  corotate doctor                  every line with what to do about it, after
                                   ten seconds of ticks
  corotate doctor fast.toml --seconds 60
                                   for that scenario's roles, rate and cores,
                                   measured for a minute
  corotate doctor --link tcp/127.0.0.1:7447
                                   the clock of the host that launches, and how
                                   long messages take to it and back
  corotate doctor --clean --json   remove what dead runs left; for programs";

/// Examines the machine.
pub fn doctor(arguments: &Arguments) -> Ended {
    if let Some(address) = &arguments.link {
        return hosts::probe(address, &arguments.keys, f64::from(arguments.seconds), arguments.json);
    }
    let scenario = load(arguments.file.as_deref(), []).map_err(|error| fail(Exit::Usage, error))?;
    // If it cannot be done, the line on what is left says why.
    let cleared = if arguments.clean { remove_dead_domains().map_err(DomainError::from) } else { Ok(Vec::new()) };
    let demand = Demand::of(&scenario);
    let mut checks = Machine::at(Path::new("/")).examine(&demand);
    // The line on the limit tells it where the limit forbids it.
    if !checks.iter().any(|check| check.name == "rtprio limit" && check.verdict == Verdict::Bad) {
        checks.extend(refused(demand.priority));
    }
    checks.push(leftovers(cleared.and_then(|_| domains())));
    if arguments.clean {
        scan_abandoned(true);
    }
    checks.extend(left_in_shared_memory(scan_abandoned(false)));
    let trial = match (arguments.seconds > 0).then(|| attempt(arguments)).transpose() {
        Ok(trial) => trial,
        Err(Unmeasured::Exit(exit)) => return Err(exit),
        Err(Unmeasured::Failed(check)) => {
            checks.push(check);
            None
        }
    };
    let diagnosis = Diagnosis::new(&scenario.name, checks, trial);
    let text = if arguments.json { diagnosis.to_json() } else { diagnosis.to_string() };
    say(&text).map(|exit| if diagnosis.fit == Some(false) { Exit::NotAccepted } else { exit })
}

/// Why there is no measurement.
enum Unmeasured {
    /// The run failed, and the line says why.
    Failed(Check),
    /// It was not to be: the error is told.
    Exit(Exit),
}

/// Runs the scenario for some seconds, with its progress on a terminal.
fn attempt(arguments: &Arguments) -> Result<Trial, Unmeasured> {
    let duration = format!("duration_s={}", arguments.seconds);
    // Nothing of the run is to go wrong by the script, nor to wait for somebody else.
    let overrides =
        ["clock=realtime", &duration, "accept={}", "fault=[]", "watchdog={}", "launch.external=[]", "host=[]"];
    let scenario = load(arguments.file.as_deref(), overrides.map(Change::Set))
        .map_err(|error| Unmeasured::Failed(Trial::failed(error.to_string())))?;
    let signal = catch_signals().map_err(|error| Unmeasured::Exit(fail(Exit::Failure, error)))?;
    let style = ProgressStyle::with_template("{bar:40} running in real time, {eta} left");
    let bar = ProgressBar::new(scenario.last_tick).with_style(style.expect("the template is a constant that parses"));
    let mut show = |progress: &Progress<'_>| {
        if let Progress::Running { tick, .. } = progress {
            bar.set_position(*tick);
        }
    };
    let outcome = run(&scenario, &mut Launch::new(&signal, &mut show));
    bar.finish_and_clear();
    let outcome = outcome.map_err(|error| Unmeasured::Failed(Trial::failed(Failure::from(error).to_string())))?;
    if outcome.signal != 0 {
        return Err(Unmeasured::Exit(Exit::Signal(outcome.signal)));
    }
    if let Some(incident) = outcome.incidents.first() {
        return Err(Unmeasured::Failed(Trial::failed(incident.to_string())));
    }
    let tick_hz = 1e9 / scenario.period_ns as f64;
    Ok(Trial::new(tick_hz, scenario.last_tick + 1, &outcome.reports, &outcome.grants))
}
