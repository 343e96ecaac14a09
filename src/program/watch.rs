//! `corotate watch`: shows a running loop on the terminal.

use super::output::{CommandResult, Exit, fail, say};
use super::runs;
use super::signals::catch_signals;
use crate::sample::RoleState;
use crate::watch::{Model, RoleLine, Session, WatchError, show, text};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

/// Options of `corotate watch`.
#[derive(clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub struct Arguments {
    /// The run's results directory or domain [default: your newest run]
    #[arg(value_name = "DIR")]
    domain: Option<PathBuf>,
    /// Show the inputs in the place of the signals, to change them
    #[arg(long, conflicts_with = "once")]
    tune: bool,
    /// Watch for S seconds (2 if left out), print one screen of 80 by 24, exit
    #[arg(long, value_name = "S", num_args = 0..=1, default_missing_value = "2", value_parser = seconds)]
    once: Option<f64>,
    /// With --once: print the screen as one JSON object (corotate/watch/v1)
    #[arg(long, requires = "once")]
    json: bool,
}

/// Layout version of the JSON.
const SCHEMA: &str = "corotate/watch/v1";

fn seconds(text: &str) -> Result<f64, String> {
    let seconds = text.parse().ok().filter(|seconds| (0.1..=86_400.0).contains(seconds));
    seconds.ok_or_else(|| "give 0.1 to 86400 s".to_owned())
}

const EXAMPLES: &str = "\
Keys: q: quit; space: pause; up, down, tab: select a signal; left, right:
scroll its fields; t: the inputs, which change by a typed number and Enter, or
by left and right; u: undo. Latencies are median/99 % of the last 4096 samples, from the
samples' stamps: due-sent from the tick's due time to the sending of the role's
sample, in-sent from the sending of the input to that of the role's sample.
In real time a line has the number of late ticks, and the last one's cause.

Examples:
  corotate run & corotate watch    your newest run
  corotate watch runs/pair         the run started by `run --out runs/pair`
  corotate watch --tune            change gains and set points
  corotate watch --once 5 > screen.txt
                                   one screen as text, after five seconds";

/// Watches until the user quits or `--once` has elapsed.
pub fn watch(arguments: &Arguments) -> CommandResult {
    let signal = catch_signals().map_err(|error| fail(Exit::Failure, error))?;
    let domain = runs::domain(arguments.domain.as_deref())?;
    attempt(arguments, &domain, &signal).map_err(|error| fail(exit_of(&error), error))
}

fn attempt(arguments: &Arguments, domain: &Path, signal: &AtomicUsize) -> Result<Exit, WatchError> {
    let received = || signal.load(Ordering::Relaxed);
    let mut session = match Session::open(Some(domain), || received() != 0) {
        Err(_) if received() != 0 => return Ok(Exit::Signal(received())),
        opened => opened?,
    };
    match arguments.once {
        None => show(&mut session, arguments.tune, signal)?,
        Some(seconds) => {
            session.follow((seconds * 1e9) as u64, || received() != 0)?;
            if let Err(exit) = say(&if arguments.json { json(&session.model) } else { text(&session.model, 80, 24) }) {
                return Ok(exit);
            }
        }
    }
    Ok(match received() {
        0 => Exit::Ok,
        number => Exit::Signal(number),
    })
}

/// Returns the contents of the screen as JSON. A number that is not finite is null.
fn json(model: &Model) -> String {
    let role = |role: &RoleLine| {
        let state = RoleState::NAMES.into_iter().find(|(_, state)| *state == role.state).map(|(name, _)| name);
        let latency = |window: Option<[f64; 2]>| window.map(|[p50, p99]| serde_json::json!({ "p50": p50, "p99": p99 }));
        serde_json::json!({
            "role": role.name,
            "state": state,
            "life": role.generation,
            "tick": role.tick,
            "rate_hz": role.rate.per_s(),
            "missed": role.missed,
            "due_sent_us": latency(role.lateness.percentiles_us()),
            "in_sent_us": latency(role.step.percentiles_us()),
        })
    };
    let fields = |fields: &[(String, String)]| fields.iter().cloned().collect::<BTreeMap<_, _>>();
    let object = serde_json::json!({
        "schema": SCHEMA,
        "scenario": model.scenario,
        "clock": model.clock,
        "domain": model.domain,
        "tick": model.tick,
        "last_tick": model.last_tick,
        "ended": model.ended,
        "roles": model.roles.iter().map(role).collect::<Vec<_>>(),
        "late": model.late,
        "pace": model.pace.map(|pace| serde_json::json!({
            "state": <&str>::from(pace.state),
            "phase_error_us": pace.phase_error_ns as f64 / 1e3,
            "drift_ppm": pace.drift_ppm,
            "slips": pace.slips,
        })),
        "errors": model.series.iter().map(|series| (&series.name, series.last)).collect::<BTreeMap<_, _>>(),
        "events": model.events.iter().map(|event| serde_json::json!({ "tick": event.tick, "text": event.text })).collect::<Vec<_>>(),
        "signals": model.signals.iter().map(|signal| (&signal.name, fields(&signal.fields))).collect::<BTreeMap<_, _>>(),
    });
    format!("{object}\n")
}

fn exit_of(error: &WatchError) -> Exit {
    match error {
        WatchError::Domain(_) | WatchError::Run(_) | WatchError::Terminal { .. } => Exit::Usage,
        WatchError::Join { .. } | WatchError::Bus(_) => Exit::Failure,
    }
}
