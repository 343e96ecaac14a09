//! `corotate replay`: feeds a recording to the roles and compares what they publish.

use super::output::{CommandResult, Exit, Failure, fail, harmless, say};
use super::record::{exit_of, exit_with, open_run};
use super::signals::catch_signals;
use crate::launch::{LaunchError, replay_as_process};
use crate::record::{RecordError, Recording, RoleReplay, replay_in_process};
use crate::runtime::RoleId;
use crate::scenario::Scenario;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

/// Options of `corotate replay`.
#[derive(clap::Args)]
#[command(after_long_help = EXAMPLES)]
pub struct Arguments {
    /// A run's directory, a recording, or latest [default: runs/latest]
    run: Option<PathBuf>,
    /// Replay observer, controller, a body by its name, or all
    #[arg(long, value_name = "ROLE", default_value = "all")]
    role: String,
    /// Replay each role in its own process, as in runs, not in one thread
    #[arg(long)]
    processes: bool,
    /// Accept an incomplete recording
    #[arg(long)]
    accept_incomplete: bool,
    /// Print one JSON object on stdout (corotate/replay/v1)
    #[arg(long)]
    json: bool,
}

/// Layout version of the JSON.
const SCHEMA: &str = "corotate/replay/v1";

const EXAMPLES: &str = "\
Each role gets its recorded inputs, and misses the samples that it missed. All
that it publishes, except times of sending, is compared with the recording. Exit
code 3 if anything differs. Ticks that cannot be compared are printed.

Examples:
  corotate replay                  the newest run in runs/, all roles
  corotate replay runs/20261121T150000Z-rigid-pair
  corotate replay run.mcap --role observer --processes";

/// Executes `corotate replay`.
pub fn replay(arguments: &Arguments) -> CommandResult {
    let (file, recording) = open_run(arguments.run.as_deref(), arguments.accept_incomplete)?;
    // In one thread a signal ends the process.
    let signal = arguments.processes.then(catch_signals).transpose().map_err(|error| fail(Exit::Failure, error))?;
    let replays = attempt(arguments, &recording, signal.as_deref()).map_err(|error| match error {
        LaunchError::Record(error) => fail(exit_of(&error), error),
        error => fail(super::output::exit_of(&error), error),
    })?;
    let number = signal.map_or(0, |signal| signal.load(Ordering::Relaxed));
    if number != 0 {
        let text = "a signal ended the replay before its end";
        return Err(fail(Exit::Signal(number), Failure::new("interrupted", text)));
    }
    let text = || harmless(&replays.iter().map(text).collect::<String>());
    say(&if arguments.json { json(&file, &replays) } else { text() })?;
    let differs = replays.iter().any(|replay| replay.difference.is_some());
    Ok(exit_with(&recording, if differs { Exit::NotAccepted } else { Exit::Ok }))
}

fn attempt(
    arguments: &Arguments,
    recording: &Recording,
    signal: Option<&AtomicUsize>,
) -> Result<Vec<RoleReplay>, LaunchError> {
    let scenario = recording.scenario_for_replay()?;
    recording.check_layouts(&scenario)?;
    let roles = roles(&arguments.role, &scenario)?;
    let Some(signal) = signal else {
        return Ok(roles
            .into_iter()
            .map(|role| replay_in_process(recording, &scenario, role))
            .collect::<Result<_, _>>()?);
    };
    let mut replays = Vec::new();
    for role in roles {
        replays.push(replay_as_process(recording, &scenario, role, signal)?);
        if signal.load(Ordering::Relaxed) != 0 {
            break;
        }
    }
    Ok(replays)
}

fn roles(name: &str, scenario: &Scenario) -> Result<Vec<RoleId>, RecordError> {
    if name == "all" {
        return Ok(RoleId::all(scenario));
    }
    RoleId::named(scenario, name).map(|role| vec![role]).ok_or_else(|| {
        let known = scenario.roles().join(", ");
        RecordError::UnknownRole { role: name.to_owned(), known }
    })
}

/// Returns the results as JSON.
fn json(file: &Path, replays: &[RoleReplay]) -> String {
    let role = |replay: &RoleReplay| {
        let RoleReplay { role, ticks, lives, samples, difference, limit } = replay;
        let difference = difference.as_ref().map(|first| {
            serde_json::json!({
                "tick": first.tick,
                "service": first.service,
                "field": first.field,
                "recorded": first.recorded,
                "replayed": first.replayed,
            })
        });
        let limit = limit.as_ref().map(|limit| serde_json::json!({ "tick": limit.tick, "reason": limit.reason }));
        serde_json::json!({
            "role": role,
            "ticks": ticks,
            "lives": lives,
            "samples": samples,
            "same": difference.is_none(),
            "difference": difference,
            "limit": limit,
        })
    };
    let same = replays.iter().all(|replay| replay.difference.is_none());
    let roles: Vec<_> = replays.iter().map(role).collect();
    let file = file.display().to_string();
    format!("{}\n", serde_json::json!({ "schema": SCHEMA, "file": file, "same": same, "roles": roles }))
}

/// Returns the result of one role as text.
fn text(replay: &RoleReplay) -> String {
    let RoleReplay { role, ticks, lives, samples, difference, limit } = replay;
    let lives = if *lives > 1 { format!(" in {lives} generations") } else { String::new() };
    let verdict = match difference {
        None => "equal bit for bit".to_owned(),
        Some(first) => {
            let field = first.field.as_ref().map_or(String::new(), |field| format!(" {field}"));
            format!(
                "first difference at tick {}, {}{field}:\n  recorded {}\n  replayed {}",
                first.tick, first.service, first.recorded, first.replayed
            )
        }
    };
    let limit = limit
        .as_ref()
        .map_or(String::new(), |limit| format!("  not compared from tick {}: {}\n", limit.tick, limit.reason));
    format!("{role}: {ticks} ticks{lives}, {samples} samples: {verdict}\n{limit}")
}
