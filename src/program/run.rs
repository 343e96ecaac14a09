//! `corotate run`: one scenario from file to verdict.

use super::campaign;
use super::color::{Color, paint};
use super::foxglove;
use super::hosts::{self, KeyArguments};
use super::output::{Exit, Failure, exit_of, fail, print, remark};
use super::scenario::{Change, changed, load, stem};
use super::shipped::name;
use super::signals::catch_signals;
use crate::config::{ClockKind, RunId};
use crate::doctor::Machine;
use crate::files;
use crate::hosts::{Address, HostEndpoint};
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
    /// Run this case of a campaign; SCENARIO is the campaign's name or file
    #[arg(long, value_name = "N", requires = "file")]
    case: Option<u64>,
    /// What drives the ticks
    #[arg(long, value_name = "CLOCK", value_parser = ["realtime", "lockstep", "in-process"])]
    clock: Option<String>,
    /// Length of the run, s
    #[arg(long, value_name = "S", allow_negative_numbers = true)]
    duration: Option<String>,
    /// Ticks per second, Hz
    #[arg(long, value_name = "HZ", allow_negative_numbers = true)]
    tick_hz: Option<String>,
    /// Override a key, as leader.measured_axes=[1,3]
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Directory for the results [default: runs/<utc>-<name>]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Remove the files of an earlier run from the directory for the results
    #[arg(long, requires = "out", hide_short_help = true)]
    overwrite: bool,
    /// Do not run without every privilege that the scenario asks for
    #[arg(long, hide_short_help = true)]
    require_rt: bool,
    /// Do not start this role: wait for somebody else to
    #[arg(long, value_name = "ROLE")]
    external: Vec<String>,
    /// Print this role's process before the first tick, and wait for a debugger that continues it (several: a,b)
    #[arg(long, value_name = "ROLE", value_parser = role_list, hide_short_help = true)]
    debug: Option<String>,
    /// Write the verdict as JUnit XML, one test case per criterion
    #[arg(long, value_name = "FILE", hide_short_help = true)]
    junit: Option<PathBuf>,
    /// Record every sample to run.mcap beside the results
    #[arg(long)]
    record: bool,
    /// Show every signal live on a Foxglove WebSocket, at IP:PORT; without ADDR at 127.0.0.1:8765
    #[arg(long, hide_short_help = true, value_name = "ADDR", num_args = 0..=1, default_missing_value = foxglove::ADDRESS, value_parser = foxglove::address)]
    foxglove: Option<SocketAddr>,
    /// Be this host of the scenario's, and wait for the others to join
    #[arg(long, value_name = "NAME", requires = "listen", hide_short_help = true)]
    host: Option<String>,
    /// Where the others join: quic/HOST:PORT, or tcp/ or udp/ on loopback
    #[arg(long, value_name = "ADDR", requires = "host", hide_short_help = true)]
    listen: Option<Address>,
    #[command(flatten)]
    keys: KeyArguments,
    /// Print the summary as JSON, all else on stderr
    #[arg(long)]
    json: bool,
    /// Tell programs what happens, on stdout, each event as one line of JSON (corotate/event/v1)
    #[arg(long, conflicts_with = "json")]
    events: bool,
    /// Print nothing but errors and the last line
    #[arg(short, long, conflicts_with = "verbose")]
    quiet: bool,
    /// Print the whole table, and on stderr the phases
    #[arg(short, long)]
    verbose: bool,
}

const EXAMPLES: &str = "\
A name always means the scenario that ships with the program, as
`corotate init --list` tells them; a file in this directory is meant by ./NAME
or NAME.toml. runs/latest leads to the newest run in runs/.

The last line is PASS if every criterion of [accept] that was judged holds, FAIL
if one does not or the run was not sound, NOT JUDGED if nothing was broken but
the run is no proof: no criteria, stopped, shorter than settled_by_s, not scored.
It names ticks that roles missed, starved or were safe at. It ends the table on
stdout; with --json it is on stderr. A run that could not begin has an error.

Examples:
  corotate run rigid-trio          a scenario that ships with the program
  corotate run pair.toml           a file: four processes in real time; a table,
                                   and runs/<utc>-<name>/
  corotate init rigid-pair | corotate run - --clock lockstep
                                   as fast as the machine goes, the same bits
  corotate run pair.toml --record --set follower.0.initial_rate_rad_s=[1,0,0]
                                   every sample to run.mcap, another start
  corotate run pair.toml --external follower
                                   wait for hardware in the follower's seat
  corotate run pair.toml --junit verdict.xml --require-rt
                                   as a test, where real time is granted";

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

    fn scenario(&self) -> Result<Scenario, Failed> {
        let loaded = match (self.case, &self.file) {
            (Some(case), Some(file)) => campaign::load(file, &[]).and_then(|campaign| {
                let document = campaign::case(&campaign, case)?;
                Ok(changed(document, self.changes())?)
            }),
            _ => load(self.file.as_deref(), self.changes()),
        };
        let unusable = |failure| Failed { exit: Exit::Usage, failure };
        let scenario = loaded.map_err(unusable)?;
        self.check_external(&scenario)
            .and_then(|()| self.check_foxglove(&scenario))
            .and_then(|()| self.check_host(&scenario))
            .and_then(|()| Ok(check_cores(&scenario)?))
            .map_err(unusable)?;
        Ok(scenario)
    }

    fn check_foxglove(&self, scenario: &Scenario) -> Result<(), Failure> {
        let in_thread = "a run in one thread has nothing that another process could show; take --clock lockstep";
        let in_thread = (scenario.clock == ClockKind::InProcess).then_some(("one-process", in_thread));
        let refused = foxglove::refusal().map(|reason| ("built-without", reason)).or(in_thread);
        let refused = refused.filter(|_| self.foxglove.is_some());
        refused.map_or(Ok(()), |(code, reason)| Err(Failure::new(code, format!("--foxglove: {reason}"))))
    }

    /// This host's part in a run over several.
    fn seat(&self) -> Result<Option<HostEndpoint>, Failure> {
        let (Some(host), Some(address)) = (&self.host, &self.listen) else {
            return if self.keys.any() {
                Err(Failure::new("unused-keys", "--tls-… and --insecure are for --listen"))
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
            return refuse("one-process", "one thread has one host; give --clock realtime or lockstep".to_owned());
        }
        if !self.external.is_empty() {
            let reason = "somebody else's role has no part in a run over several hosts; leave it out, or --external";
            return refuse("external-with-hosts", reason.to_owned());
        }
        if let Some(role) = scenario.debug.iter().find(|role| scenario.hosts.host_of(role) != Some(&host)) {
            let reason = format!("the {role} of launch.debug is on another host; debug the roles of this one");
            return refuse("debugged-elsewhere", reason);
        }
        match names.contains(&host.as_str()) {
            true => Ok(()),
            false if names.is_empty() => {
                refuse("no-hosts", "the scenario has no [[host]]; name hosts and their roles there".to_owned())
            }
            false => refuse("no-such-host", format!("the scenario has no such host; it has: {}", names.join(", "))),
        }
    }

    fn check_external(&self, scenario: &Scenario) -> Result<(), Failure> {
        let check = |role: &String| {
            let checked = scenario.check_external(role);
            checked.map_err(|error| Failure::prefixed(format_args!("--external {role}"), error))
        };
        self.external.iter().try_for_each(check)
    }
}

/// Returns names that commas separate as a list of a scenario file.
fn role_list(names: &str) -> Result<String, std::convert::Infallible> {
    let names: Vec<String> = names.split(',').map(|name| format!("{:?}", name.trim())).collect();
    Ok(format!("[{}]", names.join(", ")))
}

/// Why a run has no verdict.
struct Failed {
    exit: Exit,
    failure: Failure,
}

impl Failed {
    fn new(exit: Exit, error: impl Into<Failure>) -> Self {
        Self { exit, failure: error.into() }
    }
}

/// Runs a scenario.
pub fn run(arguments: &Arguments) -> Exit {
    let run = match new_run() {
        Ok(run) => run,
        Err(error) => {
            let reason = "a sandbox may forbid getrandom: allow it";
            let reason = format!("the run gets no identifier: no random numbers: {error}; {reason}");
            return fail(Exit::Failure, Failure::new("no-random-numbers", reason));
        }
    };
    let loaded = arguments.scenario().map(|mut scenario| {
        scenario.run = Some(run);
        scenario
    });
    let name = loaded.as_ref().map_or_else(|_| stem(arguments.file.as_deref()), |scenario| scenario.name.clone());
    let write_verdict = |ended| arguments.junit.as_deref().map_or(Ok(()), |path| write_junit(path, &name, run, ended));
    // Whoever reads the file finds no older verdict, however this run ends.
    if let Err(exit) = write_verdict(Err("the run did not come to an end")) {
        return exit;
    }
    let ended = loaded.and_then(|scenario| attempt(arguments, &scenario));
    let told = ended.as_ref().map(|(summary, _)| summary);
    let reason = ended.as_ref().err().map(|failed| failed.failure.to_string()).unwrap_or_default();
    let written = write_verdict(told.map_err(|_| reason.as_str()));
    let exit = match ended {
        Ok((summary, _)) => {
            let verdict = Verdict::of(&summary);
            verdict.tell(arguments).map_or_else(|error| fail(Exit::Failure, error), |()| verdict.exit)
        }
        Err(Failed { exit, failure }) => fail(exit, failure),
    };
    match (written, exit) {
        (Err(failed), Exit::Ok) => failed,
        _ => exit,
    }
}

fn write_junit(path: &Path, name: &str, run: RunId, ended: Result<&Summary, &str>) -> Result<(), Exit> {
    let directory = path.parent().filter(|parent| !parent.as_os_str().is_empty());
    let made = directory.map_or(Ok(()), files::create_directories);
    made.and_then(|()| files::write(path, junit(name, run, ended).as_bytes()))
        .map_err(|error| format!("{}: {error}; name another file with --junit", path.display()))
        .map_err(|reason| fail(Exit::Failure, Failure::new("cannot-write", reason)))
}

/// Runs a scenario, and writes and tells what came of it. The outcome is given too: it holds what is still to be removed.
fn attempt(arguments: &Arguments, scenario: &Scenario) -> Result<(Summary, Outcome), Failed> {
    let broken = |failure: Failure| Failed { exit: Exit::Failure, failure };
    let unwritten = |error: &dyn std::fmt::Display| {
        broken(Failure::new("cannot-write", format!("{error}; name another directory with --out")))
    };
    let started = SystemTime::now();
    let directory =
        make_directory(arguments.out.as_deref(), &scenario.name, started).map_err(|error| unwritten(&error))?;
    let run = scenario.run.expect("it was given before");
    // Kept to the end: no other run writes to the directory meanwhile.
    let claim = claim(&directory, run, arguments.overwrite).map_err(|error| match error {
        ResultsError::Directory { .. } => Failed::new(Exit::Failure, error),
        _ => Failed::new(Exit::Usage, error),
    })?;
    if let Some(names) = claim.removed_names().filter(|_| !arguments.quiet) {
        remark(&format!("removed from {}: {names}", directory.display()));
    }
    let signal = catch_signals().map_err(broken)?;
    let fleets = scenario.rig.bodies().iter().filter(|body| body.fleet.is_some());
    let fleets = fleets.map(|body| body.name.to_string()).collect();
    let (level, events) = (Level::of(arguments), arguments.events);
    let joins = arguments.listen.as_ref().map(|address| arguments.keys.join_words(address));
    let mut screen = Screen { bar: None, asked: false, fleets, level, told: String::new(), events, joins };
    screen.tell_verbose(format_args!("results go to {}", directory.display()));
    if scenario.clock == ClockKind::Realtime && screen.level > Level::Quiet {
        tell_ungranted(scenario);
    }
    let outcome = crate::launch::run(
        scenario,
        &mut Launch {
            external: arguments.external.clone(),
            record: scenario.record.then(|| directory.join("run.mcap")),
            results: std::fs::canonicalize(&directory).ok(),
            foxglove: arguments.foxglove,
            host: arguments.seat().map_err(|failure| Failed { exit: Exit::Usage, failure })?,
            require_realtime: arguments.require_rt,
            checkpoints: true,
            signal: &signal,
            progress: &mut |progress| screen.show(progress),
        },
    );
    screen.clear();
    let outcome = outcome.map_err(|error| Failed::new(exit_of(&error), error))?;
    let summary = Summary::new(scenario, &outcome, started);
    let written = write_run(&directory, scenario, &summary);
    let reported = report(arguments, &summary, &directory);
    written.map_err(|error| unwritten(&format_args!("cannot write the results: {error}")))?;
    if let Err(error) = make_latest(&directory) {
        remark(&format!("runs/latest does not lead to this run: {error}; name {} instead", directory.display()));
    }
    reported.map_err(broken)?;
    Ok((summary, outcome))
}

/// Tells in a line what the machine will not grant, and the command that changes it: before the run, because its deadlines are
/// missed for it.
fn tell_ungranted(scenario: &Scenario) {
    if let Some((lacking, command)) = Machine::at(Path::new("/")).ungranted(&scenario.realtime) {
        let text = format!("not granted: {lacking}; this shell is granted it by `{command}`");
        remark(&Failure::new("not-granted", text));
    } else if scenario.realtime.priority > 0
        && let Some(error) = refused_priority(scenario.realtime.priority)
    {
        let (priority, remedy) = (scenario.realtime.priority, priority_remedy(Path::new("/")));
        remark(&Failure::new("not-granted", format!("not granted: SCHED_FIFO {priority}: {error}; {remedy}")));
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

/// What a run that came to an end is judged: its exit code, and its last line.
struct Verdict {
    exit: Exit,
    word: (&'static str, Color),
    reason: String,
}

impl Verdict {
    fn new(exit: Exit, word: (&'static str, Color), reason: impl Into<String>) -> Self {
        Self { exit, word, reason: reason.into() }
    }

    /// Judges a run, and says on stderr what is wrong with it. Ticks that were missed, starved or safe are always named.
    fn of(summary: &Summary) -> Self {
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
            return Self::new(exit, FAIL, "the counters do not balance");
        }
        if let Some(stopped) = summary.incidents.iter().find(|incident| incident.action == Action::Stopped) {
            // A run in one thread has printed nothing yet.
            if stopped.panic.is_some() && summary.clock == "in-process" {
                remark(stopped);
            }
            let why = stopped.panic.as_ref().map_or(String::new(), |panic| format!(": {panic}"));
            return Self::new(Exit::ProcessLost, FAIL, format!("the {} was lost{why}", stopped.role));
        }
        if let Some(problem) = summary.recording.as_ref().and_then(|recording| recording.problem.as_ref()) {
            let exit = fail(
                Exit::Failure,
                Failure::new("incomplete-recording", format!("the recording is not complete: {problem}")),
            );
            return Self::new(exit, FAIL, "the recording is not complete");
        }
        let broken: Vec<_> = summary.criteria.iter().filter(|criterion| criterion.holds == Some(false)).collect();
        for criterion in &broken {
            let value = criterion.value.map_or("nothing was measured".to_owned(), exact);
            let role = criterion.role.as_ref().map_or(String::new(), |role| format!("{role}: "));
            let text = format!("accept.{}: {role}{value}, limit {}", criterion.name, exact(criterion.limit));
            remark(&Failure::new("not-met", text));
        }
        let ended = (summary.signal != 0).then(|| format!("ended in order by signal {}", summary.signal));
        ended.iter().for_each(|ended| remark(&Failure::new("interrupted", ended)));
        let signal = (summary.signal != 0).then_some(Exit::Signal(summary.signal));
        match summary.accepted {
            Some(true) => {
                let held = summary.criteria.iter().filter(|criterion| criterion.holds == Some(true)).count();
                let left = match summary.criteria.len() - held {
                    0 => String::new(),
                    left => format!(", {left} not judged"),
                };
                Self::new(signal.unwrap_or(Exit::Ok), PASS, format!("{}{left}", counted(held, "holds", "hold")))
            }
            Some(false) => {
                let reason = format!("{} of {} not met", broken.len(), counted(summary.criteria.len(), "", ""));
                Self::new(signal.unwrap_or(Exit::NotAccepted), FAIL, reason)
            }
            None => {
                let reason = summary.verdict.strip_prefix("not judged: ").unwrap_or(&summary.verdict);
                Self::new(signal.unwrap_or(Exit::Ok), NOT_JUDGED, ended.as_deref().unwrap_or(reason))
            }
        }
    }

    /// Prints the last line where the table is.
    fn tell(&self, arguments: &Arguments) -> Result<(), Failure> {
        let (word, color) = self.word;
        if arguments.events {
            event("verdict", serde_json::json!({ "word": word, "reason": self.reason, "exit": self.exit.code() }))?;
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

/// So many criteria, with the verb that goes with the number.
fn counted(count: usize, one: &str, many: &str) -> String {
    let text = if count == 1 { format!("1 criterion {one}") } else { format!("{count} criteria {many}") };
    text.trim_end().to_owned()
}

/// Tells programs of one thing that happened: a line of JSON.
fn event(what: &str, mut about: serde_json::Value) -> Result<(), Failure> {
    about["schema"] = "corotate/event/v1".into();
    about["event"] = what.into();
    print(&format!("{about}\n"))
}

/// How much is said of a run while it goes on.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Level {
    /// Nothing.
    Quiet,
    /// Progress on a terminal, and what a person must do.
    Usual,
    /// Where it is, and each of its phases.
    Verbose,
}

impl Level {
    fn of(arguments: &Arguments) -> Self {
        match arguments {
            Arguments { quiet: true, .. } => Self::Quiet,
            Arguments { verbose: true, .. } => Self::Verbose,
            _ => Self::Usual,
        }
    }
}

/// Progress on a terminal; silence elsewhere, but for what a person must do, or asked to be told.
struct Screen {
    bar: Option<ProgressBar>,
    asked: bool,
    /// The bodies that are many, and that no device can be.
    fleets: Vec<String>,
    level: Level,
    /// What was told last of the phases.
    told: String,
    /// Whether programs are told, too.
    events: bool,
    /// What is typed on another host to join, but for its name; where others can.
    joins: Option<String>,
}

impl Screen {
    fn show(&mut self, progress: &Progress<'_>) {
        self.tell_phase(progress);
        match progress {
            _ if self.level == Level::Quiet => {}
            Progress::Waiting { hosts, .. } if !hosts.is_empty() && !self.asked => {
                self.asked = true;
                let joins = self.joins.as_deref().unwrap_or_default();
                for host in hosts {
                    tell(format_args!("waiting for the host {host}: type there\n  {} {joins} --host {host}", name()));
                }
            }
            Progress::Waiting { external, domain, .. } if !external.is_empty() && !self.asked => {
                self.asked = true;
                for role in external {
                    tell(format_args!("waiting for {role}: start it with\n  {}", self.by_hand(role, domain)));
                    let seat = seat_path(domain, role);
                    tell(format_args!("or give a program of your own the seat\n  {}", seat.display()));
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

    /// Tells each phase of a run once, to whoever wants to know.
    fn tell_phase(&mut self, progress: &Progress<'_>) {
        let phase = match progress {
            Progress::Waiting { domain, hosts, .. } if !hosts.is_empty() => {
                format!("the run's domain is {}; it waits for {}", domain.display(), hosts.join(", "))
            }
            Progress::Waiting { domain, .. } => format!("the run's domain is {}", domain.display()),
            Progress::Running { last_tick, .. } => format!("ticks 0 to {last_tick} run"),
            Progress::External(_) => return,
        };
        if phase != self.told {
            self.tell_verbose(format_args!("{phase}"));
            self.told = phase;
            if self.events {
                // A reader that has gone is told of at the end, when what it lacks is most.
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

    fn tell_verbose(&self, words: std::fmt::Arguments<'_>) {
        if self.level == Level::Verbose {
            remark(&words);
        }
    }

    fn by_hand(&self, role: &str, domain: &Path) -> String {
        let (name, domain) = (name(), domain.display());
        match role {
            "observer" | "controller" if !self.fleets.is_empty() => format!("{name} {role} --domain {domain}"),
            "observer" | "controller" => format!(
                "{name} {role} --domain {domain}\nor put a device there with\n  \
                 {name} bridge --serial PATH --role {role} --domain {domain}"
            ),
            body if body == "leader" || self.fleets.iter().any(|fleet| fleet == body) => {
                format!("{name} plant --body {body} --domain {domain}")
            }
            body => format!(
                "{name} plant --body {body} --domain {domain}\nor put a device there with\n  \
                 {name} bridge --serial PATH --role {body} --domain {domain}"
            ),
        }
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
