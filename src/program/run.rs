//! `corotate run`: runs a scenario and prints its verdict.

mod screen;
mod verdict;

use super::campaign;
use super::color::paint;
use super::foxglove;
use super::hosts::{self, KeyArguments};
use super::output::{Exit, Failure, event, exit_of, fail, print, remark};
use super::perfetto;
use super::scenario::{Change, changed, load, stem};
use super::signals::{catch_signals, die_with};
use crate::config::{ClockKind, RunId};
use crate::doctor::{self, Demand, Machine};
use crate::files;
use crate::hosts::{Address, HostEndpoint};
use crate::late::LateReport;
use crate::launch::{
    Launch, Outcome, ResultsError, Summary, check_cores, claim, junit, make_directory, make_latest, new_run, table,
    write_run,
};
use crate::runtime::{priority_remedy, refused_priority};
use crate::scenario::Scenario;
use crate::system::tell;
use screen::{Screen, Verbosity};
use std::io;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::SystemTime;
use verdict::Verdict;

/// Options of `corotate run`.
#[derive(clap::Args, Default)]
#[command(after_long_help = EXAMPLES)]
pub struct Arguments {
    /// A shipped scenario's name, a file (x.toml, ./x), or - for stdin
    #[arg(value_name = "SCENARIO")]
    file: Option<PathBuf>,
    /// Run this case of a campaign; SCENARIO is the campaign
    #[arg(long, value_name = "N", requires = "file")]
    case: Option<u64>,
    /// Clock of the ticks
    #[arg(long, value_name = "CLOCK", value_parser = ["realtime", "lockstep", "in-process"])]
    clock: Option<String>,
    /// Length of the run, s
    #[arg(long, value_name = "S")]
    duration: Option<String>,
    /// Ticks per second, Hz
    #[arg(long, value_name = "HZ")]
    tick_hz: Option<String>,
    /// Override a key, such as leader.measured_axes=[1,3]
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Directory of the results [default: runs/<utc>-<name>]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Remove the files of an earlier run from --out
    #[arg(long, requires = "out", hide_short_help = true)]
    overwrite: bool,
    /// Fail unless all requested real-time privileges are granted
    #[arg(long, hide_short_help = true)]
    require_rt: bool,
    /// Do not start this role; wait for one started by hand
    #[arg(long, value_name = "ROLE")]
    external: Vec<String>,
    /// Print this role's process and wait for a debugger before the first tick; several: a,b
    #[arg(long, value_name = "ROLE", value_parser = role_list, hide_short_help = true)]
    debug: Option<String>,
    /// Write the verdict as JUnit XML, one test case per criterion
    #[arg(long, value_name = "FILE", hide_short_help = true)]
    junit: Option<PathBuf>,
    /// Write late ticks and samples as a trace for ui.perfetto.dev, in real time
    #[arg(long, value_name = "FILE", hide_short_help = true)]
    trace_out: Option<PathBuf>,
    /// Record every sample to run.mcap beside the results
    #[arg(long)]
    record: bool,
    /// Serve all signals to Foxglove (WebSocket) at IP:PORT; without ADDR at 127.0.0.1:8765
    #[arg(long, hide_short_help = true, value_name = "ADDR", num_args = 0..=1, default_missing_value = foxglove::ADDRESS, value_parser = foxglove::address)]
    foxglove: Option<SocketAddr>,
    /// Be this host of the scenario, and wait for the further to join
    #[arg(long, value_name = "NAME", requires = "listen", hide_short_help = true)]
    host: Option<String>,
    /// Address for the further: quic/HOST:PORT, or tcp/ or udp/ on loopback
    #[arg(long, value_name = "ADDR", requires = "host", hide_short_help = true)]
    listen: Option<Address>,
    #[command(flatten)]
    keys: KeyArguments,
    /// Print the summary as JSON, everything else to stderr
    #[arg(long)]
    json: bool,
    /// Print events as lines of JSON (corotate/event/v1); with -q errors and the verdict only there
    #[arg(long, conflicts_with = "json")]
    events: bool,
    /// Die with this process
    #[arg(long, value_name = "PID", hide = true)]
    parent: Option<i32>,
    /// Print only errors and the last line
    #[arg(short, long, conflicts_with = "verbose")]
    quiet: bool,
    /// Print the full table, and phases to stderr
    #[arg(short, long)]
    verbose: bool,
}

const EXAMPLES: &str = "\
A name selects a shipped scenario; `corotate init --list` prints all. Write a
file in this directory as ./NAME or NAME.toml. runs/latest links to the newest
run.

The last line is the verdict. PASS: all judged criteria of [accept] hold. FAIL:
a criterion does not hold, or the run failed. NOT JUDGED: the run has no
criteria or no score, was stopped, or is shorter than settled_by_s. The line
counts missed, starved and safe ticks. It is on stdout; with --json on stderr.
If the run could not begin, an error takes its place.

Examples:
  corotate run rigid-trio          a shipped scenario
  corotate run pair.toml           a file; results in runs/<utc>-<name>/
  corotate init rigid-pair | corotate run - --clock lockstep
                                   as fast as possible, with the same results
  corotate run pair.toml --record --set follower.0.initial_rate_rad_s=[1,0,0]
                                   record every sample, change the start
  corotate run pair.toml --external follower
                                   wait for hardware as the follower
  corotate run pair.toml --junit verdict.xml --require-rt
                                   as a test, with real time required
  corotate run pair.toml --trace-out trace.json
                                   late ticks and cores on one time axis";

impl Arguments {
    fn changes(&self) -> impl Iterator<Item = Change<'_>> {
        let named = [
            ("--clock", "clock", &self.clock),
            ("--duration", "duration_s", &self.duration),
            ("--tick-hz", "tick_hz", &self.tick_hz),
            ("--debug", "launch.debug", &self.debug),
        ];
        let named = named
            .into_iter()
            .filter_map(|(option, key, value)| value.as_deref().map(|value| Change::Option(option, key, value)));
        let record = self.record.then_some(Change::Option("--record", "record", "true"));
        self.set.iter().map(|argument| Change::Set(argument)).chain(named).chain(record)
    }

    fn scenario(&self) -> Result<Scenario, RunFailure> {
        let loaded = match (self.case, &self.file) {
            (Some(case), Some(file)) => campaign::load(file, &[]).and_then(|campaign| {
                let document = campaign::case(&campaign, case)?;
                Ok(changed(document, self.changes())?)
            }),
            _ => load(self.file.as_deref(), self.changes()),
        };
        let unusable = |failure| RunFailure { exit: Exit::Usage, failure };
        let scenario = loaded.map_err(unusable)?;
        self.check_external(&scenario)
            .and_then(|()| self.check_foxglove(&scenario))
            .and_then(|()| self.check_host(&scenario))
            .and_then(|()| self.check_trace(&scenario))
            .and_then(|()| Ok(check_cores(&scenario)?))
            .map_err(unusable)?;
        Ok(scenario)
    }

    fn check_foxglove(&self, scenario: &Scenario) -> Result<(), Failure> {
        let in_thread = "not possible with the clock in-process; use --clock lockstep";
        let in_thread = (scenario.clock == ClockKind::InProcess).then_some(("one-process", in_thread));
        let refused = foxglove::refusal().map(|reason| ("built-without", reason)).or(in_thread);
        let refused = refused.filter(|_| self.foxglove.is_some());
        refused.map_or(Ok(()), |(code, reason)| Err(Failure::new(code, format!("--foxglove: {reason}"))))
    }

    /// Returns this host's part in a run over several hosts.
    fn seat(&self) -> Result<Option<HostEndpoint>, Failure> {
        let (Some(host), Some(address)) = (&self.host, &self.listen) else {
            return if self.keys.any() {
                Err(Failure::new("unused-keys", "--tls-… and --insecure need --listen; add it, or leave them out"))
            } else {
                Ok(None)
            };
        };
        let endpoint = self.keys.endpoint(address.clone())?;
        Ok(Some(HostEndpoint { host: host.clone(), endpoint }))
    }

    fn check_host(&self, scenario: &Scenario) -> Result<(), Failure> {
        let Some(HostEndpoint { host, .. }) = self.seat()? else { return Ok(()) };
        let refuse = |code, reason: String| Err(Failure::new(code, format!("--host {host}: {reason}")));
        hosts::refusal().map_or(Ok(()), |reason| refuse("built-without", reason.to_owned()))?;
        let names: Vec<&str> = scenario.hosts.hosts.iter().map(|host| &*host.name).collect();
        if scenario.clock == ClockKind::InProcess {
            return refuse(
                "one-process",
                "not possible with the clock in-process; use --clock realtime or lockstep".to_owned(),
            );
        }
        if !self.external.is_empty() {
            let reason = "external roles are not possible in a run over several hosts; leave out --external or --host";
            return refuse("external-with-hosts", reason.to_owned());
        }
        if let Some(role) = scenario.debug.iter().find(|role| scenario.hosts.host_of(role) != Some(&host)) {
            let reason = format!("launch.debug names {role}, which runs on another host; name roles of this host");
            return refuse("debugged-elsewhere", reason);
        }
        match names.contains(&host.as_str()) {
            true => Ok(()),
            false if names.is_empty() => {
                refuse("no-hosts", "the scenario has no hosts; add [[host]] tables with their roles".to_owned())
            }
            false => refuse("no-such-host", format!("the scenario has no such host; choose from {}", names.join(", "))),
        }
    }

    fn check_trace(&self, scenario: &Scenario) -> Result<(), Failure> {
        if self.trace_out.is_none() || scenario.keeps_late_ticks() {
            return Ok(());
        }
        let reason = match scenario.clock {
            ClockKind::Realtime => "realtime.trace is \"off\"; set it to \"auto\"".to_owned(),
            clock => format!("no tick is late with the clock {}; use --clock realtime", clock.name()),
        };
        Err(Failure::new("no-late-ticks", format!("--trace-out: {reason}")))
    }

    fn check_external(&self, scenario: &Scenario) -> Result<(), Failure> {
        let check = |role: &String| {
            let checked = scenario.check_external(role);
            checked.map_err(|error| Failure::prefixed(format_args!("--external {role}"), error))
        };
        self.external.iter().try_for_each(check)
    }
}

/// Returns names separated by commas as a list in TOML.
fn role_list(names: &str) -> Result<String, std::convert::Infallible> {
    let names: Vec<String> = names.split(',').map(|name| format!("{:?}", name.trim())).collect();
    Ok(format!("[{}]", names.join(", ")))
}

/// The reason why a run has no verdict.
struct RunFailure {
    exit: Exit,
    failure: Failure,
}

impl RunFailure {
    fn new(exit: Exit, error: impl Into<Failure>) -> Self {
        Self { exit, failure: error.into() }
    }

    /// Prints the reason: as an event too, if events are printed; with `--quiet` then only as an event. `invalid` if the scenario is.
    fn report(self, arguments: &Arguments, invalid: bool) -> Exit {
        let Self { exit, failure } = self;
        let error = |(text, code): &(String, &str)| serde_json::json!({ "text": text, "code": code });
        let errors: Vec<_> = failure.0.iter().map(error).collect();
        let fields = serde_json::json!({ "errors": errors, "invalid": invalid, "exit": exit.code() });
        match arguments.events.then(|| event("error", fields)) {
            Some(Ok(())) if arguments.quiet => exit,
            _ => fail(exit, failure),
        }
    }
}

/// Executes `corotate run`.
pub fn run(arguments: &Arguments) -> Exit {
    if let Some(Err(exit)) = arguments.parent.map(die_with) {
        return exit;
    }
    let run = match new_run() {
        Ok(run) => run,
        Err(error) => {
            let remedy = "if a sandbox forbids getrandom, allow it";
            let reason = format!("cannot create the run's identifier: no random numbers: {error}; {remedy}");
            return fail(Exit::Failure, Failure::new("no-random-numbers", reason));
        }
    };
    let loaded = arguments.scenario().map(|mut scenario| {
        scenario.run = Some(run);
        scenario
    });
    let name = loaded.as_ref().map_or_else(|_| stem(arguments.file.as_deref()), |scenario| scenario.name.clone());
    let write_verdict =
        |result| arguments.junit.as_deref().map_or(Ok(()), |path| write_junit(path, &name, run, result));
    // Replaces an older verdict, in case this process is killed.
    if let Err(exit) = write_verdict(Err("the run did not finish")) {
        return exit;
    }
    let invalid = loaded.is_err();
    let result = loaded.and_then(|scenario| attempt(arguments, &scenario));
    let summary = result.as_ref().map(|(summary, _)| summary);
    let reason = result.as_ref().err().map(|failed| failed.failure.to_string()).unwrap_or_default();
    let written = write_verdict(summary.map_err(|_| reason.as_str()));
    let exit = match result {
        Ok((summary, _)) => {
            let verdict = Verdict::new(&summary);
            print_verdict(&verdict, arguments).map_or_else(|error| fail(Exit::Failure, error), |()| verdict.exit)
        }
        Err(failed) => failed.report(arguments, invalid),
    };
    match (written, exit) {
        (Err(failure), Exit::Ok) => failure,
        _ => exit,
    }
}

fn write_junit(path: &Path, name: &str, run: RunId, result: Result<&Summary, &str>) -> Result<(), Exit> {
    replace(path, junit(name, run, result).as_bytes(), "--junit").map_err(|failure| fail(Exit::Failure, failure))
}

/// Writes the file that an option names, and its directory if that is missing.
fn replace(path: &Path, content: &[u8], option: &str) -> Result<(), Failure> {
    let directory = path.parent().filter(|parent| !parent.as_os_str().is_empty());
    let made = directory.map_or(Ok(()), files::create_directories);
    made.and_then(|()| files::write(path, content)).map_err(|error| {
        let reason = format!("cannot write {}: {error}; name another file with {option}", path.display());
        Failure::new("cannot-write", reason)
    })
}

/// Writes the trace of a finished run, if `--trace-out` is given.
fn write_trace(arguments: &Arguments, directory: &Path, late: Option<&LateReport>) -> Result<(), RunFailure> {
    let (Some(out), Some(late)) = (&arguments.trace_out, late) else { return Ok(()) };
    perfetto::write(directory, late, out).map_err(|(exit, failure)| RunFailure { exit, failure })?;
    if !arguments.quiet {
        remark(&format!("{}: open it at https://ui.perfetto.dev", out.display()));
    }
    Ok(())
}

/// Runs a scenario, writes its results and prints its table. The returned outcome owns files that are removed on drop.
fn attempt(arguments: &Arguments, scenario: &Scenario) -> Result<(Summary, Outcome), RunFailure> {
    let broken = |failure: Failure| RunFailure { exit: Exit::Failure, failure };
    let unwritten = |error: &dyn std::fmt::Display| {
        broken(Failure::new("cannot-write", format!("{error}; name another directory with --out")))
    };
    let started = SystemTime::now();
    let directory =
        make_directory(arguments.out.as_deref(), &scenario.name, started).map_err(|error| unwritten(&error))?;
    let run = scenario.run.expect("the caller has set it");
    // Held to the end, so that no other run writes to the directory.
    let claim = claim(&directory, run, arguments.overwrite).map_err(|error| match error {
        ResultsError::Directory { .. } => RunFailure::new(Exit::Failure, error),
        _ => RunFailure::new(Exit::Usage, error),
    })?;
    if let Some(names) = claim.removed_names().filter(|_| !arguments.quiet) {
        remark(&format!("removed from {}: {names}", directory.display()));
    }
    // Replaces an older trace, in case this process is killed.
    arguments.trace_out.as_deref().map_or(Ok(()), |out| replace(out, b"", "--trace-out")).map_err(broken)?;
    let signal = catch_signals().map_err(broken)?;
    let bodies = scenario.bodies.clone();
    let level = match arguments {
        Arguments { quiet: true, .. } => Verbosity::Quiet,
        Arguments { verbose: true, .. } => Verbosity::Verbose,
        _ => Verbosity::Usual,
    };
    let events = arguments.events;
    let join_command = arguments.listen.as_ref().map(|address| arguments.keys.join_command(address));
    let mut screen = Screen::new(bodies, level, events, join_command);
    screen.print_verbose(format_args!("results go to {}", directory.display()));
    if scenario.clock == ClockKind::Realtime && screen.level > Verbosity::Quiet {
        warn_ungranted(scenario);
        warn_unfit(scenario);
    }
    let outcome = crate::launch::run(
        scenario,
        &mut Launch {
            external: arguments.external.clone(),
            record: scenario.record.then(|| directory.join("run.mcap")),
            results: std::fs::canonicalize(&directory).ok(),
            foxglove: arguments.foxglove,
            host: arguments.seat().map_err(|failure| RunFailure { exit: Exit::Usage, failure })?,
            require_realtime: arguments.require_rt,
            checkpoints: true,
            signal: &signal,
            progress: &mut |progress| screen.show(progress),
        },
    );
    screen.clear();
    let outcome = outcome.map_err(|error| RunFailure::new(exit_of(&error), error))?;
    let summary = Summary::new(scenario, &outcome, started);
    let written = write_run(&directory, scenario, &summary, outcome.late.as_ref());
    let reported = report(arguments, &summary, &directory);
    written.map_err(|error| unwritten(&format_args!("cannot write the results: {error}")))?;
    if let Err(error) = make_latest(&directory) {
        remark(&format!("runs/latest does not link to this run: {error}; name {} instead", directory.display()));
    }
    reported.map_err(broken)?;
    write_trace(arguments, &directory, outcome.late.as_ref())?;
    Ok((summary, outcome))
}

/// Prints the privileges that the machine does not grant, with a remedy, because the run may miss deadlines without them.
fn warn_ungranted(scenario: &Scenario) {
    if let Some((lacking, command)) = Machine::at(Path::new("/")).ungranted(&scenario.realtime) {
        let text = format!("not granted: {lacking}; to grant it to this shell, run `{command}`");
        remark(&Failure::new("not-granted", text));
    } else if scenario.realtime.priority > 0
        && let Some(error) = refused_priority(scenario.realtime.priority)
    {
        let (priority, remedy) = (scenario.realtime.priority, priority_remedy(Path::new("/")));
        remark(&Failure::new("not-granted", format!("not granted: SCHED_FIFO {priority}: {error}; {remedy}")));
    }
}

/// Prints in one line what about the machine causes late ticks. The privileges have a line of their own.
fn warn_unfit(scenario: &Scenario) {
    let checks = Machine::at(Path::new("/")).examine(&Demand::new(scenario)).into_iter();
    let bad = checks.filter(|check| check.verdict == doctor::Verdict::Bad && !check.name.ends_with(" limit"));
    let bad: Vec<String> = bad.map(|check| format!("{} ({})", check.name, check.found)).collect();
    if scenario.realtime.priority > 0 && !bad.is_empty() {
        remark(&format!("ticks may be late on this machine: {}; `corotate doctor` has the remedies", bad.join(", ")));
    }
}

fn report(arguments: &Arguments, summary: &Summary, directory: &Path) -> Result<(), Failure> {
    let text = if arguments.quiet {
        String::new()
    } else {
        format!("{}results in {}\n", table(summary, arguments.verbose), directory.display())
    };
    if arguments.events {
        text.lines().for_each(tell);
        for incident in &summary.incidents {
            event("incident", serde_json::json!({ "incident": incident }))?;
        }
        event("results", serde_json::json!({ "directory": directory, "accepted": summary.accepted }))
    } else if arguments.json {
        text.lines().for_each(tell);
        print(&format!("{}\n", serde_json::to_string(summary).expect("a summary of plain values is JSON")))
    } else {
        print(&text)
    }
}

/// Prints the last line of a run to the stream of the table.
fn print_verdict(verdict: &Verdict, arguments: &Arguments) -> Result<(), Failure> {
    let (word, color) = verdict.word;
    if arguments.events {
        event("verdict", serde_json::json!({ "word": word, "reason": verdict.reason, "exit": verdict.exit.code() }))?;
    }
    if arguments.events && arguments.quiet {
        return Ok(());
    }
    if arguments.json || arguments.events {
        tell(format_args!("{}: {}", paint(word, color, &io::stderr()), verdict.reason));
        return Ok(());
    }
    print(&format!("{}: {}\n", paint(word, color, &io::stdout()), verdict.reason))
}
