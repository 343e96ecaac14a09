//! `corotate run`: runs a scenario and prints its verdict.

use super::campaign;
use super::color::{Color, paint};
use super::foxglove;
use super::hosts::{self, KeyArguments};
use super::output::{Exit, Failure, exit_of, fail, print, remark};
use super::perfetto;
use super::scenario::{Change, changed, load, stem};
use super::shipped::name;
use super::signals::{catch_signals, die_with};
use crate::config::{BodyInfo, ClockKind, RunId};
use crate::doctor::{self, Demand, Machine};
use crate::files;
use crate::hosts::{Address, HostEndpoint};
use crate::late::LateReport;
use crate::launch::{
    Action, Launch, Outcome, Progress, ResultsError, Summary, check_cores, claim, exact, junit, make_directory,
    make_latest, new_run, table, tick_words, write_run,
};
use crate::runtime::{priority_remedy, refused_priority};
use crate::scenario::Scenario;
use crate::seat::seat_path;
use crate::system::tell;
use indicatif::{ProgressBar, ProgressStyle};
use std::collections::BTreeMap;
use std::io;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

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
    #[arg(long, value_name = "S", allow_negative_numbers = true)]
    duration: Option<String>,
    /// Ticks per second, Hz
    #[arg(long, value_name = "HZ", allow_negative_numbers = true)]
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
            verdict.print(arguments).map_or_else(|error| fail(Exit::Failure, error), |()| verdict.exit)
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
    let (level, events) = (Verbosity::new(arguments), arguments.events);
    let join_command = arguments.listen.as_ref().map(|address| arguments.keys.join_command(address));
    let mut screen =
        Screen { bar: None, instructed: false, bodies, level, last_phase: String::new(), events, join_command };
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

/// The verdict of a finished run: exit code and last line.
struct Verdict {
    exit: Exit,
    word: (&'static str, Color),
    reason: String,
}

impl Verdict {
    fn with(exit: Exit, word: (&'static str, Color), reason: impl Into<String>) -> Self {
        Self { exit, word, reason: reason.into() }
    }

    /// Judges a run and prints its problems to stderr. The reason always counts missed, starved and safe ticks.
    fn new(summary: &Summary) -> Self {
        let verdict = Self::without_ticks(summary);
        let ticks = tick_words(&summary.books);
        let reason = if ticks.is_empty() { verdict.reason } else { format!("{}; {ticks}", verdict.reason) };
        Self { reason, ..verdict }
    }

    fn without_ticks(summary: &Summary) -> Self {
        if !summary.books.balanced {
            let exit = fail(
                Exit::Failure,
                Failure::new("unbalanced", "the counters do not balance: samples or ticks are unaccounted for"),
            );
            return Self::with(exit, FAIL, "the counters do not balance");
        }
        if let Some(stopped) = summary.incidents.iter().find(|incident| incident.action == Action::Stopped) {
            // A run in one thread has not printed it yet.
            if stopped.panic.is_some() && summary.clock == "in-process" {
                remark(stopped);
            }
            let why = stopped.panic.as_ref().map_or(String::new(), |panic| format!(": {panic}"));
            return Self::with(Exit::ProcessLost, FAIL, format!("the role {} was lost{why}", stopped.role));
        }
        if let Some(problem) = summary.recording.as_ref().and_then(|recording| recording.problem.as_ref()) {
            let exit = fail(
                Exit::Failure,
                Failure::new("incomplete-recording", format!("the recording is incomplete: {problem}")),
            );
            return Self::with(exit, FAIL, "the recording is incomplete");
        }
        let broken: Vec<_> = summary.criteria.iter().filter(|criterion| criterion.holds == Some(false)).collect();
        for criterion in &broken {
            let value = criterion.value.map_or("not measured".to_owned(), exact);
            let role = criterion.role.as_ref().map_or(String::new(), |role| format!("{role}: "));
            let text = format!("accept.{}: {role}{value}, limit {}", criterion.name, exact(criterion.limit));
            remark(&Failure::new("not-met", text));
        }
        let ended = (summary.signal != 0).then(|| format!("stopped by signal {}", summary.signal));
        ended.iter().for_each(|ended| remark(&Failure::new("interrupted", ended)));
        let signal = (summary.signal != 0).then_some(Exit::Signal(summary.signal));
        match summary.accepted {
            Some(true) => {
                let held = summary.criteria.iter().filter(|criterion| criterion.holds == Some(true)).count();
                let left = match summary.criteria.len() - held {
                    0 => String::new(),
                    left => format!(", {left} not judged"),
                };
                Self::with(signal.unwrap_or(Exit::Ok), PASS, format!("{}{left}", counted(held, "holds", "hold")))
            }
            Some(false) => {
                let reason = format!("{} of {} not met", broken.len(), counted(summary.criteria.len(), "", ""));
                Self::with(signal.unwrap_or(Exit::NotAccepted), FAIL, reason)
            }
            None => {
                let reason = summary.verdict.strip_prefix("not judged: ").unwrap_or(&summary.verdict);
                Self::with(signal.unwrap_or(Exit::Ok), NOT_JUDGED, ended.as_deref().unwrap_or(reason))
            }
        }
    }

    /// Prints the last line to the stream of the table.
    fn print(&self, arguments: &Arguments) -> Result<(), Failure> {
        let (word, color) = self.word;
        if arguments.events {
            event("verdict", serde_json::json!({ "word": word, "reason": self.reason, "exit": self.exit.code() }))?;
        }
        if arguments.events && arguments.quiet {
            return Ok(());
        }
        if arguments.json || arguments.events {
            tell(format_args!("{}: {}", paint(word, color, &io::stderr()), self.reason));
            return Ok(());
        }
        print(&format!("{}: {}\n", paint(word, color, &io::stdout()), self.reason))
    }
}

const PASS: (&str, Color) = ("PASS", Color::Green);
const FAIL: (&str, Color) = ("FAIL", Color::Red);
const NOT_JUDGED: (&str, Color) = ("NOT JUDGED", Color::Yellow);

/// Returns the number of criteria with a verb in singular or plural.
fn counted(count: usize, singular: &str, plural: &str) -> String {
    let text = if count == 1 { format!("1 criterion {singular}") } else { format!("{count} criteria {plural}") };
    text.trim_end().to_owned()
}

/// Prints an event as a line of JSON.
fn event(name: &str, mut fields: serde_json::Value) -> Result<(), Failure> {
    fields["schema"] = "corotate/event/v1".into();
    fields["event"] = name.into();
    print(&format!("{fields}\n"))
}

/// The amount of output during a run.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Verbosity {
    /// Nothing.
    Quiet,
    /// A progress bar on a terminal, and instructions for the user.
    Usual,
    /// Also the directory and the phases.
    Verbose,
}

impl Verbosity {
    fn new(arguments: &Arguments) -> Self {
        match arguments {
            Arguments { quiet: true, .. } => Self::Quiet,
            Arguments { verbose: true, .. } => Self::Verbose,
            _ => Self::Usual,
        }
    }
}

/// Output during a run: a progress bar on a terminal, instructions, phases and events.
struct Screen {
    bar: Option<ProgressBar>,
    /// True once the user has instructions for missing roles or hosts.
    instructed: bool,
    /// The bodies of the scenario; a device cannot replace a fleet.
    bodies: Vec<BodyInfo>,
    level: Verbosity,
    /// The last printed phase.
    last_phase: String,
    /// True if events are printed.
    events: bool,
    /// The command by which other hosts join, without the host's name.
    join_command: Option<String>,
}

impl Screen {
    fn show(&mut self, progress: &Progress<'_>) {
        self.print_phase(progress);
        match progress {
            _ if self.level == Verbosity::Quiet => {}
            Progress::Waiting { hosts, .. } if !hosts.is_empty() && !self.instructed => {
                self.instructed = true;
                let join_command = self.join_command.as_deref().unwrap_or_default();
                for host in hosts {
                    tell(format_args!("waiting for host {host}: run there\n  {} {join_command} --host {host}", name()));
                }
            }
            Progress::Waiting { external, domain, .. } if !external.is_empty() && !self.instructed => {
                self.instructed = true;
                for role in external {
                    tell(format_args!("waiting for {role}: start it with\n  {}", self.by_hand(role, domain)));
                    let seat = seat_path(domain, role);
                    tell(format_args!("or pass this seat to your own program\n  {}", seat.display()));
                }
            }
            Progress::Waiting { .. } => {}
            Progress::External(words) => match &self.bar {
                Some(bar) => bar.suspend(|| tell(words)),
                None => tell(words),
            },
            Progress::Running { tick, last_tick, metric } => {
                let bar = self.bar.get_or_insert_with(|| bar(*last_tick));
                bar.set_position(*tick);
                bar.set_message(if metric.is_nan() { "-".to_owned() } else { format!("{metric:.2e}") });
            }
        }
    }

    /// Prints each phase of a run once, as text with `--verbose` and as events.
    fn print_phase(&mut self, progress: &Progress<'_>) {
        let phase = match progress {
            Progress::Waiting { domain, hosts, .. } if !hosts.is_empty() => {
                format!("the run's domain is {}; waiting for {}", domain.display(), hosts.join(", "))
            }
            Progress::Waiting { domain, .. } => format!("the run's domain is {}", domain.display()),
            Progress::Running { last_tick, .. } => format!("running ticks 0 to {last_tick}"),
            Progress::External(words) if self.events => {
                // As below.
                let _ = event("notice", serde_json::json!({ "text": words }));
                return;
            }
            Progress::External(_) => return,
        };
        if phase != self.last_phase {
            self.print_verbose(format_args!("{phase}"));
            self.last_phase = phase;
            if self.events {
                // A failure to print is reported at the end of the run.
                let _ = match progress {
                    Progress::Waiting { external, domain, hosts, .. } => {
                        let seat = |role: &&str| (role.to_string(), seat_path(domain, role));
                        let seats: BTreeMap<String, PathBuf> = external.iter().map(seat).collect();
                        event("waiting", serde_json::json!({ "domain": domain, "seats": seats, "hosts": hosts }))
                    }
                    Progress::Running { last_tick, .. } => {
                        event("running", serde_json::json!({ "last_tick": last_tick }))
                    }
                    Progress::External(_) => Ok(()),
                };
            }
        }
    }

    fn print_verbose(&self, words: std::fmt::Arguments<'_>) {
        if self.level == Verbosity::Verbose {
            remark(&words);
        }
    }

    fn by_hand(&self, role: &str, domain: &Path) -> String {
        let (name, domain) = (name(), domain.display());
        let fleets = self.bodies.iter().any(|body| body.fleet.is_some());
        let further = || self.bodies.iter().skip(1).filter(|body| body.observer.is_some());
        let observed = further().find(|body| body.observer.as_deref() == Some(role));
        let (command, device) = match (role, observed) {
            ("observer", _) => (role.to_owned(), !fleets),
            ("controller", _) => (role.to_owned(), !fleets && !further().any(|body| body.driven)),
            (_, Some(body)) => (format!("observer --body {}", body.name), true),
            (body, None) => {
                let fleet = self.bodies.iter().any(|info| info.name == body && info.fleet.is_some());
                (format!("plant --body {body}"), body != "leader" && !fleet)
            }
        };
        let by_hand = format!("{name} {command} --domain {domain}");
        let bridge =
            || format!("\nor connect a device with\n  {name} bridge --serial PATH --role {role} --domain {domain}");
        if device { by_hand + &bridge() } else { by_hand }
    }

    fn clear(&mut self) {
        if let Some(bar) = self.bar.take() {
            bar.finish_and_clear();
        }
    }
}

fn bar(last_tick: u64) -> ProgressBar {
    let style = ProgressStyle::with_template("{bar:40} tick {pos}/{len} {eta} left, error {msg}");
    // Drawn on stderr, and only if that is a terminal.
    ProgressBar::new(last_tick).with_style(style.expect("the template is a constant that parses"))
}
