//! `corotate doctor`: checks whether this machine is fit for real time, and prints remedies; or hunts for late wake-ups.

use super::hosts::{self, KeyArguments};
use super::output::{CommandResult, Exit, Failure, fail, harmless, say};
use super::scenario::{Change, load};
use super::signals::{catch_signals, terminated_by_signals};
use crate::bus::domain::{DomainError, domains, remove_dead_domains, scan_abandoned};
use crate::doctor::{Check, Demand, Diagnosis, HuntOptions, Machine, Trial, Verdict};
use crate::doctor::{hunt, kernel_trace, left_in_shared_memory, leftovers, refused};
use crate::hosts::Address;
use crate::late::remove_dead_traces;
use crate::launch::{Launch, Progress, run};
use crate::system::remedy;
use indicatif::{ProgressBar, ProgressStyle};
use std::path::{Path, PathBuf};

/// Options of `corotate doctor`.
#[derive(clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub struct Arguments {
    /// Scenario that the machine must run [default: the program's first]
    file: Option<PathBuf>,
    /// Duration of the test run in real time, s; 0 skips it
    #[arg(long, value_name = "S", default_value_t = 10, value_parser = clap::value_parser!(u32).range(0..=86_400))]
    seconds: u32,
    /// Remove the files of your dead runs
    #[arg(long)]
    clean: bool,
    /// Only measure the link to a run that waits for hosts, for --seconds
    #[arg(long, value_name = "ADDR")]
    link: Option<Address>,
    /// Only measure how late each core wakes, for this duration in seconds, and
    /// name the causes of late wakes
    #[arg(
        long,
        value_name = "SECONDS",
        value_parser = clap::value_parser!(u32).range(1..=86_400),
        conflicts_with_all = ["file", "seconds", "clean", "link"]
    )]
    hunt: Option<u32>,
    /// Wakes per second of --hunt
    #[arg(
        long,
        value_name = "HZ",
        default_value_t = 1000,
        value_parser = clap::value_parser!(u32).range(10..=20_000),
        requires = "hunt"
    )]
    rate: u32,
    #[command(flatten)]
    keys: KeyArguments,
    /// Print the report as one JSON object on stdout
    #[arg(long)]
    json: bool,
}

const EXAMPLES: &str = "\
Exit codes: 0 fit: no line is bad; 3 not fit: a line is bad; --hunt and --link
do not judge

The test run keeps cores, priorities and rate of the scenario, but has no
faults, no criteria and no results; it starts external roles itself.

Examples:
  corotate doctor                  all checks with remedies, and a test run of
                                   ten seconds
  corotate doctor fast.toml --seconds 60
                                   for another scenario, with a test run of a
                                   minute
  corotate doctor --link tcp/127.0.0.1:7447
                                   clock offset and round-trip times to the
                                   launching host
  corotate doctor --hunt 60        wake-up lateness of each core for a minute,
                                   before a bench is booked; best as root
  corotate doctor --clean --json   remove files of dead runs; print JSON";

/// Examines the machine.
pub fn doctor(arguments: &Arguments) -> CommandResult {
    if let Some(address) = &arguments.link {
        return hosts::probe(address, &arguments.keys, f64::from(arguments.seconds), arguments.json);
    }
    if let Some(seconds) = arguments.hunt {
        return measure_wakes(&HuntOptions { seconds, rate_hz: arguments.rate }, arguments.json);
    }
    let scenario = load(arguments.file.as_deref(), []).map_err(|error| fail(Exit::Usage, error))?;
    // A failure appears in the line on leftovers.
    let cleared = if arguments.clean { remove_dead_domains().map_err(DomainError::from) } else { Ok(Vec::new()) };
    let demand = Demand::new(&scenario);
    let mut checks = Machine::at(Path::new("/")).examine(&demand);
    // Not repeated if the line on the limit reports it.
    if !checks.iter().any(|check| check.name == "rtprio limit" && check.verdict == Verdict::Bad) {
        checks.extend(refused(demand.priority));
    }
    checks.push(kernel_trace());
    checks.push(leftovers(cleared.and_then(|_| domains())));
    if arguments.clean {
        scan_abandoned(true);
        remove_dead_traces();
    }
    checks.extend(left_in_shared_memory(scan_abandoned(false)));
    let trial = match (arguments.seconds > 0).then(|| attempt(arguments)).transpose() {
        Ok(trial) => trial,
        Err(TrialError::Exit(exit)) => return Err(exit),
        Err(TrialError::Failed(check)) => {
            checks.push(check);
            None
        }
    };
    let diagnosis = Diagnosis::new(&scenario.name, checks, trial);
    let text = if arguments.json { diagnosis.to_json() } else { diagnosis.to_string() };
    say(&text).map(|exit| if diagnosis.fit == Some(false) { Exit::NotAccepted } else { exit })
}

/// Measures the lateness of wakes, with a progress bar on a terminal. A signal ends it early.
fn measure_wakes(options: &HuntOptions, json: bool) -> CommandResult {
    let ended = terminated_by_signals()?;
    let bar = progress_bar(options.ticks(), "{bar:40} measuring wake-ups, {eta} left; Ctrl-C ends it with a report");
    let report = hunt(options, &ended, &mut |tick| bar.set_position(tick));
    bar.finish_and_clear();
    let report = report.map_err(|error| {
        let text = format!("cannot start a thread: {error}; {}", remedy(&error));
        fail(Exit::Failure, Failure::new("cannot-start", text))
    })?;
    say(&if json { report.to_json() } else { harmless(&report.to_string()) })
}

fn progress_bar(length: u64, template: &str) -> ProgressBar {
    let style = ProgressStyle::with_template(template);
    ProgressBar::new(length).with_style(style.expect("the template is a constant that parses"))
}

/// The reason why there is no measurement.
enum TrialError {
    /// The run failed; the line contains the reason.
    Failed(Check),
    /// The command must end; its reason is printed.
    Exit(Exit),
}

/// Runs the scenario for `--seconds`, with a progress bar on a terminal.
fn attempt(arguments: &Arguments) -> Result<Trial, TrialError> {
    let duration = format!("duration_s={}", arguments.seconds);
    // Without injected faults, and without roles that the run would wait for.
    let overrides =
        ["clock=realtime", &duration, "accept={}", "fault=[]", "watchdog={}", "launch.external=[]", "host=[]"];
    let scenario = load(arguments.file.as_deref(), overrides.map(Change::Set))
        .map_err(|error| TrialError::Failed(Trial::failed(error.to_string())))?;
    let signal = catch_signals().map_err(|error| TrialError::Exit(fail(Exit::Failure, error)))?;
    let bar = progress_bar(scenario.last_tick, "{bar:40} running in real time, {eta} left");
    let mut show = |progress: &Progress<'_>| {
        if let Progress::Running { tick, .. } = progress {
            bar.set_position(*tick);
        }
    };
    let outcome = run(&scenario, &mut Launch::new(&signal, &mut show));
    bar.finish_and_clear();
    let outcome = outcome.map_err(|error| TrialError::Failed(Trial::failed(Failure::from(error).to_string())))?;
    if outcome.signal != 0 {
        return Err(TrialError::Exit(Exit::Signal(outcome.signal)));
    }
    if let Some(incident) = outcome.incidents.first() {
        return Err(TrialError::Failed(Trial::failed(incident.to_string())));
    }
    let tick_hz = 1e9 / scenario.period_ns as f64;
    Ok(Trial::new(tick_hz, scenario.last_tick + 1, &outcome.reports, &outcome.grants))
}
