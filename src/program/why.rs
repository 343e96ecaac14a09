//! `corotate why`: prints the late ticks of a run with their causes.

use super::output::{CommandResult, Exit, Failure, fail, harmless, remark, say};
use super::{perfetto, record, runs};
use crate::files;
use crate::late::{ASCII_US, LateReport, LateTick, TickOfRole, folded, header, listing, pattern};
use crate::launch::{LATE, RECORDING, SUMMARY, Summary};
use crate::record::{RecordError, Recording};
use std::collections::BTreeSet;
use std::fmt::Write;
use std::io::ErrorKind;
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};

/// Options of `corotate why`.
#[derive(clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub struct Arguments {
    /// A run's directory, its recording, or latest [default: runs/latest]
    run: Option<PathBuf>,
    /// Print only late ticks that cover this tick
    #[arg(long, value_name = "N")]
    tick: Option<u64>,
    /// Print only late ticks of this role
    #[arg(long, value_name = "ROLE")]
    role: Option<String>,
    /// The largest number of late ticks to print; without --json each with its
    /// whole chain
    #[arg(short = 'n', value_name = "COUNT", default_value = "10")]
    count: NonZeroUsize,
    /// Also write the whole run to this file, as a trace for
    /// ui.perfetto.dev: late ticks, cores, samples if recorded
    #[arg(long, value_name = "FILE")]
    perfetto: Option<PathBuf>,
    /// Print them as one JSON object (corotate/why/v1)
    #[arg(long)]
    json: bool,
}

/// Layout version of the JSON.
const SCHEMA: &str = "corotate/why/v1";

const EXAMPLES: &str = "\
Prints late, missed and starved ticks, the longest delay first. Below each one
are its causes with the time that each explains, and the late tick of another
role that caused it, which is not printed again. `unknown` is the time that no
observed cause explains.

Examples:
  corotate why                     the newest run in runs/
  corotate why runs/pair --tick 3277
                                   every role at that tick
  corotate why run.mcap            a recording alone: the worst 1000 late ticks
  corotate why --role controller -n 50
  corotate why --perfetto trace.json";

/// A run with its late ticks.
struct Run {
    /// The directory or the recording.
    path: PathBuf,
    late: LateReport,
    /// The last tick and the roles, if they are known.
    extent: Option<(u64, Vec<String>)>,
}

/// A late tick as the JSON has it.
#[derive(serde::Serialize)]
struct ShownTick<'a> {
    #[serde(flatten)]
    late: &'a LateTick,
    /// The part of the delay whose cause is unknown, µs.
    unknown_us: f64,
    /// The late ticks that led to this one, the last one first.
    chain: Vec<TickOfRole>,
}

impl<'a> ShownTick<'a> {
    fn new(report: &LateReport, late: &'a LateTick) -> Self {
        let chain = report.chain(late).ticks.into_iter().skip(1);
        let chain = chain.map(|late| TickOfRole { role: late.role.clone(), tick: late.tick }).collect();
        Self { late, unknown_us: late.unknown_us(), chain }
    }
}

/// Executes `corotate why`.
pub fn why(arguments: &Arguments) -> CommandResult {
    let run = open(arguments.run.as_deref()).map_err(|(exit, failure)| fail(exit, failure))?;
    run.check(arguments).map_err(|failure| fail(Exit::Usage, failure))?;
    if let Some(out) = &arguments.perfetto {
        let written = perfetto::write(&run.path, &run.late, out);
        written.map_err(|(exit, failure)| fail(exit, failure))?;
        remark(&format!("{}: open it at https://ui.perfetto.dev", out.display()));
    }
    let selected = run.late.select(arguments.tick, arguments.role.as_deref());
    if arguments.json {
        let shown = &selected[..selected.len().min(arguments.count.get())];
        return say(&json(&run, shown, selected.len()));
    }
    say(&harmless(&text(&run.late, arguments, &selected)))
}

/// Opens the run that the command line names: a directory with results, or a recording alone.
fn open(given: Option<&Path>) -> Result<Run, (Exit, Failure)> {
    let path = runs::results(given).map_err(|failure| (Exit::Usage, failure))?;
    if !path.exists() {
        let text = format!("{} does not exist; name a run's directory", path.display());
        return Err((Exit::Usage, Failure::new("no-such-run", text)));
    }
    if path.is_dir() {
        return open_directory(path);
    }
    let reason = "its clock is not real time, realtime.trace was \"off\", it has no end, or an older version made it";
    open_recording(&path)?.ok_or_else(|| {
        let text = format!("{} has no late ticks: {reason}; name the run's directory", path.display());
        (Exit::Usage, Failure::new("no-late-ticks", text))
    })
}

/// Opens a directory with results.
fn open_directory(directory: PathBuf) -> Result<Run, (Exit, Failure)> {
    let failed = |path: &Path, error| {
        (Exit::Failure, Failure::new("cannot-read", format!("cannot read {}: {error}", path.display())))
    };
    let read = |name: &str| match files::read(&directory.join(name)) {
        Ok(bytes) => Ok(Some(bytes)),
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
        Err(error) => Err(failed(&directory.join(name), error)),
    };
    let summary = read(SUMMARY)?.and_then(|bytes| Summary::parse(std::str::from_utf8(&bytes).ok()?).ok());
    let late = match read(LATE)? {
        Some(bytes) => LateReport::parse(&bytes).map_err(|reason| unreadable(&directory.join(LATE), &reason))?,
        None => {
            let recording = directory.join(RECORDING);
            let recorded = if recording.exists() { open_recording(&recording)? } else { None };
            recorded.ok_or_else(|| (Exit::Usage, missing(&directory, summary.as_ref())))?.late
        }
    };
    if let Some(summary) = summary.as_ref().filter(|summary| summary.run != late.run) {
        let named = |run: Option<_>| run.map_or("a run without an identifier".to_owned(), |run| format!("run {run}"));
        let (a, b) = (named(late.run), named(summary.run));
        let text = format!("in {} {LATE} belongs to {a} and {SUMMARY} to {b}; run again", directory.display());
        return Err((Exit::Usage, Failure::new("two-runs", text)));
    }
    let extent = |summary: Summary| (summary.last_tick, summary.books.roles.into_keys().collect());
    Ok(Run { path: directory, late, extent: summary.map(extent) })
}

/// Opens a recording; returns `None` if it has no late ticks.
fn open_recording(path: &Path) -> Result<Option<Run>, (Exit, Failure)> {
    let refused = |error: RecordError| (record::exit_of(&error), error.into());
    let recording = Recording::open(path).map_err(refused)?;
    // The late ticks of an incomplete recording are whole.
    if let Err(error @ RecordError::Damaged { .. }) = recording.require_whole() {
        return Err(refused(error));
    }
    let late = recording.late_ticks().map_err(|reason| unreadable(path, &reason))?;
    let roles: BTreeSet<&str> = recording.signals().iter().map(|signal| &*signal.role).collect();
    let extent = (recording.info().last_tick, roles.into_iter().map(str::to_owned).collect());
    Ok(late.map(|late| Run { path: path.to_owned(), late, extent: Some(extent) }))
}

fn unreadable(path: &Path, reason: &str) -> (Exit, Failure) {
    let text = format!("cannot read {}: {reason}; run again, or use the version that wrote it", path.display());
    (Exit::Usage, Failure::new("unreadable-late-ticks", text))
}

/// Returns the reason why a directory has no late ticks, with a remedy.
fn missing(directory: &Path, summary: Option<&Summary>) -> Failure {
    let shown = directory.display();
    let Some(summary) = summary else {
        let text = format!("{shown} has no {LATE} and no readable {SUMMARY}; name the directory of a finished run");
        return Failure::new("no-results", text);
    };
    let reason = match summary.clock.as_str() {
        "realtime" => {
            "realtime.trace was \"off\", or an older version made the run; run again with realtime.trace = \"auto\""
                .to_owned()
        }
        clock => format!("no tick is late with clock = \"{clock}\"; run with --clock realtime"),
    };
    Failure::new("no-late-ticks", format!("{shown} has no {LATE}: {reason}"))
}

impl Run {
    /// Checks that the run has the wanted tick and role, as far as this is known.
    fn check(&self, arguments: &Arguments) -> Result<(), Failure> {
        let Some((last_tick, roles)) = &self.extent else { return Ok(()) };
        if let Some(tick) = arguments.tick.filter(|tick| tick > last_tick) {
            let text = format!("--tick {tick}: the last tick of the run is {last_tick}");
            return Err(Failure::new("out-of-range", text));
        }
        let known = |role: &str| {
            roles.iter().any(|known| known == role) || self.late.ticks.iter().any(|late| late.role == role)
        };
        match arguments.role.as_deref().filter(|role| !known(role)) {
            None => Ok(()),
            Some(role) => {
                let text = format!("--role {role}: the run has no such role; its roles are: {}", roles.join(", "));
                Err(Failure::new("unknown-role", text))
            }
        }
    }
}

/// Returns the selected late ticks as text. A tick in the chain of an earlier one is not listed again.
fn text(late: &LateReport, arguments: &Arguments, selected: &[&LateTick]) -> String {
    let (shown, left) = late.heads(selected, arguments.count.get());
    let mut text = folded(&format!("{}: {}", late.scenario, header(late, ASCII_US))) + "\n";
    // Writing to a string does not fail.
    if let Some(note) = &late.note {
        let _ = writeln!(text, "note: {note}");
    }
    if shown.is_empty() {
        let _ = writeln!(text, "{}", nothing(late, arguments));
        return text;
    }
    let _ = write!(text, "\n{}", listing(late, &shown, ASCII_US));
    if left > 0 {
        let _ = writeln!(text, "\n{left} more: -n {} prints them", shown.len() + left);
    }
    if arguments.tick.is_none() && !late.patterns.is_empty() {
        text.push('\n');
        late.patterns.iter().for_each(|found| _ = writeln!(text, "{}", pattern(found)));
    }
    text
}

/// Returns the result in words if no late tick was selected.
fn nothing(late: &LateReport, arguments: &Arguments) -> String {
    let role = arguments.role.as_ref().map_or("any role".to_owned(), |role| format!("role {role}"));
    let which = arguments.tick.map_or("no tick was late".to_owned(), |tick| format!("tick {tick} was not late"));
    let hidden = late.counted.saturating_sub(late.examined) + late.left_out();
    if hidden > 0 {
        let tick = arguments.tick.map_or("no examined late tick".to_owned(), |tick| {
            format!("tick {tick} is not among the examined late ticks")
        });
        return format!("{tick} in {role}; {hidden} were not examined or not recorded");
    }
    format!("{which} in {role}")
}

/// Returns the shown late ticks of all `selected` as JSON.
fn json(run: &Run, shown: &[&LateTick], selected: usize) -> String {
    let late = &run.late;
    let ticks: Vec<_> = shown.iter().map(|tick| ShownTick::new(late, tick)).collect();
    let object = serde_json::json!({
        "schema": SCHEMA,
        "directory": run.path.display().to_string(),
        "run": late.run,
        "scenario": late.scenario,
        "period_us": late.period_us,
        "late_us": late.late_us,
        "source": late.source,
        "note": late.note,
        "counted": late.counted,
        "examined": late.examined,
        "traced": late.traced,
        "selected": selected,
        "ticks": ticks,
        "causes": late.causes,
        "patterns": late.patterns,
        "tracer": late.tracer,
    });
    format!("{object}\n")
}
